"""Drive Taming-3DGS: densification to a budget of Gaussians, opacities without an upper limit towards the end."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lapgs_plugin.adapters.base import BackboneAdapter, logits_of
from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.source import readable_source
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall
from lapgs_plugin.errors import UserInputError

if TYPE_CHECKING:
    from torch import Tensor

    from lapgs_plugin.fields.gaussian_field import GaussianField

logger = logging.getLogger(__name__)

BASE_SHARE = 0.5
"""Share of the budget that the coarsest level ends with. It has a fraction of the pixels, and less work with fewer
Gaussians."""
FINEST_SHARE = 1.0
"""Share of the budget that the finest level ends with; levels between are interpolated."""

SCORES = "utils.taming_utils"
"""Module of a checkout that scores Gaussians."""

LOW_LOGIT = -1.0
"""Value that tells logits from opacities in a PLY: a trained field has logits down to about -5.3 (opacity 0.005, where
training prunes), and opacities are hardly below 0."""


class Adapter(BackboneAdapter):
    """Drive a Taming-3DGS checkout.

    Both modes of its budget, one of which counts from a stage's first Gaussians, become a final count for each stage.
    """

    info = BackboneInfo(
        name="taming",
        title="Taming-3DGS",
        rasterizer="diff_gaussian_rasterization",
        density_scores=("compute_gaussian_score",),
        own_files=("utils/taming_utils.py",),
        unscaled=("ho_iteration",),
    )

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        """Return whether a folder is the root of its checkout; forks that score otherwise may have kept its file."""
        source = readable_source(folder)
        return super().recognises(folder) and (source is None or SCORES in source.modules)

    @classmethod
    def saved_field(cls, path: Path) -> GaussianField:
        field = super().saved_field(path)
        stored = field.opacity_logits
        if not bool((stored > LOW_LOGIT).all()):
            return field
        # Half way through training it replaces the sigmoid by the absolute value, and saves the value before that.
        return field.with_parameters({"opacity_logits": logits_of(stored.abs())})

    def replacements(self, in_residual: Callable[[], bool]) -> list[Replacement]:
        consumer = "densify_with_score(), which cannot sample nothing"
        model = self.profile.model
        return [
            Replacement(sys.modules[SCORES], "get_loss_map", _with_edges_of_the_level, "compute_gaussian_score()"),
            Replacement(
                model, "densify_with_score", _unless_none_qualifies, "training() when it densifies", ("self", "scores")
            ),
            *(
                Replacement(model, name, _unless_nothing, consumer, ("self", "grads", "budget", "filter"))
                for name in ("densify_and_clone_taming", "densify_and_split_taming")
            ),
        ]

    def refuse(self, call: TrainingCall, residuals: bool) -> None:
        super().refuse(call, residuals)
        if residuals and call.values["args"].benchmark_dir:
            raise UserInputError(
                f"--benchmark_dir {call.values['args'].benchmark_dir}: the checkout would write every stage's timings "
                "over the last one's; leave it out, the manifest holds the time of each stage"
            )

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        changed = super().stage_call(call, window, model_path)
        args, opt = changed.values["args"], changed.opt
        # Its table of counts has one entry an interval; a lookup is past its end unless densification starts and stops
        # at whole intervals.
        opt.densify_from_iter = -(-opt.densify_from_iter // opt.densification_interval) * opt.densification_interval
        intervals = (opt.densify_until_iter - opt.densify_from_iter) // opt.densification_interval
        if intervals < 1:
            raise UserInputError(
                f"level {window.stage.level} would stop densifying at iteration {opt.densify_until_iter} and start "
                f"after {opt.densify_from_iter}, but a budget needs at least one interval of "
                f"{opt.densification_interval} between; raise --iterations, or lower --densify_from_iter "
                "or --densification_interval"
            )
        opt.densify_until_iter = opt.densify_from_iter + intervals * opt.densification_interval
        args.mode, args.budget = "final_count", self._budget(call, window)
        logger.info("level %d may grow to %d Gaussians", window.stage.level, args.budget)
        return changed

    def _budget(self, call: TrainingCall, window: StageWindow) -> int:
        """Return the number of Gaussians that a stage may grow to."""
        args = call.values["args"]
        whole = args.budget * self._points if args.mode == "multiplier" else args.budget
        progress = 1 - window.stage.level / (window.levels - 1)  # 0 for the base, 1 for the finest
        return int(whole * (BASE_SHARE + (FINEST_SHARE - BASE_SHARE) * progress))

    def resume(self, call: TrainingCall, gaussians: Any, iteration: int) -> None:
        if iteration < call.opt.densify_until_iter:
            raise UserInputError(
                f"--resume: the budget of {self.info.title} counts from the first Gaussians of a call of its training, "
                f"which would start again at iteration {iteration + 1}, before --densify_until_iter "
                f"{call.opt.densify_until_iter}; start again with --overwrite"
            )
        if 0 < call.values["args"].ho_iteration <= iteration:
            import torch

            with torch.no_grad():  # as its training does
                gaussians.modify_functions()

    def first_points(self, count: int) -> None:
        self._points = count


def _with_edges_of_the_level(original: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Find the edges of a photo again if they are of another size: training() finds those of all views at its start."""

    def get_loss_map(
        reconstructed_image: Tensor, original_image: Tensor, config: Any, edges_loss_norm: Tensor
    ) -> Tensor:
        if edges_loss_norm.shape != original_image.shape[-2:]:
            edges = sys.modules[SCORES].get_edges(original_image).squeeze().to(original_image.device)
            edges_loss_norm = (edges - edges.min()) / (edges.max() - edges.min())
        return original(reconstructed_image, original_image, config, edges_loss_norm)

    return get_loss_map


def _unless_nothing(original: Callable[..., None]) -> Callable[..., None]:
    """Skip densification without a budget, where an inherited field has as many Gaussians as it may."""

    def densify(gaussians: Any, grads: Tensor, budget: int, filter: Tensor, *others: Any) -> None:
        if budget > 0:
            original(gaussians, grads, budget, filter, *others)

    return densify


def _unless_none_qualifies(original: Callable[..., None]) -> Callable[..., None]:
    """Skip densification if no Gaussian qualifies: the checkout divides by their number.

    Gradients of a residual are near zero at first, as its colours are.
    """

    def densify_with_score(gaussians: Any, *args: Any, **kwargs: Any) -> None:
        try:
            original(gaussians, *args, **kwargs)
        except ZeroDivisionError:  # raised before anything is changed
            logger.info("no Gaussian qualifies for densification")

    return densify_with_score
