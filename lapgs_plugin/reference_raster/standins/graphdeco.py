"""`diff_gaussian_rasterization` of graphdeco, branch main: image and radii."""

from __future__ import annotations

from torch import Tensor

from lapgs_plugin.reference_raster.standins.binding import RasterizerBase, gather
from lapgs_plugin.reference_raster.standins.engine import Options, rasterize
from lapgs_plugin.reference_raster.standins.settings import settings_class

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]

GaussianRasterizationSettings = settings_class("graphdeco")


class GaussianRasterizer(RasterizerBase):
    """Renders Gaussians; see `engine.Inputs` for shapes."""

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Returns the image (3, h, w) and the radii (n,) int32."""
        settings = self.raster_settings
        inputs = gather(means3D, means2D, opacities, None, shs, colors_precomp, scales, rotations, cov3D_precomp)
        output = rasterize(settings, inputs, Options())
        return output.image, output.radii
