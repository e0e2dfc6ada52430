"""Make the matrices by which unit spheres become Gaussians: rotations whose columns are scaled."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.ops.scaled_rotations.in_torch import scaled_rotations_torch
from lapgs_plugin.ops.self_check import largest, matches_reference


def scaled_rotations(scales: Tensor, quaternions: Tensor) -> Tensor:
    """Return rotation times diagonal matrix (n, 3, 3), without gradients.

    Args:
        scales: (n, 3) contiguous.
        quaternions: (n, 4) contiguous, of any length above 0.
    """
    if len(scales) > 0 and triton_works(scales, quaternions):
        from lapgs_plugin.ops.scaled_rotations.in_triton import scaled_rotations_triton

        return scaled_rotations_triton(scales, quaternions)
    return scaled_rotations_torch(scales.detach(), quaternions.detach())


@matches_reference("scaled rotations in several operations instead of one kernel", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare the matrices of some Gaussians."""
    from lapgs_plugin.ops.scaled_rotations.in_triton import scaled_rotations_triton

    scales, quaternions = examples(device)
    matrices = scaled_rotations_triton(scales, quaternions)
    return largest([(matrices - scaled_rotations_torch(scales, quaternions)).abs()])


def examples(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return scales up to 4 and quaternions, to compare functions by."""
    generator = torch.Generator().manual_seed(0)
    scales, quaternions = torch.rand(300, 3, generator=generator), torch.randn(300, 4, generator=generator)
    return scales.mul(4).to(device), quaternions.to(device)
