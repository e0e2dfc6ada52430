"""Drive Speedy-Splat: it prunes at fixed intervals by how much each Gaussian changes the images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lapgs_plugin.adapters import generic
from lapgs_plugin.adapters.base import BackboneInfo, StageWindow, TrainingCall
from lapgs_plugin.checkouts.attachment import Replacement

PRUNING = ("prune_from_iter", "prune_until_iter", "prune_interval")
"""Options of its schedule of pruning."""


class Adapter(generic.Adapter):
    """Drive a Speedy-Splat checkout.

    The schedule of pruning is scaled to a stage of its own. Its last pruning leaves half an interval to recover: a
    field is archived after the stage's last iteration.
    """

    info = BackboneInfo(
        name="speedy_splat",
        title="Speedy-Splat",
        rasterizer="diff_gaussian_rasterization",
        stand_in="speedy-splat",
        own_files=("compute_scene_metrics.py",),
        fork_of=("graphdeco",),
        density_scores=("score_func",),
    )

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        return all((folder / name).is_file() for name in ("train.py", *cls.info.own_files))

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        changed = super().stage_call(call, window, model_path)
        opt, iterations = changed.opt, window.stage.iterations
        for name in PRUNING:
            setattr(opt, name, max(1, window.scaled(getattr(opt, name))))
        opt.prune_until_iter = min(opt.prune_until_iter, iterations - opt.prune_interval // 2)
        return changed

    def replacements(self, window_of: Callable[[], StageWindow | None]) -> list[Replacement]:
        return [
            Replacement(
                self.train,
                "score_func",
                lambda original: self._scores_alone,
                ("view", "gaussians", "pipeline", "background", "scores"),
                "prune()",
            )
        ]

    def _scores_alone(self, view: Any, gaussians: Any, pipeline: Any, background: Any, scores: Any) -> None:
        """Add a view's scores to `scores` (n, 1), as the checkout does, with gradients by nothing else.

        The checkout's backward pass would add gradients of this image to those of finished fields that are trained
        jointly. Its own field's are lost either way: pruned parameters are new ones.
        """
        import torch

        of_view = torch.zeros_like(scores, requires_grad=True)
        image = self.train.render(view, gaussians, pipeline, background, scores=of_view)["render"]
        (found,) = torch.autograd.grad(image.sum(), of_view)
        scores += found
