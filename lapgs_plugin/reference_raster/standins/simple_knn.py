"""`simple_knn._C`: distances between neighbouring points, from which 3DGS takes the Gaussians' first sizes."""

from __future__ import annotations

from torch import Tensor

from lapgs_plugin.hierarchy.inheritance import mean_squared_distance

__all__ = ["distCUDA2"]


def distCUDA2(points: Tensor) -> Tensor:
    """(n,) mean of the squared distances from each point (n, 3) to its three nearest neighbours.

    With fewer than four points it is over those there are, where the CUDA code returns infinity.
    """
    return mean_squared_distance(points)
