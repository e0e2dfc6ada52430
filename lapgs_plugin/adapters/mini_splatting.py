"""Drive Mini-Splatting: in mid-training it replaces Gaussians by points at their depths, and keeps a sample of them.

Both make a field anew from the images that it renders. That is right for a field that makes the whole image, and wrong
for a residual, whose Gaussians come from the level below.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.schedule import Schedule
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall

SIMPLIFICATIONS = ("simp_iteration1", "simp_iteration2")
"""Arguments of its script: the iterations after which it simplifies."""

CLOCK, UNLOCK = "update_learning_rate", "oneupSHdegree"
"""Methods of its model that begin an iteration, and unlock an SH degree."""

SH_EVERY = 1000
"""Iterations between two SH degrees."""


class Adapter(BackboneAdapter):
    """Drive a Mini-Splatting checkout.

    The base is simplified at its share of the run's iterations. A residual is neither simplified nor made anew, and
    has SH from its start, which the checkout unlocks after simplification.
    """

    info = BackboneInfo(
        name="mini_splatting",
        title="Mini-Splatting",
        rasterizer="diff_gaussian_rasterization_ms",
        own_files=("ms/train.py",),
        family_files=(),
        fork_of=("graphdeco",),
        unscaled=SIMPLIFICATIONS,
    )

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        self._degree = call.dataset.sh_degree
        changed = super().stage_call(call, window, model_path)
        if not hasattr(changed.values.get("args"), SIMPLIFICATIONS[0]):
            return changed  # gs/train.py is plain 3DGS
        args = changed.values["args"]
        for name in SIMPLIFICATIONS:
            never = window.stage.iterations + 1
            setattr(args, name, never if window.stage.signed else window.scaled(getattr(args, name)))
        return changed

    def replacements(self, in_residual: Callable[[], bool]) -> list[Replacement]:
        model, start = self.profile.model, "Scene, and fields that inherit"
        clock = "training() at the start of every iteration"
        return [
            Replacement(model, "reinitial_pts", partial(_unless, in_residual), "training()", ("self", "pts", "rgb")),
            Replacement(model, "create_from_pcd", partial(self._with_sh, in_residual), start, ("self", "pcd")),
            *(
                [Replacement(model, CLOCK, partial(_unlocking_sh, in_residual), clock, ("self", "iteration"))]
                if self._unlocks_sh_late
                else []
            ),
        ]

    @property
    def _unlocks_sh_late(self) -> bool:
        """Whether the script unlocks SH from some iteration on; its plain 3DGS does so from the first."""
        unlocking = [event for event in Schedule(self.profile.source.training).events if UNLOCK in event.calls]
        return all(any(operand.is_bound for operand in event.operands) for event in unlocking)

    def _with_sh(self, in_residual: Callable[[], bool], original: Callable[..., None]) -> Callable[..., None]:
        """Give a residual all SH coefficients; the checkout makes its model without."""

        def create_from_pcd(gaussians: Any, pcd: Any, *others: Any) -> None:
            if in_residual():
                gaussians.max_sh_degree = self._degree
            original(gaussians, pcd, *others)

        return create_from_pcd


def _unless(in_residual: Callable[[], bool], original: Callable[..., None]) -> Callable[..., None]:
    """Keep a residual's Gaussians where the checkout would make them anew."""

    def reinitial_pts(gaussians: Any, pts: Any, rgb: Any) -> None:
        if not in_residual():
            original(gaussians, pts, rgb)

    return reinitial_pts


def _unlocking_sh(in_residual: Callable[[], bool], original: Callable[[Any, int], Any]) -> Callable[[Any, int], Any]:
    """Unlock a residual's SH at the checkout's interval."""

    def update_learning_rate(gaussians: Any, iteration: int) -> Any:
        if in_residual() and iteration % SH_EVERY == 0:
            gaussians.oneupSHdegree()
        return original(gaussians, iteration)

    return update_learning_rate
