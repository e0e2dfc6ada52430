"""Stand in for the sparse Adam of the accelerated rasterizers."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.ops.adam.rows import step_rows


class SparseGaussianAdam(torch.optim.Adam):
    """Move only the Gaussians of the last view by Adam, without correcting the moments' bias.

    A parameter group has one tensor, whose first dimension is the Gaussians. The state is that of torch.optim.Adam, but
    'step' stays 0.
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
            moments = state["exp_avg"], state["exp_avg_sq"]
            marked = visibility.reshape(N).bool()
            step_rows(parameter, parameter.grad, *moments, marked, float(group["lr"]), group["eps"])
