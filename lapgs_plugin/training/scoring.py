"""Score the Gaussians of a stage by its training views: their part in errors, and their visibility."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.hierarchy.masks import fill_outside
from lapgs_plugin.hierarchy.pruning import blended_pixels, least_blended
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.runs.profiling import Breakdown
from lapgs_plugin.training.densification import ViewScores
from lapgs_plugin.training.losses import ViewLosses
from lapgs_plugin.training.multiview import SCORED_VIEWS, ScoredView, pixels_and_blame, view_scores
from lapgs_plugin.training.poses import ViewPoses, at_pose
from lapgs_plugin.training.ranks.steps import WholeSteps
from lapgs_plugin.training.views import LevelView, shuffled


@dataclass
class FieldScoring:
    """Render the field once more, also without colours, to score its Gaussians.

    Attributes:
        rasterizer: renders the field.
        views: the training views at the stage's level.
        losses: of the stage.
        poses: refined poses of the views; None without refinement.
        background: (3,) behind the field.
        seed: of the run.
        breakdown: gets the time that this takes.
        steps: of the stage, which say which rank renders a view.
    """

    rasterizer: Rasterizer
    views: Sequence[LevelView]
    losses: ViewLosses
    poses: ViewPoses | None
    background: Tensor
    seed: int
    breakdown: Breakdown
    steps: WholeSteps

    def scores(self, field: GaussianField, iteration: int, degree: int, threshold: float) -> ViewScores:
        """Score Gaussians by some training views, which are a function of the seed and the iteration.

        Args:
            field: without gradients.
            iteration: of the stage.
            degree: of the SH that are active in it.
            threshold: as `pixels_and_blame` takes it.
        """
        photos, ssim_weight = self.losses.images.photos, self.losses.ssim_weight
        chosen = shuffled(len(self.views), self.seed, self.losses.stage.level, iteration)[:SCORED_VIEWS]
        plain, grey = _grey(field)

        def asked(view: LevelView) -> ScoredView:
            with torch.no_grad():
                image = self._render(field, view, degree)
                below, (target, _) = self.losses.below(), photos.get(view.name)
                image = image if below is None else image + below.get(view.name)
                self.breakdown.mark("densification")
                composed = self.losses.as_photographed([view.name], image)
                whole = fill_outside(composed, target, photos.get_weights(view.name))
                loss = photometric_loss(whole, target, ssim_weight)
            return ScoredView(self._render(plain, view, 0), whole, target, loss)

        def summed(part: Sequence[int]) -> list[Tensor]:
            return pixels_and_blame((asked(self.views[index]) for index in part), grey, threshold)

        sums = [summed(part) for part in self.steps.own(chosen)]
        pixels, blame = self.steps.total(sums, lambda: summed(()))
        return view_scores(pixels, blame, len(chosen))

    def least_visible(self, field: GaussianField, share: float) -> Tensor:
        """Return a mask (n,) of Gaussians with negligible visibility in the training views; see `least_blended`."""
        plain, grey = _grey(field)
        own = [self.views[index] for part in self.steps.own(range(len(self.views))) for index in part]
        pixels = blended_pixels((self._render(plain, view, 0) for view in own), grey)
        ranks = self.steps.ranks
        return ranks.as_leader(least_blended(ranks.largest(pixels), share))

    def _render(self, field: GaussianField, view: LevelView, degree: int) -> Tensor:
        camera = at_pose(view, self.poses).camera
        return self.rasterizer.render_image(field, camera, background=self.background, sh_degree=degree)


def _grey(field: GaussianField) -> tuple[GaussianField, Tensor]:
    """Return a field with all colours zero, and its coefficients (n, 1, 3), which get gradients."""
    grey = field.sh.new_zeros(len(field), 1, 3).requires_grad_()
    return replace(field, sh=grey, signed=True), grey
