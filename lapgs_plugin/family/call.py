"""Declare the data of a rasterizer's call, whichever engine renders it: settings, inputs, options, output."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from lapgs_plugin.reference_raster.layout import PIXEL_VARIANCE


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


class ShParts(NamedTuple):
    """Take the place of a binding's argument `shs`, (n, k, 3), where joining it would be work for nothing else.

    Attributes:
        dc: (n, 1, 3).
        rest: (n, k - 1, 3).
    """

    dc: Tensor
    rest: Tensor

    @property
    def whole(self) -> Tensor:
        """All coefficients, (n, k, 3)."""
        return torch.cat([self.dc, self.rest], dim=1)


class Inputs(NamedTuple):
    """Hold the tensors of a call, on one device; n Gaussians, float32, None for arguments that are not given.

    Attributes:
        means: (n, 3).
        means2d: (n, 3), or (n, 4) for sums of absolute values in the last two columns; only its gradient is used.
        opacities: (n, 1).
        dc: (n, 1, 3) first SH coefficients, or None if `sh` has them or there are colours.
        sh: (n, k, 3) SH coefficients, those after the first where `dc` is given; None if there are colours.
        colors: (n, 3), or None.
        scales, quats: (n, 3) and (n, 4), or None if there are covariances.
        covariances: (n, 6), or None.
    """

    means: Tensor
    means2d: Tensor
    opacities: Tensor
    dc: Tensor | None
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
        exact_antialiasing: as Mip-Splatting does: those whose determinant without the blur is at most `VANISHING` are
            left out, and gradients are exact. Else their factor has a lower bound, and graphdeco's gradient.
        blur: variance that is added to the 2D covariances, in px^2.
        inverse_depth: also blend 1 / depth.
        sums: those of `SUMS` to compute.
        pixel_weights: (height * width,) float32, if "weights" is among them.
        blending: return how each pixel is blended.
        positions: return centres and depths.
    """

    mult: float | None = None
    antialiasing: bool = False
    exact_antialiasing: bool = False
    blur: float = PIXEL_VARIANCE
    inverse_depth: bool = False
    sums: tuple[str, ...] = ()
    pixel_weights: Tensor | None = None
    blending: bool = False
    positions: bool = False


SUMS = ("weights", "counts", "blending", "distances")
"""Names of the fields of `Contributions`."""


@dataclass(frozen=True)
class Contributions:
    """Hold sums over the pixels in which each Gaussian is blended, without gradients; None where not asked for.

    Attributes:
        weights: (n,) float32 of the pixels' weights.
        counts: (n,) int32 of 1.
        blending: (n,) float32 of transmittance times alpha, the Gaussian's share of the pixel.
        distances: (n,) float32 of the distance of the pixel from the projected centre, in pixels.
    """

    weights: Tensor | None = None
    counts: Tensor | None = None
    blending: Tensor | None = None
    distances: Tensor | None = None


class Blending(ABC):
    """Say how `n` Gaussians are blended in each pixel of an image, without gradients."""

    n: int

    @property
    @abstractmethod
    def transmittance(self) -> Tensor:
        """Return the transmittance (height, width) behind all Gaussians."""

    @abstractmethod
    def leaders(self, ranks: int = 1) -> Tensor:
        """Return the Gaussians with the largest shares of each pixel, (ranks, height * width) int64, -1 for none."""

    @abstractmethod
    def weighted_shares(self, weights: Tensor) -> Tensor:
        """Return the sum over pixels of weight times alpha times the transmittance behind the Gaussian, (n,) float32.

        Args:
            weights: (height * width,).
        """

    @abstractmethod
    def squared_gradients(self, grad_image: Tensor) -> Tensor:
        """Return the sum over pixels of the squared derivative of the loss by a Gaussian's value there, (n,) float32.

        The value is alpha over opacity; as in the CUDA code, the cap on alpha does not stop the derivative.

        Args:
            grad_image: (3, height * width) derivative of the loss by the image.
        """


@dataclass(frozen=True)
class Output:
    """Hold the results of a call, on the device of its inputs.

    Attributes:
        image: (3, height, width).
        radii: (n,) int32, 0 where culled.
        inverse_depths: (1, height, width), or None if not asked for.
        centres: (n, 2) pixels, 0 where culled, or None if not asked for.
        depths: (n,) camera-space z, 0 where culled, or None if not asked for.
        contributions: None if no sums are asked for.
        blending: None if not asked for.
    """

    image: Tensor
    radii: Tensor
    inverse_depths: Tensor | None
    centres: Tensor | None
    depths: Tensor | None
    contributions: Contributions | None = None
    blending: Blending | None = None

    def sum(self, name: str) -> Tensor:
        """Return one of the sums that were asked for."""
        value: Tensor | None = getattr(self.contributions, name)
        assert value is not None, f"{name} is not among the sums of the call's options"
        return value


def depths_of(means: Tensor, viewmatrix: Tensor) -> Tensor:
    """Return camera-space z, (n,); `viewmatrix` without gradients."""
    matrix = viewmatrix.detach().float()
    return means @ matrix[:3, 2] + matrix[3, 2]
