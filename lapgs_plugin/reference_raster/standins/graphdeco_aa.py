"""`diff_gaussian_rasterization` of graphdeco, branch dr_aa: with antialiasing and inverse depths."""

from __future__ import annotations

from torch import Tensor

from lapgs_plugin.reference_raster.standins.binding import RasterizerBase, gather
from lapgs_plugin.reference_raster.standins.engine import Options, rasterize
from lapgs_plugin.reference_raster.standins.settings import settings_class

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]

GaussianRasterizationSettings = settings_class("graphdeco-aa")


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
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the image (3, h, w), the radii (n,) int32 and 1 / depth blended over black (1, h, w)."""
        settings = self.raster_settings
        inputs = gather(means3D, means2D, opacities, None, shs, colors_precomp, scales, rotations, cov3D_precomp)
        output = rasterize(settings, inputs, Options(antialiasing=settings.antialiasing, inverse_depth=True))
        assert output.inverse_depths is not None
        return output.image, output.radii, output.inverse_depths
