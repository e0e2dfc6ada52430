"""Render with the CUDA backend of Faster-GS, a function of raw parameters, where it is installed.

Its kernel clamps colours at zero and takes no computed ones. Signed colour is rendered with a constant on top of all
colours and of the background, which is subtracted from the image: a pixel's weights and its transmittance add up to 1.

Only rendering is used. Its Adam, and that in the backward pass of its branch FasterGSFused, are not: levels share
parameters and optimizers with density control, regularization and joint training, which read gradients.
"""

from __future__ import annotations

import importlib
import inspect
import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.environment import is_installed
from lapgs_plugin.errors import MissingExtraError, UserInputError, first_line
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult, Semantics, degree_to_evaluate, require_color
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.gpu_raster.cameras import CameraCache
from lapgs_plugin.rasterizers.empty_images import companion, projected_centres, surely_blends
from lapgs_plugin.rasterizers.gsplat.stock import is_differentiated
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH, PIXEL_VARIANCE
from lapgs_plugin.reference_raster.oracle import footprint_radii, projection_jacobians, world_covariances

NAME = "faster-gs"
MODULE = "FasterGSCudaBackend.torch_bindings"
"""Compiled module of Faster-GS."""
INSTALL = (
    "pip install git+https://github.com/nerficg-project/faster-gaussian-splatting/#subdirectory=FasterGSCudaBackend "
    "--no-build-isolation"
)
"""Command that installs it; needs nvcc and a C++ compiler."""
ARGUMENTS = (
    *("means", "scales", "rotations", "opacities", "sh_coefficients_0", "sh_coefficients_rest"),
    *("densification_info", "rasterizer_settings"),
)
"""Arguments of `diff_rasterize` on the branch main. That of FasterGSFused also takes Adam's moments."""
FAR = 1e10
OFFSET = 0.5
"""Number that the kernel adds to SH values before it clamps them."""

LIMIT = "the limit of the projection's Jacobian is another, or its gradient is"
SEMANTICS = Semantics(
    three_sigma_cut=False,
    expanded_conic_gradient=True,
    rebuilt_transmittance=True,
    screen_gradient_norms=True,
    departures={
        "saturated": "alpha is not capped, and the Gaussian that makes a pixel opaque is blended",
        **dict.fromkeys(("opaque_crowd", "one_pixel"), "the Gaussian that makes a pixel opaque is blended"),
        **dict.fromkeys(("off_centre", "outside_frustum", "same_plane"), LIMIT),
    },
    note="alpha is not capped at 0.99; the Gaussian after which less than 1e-4 of a pixel is left is blended; the "
    "Jacobian's limit counts from the border of the image instead of 1.3 half sides from its centre, and beyond it "
    "depth has another gradient; footprints end where alpha = 1/255 instead of at three sigma; a depth of exactly 0.2 "
    "is not culled; of gradients by screen positions there are only the norms",
)


def missing() -> str:
    """Return why this rasterizer cannot render on this machine, as a clause; empty if it can."""
    if not torch.cuda.is_available():
        return "PyTorch finds no CUDA device"
    return "" if is_installed(MODULE) else f"FasterGSCudaBackend is not installed; `{INSTALL}` installs it"


class FasterGsRasterizer(Rasterizer):
    """Render float32 fields on a CUDA device with the backend of Faster-GS, without its antialiasing.

    `RenderResult.means2d.grad` has the norms alone, see `Semantics.screen_gradient_norms`.

    Args:
        device: that renders; tests render on a CPU with a stand-in for the backend.
        backend: its module; None imports it.

    Raises:
        MissingExtraError: the backend is not installed, or was built for another PyTorch, or there is no CUDA device.
        UserInputError: it is of another branch than main.
    """

    name = NAME
    devices = ("cuda",)

    def __init__(self, device: torch.device | str = "cuda", *, backend: Any = None) -> None:
        self._device = torch.device(device)
        self._backend = _imported() if backend is None else backend
        arguments = tuple(inspect.signature(self._backend.diff_rasterize).parameters)
        if arguments != ARGUMENTS:
            raise UserInputError(
                f"--rasterizer {NAME}: diff_rasterize of {MODULE} takes {', '.join(arguments)}, expected "
                f"{', '.join(ARGUMENTS)}, as on the branch main; `{INSTALL}` installs that"
            )
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
        """Render `field`; see `fields.rasterizer.Rasterizer`."""
        differentiated = is_differentiated(field)
        means2d = field.means.new_zeros(len(field), 2).requires_grad_(differentiated)
        image = self._image(field, camera, background, sh_degree, means2d if differentiated else None)
        with torch.no_grad():
            radii = _shown_radii(field, camera)
            means2d.copy_(projected_centres(field, camera) * (radii > 0)[:, None])
        return RenderResult(image, None, radii, means2d)

    def render_image(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> Tensor:
        """Render the image without radii and centres; see `fields.rasterizer.Rasterizer`."""
        return self._image(field, camera, background, sh_degree, None)

    def _image(
        self, field: GaussianField, camera: Camera, background: Tensor, sh_degree: int | None, means2d: Tensor | None
    ) -> Tensor:
        """Render (3, h, w), with norms of gradients by the centres (n, 2) where these are asked for."""
        require_color(background)
        degree = degree_to_evaluate(field, sh_degree)
        self._check(field, background)
        # Their kernels launch a grid of no blocks where no Gaussian is in a tile.
        if not surely_blends(field, camera):
            field = _with_companion(field, camera)
        means, noted = field.means, field.means.new_empty(0)
        if means2d is not None:
            noted = means.new_zeros(2, len(field))
            means = _NotedNorms.apply(means, means2d, noted, camera.width)  # type: ignore[no-untyped-call]  # torch's
        constant: Tensor | float = _largest_color(field.sh, degree) + OFFSET if field.signed else 0.0
        lift = (constant - OFFSET) / SH_C0 if field.signed else 0.0
        image: Tensor = self._backend.diff_rasterize(
            means.contiguous(),
            field.log_scales.contiguous(),
            field.quaternions.contiguous(),
            field.opacity_logits[:, None].contiguous(),
            (field.sh[:, :1] + lift).contiguous(),
            field.sh[:, 1:].contiguous(),
            noted,
            self._settings(camera, background + constant, degree),
        )
        return image - constant if field.signed else image

    def _settings(self, camera: Camera, background: Tensor, degree: int) -> Any:
        cameras = self._cameras.get([camera], background)
        return self._backend.RasterizerSettings(
            w2c=cameras.poses[0],
            cam_position=cameras.centres[0],
            bg_color=background,
            active_sh_bases=(degree + 1) ** 2,
            width=camera.width,
            height=camera.height,
            focal_x=camera.fx,
            focal_y=camera.fy,
            center_x=camera.cx,
            center_y=camera.cy,
            near_plane=NEAR_DEPTH,
            far_plane=FAR,
            proper_antialiasing=False,
        )

    def _check(self, field: GaussianField, background: Tensor) -> None:
        for name, tensor in {**field.parameters, "background": background}.items():
            if tensor.device.type != self._device.type or tensor.dtype != torch.float32:
                raise UserInputError(
                    f"{name} is {tensor.dtype} on {tensor.device}, expected float32 on {self._device}; use .to()"
                )


@torch.no_grad()
def _largest_color(sh: Tensor, degree: int) -> Tensor:
    """Return a bound (scalar tensor) of the absolute SH values of coefficients (n, k, 3), from any direction.

    The squares of all SH functions up to a degree add up to (degree + 1)^2 / (4 pi) in every direction.
    """
    longest: Tensor = sh[:, : (degree + 1) ** 2].norm(dim=1).amax()
    return longest * (degree + 1) / math.sqrt(4 * math.pi)


@torch.no_grad()
def _shown_radii(field: GaussianField, camera: Camera) -> Tensor:
    """Return three-sigma radii (n,) int32 in whole pixels, 0 where a Gaussian reaches alpha 1/255 in no pixel.

    The backend tells neither. It bounds that ellipse by a rectangle, as here, and by tiles.
    """
    camera = camera.to(field.means.device)
    points = camera.local(field.means)  # (n, 3)
    in_front = points[:, 2] > NEAR_DEPTH  # (n,)
    points = torch.where(in_front[:, None], points, 1.0)
    to_screen = projection_jacobians(points, (camera.fx, camera.fy), camera.tan_half_fov)
    to_screen = to_screen @ camera.world_to_camera[:3, :3].to(points)  # (n, 2, 3)
    covariances = to_screen @ world_covariances(field.quaternions, field.log_scales) @ to_screen.mT  # (n, 2, 2)
    xx, xy, yy = covariances[:, 0, 0] + PIXEL_VARIANCE, covariances[:, 0, 1], covariances[:, 1, 1] + PIXEL_VARIANCE
    radii = footprint_radii(xx, yy, xx * yy - xy * xy)  # (n,)
    # -2 ln of 1/255 over the opacity: the squared distance at which alpha is 1/255, in standard deviations.
    squared = 2 * (torch.nn.functional.logsigmoid(field.opacity_logits) + math.log(255))  # (n,)
    extents = (torch.stack([xx, yy], 1) * squared.clamp_min(0)[:, None]).sqrt()  # (n, 2)
    centres = projected_centres(field, camera)  # (n, 2)
    last = centres.new_tensor([camera.width - 1, camera.height - 1])  # (2,)
    inside = ((centres + extents >= 0) & (centres - extents <= last)).all(1)  # (n,)
    return torch.where(in_front & inside & (squared >= 0), radii, 0).to(torch.int32)


def _imported() -> Any:
    """Import the backend.

    Raises:
        MissingExtraError: it is not installed, or was built for another PyTorch.
    """
    if reason := missing():
        raise MissingExtraError(f"--rasterizer {NAME}: {reason}")
    try:
        return importlib.import_module(MODULE)
    except ImportError as error:
        raise MissingExtraError(
            f"--rasterizer {NAME}: {MODULE} cannot be imported ({first_line(error)}); `{INSTALL}` builds it again"
        ) from error


def _with_companion(field: GaussianField, camera: Camera) -> GaussianField:
    """Append a Gaussian that is in a tile but changes no pixel."""
    added = companion(camera, field.means.detach())
    sh = torch.cat([added.sh, added.sh.new_zeros(1, field.sh.shape[1] - 1, 3)], 1)
    parts = {**added.parameters, "sh": sh}
    return field.with_parameters({name: torch.cat([values, parts[name]]) for name, values in field.parameters.items()})


class _NotedNorms(torch.autograd.Function):
    """Pass centres (n, 3) through, and give (m, 2), m <= n, the norms that the backend notes in its backward pass."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, means2d: Tensor, noted: Tensor, width: int) -> Tensor:
        ctx.noted, ctx.count, ctx.half_width = noted, len(means2d), width / 2
        return means.view_as(means)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None, None]:
        # They are by normalised device coordinates, in which the image is 2 wide and high.
        norms = ctx.noted[1, : ctx.count] / ctx.half_width
        by_centres = torch.stack([norms, torch.zeros_like(norms)], 1)
        ctx.noted.zero_()  # it adds to them in the next backward pass
        return gradient, by_centres, None, None
