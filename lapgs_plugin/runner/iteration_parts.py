"""Mark the parts of an iteration in a checkout's training loop by the functions that it calls.

In the order of an iteration, each call and the part that begins with it:

    update_learning_rate                     other             before the rasterizer: views, targets, logging
    settings of the rasterizer               forward           the first call of every render
    return of the rasterizer                 loss              composition, exposure, the loop's own loss
    Tensor.backward                          backward
    density control and its scores           densification     including renders without gradients
    step of any optimizer                    optimizer

`other` begins after each of the last three. Without `--breakdown` nothing is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.optim.optimizer import register_optimizer_step_post_hook, register_optimizer_step_pre_hook

from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.profile import Profile
from lapgs_plugin.runner.running_stage import Stages
from lapgs_plugin.runs.profiling import Breakdown


class IterationParts:
    """Mark the parts of iterations of the running stage.

    Args:
        stages: hold the running stage, whose record has its breakdown.
        measures: whether to measure; without it no symbol is replaced.
    """

    def __init__(self, stages: Stages, measures: bool) -> None:
        self._stages, self._measures, self._nothing = stages, measures, Breakdown()

    @property
    def _breakdown(self) -> Breakdown:
        """Seconds of the running stage by part."""
        running = self._stages.running
        return self._nothing if running is None else running.record.breakdown

    def mark_render(self, part: str) -> None:
        """Mark the beginning of a part of a render with gradients: "forward", or "loss" when it has rasterized."""
        if torch.is_grad_enabled():
            self._breakdown.mark(part)

    def replacements(self, profile: Profile, info: BackboneInfo) -> list[Replacement]:
        """Return replacements in the training loop, whose time includes that of all others: they come last."""
        if not self._measures:
            return []
        scores = profile.named(info.density_scores)
        control = [(profile.model, name) for name in profile.density_control]
        consumer = "training() when it densifies and prunes"
        return [
            Replacement(torch.Tensor, "backward", self._backward, "training() after its loss", ("self",)),
            *(Replacement(owner, name, self._densifying, consumer) for owner, name in (*scores, *control)),
        ]

    @contextmanager
    def watching_optimizers(self) -> Iterator[None]:
        """Mark the steps of all optimizers inside."""
        if not self._measures:
            yield
            return
        before = register_optimizer_step_pre_hook(lambda *_: self._breakdown.mark("optimizer"))
        after = register_optimizer_step_post_hook(lambda *_: self._breakdown.mark("other"))
        try:
            yield
        finally:
            before.remove()
            after.remove()

    def _backward(self, original: Callable[..., None]) -> Callable[..., None]:
        def backward(tensor: torch.Tensor, *args: Any, **kwargs: Any) -> None:
            self._breakdown.mark("backward")
            original(tensor, *args, **kwargs)
            self._breakdown.mark("other")

        return backward

    def _densifying(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def densify(*args: Any, **kwargs: Any) -> Any:
            with self._breakdown.within("densification"):
                return original(*args, **kwargs)

        return densify
