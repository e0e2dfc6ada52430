"""Shake positions by noise of the shape of each Gaussian, most where it is faint."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.ops.position_noise.in_torch import add_noise_torch
from lapgs_plugin.ops.self_check import largest, matches_reference


def add_noise(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, opacity_logits: Tensor, noise: Tensor, amount: float
) -> None:
    """Move Gaussians by `displacements`, in place; arguments are those of that function, with `means` (n, 3)."""
    if len(means) == 0:
        return
    if triton_works(means):
        from lapgs_plugin.ops.position_noise.in_triton import add_noise_triton

        add_noise_triton(means, quaternions, log_scales, opacity_logits, noise, amount)
    else:
        add_noise_torch(means, quaternions, log_scales, opacity_logits, noise, amount)


@matches_reference("noise of positions in several operations instead of one kernel", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare how far some Gaussians move, relative to the farthest."""
    from lapgs_plugin.ops.position_noise.in_triton import add_noise_triton

    generator = torch.Generator().manual_seed(0)
    log_scales, noise = (torch.randn(300, 3, generator=generator).to(device) for _ in range(2))
    quaternions = torch.randn(300, 4, generator=generator).to(device)
    logits = torch.linspace(-8.0, 8.0, 300, device=device)
    moved, expected = (torch.zeros_like(noise) for _ in range(2))
    for add, means in ((add_noise_triton, moved), (add_noise_torch, expected)):
        add(means, quaternions, log_scales, logits, noise, 0.5)
    return largest([(moved - expected).abs() / expected.abs().max()])
