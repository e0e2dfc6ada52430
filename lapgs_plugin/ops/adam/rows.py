"""Step those rows of a tensor that a mask marks, without asking a GPU which ones."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.ops.adam.in_torch import ADAM_EPS, BETAS
from lapgs_plugin.ops.self_check import largest, matches_reference


@torch.no_grad()
def step_rows(
    values: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, marked: Tensor, rate: float, eps: float
) -> None:
    """Take a step of Adam in place, without correcting the moments' bias.

    Args:
        values, gradient, mean, square: (n, ...) the tensor, its gradient, Adam's first and second moment.
        marked: (n,) bool; other rows keep their values and their moments.
        rate: step size.
        eps: added to the root of the second moment.
    """
    tensors = values, gradient, mean, square
    if values.numel() and all(tensor.is_contiguous() for tensor in tensors) and triton_works(*tensors):
        from lapgs_plugin.ops.adam.in_triton import step_rows_triton

        step_rows_triton(values, gradient, mean, square, marked, rate, eps)
    else:
        step_rows_torch(values, gradient, mean, square, marked, rate, eps)


def step_rows_torch(
    values: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, marked: Tensor, rate: float, eps: float
) -> None:
    """Do `step_rows` in PyTorch's operations, on any device."""
    rows = marked.view(-1, *(1,) * (values.ndim - 1))
    mean.copy_(torch.where(rows, mean.lerp(gradient, 1 - BETAS[0]), mean))
    square.copy_(torch.where(rows, square.lerp(gradient.square(), 1 - BETAS[1]), square))
    values.sub_(torch.where(rows, rate * mean / (square.sqrt() + eps), 0.0))


@matches_reference("sparse Adam in PyTorch's operations instead of ours", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare three steps of more numbers than a program takes, relative to how far they moved."""
    from lapgs_plugin.ops.adam.in_triton import step_rows_triton

    generator = torch.Generator().manual_seed(0)
    start = torch.randn(700, 3, generator=generator).to(device)
    results = []
    for step in (step_rows_torch, step_rows_triton):
        values, mean, square = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
        generator.manual_seed(1)
        for _ in range(3):
            gradient = torch.randn(start.shape, generator=generator).to(device)
            marked = (torch.rand(len(start), generator=generator) < 0.5).to(device)
            step(values, gradient, mean, square, marked, 0.1, ADAM_EPS)
        results.append(values)
    return largest([(results[0] - results[1]).abs() / (results[0] - start).abs().max()])
