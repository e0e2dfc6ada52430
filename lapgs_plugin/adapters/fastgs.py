"""Drive FastGS: multi-view scores for densification and pruning, compact boxes, an optimizer that skips steps.

FastGS hard-codes two schedules by iteration. Late pruning is rescaled to a stage, which would never reach it. The
optimizer's schedule is left as it is: it counts from 1 in each stage, as in the paper authors' release.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lapgs_plugin.adapters import generic
from lapgs_plugin.adapters.base import BackboneInfo, StageWindow, TrainingCall
from lapgs_plugin.checkouts.attachment import Replacement

if TYPE_CHECKING:
    from lapgs_plugin.fields.rasterizer import Semantics

LATE_PRUNING_FROM, LATE_PRUNING_EVERY = 1 / 2, 1 / 10
"""First late pruning and interval as shares of the iterations; FastGS hard-codes them for 30,000."""

LATE_MIN_OPACITY = 0.1
"""Opacity below which late pruning removes Gaussians."""


class Adapter(generic.Adapter):
    """Drive a FastGS checkout; only its late pruning needs adapting.

    Its score functions get composed images and the level's ground truth, because both are replaced below them.
    """

    info = BackboneInfo(
        name="fastgs",
        title="FastGS",
        rasterizer="diff_gaussian_rasterization_fastgs",
        stand_in="fastgs",
        density_scores=("compute_gaussian_score_fastgs",),
        own_files=("utils/fast_utils.py",),
        fork_of=("taming",),
        raster_defaults={"mult": 0.5},
    )

    @classmethod
    def rasterizer_semantics(cls) -> Semantics:
        from lapgs_plugin.fields.rasterizer import Semantics

        return Semantics(
            three_sigma_cut=False,
            expanded_conic_gradient=True,
            note="tiles by the ellipse alpha = 1/255 (mult = 1), not by three sigma; gradients of needles are right to "
            "a few hundredths",
        )

    def replacements(self, window_of: Callable[[], StageWindow | None]) -> list[Replacement]:
        model = self.profile.model
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
        """Prune before an iteration if the one before it was due.

        By then the optimizer has stepped: no gradient or radius of the pruned Gaussians is used any more.
        """

        def update_learning_rate(gaussians: Any, iteration: int) -> Any:
            window = window_of()
            if window is not None and late_pruning_due(iteration - 1, window.stage.iterations):
                self._prune_late(gaussians)
            return original(gaussians, iteration)

        return update_learning_rate

    def _prune_late(self, gaussians: Any) -> None:
        """Prune as the training loop does at its hard-coded iterations."""
        import torch

        utils, opt, pipe = sys.modules["utils.fast_utils"], self._stage.opt, self._stage.pipe
        cameras = utils.sampling_cameras(self._scene.getTrainCameras().copy())
        background = torch.full((3,), float(self._stage.dataset.white_background), device=gaussians._xyz.device)
        with torch.no_grad():
            _, score = utils.compute_gaussian_score_fastgs(cameras, gaussians, pipe, background, opt)
            gaussians.tmp_radii = None  # pruning reads it, and only densification sets it
            gaussians.final_prune_fastgs(min_opacity=LATE_MIN_OPACITY, pruning_score=score)


def late_pruning_due(iteration: int, iterations: int) -> bool:
    """Return whether late pruning follows an iteration of a stage of `iterations`.

    >>> [i for i in range(1, 30_001) if late_pruning_due(i, 30_000)]
    [18000, 21000, 24000, 27000]
    """
    every = max(1, round(iterations * LATE_PRUNING_EVERY))
    return iteration % every == 0 and iterations * LATE_PRUNING_FROM < iteration < iterations


def _scores_for_densification_only(
    original: Callable[..., Any], window_of: Callable[[], StageWindow | None]
) -> Callable[..., Any]:
    """Skip scores for late pruning: the loop asks for them, without DENSIFY, at its hard-coded iterations."""

    def compute_gaussian_score_fastgs(
        camlist: Any, gaussians: Any, pipe: Any, bg: Any, args: Any, DENSIFY: bool = False
    ) -> Any:
        if window_of() is not None and not DENSIFY:
            return None, None
        return original(camlist, gaussians, pipe, bg, args, DENSIFY=DENSIFY)

    return compute_gaussian_score_fastgs


def _unless_unscored(original: Callable[..., None]) -> Callable[..., None]:
    """Skip late pruning without scores."""

    def final_prune_fastgs(gaussians: Any, min_opacity: float, pruning_score: Any = None) -> None:
        if pruning_score is not None:
            original(gaussians, min_opacity=min_opacity, pruning_score=pruning_score)

    return final_prune_fastgs
