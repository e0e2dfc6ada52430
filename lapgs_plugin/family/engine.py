"""Choose the engine that renders a call by the device of its tensors."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.family.call import Inputs, Options, Output, Settings, depths_of
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH, SIGNED_COLOR_BIT

ENGINES = {"cpu": "lapgs_plugin.family.cpu", "cuda": "lapgs_plugin.family.gpu"}
"""Modules with a function `rasterize`, by the type of the device; imported when they are needed."""


def rasterize(settings: Settings, inputs: Inputs, options: Options) -> Output:
    """Render on the device of the inputs, differentiably by all tensors of `inputs`.

    As in the CUDA code, a call without Gaussians gives a black image with any background, the gradient by `means2D` is
    in units of half the image's sides, and the gradient by the scales lacks the factor `scale_modifier`.

    Raises:
        UserInputError: tensors do not fit each other, there is no engine for their device, or the projection does not
            fit the field of view.
    """
    device = inputs.means.device
    if device.type not in ENGINES:
        raise UserInputError(f"means3D is on {device}: expected {' or '.join(ENGINES)}")
    _check(settings, inputs)
    _check_pixels(settings, options)
    engine: Any = import_module(ENGINES[device.type])
    output: Output = engine.rasterize(settings, inputs, options)
    return output


def mark_visible(settings: Settings, positions: Tensor) -> Tensor:
    """Return which points (n, 3) are in front of the near plane, (n,) bool; the CUDA code tests no more."""
    return depths_of(positions.detach(), settings.viewmatrix) > NEAR_DEPTH


def _check(settings: Settings, inputs: Inputs) -> None:
    """Refuse tensors that kernels would read out of bounds, or whose gradients they would write there."""
    n, device = inputs.means.shape[0], inputs.means.device
    wanted = (
        ("means3D", inputs.means, (n, 3)),
        ("opacities", inputs.opacities, (n, 1)),
        ("dc", inputs.dc, (n, 1, 3)),
        ("colors_precomp", inputs.colors, (n, 3)),
        ("scales", inputs.scales, (n, 3)),
        ("rotations", inputs.quats, (n, 4)),
        ("cov3D_precomp", inputs.covariances, (n, 6)),
    )
    for name, tensor, shape in wanted:
        if tensor is not None and (tensor.shape != shape or tensor.dtype != torch.float32 or tensor.device != device):
            raise UserInputError(
                f"{name} is {tuple(tensor.shape)}, {tensor.dtype}, on {tensor.device}: "
                f"expected {shape}, torch.float32, on {device}"
            )
    if inputs.means2d.shape not in ((n, 3), (n, 4)):
        raise UserInputError(f"means2D is {tuple(inputs.means2d.shape)}: expected {(n, 3)} or {(n, 4)}")
    degree, sh = int(settings.sh_degree) & ~SIGNED_COLOR_BIT, inputs.sh
    if sh is None:
        return
    count = sh.shape[1] + (inputs.dc is not None)
    if not (
        0 <= degree <= 3
        and sh.shape == (n, sh.shape[1], 3)
        and count in (1, 4, 9, 16)
        and count >= (degree + 1) ** 2
        and sh.dtype == torch.float32
        and sh.device == device
    ):
        raise UserInputError(
            f"SH coefficients are {(*sh.shape[:1], count, *sh.shape[2:])}, {sh.dtype}, on {sh.device} at sh_degree "
            f"{degree}: expected ({n}, k, 3), torch.float32, on {device}, k of 1, 4, 9 or 16 and at least "
            "(degree + 1)^2, dc included"
        )


def _check_pixels(settings: Settings, options: Options) -> None:
    """Refuse a background and weights that kernels would read out of bounds."""
    if settings.bg.numel() != 3:
        raise UserInputError(f"bg is {tuple(settings.bg.shape)}: expected (3,)")
    weights, width, height = options.pixel_weights, int(settings.image_width), int(settings.image_height)
    if weights is not None and weights.numel() != width * height:
        raise UserInputError(
            f"{weights.numel()} weights of pixels: expected {width * height}, for an image of {width}x{height}"
        )
