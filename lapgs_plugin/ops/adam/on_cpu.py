"""Take Adam's steps on the CPU in one pass over memory, on all threads."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.jit.lanes import Floats
from lapgs_plugin.jit.threads import parallel
from lapgs_plugin.ops.adam.in_torch import ADAM_EPS, BETAS, PlainOptimizer

_FLAT_COLUMNS = 4096  # length of the rows that a parameter is cut into if all its columns are treated alike


class FieldAdam(PlainOptimizer):
    """Optimize parameters of n Gaussians, (n, ...), on the CPU with the formula and the state of `torch.optim.Adam`.

    The state has torch's keys 'step', 'exp_avg' and 'exp_avg_sq', so densification code that edits the state of torch's
    Adam edits this one. Updates have the same bits for any number of threads.

    Each parameter group also has these options, which may change between steps:
        column_scale: factors on the learning rate, a tensor of the shape of one row, such as (k, 3) for SH; or None.
        active_columns: number of entries of dimension 1 that are updated, such as the SH coefficients up to the current
            degree; None for all. Skipping the others is exact while their gradients have always been zero.
        views: `StepScale.views`, 1 by default.

    Args:
        params: float32 or float64 tensors on the CPU.
        lr, eps: as in torch.optim.Adam, with the epsilon of 3DGS.
        column_scale: as above.

    Raises:
        UserInputError: an argument out of range, or a parameter that is not a contiguous CPU tensor of a fitting shape.
    """

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        lr: float,
        eps: float = ADAM_EPS,
        column_scale: Tensor | None = None,
    ) -> None:
        if lr < 0 or eps < 0:
            raise UserInputError(f"lr {lr}, eps {eps}: expected 0 or more for both")
        options = {"column_scale": column_scale, "active_columns": None, "views": 1}
        super().__init__(params, {"lr": lr, "betas": BETAS, "eps": eps, **options})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]  # without a closure
        """Update every parameter that has a gradient."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._update_parameter(parameter, group)

    def _update_parameter(self, parameter: Tensor, group: dict[str, Any]) -> None:
        from lapgs_plugin.ops.adam.in_numba import adam_kernel  # here, because GPUs do without Numba

        columns, active, scale = _rows(parameter, group["column_scale"], group["active_columns"])
        state = self.state[parameter]
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"] = torch.zeros_like(parameter)
            state["exp_avg_sq"] = torch.zeros_like(parameter)
        state["step"] += group["views"]
        step, (beta1, beta2) = state["step"].item(), group["betas"]
        step_size, correction = group["lr"] / (1 - beta1**step), 1 / math.sqrt(1 - beta2**step)
        beta1, beta2 = beta1 ** group["views"], beta2 ** group["views"]
        rates = np.array([1 - beta1, beta2, 1 - beta2, step_size, correction, group["eps"]], scale.dtype)
        if parameter.numel() == 0:
            return
        assert parameter.grad is not None
        tensors = (parameter, parameter.grad.contiguous(), state["exp_avg"], state["exp_avg_sq"])
        arrays = (tensor.detach().view(-1).numpy() for tensor in tensors)
        parallel(adam_kernel, *arrays, columns, active, scale, rates)
        torch.autograd.graph.increment_version(parameter)  # autograd does not see that a kernel wrote to it


def _rows(parameter: Tensor, scale: Tensor | None, active_columns: int | None) -> tuple[int, int, Floats]:
    """Return the elements in a row, how many of them are updated, and the scale of each."""
    if (
        parameter.device.type != "cpu"
        or parameter.dtype not in (torch.float32, torch.float64)
        or parameter.ndim == 0
        or not parameter.is_contiguous()
    ):
        raise UserInputError(
            f"FieldAdam got a parameter of shape {tuple(parameter.shape)}, {parameter.dtype}, on {parameter.device}: "
            "expected a contiguous (n, ...), float32 or float64, on the CPU; use torch.optim.Adam for others"
        )
    dtype = torch.empty(0, dtype=parameter.dtype).numpy().dtype
    if scale is None and active_columns is None:
        return _FLAT_COLUMNS, _FLAT_COLUMNS, np.ones(_FLAT_COLUMNS, dtype)
    row = parameter.shape[1:]
    if scale is not None and scale.shape != row:
        raise UserInputError(f"column_scale has shape {tuple(scale.shape)}, expected one row's: {tuple(row)}")
    if active_columns is not None and not (row and 0 <= active_columns <= row[0]):
        raise UserInputError(
            f"active_columns {active_columns} for a parameter of shape {tuple(parameter.shape)}: "
            "expected from 0 to the size of its dimension 1"
        )
    columns = row.numel()
    active = columns if active_columns is None else active_columns * row[1:].numel()
    scales = np.ones(columns, dtype) if scale is None else scale.detach().flatten().numpy().astype(dtype)
    return columns, active, scales
