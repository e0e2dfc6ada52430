"""Render with gsplat behind the interface `fields.rasterizer.Rasterizer`.

gsplat takes colours as they are, so signed colour needs no change to it: its own kernel evaluates SH, and nothing is
added or clamped. Ordinary colour is evaluated here as well, because gsplat would invert the camera's pose for it, which
waits for the GPU.

Our own kernels (`direct`) take the place of gsplat's where they can. They need PyTorch and Triton alone. A call of
gsplat's waits for the GPU once, for the number of pairs of Gaussians and tiles; a packed one also for that of visible
Gaussians.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from importlib.metadata import version

import torch
from torch import Tensor

from lapgs_plugin.environment import gsplat_built, triton_missing
from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import (
    FieldStack,
    Rasterizer,
    RenderResult,
    Semantics,
    degree_to_evaluate,
    require_color,
)
from lapgs_plugin.gpu_raster.cameras import CameraCache
from lapgs_plugin.gpu_raster.records import RECORD
from lapgs_plugin.ops.mixed_sizes import largest_size
from lapgs_plugin.rasterizers.gsplat import direct
from lapgs_plugin.rasterizers.gsplat.direct_stack import DirectStack
from lapgs_plugin.rasterizers.gsplat.self_check import direct_works
from lapgs_plugin.rasterizers.gsplat.stack import GsplatStack
from lapgs_plugin.rasterizers.gsplat.stock import StockRasterization, is_differentiated

NAME = "gsplat"
MOST_NUMBERS = 2**31 - 1
"""SH coefficients of a field, or numbers that blending reads, that our kernels can count: those of 44 million Gaussians
of degree 3, of 22 million seen by eight cameras."""

LIMIT = "the limit of the projection's Jacobian is another, or its gradient is"
SEMANTICS = Semantics(
    three_sigma_cut=False,
    expanded_conic_gradient=True,
    rebuilt_transmittance=True,
    departures={
        "saturated": "alpha is capped at 0.999, without a gradient there",
        **dict.fromkeys(("off_centre", "outside_frustum", "same_plane"), LIMIT),
    },
    note="alpha is capped at 0.999 instead of 0.99, and where it is, there is no gradient by opacity and position; the "
    "Jacobian's limit counts from the border of the image instead of 1.3 half sides from its centre, which differs for "
    "principal points off the centre, and beyond it depth has another gradient; footprints end where alpha = 1/255 "
    "instead of at three sigma; a depth of exactly 0.2 is not culled; gradients of needles are right to a few "
    "thousandths, and by way of pixels that are nearly opaque to 3e-4",
)


def missing(*, direct: bool = True) -> str:
    """Return why this rasterizer cannot render on this machine, as a clause; empty if it can.

    It imports and compiles nothing.

    Args:
        direct: whether our own kernels may render.
    """
    if not torch.cuda.is_available():
        return "PyTorch finds no CUDA device"
    ours, gsplats = triton_missing() if direct else "", gsplat_missing()
    if direct and not ours:
        return ""
    return gsplats and " and ".join(filter(None, (ours, gsplats)))


def gsplat_missing() -> str:
    """Return why gsplat's own CUDA part cannot be used, as a clause; empty if it can. Imports and compiles nothing."""
    built = gsplat_built()
    if built is None:
        return "gsplat is not installed"
    from torch.utils.cpp_extension import CUDA_HOME

    return "" if built or CUDA_HOME else "gsplat's CUDA part is not built, and there is no nvcc to build it"


def rays_missing() -> str:
    """Return why the gsplat that is installed does not render along rays, as a clause; empty if it does."""
    from gsplat import rasterization

    if "with_ut" in inspect.signature(rasterization).parameters:
        return ""
    return f"gsplat {version('gsplat')} has no unscented transform, which came with 1.5"


class GsplatRasterizer(Rasterizer):
    """Render float32 fields on a CUDA device with gsplat and the conventions of the 3DGS family.

    Where our kernels do not render and gsplat's CUDA part is not built yet, gsplat compiles it, which takes minutes.

    Args:
        device: that renders; tests render on a CPU with a stand-in for gsplat.
        antialiasing: dim Gaussians that are smaller than a pixel, as graphdeco's option of that name.
        packed: store intermediate results of visible Gaussians alone: less memory, a little slower.
        absgrad: offer `RenderResult.absgrad2d`, which makes the backward pass a little slower.
        own_radii: return gsplat's radii, which bound where alpha reaches 1/255, instead of computing those of three
            sigma; training only asks which are above 0.
        direct: render by our own kernels (`gsplat.direct`), in a fraction of the time. None does so if they are
            validated on this machine. Not available with `packed`, `antialiasing` or `rays`.
        rays: evaluate Gaussians along rays, which a lens may bend, by gsplat's unscented transform; see
            `reference_raster.rays`. Cameras are rendered one by one, and gradients by centres are lengths alone.

    Raises:
        MissingExtraError: neither our kernels nor gsplat's can render on this machine. A call raises it, too, if ours
            fail their validation.
    """

    name = NAME
    devices = ("cuda",)
    in_current_stream = True

    def __init__(
        self,
        device: torch.device | str = "cuda",
        *,
        antialiasing: bool = False,
        packed: bool = False,
        absgrad: bool = True,
        own_radii: bool = False,
        direct: bool | None = None,
        rays: bool = False,
    ) -> None:
        self._device = torch.device(device)
        may_be_direct = not (packed or antialiasing or rays) and direct is not False
        if self._device.type == "cuda" and (reason := missing(direct=may_be_direct) or (rays and rays_missing())):
            why = "--packed and --antialiased need gsplat's CUDA part: " if packed or antialiasing else ""
            why = "--distorted needs gsplat's CUDA part: " if rays else why
            raise MissingExtraError(f"--rasterizer {NAME}: {why}{reason}; `lapgs doctor` says what to install")
        self._rays = rays
        self._stock = StockRasterization(antialiasing, packed, own_radii, rays)
        self._absgrad = absgrad
        self._may_be_direct = self._device.type == "cuda" and may_be_direct
        self._must_be_direct = bool(direct)
        self._cameras = CameraCache()

    @classmethod
    def missing(cls) -> str:
        """See `fields.rasterizer.Rasterizer`."""
        return missing()

    @property
    def semantics(self) -> Semantics:
        """Its differences from the oracle."""
        return SEMANTICS

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        """Render `field`; see `fields.rasterizer.Rasterizer`.

        Raises:
            UserInputError: the field is not float32 on `device`.
        """
        means = field.means
        if means.device.type != self._device.type or means.dtype != torch.float32:
            raise UserInputError(
                f"means is {means.dtype} on {means.device}, expected float32 on {self._device}; use .to()"
            )
        return self._render(field, [camera], background, sh_degree)

    @property
    def can_batch(self) -> bool:
        """See `fields.rasterizer.Rasterizer`. Packed results have no row for each camera and Gaussian."""
        return self._device.type == "cuda" and not (self._stock.packed or self._rays)

    @property
    def mixes_sizes(self) -> bool:
        """See `fields.rasterizer.Rasterizer`. gsplat's functions cull all Gaussians by one size, our kernels do not."""
        return self._may_be_direct and (self._must_be_direct or direct_works())

    def render_batch(
        self,
        field: GaussianField,
        cameras: Sequence[Camera],
        *,
        background: Tensor,
        sh_degree: int | None = None,
        with_geometry: bool = True,
    ) -> RenderResult:
        """Render several cameras in one set of launches; see `fields.rasterizer.Rasterizer`."""
        if with_geometry:
            return self._render(field, cameras, background, sh_degree)
        image = self._images(field, cameras, background, sh_degree)
        count, like = len(cameras), field.means
        return RenderResult(image, None, like.new_empty(count, 0, dtype=torch.int32), like.new_empty(count, 0, 2))

    def render_image(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> Tensor:
        """Render the image without radii, centres and transmittance; see `fields.rasterizer.Rasterizer`."""
        return self._images(field, [camera], background, sh_degree)

    @torch.no_grad()
    def render_images(self, field: GaussianField, cameras: Sequence[Camera], *, background: Tensor) -> Tensor:
        """Render images of several cameras together; see `fields.rasterizer.Rasterizer`."""
        if self._rays and len(cameras) > 1:
            return super().render_images(field, cameras, background=background)
        if len(field) == 0 or self._calls_kernels(field, cameras=len(cameras)):
            images = self._images(field, cameras, background, None)
            return images[None] if len(cameras) == 1 else images
        return self._stock.images(field, cameras, background, field.sh_degree)

    @property
    def can_stack(self) -> bool:
        """Whether `stack` is available: on CUDA devices, unless gsplat renders packed or along rays."""
        return self._device.type == "cuda" and not (self._stock.packed or self._rays)

    def stack(self, fields: Sequence[GaussianField]) -> FieldStack:
        """Copy several fields to render them together; see `fields.rasterizer.Rasterizer`."""
        if self._calls_kernels(*fields):
            return DirectStack(fields, self._device)
        return GsplatStack(fields, self._device, antialiased=self._stock.antialiased)

    def _calls_kernels(self, *fields: GaussianField, cameras: int = 1) -> bool:
        """Return whether kernels are called directly, for fields or cameras that are rendered together."""
        coefficients = 3 * max(len(field) for field in fields) * max(field.sh.shape[1] for field in fields)
        numbers = max(coefficients, RECORD * cameras * sum(map(len, fields)))
        few = numbers <= MOST_NUMBERS
        if self._may_be_direct and few and (self._must_be_direct or direct_works()):
            return True
        if self._device.type == "cuda" and (reason := gsplat_missing()):
            why = "do not work here (the log says why)" if few else f"cannot count {numbers} numbers of these Gaussians"
            raise MissingExtraError(f"--rasterizer {NAME}: our kernels {why}, and {reason}; `lapgs doctor` says more")
        return False

    def _render(
        self, field: GaussianField, cameras: Sequence[Camera], background: Tensor, sh_degree: int | None
    ) -> RenderResult:
        """Render cameras with radii and centres."""
        require_color(background)
        degree, absgrad = degree_to_evaluate(field, sh_degree), self._absgrad
        if len(field) == 0:
            return _without_gaussians(field, cameras, background, absgrad)
        if self._calls_kernels(field, cameras=len(cameras)):
            on_device, own_radii = self._cameras.get(cameras, field.means), self._stock.own_radii
            return direct.render(field, on_device, background, degree, absgrad=absgrad, own_radii=own_radii)
        return self._stock.render(field, cameras, background, degree, absgrad=absgrad)

    def _images(
        self, field: GaussianField, cameras: Sequence[Camera], background: Tensor, sh_degree: int | None
    ) -> Tensor:
        """Render images alone, (3, h, w) of one camera and (b, 3, h, w) of several."""
        require_color(background)
        degree = degree_to_evaluate(field, sh_degree)
        if len(field) == 0:
            return _without_gaussians(field, cameras, background, absgrad=False).image
        if self._calls_kernels(field, cameras=len(cameras)):
            return direct.render_images(field, self._cameras.get(cameras, field.means), background, degree)
        images = self._stock.images(field, cameras, background, degree)
        # All that follows in training reads channel by channel: better reordered once than in each operation.
        return (images if len(cameras) > 1 else images[0]).contiguous()


def _without_gaussians(
    field: GaussianField, cameras: Sequence[Camera], background: Tensor, absgrad: bool
) -> RenderResult:
    """Return the result for a field of no Gaussians: the background."""
    leading, means = (len(cameras),) if len(cameras) > 1 else (), field.means
    width, height = largest_size([camera.size for camera in cameras])
    means2d = means.new_zeros(*leading, 0, 2).requires_grad_(is_differentiated(field))
    absgrad2d = means.new_zeros(*leading, 0, 2) if means2d.requires_grad and absgrad else None
    # Zero, but in the graph: a loss of the image can be differentiated by the empty parameters.
    nothing = torch.cat([value.flatten() for value in (means2d, *field.parameters.values())]).sum()
    image = (background.to(means) + nothing)[:, None, None].expand(*leading, 3, height, width)
    transmittance = None if leading else means.new_ones(height, width)
    return RenderResult(image, transmittance, means2d.detach()[..., 0].int(), means2d, absgrad2d)
