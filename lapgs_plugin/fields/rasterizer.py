"""Define the interface of all rasterizers: the CPU rasterizers, gsplat and the wrapped CUDA extensions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import SH_C0

BEHIND_CAMERA = 1e-12
"""Depth up to which no rasterizer blends a Gaussian, and whose inverse could overflow."""


@dataclass(frozen=True)
class RenderResult:
    """Hold the result of rendering one view.

    Attributes:
        image: (3, height, width) colour, background blended in, not clamped.
        transmittance: (height, width) the background's weight in each pixel, in [0, 1]; None if the rasterizer does
            not compute it anyway (`render_transmittance` does).
        radii: (n,) int32, three-sigma radius in pixels of each Gaussian's footprint; 0 where it was culled.
        means2d: (n, 2) projected centres in pixels, x then y; zeros where culled. If the field's parameters require
            gradients, `means2d.grad` holds after `backward()` the gradient of the loss by screen position, in loss per
            pixel, which densification thresholds.
        absgrad2d: (n, 2) buffer that holds after `backward()` the sum over pixels of the absolute value of that
            gradient (AbsGS); None if the rasterizer does not offer it.
    """

    image: Tensor
    transmittance: Tensor | None
    radii: Tensor
    means2d: Tensor
    absgrad2d: Tensor | None = None


@dataclass(frozen=True)
class Semantics:
    """List legitimate differences of a rasterizer from `reference_raster.oracle`, by design.

    Attributes:
        three_sigma_cut: False if a Gaussian is blended wherever alpha reaches 1/255, also beyond three sigma; one that
            is blended in no pixel may then have radius 0.
        mult: factor on the squared distance at which alpha reaches 1/255, if a Gaussian is blended in the tiles that
            this ellipse meets; None for all tiles, or those of the three-sigma cut.
        antialiasing: True if Gaussians that are smaller than a pixel are dimmed.
        exact_antialiasing: True if that is as in Mip-Splatting, without lower bound and with its own gradient.
        blur: variance that is added to 2D covariances, in px^2.
        expanded_conic_gradient: True if the backward pass turns the gradient by the inverse 2D covariance into that by
            the covariance with matrix products. In float32 that loses the gradients of Gaussians that are very long on
            screen; see `evaluation.conformance.EXPANDED_CONIC`.
        rebuilt_transmittance: True if the backward pass computes the transmittance from a pixel's stored opacity. In
            float32 that is inaccurate where little is left; see `evaluation.conformance.REBUILT_TRANSMITTANCE`.
        screen_gradient_norms: True if `RenderResult.means2d.grad` holds (g, 0) for each Gaussian, with g the length of
            the gradient by normalised device coordinates over half the image's width. Density control reads the length.
        departures: reasons by name of the conformance cases in which the image or a gradient differs.
        note: the differences in words, for reports.
    """

    three_sigma_cut: bool = True
    mult: float | None = None
    antialiasing: bool = False
    exact_antialiasing: bool = False
    blur: float = 0.3
    expanded_conic_gradient: bool = False
    rebuilt_transmittance: bool = False
    screen_gradient_norms: bool = False
    departures: Mapping[str, str] = field(default_factory=dict)
    note: str = ""


class FieldStack(ABC):
    """Hold finished fields on a device, to render them together; see `Rasterizer.stack`."""

    @abstractmethod
    def render(self, cameras: Sequence[Camera], background: Tensor | None) -> list[Tensor]:
        """Render the first fields, each from its own camera.

        Args:
            cameras: of the first field, the second, ..., at most one per field. All have the same pose; sizes and
                intrinsics may differ.
            background: (3,) behind fields that are not signed; None is black. Signed ones are rendered over zero.

        Returns:
            (3, height, width) of each camera, in PyTorch's current stream.
        """


class Rasterizer(ABC):
    """Render a field from a camera. A subclass has a name and a `__call__`; it overrides the rest where that is faster.

    Attributes:
        name: in logs, manifests and tables.
        devices: where the fields can be that it renders, "cuda", "cpu" or both. The first one that a machine has is
            taken, unless --device says it.
        in_current_stream: whether all its work on a GPU goes to PyTorch's current stream, so that fields can be
            rendered concurrently.
    """

    name: str
    devices: tuple[str, ...] = ("cuda", "cpu")
    in_current_stream: bool = False

    @classmethod
    def missing(cls) -> str:
        """Return why it cannot render on this machine, as a clause; empty if it can, or if creating it tells."""
        return ""

    @property
    def semantics(self) -> Semantics:
        """Differences from the oracle by design, for `lapgs conformance`."""
        return Semantics()

    @abstractmethod
    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        """Render `field`, differentiably by its parameters.

        Args:
            field: raw parameters; `field.signed` chooses the colour map: max(SH + 0.5, 0) or the raw SH value.
            camera: size, intrinsics and pose. The pose may be on another device than the field.
            background: (3,) colour behind everything, with the field's type and device; zero for residual fields.
            sh_degree: highest SH degree to evaluate, at most `field.sh_degree`; None means all.

        Raises:
            UserInputError: the field has no such `sh_degree`, or `background` is not a colour.
        """

    def render_image(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> Tensor:
        """Render `RenderResult.image` alone, (3, height, width), with its gradients."""
        return self(field, camera, background=background, sh_degree=sh_degree).image

    @torch.no_grad()
    def render_images(self, field: GaussianField, cameras: Sequence[Camera], *, background: Tensor) -> Tensor:
        """Render images alone from b cameras of one size, (b, 3, height, width), without gradients."""
        images = [self(field, camera, background=background).image for camera in cameras]
        return images[0][None] if len(images) == 1 else torch.stack(images)

    @property
    def can_batch(self) -> bool:
        """Whether `render_batch` is available with the options that the rasterizer was made with."""
        return False

    @property
    def mixes_sizes(self) -> bool:
        """Whether `render_batch` takes cameras of several sizes."""
        return False

    def render_batch(
        self,
        field: GaussianField,
        cameras: Sequence[Camera],
        *,
        background: Tensor,
        sh_degree: int | None = None,
        with_geometry: bool = True,
    ) -> RenderResult:
        """Render b cameras differentiably, with as many launches as one camera takes.

        Every tensor of the result has a leading dimension b. If cameras differ in size, all images are as large as the
        largest. A smaller camera has the top left part of its image. What is beyond it has no meaning. If the loss does
        not depend on it, gradients, radii and centres are those of the camera alone.

        Args:
            field, background, sh_degree: as `__call__` takes them.
            cameras: two or more, of one size unless `mixes_sizes`.
            with_geometry: fill in radii and centres; False leaves them empty and is faster.
        """
        raise NotImplementedError

    @property
    def can_stack(self) -> bool:
        """Whether `stack` is available with the options that the rasterizer was made with."""
        return False

    def stack(self, fields: Sequence[GaussianField]) -> FieldStack:
        """Copy fields from any device to its own, to render them with hardly more launches than one field takes."""
        raise NotImplementedError


def degree_to_evaluate(field: GaussianField, sh_degree: int | None) -> int:
    """Return the highest SH degree that a call of a `Rasterizer` evaluates.

    Raises:
        UserInputError: the field has no coefficients of that degree, which CUDA code would read out of bounds.
    """
    degree = field.sh_degree if sh_degree is None else sh_degree
    if not 0 <= degree <= field.sh_degree:
        raise UserInputError(f"sh_degree {degree}: expected 0 to {field.sh_degree}, the degree of the field")
    return degree


def require_color(background: Tensor) -> None:
    """Raise a UserInputError unless a background is one colour: CUDA code reads three numbers, whatever its shape."""
    if not isinstance(background, Tensor):
        raise UserInputError(f"background is a {type(background).__name__}, expected a (3,) Tensor: one RGB colour")
    if background.shape != (3,):
        raise UserInputError(f"background has shape {tuple(background.shape)}, expected (3,): one RGB colour")


def render_values(rasterizer: Rasterizer, field: GaussianField, camera: Camera, values: Tensor) -> Tensor:
    """Return values (n, 3) of the Gaussians blended as colours are, over zero: (3, height, width), differentiable."""
    shown = replace(field, sh=(values / SH_C0)[:, None], signed=True)
    return rasterizer.render_image(shown, camera, background=values.new_zeros(3), sh_degree=0)


def render_depths(rasterizer: Rasterizer, field: GaussianField, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return blended depths and opacity, (height, width) each, differentiable; their quotient is a pixel's mean depth.

    Depths are distances along the camera's axis in world units.
    """
    depths = camera.local(field.means)[:, 2]
    values = torch.stack([depths, torch.ones_like(depths), torch.zeros_like(depths)], 1)
    blended, opacity, _ = render_values(rasterizer, field, camera, values)
    return blended, opacity


def render_inverse_depths(rasterizer: Rasterizer, field: GaussianField, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return blended inverse depths and opacity, (height, width) each, differentiable.

    The background is infinitely far away. Depths are as in `render_depths`.
    """
    depths = camera.local(field.means)[:, 2]
    inverse = torch.where(depths > BEHIND_CAMERA, depths, 1.0).reciprocal()  # what lies behind is not blended
    values = torch.stack([inverse, torch.ones_like(inverse), torch.zeros_like(inverse)], 1)
    blended, opacity, _ = render_values(rasterizer, field, camera, values)
    return blended, opacity


@torch.no_grad()
def render_transmittance(rasterizer: Rasterizer, field: GaussianField, camera: Camera) -> Tensor:
    """Compute `RenderResult.transmittance` with any rasterizer: render black Gaussians over white."""
    black = replace(field.with_parameters({"sh": torch.zeros_like(field.sh[:, :1])}), signed=True)
    return rasterizer(black, camera, background=torch.ones(3).to(field.means), sh_degree=0).image[0]
