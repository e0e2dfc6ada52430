"""Render splats through a script's `rasterization`: signed colours, and levels composed to an image of any camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField, splats_from_field
from lapgs_plugin.hierarchy.cameras import level_intrinsics
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.upsample import upsample
from lapgs_plugin.rasterizers.gsplat.stock import takes_viewmats

Rasterize = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
"""Signature of gsplat's `rasterization`: images, alphas, and what its strategies need."""
COLORS = 3
"""Channels of a colour."""
DEPTH_ONLY = ("D", "ED")
"""Modes of `rasterization` without colours."""


@dataclass(frozen=True)
class Rasterizer:
    """Hold the functions of gsplat that a script renders with.

    Attributes:
        rasterization: the script's.
        spherical_harmonics: of the same package.
    """

    rasterization: Rasterize
    spherical_harmonics: Callable[..., Tensor]

    def render(self, **inputs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Call `rasterization`."""
        return self.rasterization(**inputs)

    def signed(self, **inputs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Call `rasterization` for a residual: raw SH values as colours, over black."""
        degree, coefficients = inputs.pop("sh_degree"), inputs["colors"].float()  # (n, k, 3)
        inputs["colors"] = self._raw_colors(degree, inputs["means"], inputs["viewmats"], coefficients)
        return self.rasterization(**{**inputs, "sh_degree": None, "backgrounds": None})

    def _raw_colors(self, degree: int, means: Tensor, viewmats: Tensor, coefficients: Tensor) -> Tensor:
        """Return raw SH values (c, n, 3) from c cameras."""
        if takes_viewmats(self.spherical_harmonics):
            return self.spherical_harmonics(degree, means, viewmats, coefficients)
        centres = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]  # (c, 3)
        colors = [self.spherical_harmonics(degree, means - centre, coefficients) for centre in centres]
        return torch.stack(colors)


@dataclass(frozen=True)
class FinishedField:
    """Hold a finished level: its splats by gsplat's names, as parameters or plain tensors."""

    level: int
    signed: bool
    splats: Mapping[str, Tensor]

    @classmethod
    def of(cls, level: int, field: GaussianField, device: torch.device) -> FinishedField:
        """Return an archived field on a device."""
        return cls(level, field.signed, {name: value.to(device) for name, value in splats_from_field(field).items()})

    def inputs(self) -> dict[str, Any]:
        """Return the inputs of `rasterization` that are the field's."""
        splats = self.splats
        colors = torch.cat([splats["sh0"], splats["shN"]], 1)
        return {
            "means": splats["means"],
            "quats": splats["quats"],
            "scales": splats["scales"].exp(),
            "opacities": splats["opacities"].sigmoid(),
            "colors": colors,
            "sh_degree": math.isqrt(colors.shape[1]) - 1,
        }


class CoarserLevels:
    """Render the finished levels below a running one and compose them, for any camera.

    Args:
        rasterizer: of the script.
        pyramid: Up between two levels.
        fields: coarsest first.
    """

    def __init__(self, rasterizer: Rasterizer, pyramid: Pyramid, fields: Sequence[FinishedField]) -> None:
        self._rasterizer, self._pyramid, self.fields = rasterizer, pyramid, tuple(fields)

    def predict(self, inputs: Mapping[str, Any]) -> Tensor:
        """Return the upsampled image of the finished levels for a call of `rasterization`, (c, h, w, channels).

        Channels besides colours, such as depths, are the base's.

        Args:
            inputs: of the call, at the size of the level after the finest finished one.
        """
        return self._up(self.composed(inputs), (inputs["width"], inputs["height"]))

    def composed(self, inputs: Mapping[str, Any]) -> Tensor:
        """Return the image before it is upsampled, half as large as that of `predict`."""
        size, finest = (inputs["width"], inputs["height"]), self.fields[-1].level
        image = self._render(self.fields[0], inputs, self.fields[0].level - finest + 1)
        for field in self.fields[1:]:
            down = field.level - finest + 1
            image = _added(self._up(image, level_size(size, down)), self._render(field, inputs, down))
        return image

    def _render(self, field: FinishedField, inputs: Mapping[str, Any], down: int) -> Tensor:
        """Return the render of a field so many halvings smaller than the call's images."""
        size = inputs["width"], inputs["height"]
        width, height = level_size(size, down)
        own = {
            **inputs,
            **field.inputs(),
            **{name: False for name in ("absgrad", "sparse_grad") if name in inputs},
            "Ks": level_intrinsics(inputs["Ks"], size, down),
            "width": width,
            "height": height,
        }
        if field.signed:
            own = {**own, **({"render_mode": "RGB"} if "render_mode" in own else {})}
            return self._rasterizer.signed(**own)[0]
        return self._rasterizer.render(**own)[0]

    def _up(self, image: Tensor, size: tuple[int, int]) -> Tensor:
        """Upsample images (c, h, w, channels) by one level to a size."""
        width, height = size
        return upsample(self._pyramid, image.permute(0, 3, 1, 2).contiguous(), (height, width)).permute(0, 2, 3, 1)


def _added(image: Tensor, residual: Tensor) -> Tensor:
    """Add a residual (c, h, w, 3) to the colours of an image (c, h, w, 3 or more)."""
    colors = image[..., :COLORS] + residual
    return colors if image.shape[-1] == COLORS else torch.cat([colors, image[..., COLORS:]], -1)


def compose(
    rasterizer: Rasterizer, inputs: Mapping[str, Any], predict: Callable[[Mapping[str, Any]], Tensor]
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Answer a call of `rasterization` for a residual: its signed render, with the prediction of coarser levels.

    Args:
        rasterizer: of the script.
        inputs: of the call.
        predict: returns the prediction for such a call.
    """
    mode = inputs.get("render_mode", "RGB")
    below = predict(inputs)
    own = {**inputs, **({"render_mode": "RGB"} if "render_mode" in inputs else {})}
    render, alphas, info = rasterizer.signed(**own)
    return (below if mode in DEPTH_ONLY else _added(below, render)), alphas, info
