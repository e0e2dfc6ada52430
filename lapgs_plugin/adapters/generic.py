"""Drive any checkout of the 3DGS family, from what its profile says.

Other adapters derive from this one and say only what is particular about their backbone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lapgs_plugin.adapters.base import BackboneAdapter, BackboneInfo
from lapgs_plugin.checkouts.training_call import TrainingCall

if TYPE_CHECKING:
    from torch import Tensor

OF_A_CALL = {
    "image_height", "image_width", "tanfovx", "tanfovy", "bg", "viewmatrix", "projmatrix", "sh_degree", "campos",
    "scale_modifier", "prefiltered", "debug", "lambda_dssim", "depth_threshold",
}  # fmt: skip
"""Settings of rasterizers that are no property of a run."""


class Adapter(BackboneAdapter):
    """Drive a checkout that no other adapter recognises."""

    info = BackboneInfo(
        name="generic", title="3DGS, a checkout of its own", rasterizer="diff_gaussian_rasterization", stand_in=""
    )

    def render(self, call: TrainingCall, view: Any, gaussians: Any, background: Tensor) -> None:
        # Exposure is left out: images are taken before it is applied.
        self.profile.render(call.values, view, gaussians, background, use_trained_exp=False)

    def raster_settings(self, call: TrainingCall) -> dict[str, Any]:
        """Return settings that options of the script have by name, such as antialiasing."""
        names = {name for use in self.profile.source.rasterizers for name in use.settings} - OF_A_CALL
        values = {
            name: getattr(of, name) for of in (call.dataset, call.opt, call.pipe) for name in names if hasattr(of, name)
        }
        return {name: value for name, value in sorted(values.items()) if isinstance(value, (bool, int, float))}

    def carried_over(self, gaussians: Any) -> dict[str, Any]:
        """Return the exposures, which belong to the photos and not to a level."""
        if not hasattr(gaussians, "_exposure"):
            return {}
        import torch

        return {"_exposure": torch.nn.Parameter(gaussians._exposure.detach().clone())}
