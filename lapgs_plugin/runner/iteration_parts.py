"""Which part of an iteration a checkout's training loop is in, told by what it calls.

The loop calls, in the order of an iteration, with what is marked there:

    update_learning_rate                     other             before the rasterizer: views, targets, logging
    GaussianRasterizationSettings            forward           every render makes them first
    the rasterizer returns                   loss              composition, exposure, the loop's own loss
    Tensor.backward                          backward
    density control and its scores           densification     all of it, renders without gradients included
    the step of any optimizer                optimizer

and after each of the last three `other`. All of it passes through replaced symbols that exist only while something is
measured, so that a run without `--breakdown` is the run it was.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import torch
from torch.optim.optimizer import register_optimizer_step_post_hook, register_optimizer_step_pre_hook

from lapgs_plugin.adapters.base import BackboneInfo
from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.runs.profiling import Breakdown, breakdown_on


class IterationParts:
    """Marks the parts of iterations for the stage that runs.

    Args:
        device: where the checkout renders.
        measures: whether anything is measured.
    """

    def __init__(self, device: torch.device, measures: bool) -> None:
        self._device, self._measures = device, measures
        self.breakdown = Breakdown()

    def stage_begins(self) -> None:
        """What is marked from now on belongs to another stage."""
        self.breakdown = breakdown_on(self._device) if self._measures else Breakdown()

    def inner_replacements(self, renderer: ModuleType) -> list[Replacement]:
        """Of what a render looks up; goes before replacements that compose, so that these count as composition."""
        if not self._measures:
            return []
        whoever = "render(), to tell rendering from composition"
        return [
            Replacement(renderer, "GaussianRasterizationSettings", self._settings, None, whoever),
            Replacement(renderer, "GaussianRasterizer", self._rasterizer, None, whoever),
        ]

    def outer_replacements(self, train: ModuleType, info: BackboneInfo) -> list[Replacement]:
        """Of what the loop calls; goes after all other replacements, so that they count as what they surround."""
        if not self._measures:
            return []
        utilities = [module for name, module in sys.modules.items() if name.startswith("utils.")]
        scores = [(m, name) for name in info.density_scores for m in (train, *utilities) if name in vars(m)]
        control = [(train.GaussianModel, name) for name in info.density_control]
        consumer = "training() when it densifies and prunes"
        return [
            Replacement(torch.Tensor, "backward", self._backward, ("self",), "training() after its loss"),
            *(Replacement(owner, name, self._densifying, None, consumer) for owner, name in (*scores, *control)),
        ]

    @contextmanager
    def watching_optimizers(self) -> Iterator[None]:
        """While inside, the step of every optimizer is marked, however many a checkout has."""
        if not self._measures:
            yield
            return
        before = register_optimizer_step_pre_hook(lambda *_: self.breakdown.mark("optimizer"))
        after = register_optimizer_step_post_hook(lambda *_: self.breakdown.mark("other"))
        try:
            yield
        finally:
            before.remove()
            after.remove()

    def _settings(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def make_settings(*args: Any, **kwargs: Any) -> Any:
            if torch.is_grad_enabled():
                self.breakdown.mark("forward")
            return original(*args, **kwargs)

        return make_settings

    def _rasterizer(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def make_rasterizer(raster_settings: Any) -> Any:
            return _TimedRasterizer(original(raster_settings=raster_settings), self)

        return make_rasterizer

    def _backward(self, original: Callable[..., None]) -> Callable[..., None]:
        def backward(tensor: torch.Tensor, *args: Any, **kwargs: Any) -> None:
            self.breakdown.mark("backward")
            original(tensor, *args, **kwargs)
            self.breakdown.mark("other")

        return backward

    def _densifying(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def densify(*args: Any, **kwargs: Any) -> Any:
            with self.breakdown.within("densification"):
                return original(*args, **kwargs)

        return densify


class _TimedRasterizer:
    """A rasterizer of the checkout for one view, after whose call composition begins."""

    def __init__(self, original: Any, parts: IterationParts) -> None:
        self._original, self._parts = original, parts

    def __getattr__(self, name: str) -> Any:
        return getattr(self._original, name)

    def __call__(self, **inputs: Any) -> Any:
        rendered = self._original(**inputs)
        if torch.is_grad_enabled():
            self._parts.breakdown.mark("loss")
        return rendered
