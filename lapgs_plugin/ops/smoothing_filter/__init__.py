"""Limit Gaussians to what photos resolve, by a filter in space (Yu et al. 2024, Mip-Splatting).

A Gaussian of standard deviations s becomes one of sqrt(s^2 + filter^2) that is as much fainter as it is larger.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from lapgs_plugin.ops.self_check import largest, matches_reference
from lapgs_plugin.ops.smoothing_filter import in_torch


def filtered_scales(log_scales: Tensor, filters: Tensor) -> Tensor:
    """Return standard deviations (n, 3) of filtered Gaussians.

    Args:
        log_scales: (n, 3) contiguous.
        filters: (n, 1) contiguous, without a gradient.
    """
    if triton_works(log_scales, filters):
        from lapgs_plugin.ops.smoothing_filter.in_triton import filtered_scales_triton

        return filtered_scales_triton(log_scales, filters)
    return in_torch.filtered_scales_torch(log_scales, filters)


def filtered_opacities(logits: Tensor, log_scales: Tensor, filters: Tensor) -> Tensor:
    """Return opacities (n, 1) of filtered Gaussians.

    Args:
        logits: (n, 1) contiguous, of opacities.
        log_scales, filters: as of `filtered_scales`.
    """
    if triton_works(logits, log_scales, filters):
        from lapgs_plugin.ops.smoothing_filter.in_triton import filtered_opacities_triton

        return filtered_opacities_triton(logits, log_scales, filters)
    return in_torch.filtered_opacities_torch(logits, log_scales, filters)


def nearest_depths(means: Tensor, cameras: Tensor) -> Tensor:
    """Return the least depth (n,) of each centre in the cameras that see it, inf where none does.

    Args:
        means: (n, 3) contiguous.
        cameras: (c, 16) contiguous, rows of `in_torch.CameraRow`.
    """
    if triton_works(means, cameras):
        from lapgs_plugin.ops.smoothing_filter.in_triton import nearest_depths_triton

        return nearest_depths_triton(means, cameras)
    return in_torch.nearest_depths_torch(means, cameras)


@matches_reference("filters of Gaussians in several operations instead of one kernel", 1e-4)
def triton_works(device: torch.device) -> float:
    """Compare filtered Gaussians, their gradients and depths, relative to the largest of each."""
    from lapgs_plugin.ops.smoothing_filter import in_triton

    logits, log_scales, filters = in_torch.gaussians(device)
    versions: tuple[tuple[Callable[..., Tensor], Callable[..., Tensor], tuple[Tensor, ...]], ...] = (
        (in_triton.filtered_scales_triton, in_torch.filtered_scales_torch, (log_scales, filters)),
        (in_triton.filtered_opacities_triton, in_torch.filtered_opacities_torch, (logits, log_scales, filters)),
    )
    differences = []
    for ours, reference, arguments in versions:
        *leaves, weights = (value.clone() for value in (*arguments[:-1], arguments[0]))
        results = []
        for version in (ours, reference):
            inputs = [leaf.detach().requires_grad_() for leaf in leaves]
            output = version(*inputs, arguments[-1])
            results.append((output, *torch.autograd.grad((output * weights).sum(), inputs)))
        differences += [(a - b).abs().max() / b.abs().max() for a, b in zip(*results, strict=True)]
    means, cameras = in_torch.seen_from(device)
    depths, expected = in_triton.nearest_depths_triton(means, cameras), in_torch.nearest_depths_torch(means, cameras)
    differences.append((depths.nan_to_num(posinf=0.0) - expected.nan_to_num(posinf=0.0)).abs().max())
    return largest(differences)
