"""Drive DashGaussian: renders that grow with training, and a budget of Gaussians that follows their size.

Its scheduler is made from the images and Gaussians that training starts with. A stage that starts with inherited
Gaussians would render smaller than the level below it, and grow to six times what it inherited.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall

SCHEDULER = "utils.schedule_utils"
"""Module of its scheduler, which only `train_dash.py` imports."""


class Adapter(BackboneAdapter):
    """Drive a DashGaussian checkout, whose plain `train.py` needs nothing of this.

    A residual is rendered at its level's size. It starts with as many Gaussians as it may have, and the budget grows by
    those that qualify for densification, as it does in the checkout. Nested levels keep the checkout's own schedule.
    """

    info = BackboneInfo(
        name="dashgaussian",
        title="DashGaussian",
        rasterizer="diff_gaussian_rasterization",
        stand_in="graphdeco-accel",  # its submodule, which its published runs need for --optimizer_type sparse_adam
        own_files=("train_dash.py", "utils/schedule_utils.py"),
        family_files=(),
        fork_of=("graphdeco",),
    )

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        changed = super().stage_call(call, window, model_path)
        if window.stage.signed and hasattr(changed.pipe, "resolution_mode"):
            # Its learning rates wait for the renders to reach full size, which they have.
            changed.pipe.resolution_mode = "const"
        return changed

    def replacements(self, in_residual: Callable[[], bool]) -> list[Replacement]:
        if SCHEDULER not in sys.modules:
            return []
        scheduler = sys.modules[SCHEDULER].TrainingScheduler
        later, start = "training() when it densifies", "training() at its start"
        return [
            Replacement(scheduler, "get_res_scale", partial(_full_size, in_residual), later, ("self", "iteration")),
            Replacement(
                scheduler, "__init__", partial(_budget, in_residual), start, ("self", "opt", "pipe", "gaussians")
            ),
        ]


def _full_size(in_residual: Callable[[], bool], original: Callable[[Any, int], int]) -> Callable[[Any, int], int]:
    """Render residuals at the full size of their level."""

    def get_res_scale(self: Any, iteration: int) -> int:
        return 1 if in_residual() else original(self, iteration)

    return get_res_scale


def _budget(in_residual: Callable[[], bool], original: Callable[..., None]) -> Callable[..., None]:
    """Start a field that inherits Gaussians with a budget of as many, and without the momentum of five times that."""

    def __init__(self: Any, opt: Any, pipe: Any, gaussians: Any, *others: Any, **more: Any) -> None:
        original(self, opt, pipe, gaussians, *others, **more)
        if in_residual() and self.momentum != -1:  # -1: the user set the budget
            self.momentum, self.max_n_gaussian = 0, self.init_n_gaussian

    return __init__
