"""Let a script around gsplat run without compiled packages, on a CPU with a stand-in of `rasterization`, too."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.attachment import replaced
from lapgs_plugin.checkouts.cpu_device import cuda_on_cpu
from lapgs_plugin.environment import is_installed
from lapgs_plugin.family import fused_ssim as ssim
from lapgs_plugin.family.forks import compute_relocation
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.pose import with_pose_gradient
from lapgs_plugin.gpu_raster.bindings import is_compiled
from lapgs_plugin.reference_raster import gsplat as stand_in
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH
from lapgs_plugin.reference_raster.oracle import world_covariances

IDLE = {
    "distributed", "with_ut", "with_eval3d", "ftheta_coeffs", "radial_coeffs", "tangential_coeffs",
    "thin_prism_coeffs",
}  # fmt: skip
"""Arguments that the stand-in does not take, and that mean nothing where they are False or None."""


def rasterization_on_cpu(**inputs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render as gsplat's `rasterization` does, with colours, depths ("D", "RGB+D") or expected ones ("ED", "RGB+ED").

    Lengths are scaled so that nothing is culled that gsplat's near plane leaves.

    Raises:
        UserInputError: an argument has a value that the stand-in does not support.
    """
    mode = inputs.pop("render_mode", "RGB")
    inputs = {name: value for name, value in inputs.items() if name not in IDLE or value not in (None, False)}
    unit = 2.0 ** math.floor(math.log2(inputs.pop("near_plane", 0.01) / NEAR_DEPTH))
    viewmats = inputs["viewmats"].clone()
    viewmats[:, :3, 3] /= unit
    scaled = {"means": inputs["means"] / unit, "scales": inputs["scales"] / unit, "viewmats": viewmats}
    inputs = {**inputs, **scaled}
    if viewmats.requires_grad and len(viewmats) == 1:
        inputs = _with_pose_gradient(inputs)
    images, alphas, info = stand_in.rasterization(**inputs)
    if mode == "RGB":
        return images, alphas, info
    pose = inputs["viewmats"]
    depths = torch.einsum("cj,nj->cn", pose[:, 2, :3], inputs["means"]) + pose[:, 2, 3:]  # (c, n)
    colors = (depths * unit)[..., None].expand(-1, -1, 3)
    plain = {**inputs, "colors": colors if len(pose) > 1 else colors[0], "sh_degree": None, "backgrounds": None}
    depth = stand_in.rasterization(**plain)[0][..., :1]
    if mode.endswith("ED"):
        depth = depth / alphas.clamp_min(1e-10)
    return (depth if mode in ("D", "ED") else torch.cat([images, depth], -1)), alphas, info


def _with_pose_gradient(inputs: dict[str, Any]) -> dict[str, Any]:
    """Return the inputs of one camera, whose splats also pass on gradients to its pose; the stand-in has none by it."""
    pose, colors = inputs["viewmats"][0], inputs["colors"]
    sh = colors if inputs["sh_degree"] is not None else colors.reshape(-1, 1, 3)
    field = GaussianField(inputs["means"], inputs["quats"], inputs["scales"].log(), inputs["opacities"], sh)
    rotation, centre = pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
    turn = rotation.detach().T @ rotation  # the identity, with the gradient of a turn about the centre
    vector = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    movement = torch.cat([vector, centre - centre.detach()])
    field = with_pose_gradient(field, movement, centre.detach(), 1.0)
    return {**inputs, "means": field.means, "quats": field.quaternions, "colors": field.sh.reshape(colors.shape)}


@contextmanager
def own_ssim() -> Iterator[None]:
    """Let imports of `fused_ssim`, which has to be compiled, find our module inside."""
    module = ModuleType("fused_ssim")
    module.__spec__ = ModuleSpec("fused_ssim", None)
    vars(module).update(fused_ssim=ssim.fused_ssim)
    with replaced(sys.modules, {"fused_ssim": module}):
        yield


@contextmanager
def splats_on_cpu() -> Iterator[None]:
    """Let "cuda" mean the CPU inside, also in gsplat's strategies and in `fused_ssim`."""
    with ExitStack() as stack:
        stack.enter_context(cuda_on_cpu(None))
        stack.enter_context(own_ssim())
        stack.enter_context(own_strategy_functions())
        yield


@contextmanager
def without_compiled_parts(ours_may_render: bool) -> Iterator[None]:
    """Let our functions take the places of compiled ones that are not there, on a GPU.

    Args:
        ours_may_render: whether gsplat need not be built.
    """
    with ExitStack() as stack:
        if not is_installed("fused_ssim"):
            stack.enter_context(own_ssim())
        if ours_may_render and not is_compiled():
            stack.enter_context(own_strategy_functions())
        yield


@contextmanager
def own_strategy_functions() -> Iterator[None]:
    """Let gsplat's strategies call our functions inside, which need no CUDA part of gsplat's."""
    with ExitStack() as stack:
        with suppress(ImportError):  # the script says what it needs
            ops = import_module("gsplat.strategy.ops")
            own = {"compute_relocation": _relocation, "quat_scale_to_covar_preci": _covariances}
            stack.enter_context(replaced(vars(ops), own))
        yield


def _relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacities (n,) and scales (n, 3) of Gaussians that are split into so many, as gsplat's function does."""
    most = len(binoms)
    return compute_relocation(opacities, scales, ratios.clamp(1, most), binoms, most)


def _covariances(quats: Tensor, scales: Tensor, **_: bool) -> tuple[Tensor, None]:
    """Return covariances (n, 3, 3), and no precisions, of which MCMC's noise asks for none."""
    return world_covariances(quats, scales.log()), None
