"""Drive Speedy-Splat: it prunes at fixed intervals by how much each Gaussian changes the images."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.checkouts.attachment import Replacement


class Adapter(BackboneAdapter):
    """Drive a Speedy-Splat checkout, whose scores must not reach finished fields that are trained jointly."""

    info = BackboneInfo(
        name="speedy_splat",
        title="Speedy-Splat",
        rasterizer="diff_gaussian_rasterization",
        own_files=("compute_scene_metrics.py",),
        family_files=("train.py",),
        fork_of=("graphdeco",),
        density_scores=("score_func",),
    )

    def replacements(self, in_residual: Callable[[], bool]) -> list[Replacement]:
        import torch

        return [
            Replacement(
                self.train,
                "score_func",
                lambda original: self._scores_alone,
                "prune()",
                ("view", "gaussians", "pipeline", "background", "scores"),
            ),
            Replacement(torch.cuda.Event, "elapsed_time", _when_complete, "prune()"),
        ]

    def _scores_alone(self, view: Any, gaussians: Any, pipeline: Any, background: Any, scores: Any) -> None:
        """Add a view's scores to `scores` (n, 1), as the checkout does, with gradients by nothing else.

        The checkout's backward pass would add gradients of this image to those of finished fields that are trained
        jointly. Its own field's are lost either way: pruned parameters are new ones.
        """
        import torch

        of_view = torch.zeros_like(scores, requires_grad=True)
        image = self.train.render(view, gaussians, pipeline, background, scores=of_view)["render"]
        (gradient,) = torch.autograd.grad(image.sum(), of_view)
        scores += gradient


def _when_complete(elapsed_time: Callable[[Any, Any], float]) -> Callable[[Any, Any], float]:
    """Return `torch.cuda.Event.elapsed_time` that waits for the later event instead of failing.

    The checkout's `prune` asks for the time directly after its last kernels, and waits for them nowhere: neither its
    scores nor its pruning do. It finds them done on a GPU of its own. On one that another process uses too, they may
    still wait for their turn.
    """

    @wraps(elapsed_time)
    def waiting(start: Any, end_event: Any) -> float:
        end_event.synchronize()
        return elapsed_time(start, end_event)

    return waiting
