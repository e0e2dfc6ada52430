"""Shake positions by noise of the shape of each Gaussian, most where it is faint."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.ops.position_noise.in_torch import FAINT, SHARPNESS, displacements, shaken
from lapgs_plugin.ops.self_check import largest, matches_reference


def add_noise(means: Tensor, quaternions: Tensor, log_scales: Tensor, opacity_logits: Tensor, amount: float) -> None:
    """Move means (n, 3) by `displacements` of noise, which depends on the state of torch's generators, in place."""
    if len(means) == 0:
        return
    if triton_works(means):
        from lapgs_plugin.ops.position_noise.in_triton import add_noise_triton

        seed = int(torch.randint(2**31 - 1, ()))
        add_noise_triton(means, quaternions, log_scales, opacity_logits, amount, seed)
    else:
        means += displacements(quaternions, log_scales, opacity_logits, torch.randn_like(means), amount)


@torch.no_grad()
def shake(means: Tensor, noise: Tensor, scales: Tensor, quaternions: Tensor, opacities: Tensor, amount: float) -> None:
    """Move means (n, 3) by `shaken` of noise that was drawn before, in place.

    Args:
        means, noise: (n, 3) contiguous.
        scales: (n, 3) contiguous.
        quaternions: (n, 4) contiguous, w first and of any length.
        opacities: (n, 1) contiguous.
        amount: factor for a transparent Gaussian.
    """
    tensors = noise, scales, quaternions, opacities
    if len(means) > 0 and given_noise_works(means, *tensors):
        from lapgs_plugin.ops.position_noise.in_triton import shake_triton

        shake_triton(means, *tensors, amount)
    else:
        means += shaken(*tensors, amount)


@matches_reference("noise of positions in several operations instead of one kernel", 1e-5)
def given_noise_works(device: torch.device) -> float:
    """Compare how far some Gaussians move, relative to the farthest."""
    from lapgs_plugin.ops.position_noise.in_triton import shake_triton

    generator = torch.Generator().manual_seed(0)
    noise, scales = (torch.randn(300, 3, generator=generator).to(device) for _ in range(2))
    quaternions = torch.randn(300, 4, generator=generator).to(device)
    opacities, moved = torch.linspace(0.0, 0.1, 300, device=device)[:, None], torch.zeros_like(noise)
    expected = shaken(noise, scales.exp(), quaternions, opacities, 0.5)
    shake_triton(moved, noise, scales.exp(), quaternions, opacities, 0.5)
    return largest([(moved - expected).abs() / expected.abs().max()])


@matches_reference("noise of positions in several operations instead of one kernel", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare how far some Gaussians move, relative to the farthest, by the noise that moves a round one."""
    from lapgs_plugin.ops.position_noise.in_triton import add_noise_triton

    generator = torch.Generator().manual_seed(0)
    log_scales = torch.randn(300, 3, generator=generator).to(device)
    quaternions = torch.randn(300, 4, generator=generator).to(device)
    logits = torch.linspace(-8.0, 8.0, 300, device=device)
    noise, moved = (torch.zeros_like(log_scales) for _ in range(2))
    round_ones = quaternions, torch.zeros_like(log_scales), torch.full_like(logits, -20.0)
    add_noise_triton(noise, *round_ones, 1.0, seed=7)
    noise /= torch.sigmoid(torch.tensor(SHARPNESS * FAINT))
    add_noise_triton(moved, quaternions, log_scales, logits, 0.5, seed=7)
    expected = displacements(quaternions, log_scales, logits, noise, 0.5)
    return largest([(moved - expected).abs() / expected.abs().max()])
