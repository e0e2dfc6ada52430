"""FastGS: multi-view scores for densification and pruning, a compact box, an optimizer that steps ever more rarely.

It hard-codes two schedules by iteration. Late pruning is rescaled to a stage, which would never reach it. When the
optimizer steps is left alone: it counts from 1 in each stage, as in the paper authors' release.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter, BackboneInfo, StageWindow, TrainingCall
from lapgs_plugin.checkouts.attachment import Replacement

LATE_PRUNING_FROM, LATE_PRUNING_EVERY = 1 / 2, 1 / 10
"""When FastGS prunes late, as shares of the iterations: hard-coded there for 30,000."""

LATE_MIN_OPACITY = 0.1
"""Opacity below which its late pruning removes Gaussians."""


class FastGSAdapter(BackboneAdapter):
    """Drives a FastGS checkout. Its score functions see composed images and each level's ground truth by themselves,
    because both are put in place below them; what is adapted here is its late pruning.
    """

    info = BackboneInfo(
        name="fastgs",
        title="FastGS",
        rasterizer="diff_gaussian_rasterization_fastgs",
        stand_in="fastgs",
        density_control=("densify_and_prune_fastgs", "reset_opacity", "final_prune_fastgs"),
        density_scores=("compute_gaussian_score_fastgs",),
        color_rates=("lowfeature_lr", "highfeature_lr"),
        densify_thresholds=("grad_thresh", "grad_abs_thresh"),
        raster_defaults={"mult": 0.5},
    )

    def render(self, call: TrainingCall, view: Any, gaussians: Any, background: Tensor) -> None:
        self.train.render_fastgs(view, gaussians, call.pipe, background, call.opt.mult)

    def raster_settings(self, call: TrainingCall) -> dict[str, Any]:
        return {"mult": call.opt.mult}

    def passes_dc_apart(self, call: TrainingCall) -> bool:
        return True

    def replacements(self, window_of: Callable[[], StageWindow | None]) -> list[Replacement]:
        model = self.train.GaussianModel
        return [
            Replacement(
                model,
                "update_learning_rate",
                lambda original: self._with_late_pruning(original, window_of),
                ("self", "iteration"),
                "training() at the start of every iteration",
            ),
            Replacement(
                self.train,
                "compute_gaussian_score_fastgs",
                lambda original: _scores_for_densification_only(original, window_of),
                ("camlist", "gaussians", "pipe", "bg", "args", "DENSIFY"),
                "training() when it densifies, and when it prunes at hard-coded iterations",
            ),
            Replacement(
                model,
                "final_prune_fastgs",
                _unless_unscored,
                ("self", "min_opacity", "pruning_score"),
                "training() at hard-coded iterations",
            ),
        ]

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        self._stage = super().stage_call(call, window, model_path)
        return self._stage

    def stage_scene(self, scene: Any) -> None:
        self._scene = scene

    def _with_late_pruning(
        self, original: Callable[[Any, int], Any], window_of: Callable[[], StageWindow | None]
    ) -> Callable[[Any, int], Any]:
        """Before an iteration begins, prune if the one that just ended is due. There the optimizer has stepped, so
        that no gradient or radius of an iteration is left that belongs to the Gaussians before the pruning.
        """

        def update_learning_rate(gaussians: Any, iteration: int) -> Any:
            window = window_of()
            if window is not None and late_pruning_due(iteration - 1, window.stage.iterations):
                self._prune_late(gaussians)
            return original(gaussians, iteration)

        return update_learning_rate

    @torch.no_grad()
    def _prune_late(self, gaussians: Any) -> None:
        """What the training loop does at its hard-coded iterations."""
        utils, opt, pipe = sys.modules["utils.fast_utils"], self._stage.opt, self._stage.pipe
        cameras = utils.sampling_cameras(self._scene.getTrainCameras().copy())
        background = torch.full((3,), float(self._stage.dataset.white_background), device=gaussians._xyz.device)
        _, score = utils.compute_gaussian_score_fastgs(cameras, gaussians, pipe, background, opt)
        gaussians.tmp_radii = None  # pruning reads what only a densification before it would have set
        gaussians.final_prune_fastgs(min_opacity=LATE_MIN_OPACITY, pruning_score=score)


def late_pruning_due(iteration: int, iterations: int) -> bool:
    """Whether FastGS's late pruning follows this iteration of a stage of so many.

    >>> [i for i in range(1, 30_001) if late_pruning_due(i, 30_000)]
    [18000, 21000, 24000, 27000]
    """
    every = max(1, round(iterations * LATE_PRUNING_EVERY))
    return iteration % every == 0 and iterations * LATE_PRUNING_FROM < iteration < iterations


def _scores_for_densification_only(
    original: Callable[..., Any], window_of: Callable[[], StageWindow | None]
) -> Callable[..., Any]:
    """The training loop asks for scores without DENSIFY only at its hard-coded iterations, where nothing is pruned."""

    def compute_gaussian_score_fastgs(
        camlist: Any, gaussians: Any, pipe: Any, bg: Any, args: Any, DENSIFY: bool = False
    ) -> Any:
        if window_of() is not None and not DENSIFY:
            return None, None
        return original(camlist, gaussians, pipe, bg, args, DENSIFY=DENSIFY)

    return compute_gaussian_score_fastgs


def _unless_unscored(original: Callable[..., None]) -> Callable[..., None]:
    def final_prune_fastgs(gaussians: Any, min_opacity: float, pruning_score: Any = None) -> None:
        if pruning_score is not None:
            original(gaussians, min_opacity=min_opacity, pruning_score=pruning_score)

    return final_prune_fastgs
