"""Taming-3DGS: densification to a budget of Gaussians, opacities without an upper limit towards the end."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import LARGEST_OPACITY, BackboneAdapter, BackboneInfo, StageWindow, TrainingCall
from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Hierarchy

logger = logging.getLogger(__name__)

BASE_SHARE, FINEST_SHARE = 0.5, 1.0
"""Share of the budget that the coarsest and the finest level end with; stages between lie between.

The base, at a fraction of the pixels, ends with half of it, so that the total work falls. With shares of 0.4 and 0.6
and opacities frozen half way through each stage, bonsai lost 1.4 dB.
"""

LOW_LOGIT = -1.0
"""Logits of a trained field go down to about -5.3, opacity 0.005, where training prunes; opacities kept as they are
hover above 0."""


class TamingAdapter(BackboneAdapter):
    """Drives a Taming-3DGS checkout. Its budget counts from a stage's first number of Gaussians in one of two modes;
    both are turned into a final count for each stage.
    """

    info = BackboneInfo(
        name="taming",
        title="Taming-3DGS",
        rasterizer="diff_gaussian_rasterization",
        stand_in="taming",
        density_control=("densify_with_score", "reset_opacity"),
        density_scores=("compute_gaussian_score",),
        color_rates=("feature_lr", "shfeature_lr"),
        densify_thresholds=("densify_grad_threshold",),
    )

    @staticmethod
    def saved_logits(stored: Tensor) -> Tensor:
        if not bool((stored > LOW_LOGIT).all()):
            return stored
        # Half way through it replaces the sigmoid by the absolute value, and saves what that is taken of.
        return torch.logit(stored.abs().clamp(1 - LARGEST_OPACITY, LARGEST_OPACITY))

    def render(self, call: TrainingCall, view: Any, gaussians: Any, background: Tensor) -> None:
        self.train.render(view, gaussians, call.pipe, background)

    def raster_settings(self, call: TrainingCall) -> dict[str, Any]:
        return {}

    def replacements(self, window_of: Callable[[], StageWindow | None]) -> list[Replacement]:
        consumer = "densify_with_score(), which cannot sample nothing"
        model = self.train.GaussianModel
        return [
            Replacement(
                model, "densify_with_score", _unless_none_qualifies, ("self", "scores"), "training() when it densifies"
            ),
            *(
                Replacement(model, name, _unless_nothing, ("self", "grads", "budget", "filter"), consumer)
                for name in ("densify_and_clone_taming", "densify_and_split_taming")
            ),
        ]

    def passes_dc_apart(self, call: TrainingCall) -> bool:
        return bool(call.pipe.separate_sh)

    def refuse(self, call: TrainingCall, levels: int, hierarchy: Hierarchy) -> None:
        super().refuse(call, levels, hierarchy)
        self._try_lpips(call)
        if levels > 1 and call.values["args"].benchmark_dir:
            raise UserInputError(
                f"--benchmark_dir {call.values['args'].benchmark_dir}: the checkout would write every stage's timings "
                "over the last one's; leave it out, the manifest holds the time of each stage"
            )

    def _try_lpips(self, call: TrainingCall) -> None:
        """Compute an LPIPS if reports will: its networks are downloaded at the first, hours into the training."""
        due = [i for i in call.values["testing_iterations"] if 0 < i <= call.opt.iterations]
        if not due or not hasattr(self.train, "lpips"):
            return
        image = torch.zeros(1, 3, 64, 64)
        try:
            with torch.no_grad(), torch.random.fork_rng():  # drawing their first weights is not to change the training
                self.train.lpips(image, image, net_type="vgg")
        except Exception as error:  # a package, a download, a damaged file: training would stop at any of them
            raise UserInputError(
                f"--test_iterations {' '.join(map(str, due))}: the checkout computes LPIPS then, which fails now "
                f"already ({type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no message'}); "
                "mend that, or leave these reports out with --test_iterations -1: `lapgs eval` measures the run"
            ) from error

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        changed = super().stage_call(call, window, model_path)
        args, opt = copy.copy(call.values["args"]), changed.opt
        # Its table of counts has one entry an interval, and is looked up beyond its end unless densification starts and
        # stops at whole intervals.
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
        return changed.changed(args=args)

    def _budget(self, call: TrainingCall, window: StageWindow) -> int:
        """Number of Gaussians that a stage may grow to."""
        given = call.values["args"]
        whole = given.budget * self._points if given.mode == "multiplier" else given.budget
        if window.levels == 1:
            return int(whole)
        progress = 1 - window.stage.level / (window.levels - 1)  # 0 for the base, 1 for the finest
        return int(whole * (BASE_SHARE + (FINEST_SHARE - BASE_SHARE) * progress))

    def first_points(self, count: int) -> None:
        self._points = count


def _unless_nothing(original: Callable[..., None]) -> Callable[..., None]:
    """Leave out what would add no Gaussian: a field that inherits can be at its budget, or have none that qualifies."""

    def densify(gaussians: Any, grads: Tensor, budget: int, filter: Tensor, *others: Any) -> None:
        if budget > 0:
            original(gaussians, grads, budget, filter, *others)

    return densify


def _unless_none_qualifies(original: Callable[..., None]) -> Callable[..., None]:
    """Leave out a densification for which no Gaussian qualifies: the checkout divides by how many do.

    A residual's gradients begin near zero, because its colours do.
    """

    def densify_with_score(gaussians: Any, *args: Any, **kwargs: Any) -> None:
        try:
            original(gaussians, *args, **kwargs)
        except ZeroDivisionError:  # raised before anything is changed
            logger.info("no Gaussian qualifies for densification")

    return densify_with_score
