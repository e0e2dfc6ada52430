"""What the Python sides of the CUDA rasterizers have in common: the module, its argument checks, the sparse Adam."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.reference_raster.standins.engine import Inputs, Settings, mark_visible


class RasterizerBase(nn.Module):
    """A module that holds the settings of one view."""

    def __init__(self, raster_settings: Settings) -> None:
        super().__init__()
        self.raster_settings: Any = raster_settings

    def markVisible(self, positions: Tensor) -> Tensor:
        """(n,) bool: points (n, 3) in front of the camera's near plane."""
        return mark_visible(self.raster_settings, positions)


def gather(
    means3d: Tensor,
    means2d: Tensor,
    opacities: Tensor,
    dc: Tensor | None,
    shs: Tensor | None,
    colors_precomp: Tensor | None,
    scales: Tensor | None,
    rotations: Tensor | None,
    cov3d_precomp: Tensor | None,
) -> Inputs:
    """Inputs from a binding's arguments; SH come whole, or with the first coefficient apart in `dc` (n, 1, 3).

    Raises:
        UserInputError: not exactly one of SH and colours, or of scales with rotations and covariances.
    """
    if (shs is None) == (colors_precomp is None):
        raise UserInputError("got both or neither of shs and colors_precomp: expected exactly one of them")
    pair = (scales is not None) + (rotations is not None)
    if pair == 1 or (pair == 2) == (cov3d_precomp is not None):
        raise UserInputError(
            "got both or neither of scales with rotations and cov3D_precomp: expected exactly one of them"
        )
    if shs is not None and dc is not None:
        shs = torch.cat([dc, shs], 1)
    return Inputs(means3d, means2d, opacities, shs, colors_precomp, scales, rotations, cov3d_precomp)


class SparseGaussianAdam(torch.optim.Adam):
    """Adam that moves the Gaussians of the last view only, and does not correct the moments' bias.

    One tensor a parameter group, its first dimension the Gaussians. State as in torch.optim.Adam, but 'step' stays 0.
    """

    def __init__(self, params: Any, lr: float, eps: float) -> None:
        super().__init__(params=params, lr=lr, eps=eps)

    @torch.no_grad()
    def step(self, visibility: Tensor, N: int) -> None:  # type: ignore[override]  # as the CUDA binding
        """Update the rows of each parameter for which `visibility`, (n,) bool, is true; `N` is n."""
        for group in self.param_groups:
            (parameter,) = group["params"]
            if parameter.grad is None:
                continue
            state = self.state[parameter]
            if not state:
                state["step"] = torch.tensor(0.0)
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
            rows = visibility.reshape(N).nonzero()[:, 0]
            gradient = parameter.grad[rows]
            mean = state["exp_avg"][rows].mul_(0.9).add_(gradient, alpha=0.1)
            square = state["exp_avg_sq"][rows].mul_(0.999).addcmul_(gradient, gradient, value=0.001)
            state["exp_avg"][rows], state["exp_avg_sq"][rows] = mean, square
            parameter[rows] -= group["lr"] * mean / (square.sqrt() + group["eps"])
