"""Render signed colour, the raw SH value instead of max(SH + 0.5, 0), with CUDA rasterizers.

A patched extension takes a flag for it. Whether the installed one supports the flag is tested by rendering a Gaussian,
not read from a version. If it does not, PyTorch evaluates SH and the extension gets precomputed colours: the same
image, slower.
"""

from __future__ import annotations

import logging
import math
import shlex
from enum import Enum
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from lapgs_plugin.errors import PatchError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult, degree_to_evaluate, require_color
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.patching.engine import State, Target, find_targets, status
from lapgs_plugin.rasterizers.extensions import CudaExtension
from lapgs_plugin.reference_raster.layout import SIGNED_COLOR_BIT

logger = logging.getLogger(__name__)

SIGNED_COLOR_SET = "signed-color"
"""The set of edits in `patches/*.toml` that adds the flag to a rasterizer."""

PROBE_TOLERANCE = 1e-3
"""Largest error of the probe's image and gradient: rounding gives 1e-6, a wrong colour map about 1."""


class ColorPath(Enum):
    """Choose where the colours of a signed field are computed: in the extension, or in PyTorch before it."""

    NATIVE = "native"
    PRECOMPUTED = "precomputed"


def signed_degree(degree: int) -> int:
    """Return the `sh_degree` that asks for signed colour of an SH degree, 0 to 3."""
    return degree | SIGNED_COLOR_BIT


class SignedColorRasterizer(Rasterizer):
    """Render with an extension, signed fields on its fastest path.

    Args:
        extension: that renders.
        path: for signed fields; None tests the extension at the first signed field, and logs advice once if it needs
            the slow path.
    """

    def __init__(self, extension: CudaExtension, *, path: ColorPath | None = None) -> None:
        self._extension = extension
        self.name = extension.name
        self._forced = path

    @cached_property
    def path(self) -> ColorPath:
        """The path of signed fields."""
        if self._forced is not None:
            return self._forced
        if has_signed_color(self._extension):
            return ColorPath.NATIVE
        logger.warning("%s", explain_fallback(self.name, Path.cwd()))
        return ColorPath.PRECOMPUTED

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        """Render `field`; see `fields.rasterizer.Rasterizer`."""
        require_color(background)
        degree = degree_to_evaluate(field, sh_degree)
        colors = None
        if field.signed:
            if self.path is ColorPath.NATIVE:
                degree = signed_degree(degree)
            else:
                colors = precomputed_colors(field, camera, degree)
        return self._extension.render(field, camera, background=background, sh_degree=degree, colors=colors)


def precomputed_colors(field: GaussianField, camera: Camera, degree: int) -> Tensor:
    """Evaluate the Gaussians' colours from a camera in PyTorch, (n, 3), with gradients.

    Args:
        field: n Gaussians; `field.signed` chooses the colour map.
        camera: the view.
        degree: highest SH degree to evaluate.
    """
    position = camera.position.to(field.means)  # (3,)
    directions = torch.nn.functional.normalize(field.means - position, dim=-1)  # (n, 3)
    return sh_to_color(field.sh, directions, degree, signed=field.signed)


@torch.inference_mode(False)  # whatever mode the caller is in: it takes gradients
def has_signed_color(extension: CudaExtension) -> bool:
    """Test whether the installed extension renders and differentiates signed colour."""
    field, camera, degree = _probe_scene(extension.device)
    expected = precomputed_colors(field, camera, degree)[0]  # (3,) of both signs
    with torch.enable_grad():
        sh = field.sh.clone().requires_grad_()
        result = extension.render(
            field.with_parameters({"sh": sh}),
            camera,
            background=torch.zeros(3, device=extension.device),
            sh_degree=signed_degree(degree),
        )
        (gradient,) = torch.autograd.grad(result.image.sum(), sh)
    black, white = torch.zeros(1, 3, device=extension.device), torch.ones(3, device=extension.device)
    with torch.no_grad():
        unseen = extension.render(field, camera, background=white, sh_degree=0, colors=black).image[0]  # (h, w)
    weight = 1 - unseen  # of the only Gaussian
    image_error = (result.image.detach() - weight * expected[:, None, None]).abs().max()
    # The image is weight * C0 * (sh_0 + sqrt(3) sh_2) in each channel, so these gradients are the same unless negative
    # channels were clamped, or only the forward pass was patched and the other one takes the degree for 0. Their size
    # is not tested: a backward pass that loses part of it does not make colours wrong.
    slope = float(weight.sum()) / math.sqrt(4 * math.pi)
    slopes = torch.stack([gradient[0, 0], gradient[0, 2] / math.sqrt(3)])  # (2, 3)
    spread = float(slopes.max() - slopes.min())
    return bool(image_error <= PROBE_TOLERANCE) and slope > 0 and spread <= PROBE_TOLERANCE * slope


def _probe_scene(device: torch.device) -> tuple[GaussianField, Camera, int]:
    """Return a Gaussian, a camera and an SH degree of 1, such that the colour is negative in two channels."""
    camera = Camera(16, 16, 16.0, 16.0, 8.0, 8.0, torch.eye(4, device=device))
    sh = torch.zeros(1, 4, 3)
    sh[0, 0] = torch.tensor([-2.0, 1.0, -1.0])
    sh[0, 2] = torch.tensor([-0.5, 0.5, 1.0])
    field = GaussianField(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.full((1, 3), math.log(0.2)),
        opacity_logits=torch.tensor([2.0]),
        sh=sh,
        signed=True,
    )
    return field.to(device), camera, 1


def explain_fallback(module: str, checkout: Path) -> str:
    """Explain in one line why signed colour takes the slow path, and the command for the fast one.

    Args:
        module: name of the extension's Python module.
        checkout: folder of the backbone or of the rasterizer; it may be any folder.
    """
    slow = (
        f"{module} has no signed colour: residual fields are rendered with SH evaluated in PyTorch, correct but slower"
    )
    target = _source(module, checkout)
    if target is None:
        return f"{slow}; `lapgs patch apply CHECKOUT` on the sources it was built from, then reinstall it"
    state = {patches.set: patches.state for patches in status(target)}.get(SIGNED_COLOR_SET)
    if state is State.APPLIED:
        return (
            f"{slow}; its sources in {target.folder} are patched, but the installed build is older: run "
            f"`{target.reinstall}`"
        )
    if state is State.IMPOSSIBLE:
        return (
            f"{slow}; the patch does not fit its sources in {target.folder}: `lapgs patch status "
            f"{shlex.quote(str(checkout))}` says where"
        )
    return f"{slow}; run `lapgs patch apply {shlex.quote(str(checkout))}` and then `{target.reinstall}`"


def _source(module: str, checkout: Path) -> Target | None:
    """Return the extension in the checkout that installs this module; None if there is none, or more than one."""
    try:
        targets = find_targets(checkout)
    except PatchError:  # no checkout with a rasterizer: the message is then more general
        return None
    sources = [target for target in targets if (target.folder / module).is_dir()]
    return sources[0] if len(sources) == 1 else None  # a folder of several checkouts
