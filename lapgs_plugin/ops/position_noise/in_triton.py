"""Shake positions by noise in one kernel, which draws it or gets it."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.ops.launch import blocks, launch
from lapgs_plugin.ops.position_noise.in_torch import FAINT, SHARPNESS

BLOCK = 256


@triton.jit
def _turned(
    w: tl.tensor, i: tl.tensor, j: tl.tensor, k: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor
) -> tuple[tl.tensor, tl.tensor, tl.tensor]:
    """Rotate vectors by quaternions of any length."""
    twice = 2.0 / (w * w + i * i + j * j + k * k)
    across_x, across_y, across_z = (j * z - k * y) * twice, (k * x - i * z) * twice, (i * y - j * x) * twice
    return (
        x + w * across_x + (j * across_z - k * across_y),
        y + w * across_y + (k * across_x - i * across_z),
        z + w * across_z + (i * across_y - j * across_x),
    )


@triton.jit(do_not_specialize=("amount", "seed", "n"))
def _kernel(
    means: tl.tensor, quaternions: tl.tensor, log_scales: tl.tensor, logits: tl.tensor,
    amount: float, seed: int, n: int, sharpness: tl.constexpr, faint: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here = rows < n
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logits + rows, here, 0.0)))
    share = amount / (1.0 + tl.exp(sharpness * (opacity - faint)))
    w, i = tl.load(quaternions + 4 * rows, here, 1.0), tl.load(quaternions + 4 * rows + 1, here, 0.0)
    j, k = tl.load(quaternions + 4 * rows + 2, here, 0.0), tl.load(quaternions + 4 * rows + 3, here, 0.0)
    x, y, z, _ = tl.randn4x(seed, rows)
    x, y, z = _turned(-w, i, j, k, share * x, share * y, share * z)
    x *= tl.exp(2.0 * tl.load(log_scales + 3 * rows, here, 0.0))
    y *= tl.exp(2.0 * tl.load(log_scales + 3 * rows + 1, here, 0.0))
    z *= tl.exp(2.0 * tl.load(log_scales + 3 * rows + 2, here, 0.0))
    x, y, z = _turned(w, i, j, k, x, y, z)
    _add(means, rows, here, x, y, z)


@triton.jit
def _add(means: tl.tensor, rows: tl.tensor, here: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> None:
    tl.store(means + 3 * rows, tl.load(means + 3 * rows, here) + x, here)
    tl.store(means + 3 * rows + 1, tl.load(means + 3 * rows + 1, here) + y, here)
    tl.store(means + 3 * rows + 2, tl.load(means + 3 * rows + 2, here) + z, here)


@triton.jit(do_not_specialize=("amount", "n"))
def _given_kernel(
    means: tl.tensor, noise: tl.tensor, scales: tl.tensor, quaternions: tl.tensor, opacities: tl.tensor,
    amount: float, n: int, sharpness: tl.constexpr, faint: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here = rows < n
    left = (1.0 - tl.load(opacities + rows, here, 0.0)) - (1.0 - faint)  # rounded as scripts do
    share = amount / (1.0 + tl.exp(-sharpness * left))
    w, i = tl.load(quaternions + 4 * rows, here, 1.0), tl.load(quaternions + 4 * rows + 1, here, 0.0)
    j, k = tl.load(quaternions + 4 * rows + 2, here, 0.0), tl.load(quaternions + 4 * rows + 3, here, 0.0)
    x, y = share * tl.load(noise + 3 * rows, here, 0.0), share * tl.load(noise + 3 * rows + 1, here, 0.0)
    x, y, z = _turned(-w, i, j, k, x, y, share * tl.load(noise + 3 * rows + 2, here, 0.0))
    a, b = tl.load(scales + 3 * rows, here, 0.0), tl.load(scales + 3 * rows + 1, here, 0.0)
    c = tl.load(scales + 3 * rows + 2, here, 0.0)
    x, y, z = _turned(w, i, j, k, x * a * a, y * b * b, z * c * c)
    _add(means, rows, here, x, y, z)


def add_noise_triton(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, opacity_logits: Tensor, amount: float, seed: int
) -> None:
    """Do `add_noise` for contiguous float32 tensors on one CUDA device; a seed from 0 to 2^31 - 1 fixes the noise."""
    n, parameters = len(means), (means, quaternions, log_scales, opacity_logits)
    launch(_kernel, (blocks(n, BLOCK),), *parameters, amount, seed, n, sharpness=SHARPNESS, faint=FAINT, block=BLOCK)


def shake_triton(
    means: Tensor, noise: Tensor, scales: Tensor, quaternions: Tensor, opacities: Tensor, amount: float
) -> None:
    """Do `shake` for contiguous float32 tensors on one CUDA device, not empty."""
    n, tensors = len(means), (means, noise, scales, quaternions, opacities)
    launch(_given_kernel, (blocks(n, BLOCK),), *tensors, amount, n, sharpness=SHARPNESS, faint=FAINT, block=BLOCK)
