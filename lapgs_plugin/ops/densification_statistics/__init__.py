"""Sum up, for each Gaussian, the screen-space gradients that densification decides by."""

from __future__ import annotations

import torch
from torch import Tensor

from lapgs_plugin.ops.densification_statistics.in_torch import add_statistics_torch
from lapgs_plugin.ops.self_check import largest, matches_reference


def add_statistics(gradient: Tensor, radii: Tensor, size: tuple[int, int], norms: Tensor, counts: Tensor) -> None:
    """Add gradient norms in normalised device coordinates, and 1 for each view that shows a Gaussian; in place.

    Args:
        gradient: (n, 2) of the loss by the centres in pixels; (b, n, 2) of several views.
        radii: (n,) or (b, n) int32, above 0 where a Gaussian is shown.
        size: (width, height) of the image.
        norms, counts: (n,) sums so far.
    """
    if len(norms) == 0:
        return
    if triton_works(gradient):
        from lapgs_plugin.ops.densification_statistics.in_triton import add_statistics_triton

        add_statistics_triton(gradient, radii, size, norms, counts)
    else:
        add_statistics_torch(gradient, radii, size, norms, counts)


@matches_reference("densification statistics in several operations instead of one kernel", 1e-5)
def triton_works(device: torch.device) -> float:
    """Compare the sums of two views."""
    from lapgs_plugin.ops.densification_statistics.in_triton import add_statistics_triton

    gradient = torch.linspace(-1, 1, 1200, device=device).view(2, 300, 2)
    radii = torch.arange(600, dtype=torch.int32, device=device).view(2, 300) % 7
    sums = [torch.ones(2, 300, device=device) for _ in range(2)]
    for add, both in zip((add_statistics_triton, add_statistics_torch), sums, strict=True):
        add(gradient, radii, (8, 6), both[0], both[1])
    return largest([(sums[0] - sums[1]).abs()])
