"""Call the CUDA modules that backbones import: on a GPU to record their results, on the CPU to compare stand-ins.

Each case is one call of one module with the same inputs, named in CASES; `outputs` gives all that it returns and the
gradients of a fixed random combination of its differentiable results. Needs PyTorch only, as the recorder has no more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.rasterizers.signed_color import signed_degree

WIDTH, HEIGHT, TAN_X = 33, 19, 0.6
GAUSSIANS = 24
SPLIT = {"fastgs", "taming", "taming-rasterizer", "graphdeco-accel"}
WITHOUT_GRADIENTS = {"graphdeco-accel"}
"""The copies in circulation skip Gaussians of the backward pass at random; see `variants`."""


@dataclass(frozen=True)
class Call:
    """Describe one rasterizer call.

    Attributes:
        degree: SH degree.
        signed: whether to ask for signed colour, which only patched builds know.
        precomputed: pass covariances and colours instead of scales, rotations and SH.
        background: RGB.
        options: settings that not all rasterizers have; others ignore them.
    """

    degree: int = 3
    signed: bool = False
    precomputed: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    options: dict[str, Any] = field(default_factory=dict)


CASES = {
    "clamped": Call(background=(0.2, 0.5, 0.9), options={"mult": 0.5}),
    "signed": Call(signed=True, degree=1, options={"mult": 1.0}),
    "precomputed": Call(precomputed=True, options={"mult": 0.7, "antialiasing": True}),
}


def make_inputs() -> dict[str, Tensor]:
    """Gaussians of a few pixels, some across the image's border, a camera, weights of the loss, weights of pixels."""
    g = torch.Generator().manual_seed(0)
    tan_y = TAN_X * HEIGHT / WIDTH
    depth = 2 + 4 * torch.rand(GAUSSIANS, generator=g)
    depth[0] = -1.0  # behind the camera
    x, y = (2.3 * torch.rand(2, GAUSSIANS, generator=g) - 1.15) * torch.tensor([TAN_X, tan_y])[:, None] * depth
    angle = 0.3
    pose = torch.eye(4)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1], projection[3, 2] = 1 / TAN_X, 1 / tan_y, 1.0
    projection[2, 2], projection[2, 3] = 100 / 99.99, -1 / 99.99
    pixels = torch.exp(1.6 * torch.rand(GAUSSIANS, 3, generator=g))
    return {
        "means": (torch.stack([x, y, depth], 1) - pose[:3, 3]) @ pose[:3, :3],
        "scales": pixels * (2 * TAN_X / WIDTH * depth.abs())[:, None],
        "quats": torch.nn.functional.normalize(torch.randn(GAUSSIANS, 4, generator=g), dim=1),
        "opacities": 0.05 + 0.94 * torch.rand(GAUSSIANS, 1, generator=g),
        "sh": torch.randn(GAUSSIANS, 16, 3, generator=g) * torch.tensor([1.0] + [0.3] * 15)[:, None],
        "colors": torch.randn(GAUSSIANS, 3, generator=g),
        "view": pose.T.contiguous(),
        "full": (projection @ pose).T.contiguous(),
        "position": -pose[:3, :3].T @ pose[:3, 3],
        "weights": torch.randn(4, HEIGHT, WIDTH, generator=g),
        "pixel_weights": torch.rand(HEIGHT, WIDTH, generator=g),
    }


def covariances(inputs: dict[str, Tensor]) -> Tensor:
    """(n, 6) of the Gaussians."""
    w, x, y, z = inputs["quats"].unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    root = torch.stack(rows, 1).reshape(-1, 3, 3) * inputs["scales"][:, None, :]
    return (root @ root.mT).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]


def outputs(module: ModuleType, variant: str, name: str, inputs: dict[str, Tensor], device: str) -> dict[str, Tensor]:
    """Return the results of a case, on the CPU: `out0` ... in the module's order, and `grad_` of each input."""
    case = CASES[name]
    on_device = {key: value.to(device) for key, value in inputs.items()}
    values: dict[str, Any] = {
        "image_height": HEIGHT, "image_width": WIDTH, "tanfovx": TAN_X, "tanfovy": TAN_X * HEIGHT / WIDTH,
        "bg": torch.tensor(case.background, device=device), "scale_modifier": 1.0, "viewmatrix": on_device["view"],
        "projmatrix": on_device["full"], "sh_degree": signed_degree(case.degree) if case.signed else case.degree,
        "campos": on_device["position"], "prefiltered": False, "debug": False, "mult": 1.0, "get_flag": True,
        "metric_map": (on_device["pixel_weights"] < 0.4).int(), "antialiasing": False,
        "pixel_weights": on_device["pixel_weights"],
    }  # fmt: skip
    fields = module.GaussianRasterizationSettings._fields
    settings = module.GaussianRasterizationSettings(**{key: (values | case.options)[key] for key in fields})
    points = torch.zeros(GAUSSIANS, 4 if variant == "fastgs" else 3, device=device)
    leaves = {"means3D": on_device["means"], "means2D": points, "opacities": on_device["opacities"]}
    if case.precomputed:
        leaves |= {"colors_precomp": on_device["colors"], "cov3D_precomp": covariances(on_device)}
    else:
        leaves |= {"scales": on_device["scales"], "rotations": on_device["quats"]}
        split = {"dc": on_device["sh"][:, :1].contiguous(), "shs": on_device["sh"][:, 1:].contiguous()}
        leaves |= split if variant in SPLIT else {"shs": on_device["sh"]}
    leaves = {key: value.detach().requires_grad_() for key, value in leaves.items()}
    results = module.GaussianRasterizer(settings)(**leaves)
    record = {f"out{i}": tensor.detach().cpu() for i, tensor in enumerate(results)}
    if variant not in WITHOUT_GRADIENTS:
        loss = (results[0] * on_device["weights"][:3]).sum()
        if variant == "graphdeco-aa":
            loss = loss + (results[2] * on_device["weights"][3:]).sum()
        loss.backward()
        for key, leaf in leaves.items():
            assert leaf.grad is not None, key
            record[f"grad_{key}"] = leaf.grad.cpu()
    return record


def ssim_outputs(fused_ssim: Any, inputs: dict[str, Tensor], device: str) -> dict[str, Tensor]:
    """Values and gradients of `fused_ssim` of two images."""
    record: dict[str, Tensor] = {}
    for padding in ("same", "valid"):
        first = inputs["weights"][None, :3].to(device).detach().requires_grad_()
        second = (0.7 * inputs["weights"][None, :3] + 0.2 * inputs["weights"][None, 1:]).to(device)
        value = fused_ssim(first, second, padding=padding)
        value.backward()
        assert first.grad is not None
        record[f"{padding}_value"], record[f"{padding}_grad"] = value.detach().cpu(), first.grad.cpu()
    return record
