"""Normalise the quaternions of Gaussians, with their gradient."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from lapgs_plugin.ops.self_check import largest, matches_reference


def unit_quaternions(quaternions: Tensor) -> Tensor:
    """Return what `torch.nn.functional.normalize` returns, differentiable once where kernels compute it.

    Args:
        quaternions: (n, 4); other tensors are normalised by PyTorch along their second axis.
    """
    rows = quaternions.ndim == 2 and quaternions.shape[1:] == (4,) and quaternions.shape[0] > 0
    if rows and quaternions.is_contiguous() and triton_works(quaternions):
        from lapgs_plugin.ops.unit_quaternions.in_triton import unit_quaternions_triton

        return unit_quaternions_triton(quaternions)
    return normalize(quaternions)


@matches_reference("normalised quaternions in several operations instead of one kernel", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare with PyTorch, also where quaternions are zero or shorter than it divides by."""
    from lapgs_plugin.ops.unit_quaternions.in_triton import unit_quaternions_triton

    generator = torch.Generator().manual_seed(0)
    values, weights = (torch.randn(700, 4, generator=generator).to(device) for _ in range(2))
    values[:2] *= torch.tensor([[0.0], [1e-13]], device=device)
    results = []
    for operation in (unit_quaternions_triton, normalize):
        leaf = values.clone().requires_grad_()
        units = operation(leaf)
        (gradient,) = torch.autograd.grad((units * weights).sum(), leaf)
        results.append((units, gradient / gradient.abs().amax(dim=1, keepdim=True)))
    return largest((one - other).abs() for one, other in zip(*results, strict=True))
