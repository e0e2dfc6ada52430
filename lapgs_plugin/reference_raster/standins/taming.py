"""`diff_gaussian_rasterization` of Taming-3DGS, branch main: with the sums that Gaussians are scored by."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.reference_raster.standins.binding import RasterizerBase, SparseGaussianAdam, gather
from lapgs_plugin.reference_raster.standins.engine import Options, rasterize
from lapgs_plugin.reference_raster.standins.settings import settings_class

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam"]

GaussianRasterizationSettings = settings_class("taming")


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
    ) -> tuple[Tensor, ...]:
        """Returns 13 tensors: image (3, h, w), radii (n,), counts (h, w) that the CUDA code leaves at zero, three empty
        lists, centres (n, 2), depths (n,), radii again; then, if there are two rows of pixel weights or more, sums over
        the pixels a Gaussian is blended in: of their weights, of 1, of its share in the pixel, of the distance from its
        centre in pixels; otherwise four empty tensors.
        """
        settings = self.raster_settings
        inputs = gather(means3D, means2D, opacities, dc, shs, colors_precomp, scales, rotations, cov3D_precomp)
        weights = settings.pixel_weights
        size = 0 if weights is None else len(weights)  # the CUDA code asks for rows, not for pixels
        output = rasterize(settings, inputs, Options(pixel_weights=weights if size > 1 else None))
        counts = torch.zeros((settings.image_height, settings.image_width) if size else 0, dtype=torch.int32)
        lists = torch.empty(0, dtype=torch.int32), torch.empty(0), torch.empty(0)
        sums = torch.empty(0), torch.empty(0, dtype=torch.int32), torch.empty(0), torch.empty(0)
        if output.contributions is not None:
            found = output.contributions
            sums = (
                torch.from_numpy(found.weights).float(), torch.from_numpy(found.counts),
                torch.from_numpy(found.blending).float(), torch.from_numpy(found.distances).float(),
            )  # fmt: skip
        return output.image, output.radii, counts, *lists, output.centres, output.depths, output.radii.clone(), *sums
