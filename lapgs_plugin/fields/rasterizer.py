"""The one interface of every rasterizer: the CPU reference, gsplat and each wrapped CUDA extension satisfy it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField


@dataclass(frozen=True)
class RenderResult:
    """What rendering one view returns.

    Attributes:
        image: (3, height, width) colour, background blended in, not clamped.
        transmittance: (height, width) what is left of the background's weight in each pixel, in [0, 1]; None where it
            is not for free, since neither training nor rendering looks at it: `render_transmittance` gets it.
        radii: (n,) int32, three-sigma radius in pixels of each Gaussian's footprint; 0 where it was culled.
        means2d: (n, 2) projected centres in pixels, x then y. When the field's parameters require gradients,
            `means2d.grad` holds after `backward()` the gradient of the loss with respect to the screen position, in
            loss per pixel: what densification thresholds. Zeros where culled.
        absgrad2d: (n, 2) buffer that after `backward()` holds the sum over pixels of the absolute value of that
            gradient (AbsGS); None where the rasterizer does not offer it.
    """

    image: Tensor
    transmittance: Tensor | None
    radii: Tensor
    means2d: Tensor
    absgrad2d: Tensor | None = None


@dataclass(frozen=True)
class Semantics:
    """Where a rasterizer departs by design from what `reference_raster.oracle` states, and correctly so.

    Attributes:
        three_sigma_cut: False where a Gaussian is blended wherever alpha reaches 1/255, also beyond three sigma; one
            that is blended in no pixel may then have radius 0.
        expanded_conic_gradient: True where the backward pass takes the gradient of the inverse 2D covariance to that of
            the covariance by matrix products, as such or multiplied out. In float32 that loses the gradients of
            Gaussians that are very long on screen; see `evaluation.conformance.EXPANDED_CONIC`.
        rebuilt_transmittance: True where the forward pass keeps a pixel's opacity, and the backward pass takes the
            transmittance from that. In float32 little of a small one is left; see
            `evaluation.conformance.REBUILT_TRANSMITTANCE`.
        departures: reasons by the name of the conformance case for which another image or gradient is right.
        note: the departures in words, for reports.
    """

    three_sigma_cut: bool = True
    expanded_conic_gradient: bool = False
    rebuilt_transmittance: bool = False
    departures: Mapping[str, str] = field(default_factory=dict)
    note: str = ""


class Rasterizer(Protocol):
    """Renders a field from a camera."""

    @property
    def name(self) -> str:
        """How logs, manifests and tables call it."""
        ...

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        """Render `field`, differentiably with respect to its parameters.

        Args:
            field: raw parameters; `field.signed` chooses the colour map: max(SH + 0.5, 0) or the raw SH value.
            camera: size, intrinsics and pose.
            background: (3,) colour behind everything; zero for residual fields.
            sh_degree: highest SH degree to evaluate, at most `field.sh_degree`; None means all.
        """
        ...


@runtime_checkable
class ImageRasterizer(Protocol):
    """A rasterizer that can leave out what training alone looks at, and render several views in one go.

    On a GPU all its work goes to PyTorch's current stream, so that fields can be rendered beside each other.
    """

    def render_images(self, field: GaussianField, cameras: Sequence[Camera], *, background: Tensor) -> Tensor:
        """Images (b, 3, height, width) of b cameras of one size, as `Rasterizer` renders them one by one."""
        ...


class FieldStack(Protocol):
    """Fields that are finished and ready on a device, to be rendered together; see `StackingRasterizer`."""

    def render(self, cameras: Sequence[Camera], background: Tensor | None) -> list[Tensor]:
        """Images of the first fields, each as `Rasterizer` renders it from its own camera.

        Args:
            cameras: for the first field, the second, ..., at most as many as there are fields. All have the same pose;
                sizes and intrinsics are their own.
            background: (3,) behind fields that are not signed; None is black. Signed ones always lie over zero.

        Returns:
            (3, height, width) of each camera, in PyTorch's current stream.
        """
        ...


@runtime_checkable
class StackingRasterizer(Protocol):
    """A rasterizer that may render several fields together, with hardly more launches than one alone."""

    @property
    def can_stack(self) -> bool:
        """Whether it can with the options it was made with."""
        ...

    def stack(self, fields: Sequence[GaussianField]) -> FieldStack:
        """A copy of the fields, which may be anywhere, on its own device; only where `can_stack`."""
        ...


@runtime_checkable
class BatchRasterizer(Protocol):
    """A rasterizer that may train on several views of one size with as many launches as on one."""

    @property
    def can_batch(self) -> bool:
        """Whether it can with the options it was made with."""
        ...

    def render_batch(
        self,
        field: GaussianField,
        cameras: Sequence[Camera],
        *,
        background: Tensor,
        sh_degree: int | None = None,
        describes: bool = True,
    ) -> RenderResult:
        """What a call gives for each of b cameras of one size, differentiably, with a leading dimension b each.

        Args:
            field, background, sh_degree: as a `Rasterizer` takes them.
            cameras: two or more; only where `can_batch`.
            describes: fill in radii and centres; False leaves them empty and costs less.
        """
        ...


@runtime_checkable
class PlainRasterizer(Protocol):
    """A rasterizer that is faster where nobody looks at radii and centres."""

    def render_image(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> Tensor:
        """`RenderResult.image` of the same call, (3, height, width), with its gradients."""
        ...


def render_image(
    rasterizer: Rasterizer, field: GaussianField, camera: Camera, background: Tensor, sh_degree: int | None = None
) -> Tensor:
    """The image (3, height, width) alone by any rasterizer, differentiable, the fastest way that it has."""
    if isinstance(rasterizer, PlainRasterizer):
        return rasterizer.render_image(field, camera, background=background, sh_degree=sh_degree)
    return rasterizer(field, camera, background=background, sh_degree=sh_degree).image


@torch.no_grad()
def render_images(
    rasterizer: Rasterizer, field: GaussianField, cameras: Sequence[Camera], background: Tensor
) -> Tensor:
    """Images (b, 3, height, width) of b cameras of one size by any rasterizer, the fastest way that it has."""
    if isinstance(rasterizer, ImageRasterizer):
        return rasterizer.render_images(field, cameras, background=background)
    images = [rasterizer(field, camera, background=background).image for camera in cameras]
    return images[0][None] if len(images) == 1 else torch.stack(images)


@torch.no_grad()
def render_transmittance(rasterizer: Rasterizer, field: GaussianField, camera: Camera) -> Tensor:
    """What any rasterizer leaves of the background's weight in each pixel: (height, width), in [0, 1].

    It renders black Gaussians before white.
    """
    black = replace(field.with_parameters({"sh": torch.zeros_like(field.sh[:, :1])}), signed=True)
    return rasterizer(black, camera, background=torch.ones(3).to(field.means), sh_degree=0).image[0]
