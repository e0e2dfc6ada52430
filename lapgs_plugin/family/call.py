"""Declare the data of a rasterizer's call, whichever engine renders it: settings, inputs, options, output."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from torch import Tensor

from lapgs_plugin.reference_raster.blending import Blending
from lapgs_plugin.reference_raster.contributions import Contributions


class Settings(Protocol):
    """Declare the fields that all `GaussianRasterizationSettings` share, named as in the CUDA bindings."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor


class Inputs(NamedTuple):
    """Hold the tensors of a call; n Gaussians, float32, None for arguments that are not given.

    Attributes:
        means: (n, 3).
        means2d: (n, 3), or (n, 4) for sums of absolute values in the last two columns; only its gradient is used.
        opacities: (n, 1).
        sh: (n, k, 3), or None if there are colours.
        colors: (n, 3), or None.
        scales, quats: (n, 3) and (n, 4), or None if there are covariances.
        covariances: (n, 6), or None.
    """

    means: Tensor
    means2d: Tensor
    opacities: Tensor
    sh: Tensor | None
    colors: Tensor | None
    scales: Tensor | None
    quats: Tensor | None
    covariances: Tensor | None


@dataclass(frozen=True)
class Options:
    """Hold the options that only some rasterizers have.

    Attributes:
        mult: FastGS's compact box, or None for three-sigma squares.
        antialiasing: dim Gaussians that are smaller than a pixel.
        inverse_depth: also blend 1 / depth.
        pixel_weights: (height * width,) float32 to sum up for each Gaussian, or None.
        blending: return how each pixel is blended.
    """

    mult: float | None = None
    antialiasing: bool = False
    inverse_depth: bool = False
    pixel_weights: Tensor | None = None
    blending: bool = False


@dataclass(frozen=True)
class Output:
    """Hold the results of a call.

    Attributes:
        image: (3, height, width).
        radii: (n,) int32, 0 where culled.
        inverse_depths: (1, height, width), or None if not asked for.
        centres: (n, 2) pixels, 0 where culled.
        depths: (n,) camera-space z, 0 where culled.
        contributions: None without pixel weights.
        blending: None if not asked for.
    """

    image: Tensor
    radii: Tensor
    inverse_depths: Tensor | None
    centres: Tensor
    depths: Tensor
    contributions: Contributions | None
    blending: Blending | None = None
