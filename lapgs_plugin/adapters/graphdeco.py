"""The graphdeco 3DGS repository, with either of its rasterizers: exposure, depth supervision, masks, sparse Adam."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter, BackboneInfo, StageWindow, TrainingCall, shrunk
from lapgs_plugin.errors import UserInputError


class GraphdecoAdapter(BackboneAdapter):
    """Drives a checkout of the graphdeco repository.

    Its render applies the exposure of a view and clamps to [0, 1] after the rasterizer, so both act on the composed
    image. Depth supervises the base alone: a residual's opacity says where detail is missing, not where surfaces are.
    """

    info = BackboneInfo(
        name="graphdeco",
        title="graphdeco 3DGS",
        rasterizer="diff_gaussian_rasterization",
        stand_in="graphdeco-accel",
        density_control=("densify_and_prune", "reset_opacity"),
        color_rates=("feature_lr",),
    )

    def render(self, call: TrainingCall, view: Any, gaussians: Any, background: Tensor) -> None:
        # Without exposure: predictions of finished levels lie before it.
        self.train.render(
            view, gaussians, call.pipe, background, separate_sh=self.train.SPARSE_ADAM_AVAILABLE, use_trained_exp=False
        )

    def raster_settings(self, call: TrainingCall) -> dict[str, Any]:
        return {"antialiasing": call.pipe.antialiasing}

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        changed = super().stage_call(call, window, model_path)
        opt = changed.opt
        if window.stage.signed:
            opt.depth_l1_weight_init = opt.depth_l1_weight_final = 0.0
        return changed

    def level_view(self, view: Any, original: Any, size: tuple[int, int], signed: bool) -> None:
        if original.alpha_mask is not None:
            # Most photos have no mask; without one the training loop saves a pass over the image.
            opaque = bool((original.alpha_mask == 1).all())
            view.alpha_mask = None if opaque else shrunk(original.alpha_mask, size)
        if original.invdepthmap is not None:
            if signed:
                view.invdepthmap, view.depth_mask, view.depth_reliable = None, None, False
            else:
                view.invdepthmap = shrunk(original.invdepthmap, size)
                view.depth_mask = shrunk(original.depth_mask, size)

    def carried_over(self, gaussians: Any) -> dict[str, Any]:
        """Exposures, which belong to the photos and not to a level."""
        return {"_exposure": torch.nn.Parameter(gaussians._exposure.detach().clone())}

    def refuse(self, call: TrainingCall, levels: int) -> None:
        super().refuse(call, levels)
        wanted = call.opt.optimizer_type == "sparse_adam"
        if wanted and not self.train.SPARSE_ADAM_AVAILABLE:
            raise UserInputError(
                "--optimizer_type sparse_adam: the installed diff_gaussian_rasterization has no SparseGaussianAdam; "
                "install the accelerated rasterizer as the checkout's README says, or leave the option out"
            )
