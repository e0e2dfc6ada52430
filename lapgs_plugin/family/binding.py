"""Bind the engines as graphdeco's CUDA rasterizers are bound: `forward` and argument checks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from torch import Tensor, nn

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.family.call import Inputs, Settings, ShParts
from lapgs_plugin.family.engine import mark_visible, rasterize

if TYPE_CHECKING:
    from lapgs_plugin.family.variants import Variant


class Rasterizer(nn.Module):
    """Render Gaussians with the settings of one view; see `call.Inputs` for shapes and `Variant.outputs`."""

    variant: ClassVar[Variant]

    def __init__(self, raster_settings: Settings) -> None:
        super().__init__()
        self.raster_settings: Any = raster_settings

    def markVisible(self, positions: Tensor) -> Tensor:
        """Return which points (n, 3) are in front of the camera's near plane, (n,) bool."""
        return mark_visible(self.raster_settings, positions)

    def _render(self, inputs: Inputs) -> tuple[Tensor, ...]:
        settings = self.raster_settings
        return self.variant.outputs(settings, rasterize(settings, inputs, self.variant.options(settings)))


# Each `forward` is written out, here and in `forks`, as CUDA bindings have it: its signature says which checkouts it
# stands in for (`choice`), what it can do (`rasterizers.extensions`), and how positional arguments are called.
class WholeSh(Rasterizer):
    """Take all SH coefficients in one argument."""

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
    ) -> tuple[Tensor, ...]:
        return self._render(
            gather(means3D, means2D, opacities, None, shs, colors_precomp, scales, rotations, cov3D_precomp)
        )


class DcApart(Rasterizer):
    """Take the first SH coefficient apart from the others."""

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
        return self._render(
            gather(means3D, means2D, opacities, dc, shs, colors_precomp, scales, rotations, cov3D_precomp)
        )


def gather(
    means3D: Tensor,
    means2D: Tensor,
    opacities: Tensor,
    dc: Tensor | None = None,
    shs: Tensor | ShParts | None = None,
    colors_precomp: Tensor | None = None,
    scales: Tensor | None = None,
    rotations: Tensor | None = None,
    cov3D_precomp: Tensor | None = None,
) -> Inputs:
    """Return a binding's arguments as `Inputs`; `shs` may be `ShParts`, whatever its type says to checkouts.

    Raises:
        UserInputError: not exactly one of SH and colours, or of scales with rotations and covariances.
    """
    if (shs is None) == (colors_precomp is None):
        raise UserInputError("got both or neither of shs and colors_precomp: expected exactly one of them")
    pair = (scales is not None) + (rotations is not None)
    if pair == 1 or (pair == 2) == (cov3D_precomp is not None):
        raise UserInputError(
            "got both or neither of scales with rotations and cov3D_precomp: expected exactly one of them"
        )
    if isinstance(shs, ShParts):
        dc, shs = shs
    dc = None if shs is None else dc
    return Inputs(means3D, means2D, opacities, dc, shs, colors_precomp, scales, rotations, cov3D_precomp)
