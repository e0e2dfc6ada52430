"""`diff_gaussian_rasterization_fastgs`: with the compact box and the count of marked pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.reference_raster.standins.binding import RasterizerBase, SparseGaussianAdam, gather
from lapgs_plugin.reference_raster.standins.engine import Options, rasterize
from lapgs_plugin.reference_raster.standins.settings import settings_class

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam"]

GaussianRasterizationSettings = settings_class("fastgs")


class GaussianRasterizer(RasterizerBase):
    """Renders Gaussians; see `engine.Inputs` for shapes."""

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        dc: Tensor | None = None,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the image (3, h, w), the radii (n,) int32 and, if `get_flag`, in how many marked pixels each Gaussian
        is blended (n,) int32, or an empty tensor. `means2D` is (n, 4): its gradient's last two columns are sums over
        pixels of the first two's absolute values.
        """
        settings = self.raster_settings
        inputs = gather(means3D, means2D, opacities, dc, shs, colors_precomp, scales, rotations, cov3D_precomp)
        weights = (settings.metric_map == 1).float() if settings.get_flag else None
        output = rasterize(settings, inputs, Options(mult=settings.mult, pixel_weights=weights))
        counts = torch.empty(0, dtype=torch.int32)
        if output.contributions is not None:
            counts = torch.from_numpy(output.contributions.weights).int()
        return output.image, output.radii, counts
