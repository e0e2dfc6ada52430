"""Learn a few numbers for each training view beside the field."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from lapgs_plugin.ops.adam.multi_tensor import MultiTensorAdam

BETAS = (0.8, 0.99)
"""Of Adam, which makes one step in each pass over the views, not one for each view."""


class Processes:
    """Sum gradients over the processes that train the views: this one alone, unless a subclass has others."""

    @property
    def leads(self) -> bool:
        """Whether this process reads and writes the run folder."""
        return True

    def sum_of(self, tensor: Tensor | None, like: Tensor) -> Tensor | None:
        """Return the sum of a tensor over all processes, which is kept; None, on some of several, counts as zeros."""
        return tensor


@dataclass
class ViewTransforms(ABC):
    """Hold and optimize the transforms of all training views during a stage.

    Gradients are added up over one pass through all views; then Adam steps, and `_recentre` sets the transforms' mean
    back. The logarithm of the step size decays linearly over the run.

    Several ranks all hold all transforms, since their mean is set back, and sum the gradients once in a pass.

    Attributes:
        names: of the views.
        transforms: (v, ...) parameter, on the training device.
        done, total: iterations of the run before this stage, and of all stages, for the step size.
        ranks: that train the views.
    """

    STARTS_AT: ClassVar[float] = 0.0
    """Share of the run's iterations before the first step."""
    WARM_UP: ClassVar[float] = 0.0
    """Share of the run's iterations in which the step size grows linearly from 0."""
    EPSILON: ClassVar[float] = 1e-8
    """Of Adam."""

    names: Sequence[str]
    transforms: torch.nn.Parameter  # (v, ...)
    done: int
    total: int
    ranks: Processes = field(init=False, repr=False, default=Processes())  # holds nothing
    _index: dict[str, int] = field(init=False, repr=False)
    _adam: MultiTensorAdam = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._index = {name: index for index, name in enumerate(self.names)}
        self._adam = MultiTensorAdam([self.transforms], lr=self._rates[0], betas=BETAS, eps=self.EPSILON)

    @property
    @abstractmethod
    def _rates(self) -> tuple[float, float]:
        """Adam's step size at the start and the end of a run."""

    @abstractmethod
    def _recentre(self) -> None:
        """Remove in place the common part of all transforms, which the field can express."""

    def after_step(self, iteration: int, views: int) -> None:
        """Step after the views of an iteration if they end a pass through all views.

        Args:
            iteration: the last one, from 1 within the stage.
            views: that the training step took.
        """
        if iteration % len(self.names) >= views:
            return
        progress = min(1.0, (self.done + iteration) / self.total)
        if progress < self.STARTS_AT:
            self.forget_gradients()
            return
        first, last = self._rates
        warmth = progress / self.WARM_UP if progress < self.WARM_UP else 1.0
        self._adam.param_groups[0]["lr"] = warmth * first * (last / first) ** progress
        self.transforms.grad = self.ranks.sum_of(self.transforms.grad, self.transforms)
        self._step()

    def _step(self) -> None:
        self._adam.step()
        self._adam.zero_grad()
        with torch.no_grad():
            self._recentre()

    def forget_gradients(self) -> None:
        """Drop gradients of the pass so far."""
        self._adam.zero_grad()

    def archived(self) -> Any:
        """Return the transforms by view, as they are archived."""
        return dict(zip(self.names, self.transforms.detach().cpu().tolist(), strict=True))

    def state(self) -> dict[str, Any]:
        """Return everything needed to continue to the same bits."""
        return {
            "transforms": self.transforms.detach(),
            "gradient": self.ranks.sum_of(self.transforms.grad, self.transforms),
            "moments": dict(self._adam.state[self.transforms]),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a result of `state` of the same views."""
        device = self.transforms.device
        with torch.no_grad():
            self.transforms.copy_(state["transforms"])
        gradient = state["gradient"] if self.ranks.leads else None  # the sum over all ranks
        self.transforms.grad = None if gradient is None else gradient.to(device, copy=True)
        if moments := state["moments"]:
            self._adam.state[self.transforms] = {
                key: value.clone() if key == "step" else value.to(device, copy=True) for key, value in moments.items()
            }
