"""Sum what the views of a step add up to: gradients of the fields, and statistics of density control."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.training.densification import DensityControl
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.ranks.steps import WholeSteps

Renders = Sequence[tuple[RenderResult, Camera]]
"""Arguments of `DensityControl.accumulate`."""


class StepSums:
    """Take the gradients and statistics of each part of a step's views, and give the fields their sums over all ranks.

    Args:
        steps: of the stage.
    """

    def __init__(self, steps: WholeSteps) -> None:
        self._steps = steps
        self._parts: dict[int, tuple[list[Tensor | None], dict[str, Tensor]]] = {}
        self._columns: dict[str, tuple[int, ...]] | None = None  # of each statistic, as soon as a rank has one

    def take(self, part: int, models: Sequence[TrainableField], densifier: DensityControl, renders: Renders) -> None:
        """Take what a part's views added up to, and leave no gradients.

        Args:
            part: its number.
            models: that have the gradients.
            densifier: accumulates the renders.
            renders: of the part, after their backward passes.
        """
        gradients = []
        for param in _parameters(models):
            gradients.append(param.grad)
            param.grad = None
        self._parts[part] = gradients, _statistics(densifier, renders)

    def forget(self) -> None:
        """Drop what was taken."""
        self._parts.clear()

    def give(
        self, number: int, models: Sequence[TrainableField], densifier: DensityControl, with_statistics: bool
    ) -> None:
        """Give models their gradients, summed over all ranks, and add statistics to those of density control.

        Args:
            number: of parts of a step.
            models, densifier: see `take`.
            with_statistics: whether a view of the step has any, on whichever rank.
        """
        parameters, count = _parameters(models), len(models[0])
        columns = self._layout() if with_statistics else {}

        def zeros() -> list[Tensor]:
            some = parameters[0].detach()
            gradients = [torch.zeros_like(param, requires_grad=False) for param in parameters]
            return [*gradients, *(some.new_zeros(count, *shape) for shape in columns.values())]

        def tensors(part: int) -> list[Tensor] | None:
            if part not in self._parts:
                return None
            gradients, statistics = self._parts[part]
            own = [*gradients, *(statistics.get(name) for name in columns)]
            if all(tensor is not None for tensor in own):
                return [tensor for tensor in own if tensor is not None]
            return [zero if tensor is None else tensor for tensor, zero in zip(own, zeros(), strict=True)]

        total = self._steps.total([tensors(part) for part in range(number)], zeros)
        self.forget()
        for param, gradient in zip(parameters, total, strict=False):
            param.grad = gradient
        for name, added in zip(columns, total[len(parameters) :], strict=True):
            before = densifier.state[name]
            densifier.state[name] = added if before is None else before.add_(added)

    def _layout(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the statistics' rows by name, which a rank without a view in this step does not know."""
        if self._columns is None:
            own = {name: tuple(values.shape[1:]) for _, taken in self._parts.values() for name, values in taken.items()}
            known = {name: shape for one in self._steps.ranks.gathered(own) for name, shape in one.items()}
            self._columns = dict(sorted(known.items()))
        return self._columns


def _parameters(models: Sequence[TrainableField]) -> list[torch.nn.Parameter]:
    return [param for model in models for param in model.params.values()]


def _statistics(densifier: DensityControl, renders: Renders) -> dict[str, Tensor]:
    """Return the statistics of some renders alone, by name."""
    kept: dict[str, Any] = {
        name: value for name, value in densifier.state.items() if value is None or isinstance(value, Tensor)
    }
    densifier.state |= dict.fromkeys(kept)
    for result, camera in renders:
        densifier.accumulate(result, camera)
    own = {name: densifier.state[name] for name in kept}
    densifier.state |= kept
    return {name: value for name, value in own.items() if value is not None}
