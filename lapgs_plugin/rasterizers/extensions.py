"""Wrap CUDA rasterizers of the 3DGS family for the interface `fields.rasterizer.Rasterizer`.

They are forks with the same Python interface, so one wrapper serves all. The features of a build are read from its
settings' fields and its rasterizer's arguments, never from a version, because several forks share one module name.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.adapters.registry import rasterizer_owners
from lapgs_plugin.environment import is_installed
from lapgs_plugin.errors import MissingExtraError, UserInputError, first_line
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import RenderResult, Semantics
from lapgs_plugin.rasterizers.empty_images import COMPANION_OPACITY, companion, projected_centres, surely_blends

CONSTANTS: dict[str, Any] = {
    "scale_modifier": 1.0,
    "prefiltered": False,
    "debug": False,
    "antialiasing": False,  # changes the image of the paper
    "mult": 1.0,  # the whole ellipse alpha = 1/255; less cuts off visible borders of Gaussians
    "get_flag": False,
    "pixel_weights": None,
    "kernel_size": 0.1,
    "depth_threshold": 1.0,
    "use_train_speedup": False,
    "ignored_rate": 0.0,
    "lambda_dssim": 0.2,
    "use_hwc": False,
}
"""Settings of every call, unless a run was trained with others."""
VARYING = (
    "image_height", "image_width", "tanfovx", "tanfovy", "bg", "viewmatrix", "projmatrix", "sh_degree", "campos",
    "metric_map", "subpixel_offset", "confidence",
)  # fmt: skip
"""Settings of a single call."""
OTHER_INPUTS: dict[str, Callable[[Tensor], Tensor | None]] = {
    "scores": lambda means: means.new_zeros(len(means), 1),
    "culling": lambda means: means.new_zeros(len(means), dtype=torch.bool),
    "gt_image": lambda means: None,
}
"""Inputs that some rasterizers cannot do without, given centres (n, 3): with these values they change no image."""
NEAR = 0.01
"""Near plane of the projection matrix, of which the kernels only use other rows."""
FAR = 100.0
"""Far plane of the projection matrix."""
SH_REST_COUNT = 15
"""Coefficients above the first at degree 3."""
POINT_DIMMING = 0.005
"""Factor of antialiasing on the opacity of a Gaussian without extent."""


def installed_extensions() -> list[str]:
    """Return the modules of the backbones' rasterizers that can be imported, without importing them."""
    return [name for name in rasterizer_owners() if is_installed(name)]


class CudaExtension:
    """Render with an installed extension, which `signed_color.SignedColorRasterizer` tells how to render signed colour.

    Args:
        name: of its module, a rasterizer of a registered backbone.
        device: where it renders; a stand-in for the CPU renders there.
        settings: values that replace those of `CONSTANTS`, such as {"mult": 0.5}.
        module: the module of that name; None imports it.

    Raises:
        MissingExtraError: it is not installed, or was built for another PyTorch.
        UserInputError: its settings have an unknown field, or lack one of `settings`.
    """

    def __init__(
        self,
        name: str,
        device: torch.device | str = "cuda",
        *,
        settings: Mapping[str, Any] | None = None,
        module: ModuleType | None = None,
    ) -> None:
        module = import_extension(name) if module is None else module
        self.name = name
        self.device = torch.device(device)
        self._settings = _known_settings(module)
        self._constants = {**CONSTANTS, **(settings or {})}
        unknown = [key for key in settings or {} if key not in constants_of(module)]
        if unknown:
            raise UserInputError(
                f"{name} as it is installed has no setting {', '.join(unknown)}; expected some of "
                f"{', '.join(sorted(constants_of(module)))}"
            )
        arguments = inspect.signature(module.GaussianRasterizer.forward).parameters
        self._takes_dc = "dc" in arguments
        self._others = {name: make for name, make in OTHER_INPUTS.items() if name in arguments}
        # Rasterizers with this setting return absolute gradients after the ordinary ones.
        self._absolute = "metric_map" in self._settings
        self._module = module

    @property
    def semantics(self) -> Semantics:
        """Where it departs from the oracle by design."""
        owner = rasterizer_owners().get(self.name)
        return (owner.rasterizer_semantics() if owner else None) or Semantics()

    def render(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int, colors: Tensor | None = None
    ) -> RenderResult:
        """Render without regard to `field.signed`. The result has no transmittance.

        Args:
            field: n Gaussians on `device`.
            camera: the view.
            background: (3,) colour behind everything.
            sh_degree: passed on unchanged, with the flag of `signed_color.signed_degree`.
            colors: (n, 3) the Gaussians' colours; SH and `sh_degree` are then ignored.

        Raises:
            UserInputError: a tensor is not float32, or not on `device`.
        """
        self._check(field, background)
        n = len(field)
        absgrad2d = field.means.new_zeros(n, 2) if self._absolute and torch.is_grad_enabled() else None
        means2d = field.means.new_zeros(n, 2).requires_grad_(torch.is_grad_enabled())  # (n, 2)
        image, radii = self._rasterize(field, camera, background, sh_degree, colors, means2d, absgrad2d)
        with torch.no_grad():
            means2d.copy_(projected_centres(field, camera) * (radii > 0)[:, None])
        return RenderResult(image, None, radii, means2d, absgrad2d)

    def _rasterize(
        self,
        field: GaussianField,
        camera: Camera,
        background: Tensor,
        sh_degree: int,
        colors: Tensor | None,
        means2d: Tensor,
        absgrad2d: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Return image (3, h, w) and radii (n,)."""
        n = len(field)
        inputs = {
            "means3D": field.means,
            "means2D": _ScreenPoints.apply(  # type: ignore[no-untyped-call]  # torch leaves it without types
                means2d, camera.width, camera.height, 4 if self._absolute else 3, absgrad2d
            ),
            "opacities": torch.sigmoid(field.opacity_logits)[:, None],  # (n, 1)
            "scales": torch.exp(field.log_scales),
            "rotations": torch.nn.functional.normalize(field.quaternions, dim=-1),  # the kernels expect it
            **(self._sh_inputs(field.sh) if colors is None else {"colors_precomp": colors}),
        }
        # Without Gaussians the kernels render no background. Those that take SH of degree 0 separately also blend a
        # tile's Gaussians in buckets of 32: with none in any tile they write out of bounds, or launch an empty grid in
        # the backward pass.
        antialiasing = "antialiasing" in self._settings and bool(self._constants["antialiasing"])
        if n == 0 or (self._takes_dc and (antialiasing or not surely_blends(field, camera))):
            inputs = _with_companion(inputs, camera, COMPANION_OPACITY / (POINT_DIMMING if antialiasing else 1))
        rasterizer = self._module.GaussianRasterizer(self._make_settings(camera, background, sh_degree))
        others = {name: make(inputs["means3D"]) for name, make in self._others.items()}
        image, *more = rasterizer(**{key: value.contiguous() for key, value in inputs.items()}, **others)
        radii = next(one for one in more if one.ndim == 1)  # some return images before them
        return image, radii[:n]

    def _check(self, field: GaussianField, background: Tensor) -> None:
        for name, tensor in {**field.parameters, "background": background}.items():
            if tensor.device.type != self.device.type or tensor.dtype != torch.float32:
                raise UserInputError(
                    f"{name} is {tensor.dtype} on {tensor.device}, expected float32 on {self.device}; use .to()"
                )

    def _sh_inputs(self, sh: Tensor) -> dict[str, Tensor]:
        if not self._takes_dc:
            return {"shs": sh}
        rest = sh[:, 1:]
        if rest.shape[1] == 0:
            # An empty tensor has no address, and without one the backward pass also skips degree 0.
            rest = sh.new_zeros(len(sh), SH_REST_COUNT, 3)
        return {"dc": sh[:, :1], "shs": rest}

    def _make_settings(self, camera: Camera, background: Tensor, sh_degree: int) -> Any:
        tan_x, tan_y = camera.tan_half_fov
        view, projection = _matrices(camera, background.device)
        values = {
            "image_height": camera.height,
            "image_width": camera.width,
            "tanfovx": tan_x,
            "tanfovy": tan_y,
            "bg": background.contiguous(),
            "viewmatrix": view,
            "projmatrix": projection,
            "sh_degree": sh_degree,
            "campos": camera.position.to(background).contiguous(),
            **self._constants,
        }
        if "metric_map" in self._settings:
            values["metric_map"] = torch.zeros(
                camera.height * camera.width, dtype=torch.int32, device=background.device
            )
        if "subpixel_offset" in self._settings:
            values["subpixel_offset"] = torch.zeros(camera.height, camera.width, 2, device=background.device)
        if "confidence" in self._settings:
            values["confidence"] = torch.ones(1, 1, device=background.device)
        return self._module.GaussianRasterizationSettings(**{name: values[name] for name in self._settings})


class _ScreenPoints(torch.autograd.Function):
    """Map (n, 2) centres in pixels to (n, columns) zeros for the extension's screen-space points.

    Their gradient is by normalised device coordinates, in which the image is 2 wide and high.
    """

    @staticmethod
    def forward(ctx: Any, means2d: Tensor, width: int, height: int, columns: int, absgrad2d: Tensor | None) -> Tensor:
        ctx.pixel, ctx.absgrad2d = means2d.new_tensor([2 / width, 2 / height]), absgrad2d
        return means2d.new_zeros(len(means2d), columns)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        if ctx.absgrad2d is not None:
            ctx.absgrad2d.copy_(gradient[:, 2:4] * ctx.pixel)
        return gradient[:, :2] * ctx.pixel, None, None, None, None


def constants_of(module: ModuleType) -> frozenset[str]:
    """Return the names of `CONSTANTS` that the extension has."""
    return frozenset(CONSTANTS) & frozenset(module.GaussianRasterizationSettings._fields)


def import_extension(name: str) -> ModuleType:
    """Import an extension's module.

    Raises:
        MissingExtraError: it is not installed, or was built for another PyTorch.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingExtraError(
            f"{name} cannot be imported ({first_line(error)}); install it as the README of its backbone says"
        ) from error


def _known_settings(module: ModuleType) -> tuple[str, ...]:
    """Return the field names of the extension's settings.

    Raises:
        UserInputError: one is unknown.
    """
    names: tuple[str, ...] = module.GaussianRasterizationSettings._fields
    unknown = [name for name in names if name not in CONSTANTS and name not in VARYING]
    if unknown:
        raise UserInputError(
            f"{module.__name__}: its settings have {', '.join(unknown)}, expected no more than "
            f"{', '.join([*VARYING, *CONSTANTS])}; install one of the rasterizers that `lapgs patch` knows"
        )
    return names


def _with_companion(inputs: dict[str, Tensor], camera: Camera, opacity: float) -> dict[str, Tensor]:
    """Append a Gaussian that is in a tile but changes no pixel."""
    rows = {name: value.new_zeros(1, *value.shape[1:]) for name, value in inputs.items()}
    added = companion(camera, inputs["means3D"].detach(), opacity)
    rows |= {"means3D": added.means, "scales": added.log_scales.exp(), "rotations": added.quaternions}
    rows["opacities"] = added.opacity_logits.sigmoid()[:, None]
    return {name: torch.cat([value, rows[name]]) for name, value in inputs.items()}


def _matrices(camera: Camera, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return world to camera and world to clip space, both (4, 4) float32 and transposed, as the kernels read them."""
    world_to_camera = camera.world_to_camera.to("cpu", torch.float64)
    x, y, width, height = camera.fx, camera.fy, camera.width, camera.height
    clip = torch.tensor(
        [
            [2 * x / width, 0, 2 * camera.cx / width - 1, 0],
            [0, 2 * y / height, 2 * camera.cy / height - 1, 0],
            [0, 0, FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)],
            [0, 0, 1, 0],
        ],
        dtype=torch.float64,
    )
    return tuple(  # type: ignore[return-value]  # a tuple of two, which mypy cannot count
        matrix.T.contiguous().to(device, torch.float32) for matrix in (world_to_camera, clip @ world_to_camera)
    )
