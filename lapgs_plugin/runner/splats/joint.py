"""Optimize finished levels jointly with a residual in the last part of its stage."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import torch

from lapgs_plugin.ops.adam import ADAM_EPS
from lapgs_plugin.ops.adam.multi_tensor import fuse_steps
from lapgs_plugin.runner.splats.signed import CoarserLevels, FinishedField

COLORS = ("sh0", "shN")


def trainable(field: FinishedField, device: torch.device) -> FinishedField:
    """Return a finished field whose splats are parameters."""
    splats = {name: torch.nn.Parameter(value.detach().to(device).clone()) for name, value in field.splats.items()}
    return FinishedField(field.level, field.signed, splats)


def follow(
    coarser: CoarserLevels, optimizers: Mapping[str, torch.optim.Optimizer], color_factor: float, device: torch.device
) -> None:
    """Step finished fields whenever the optimizers of a running residual step, at their learning rates.

    Args:
        coarser: the fields, of parameters.
        optimizers: of the residual, by the names of its splats.
        color_factor: factor on the residual's SH learning rates, which a base does not have.
        device: of the fields.
    """
    for name, leading in optimizers.items():
        groups = [
            {"params": [field.splats[name]], "factor": 1 / color_factor if name in COLORS and not field.signed else 1.0}
            for field in coarser.fields
            if name in field.splats
        ]
        if not groups:
            continue
        following = torch.optim.Adam(groups, lr=0.0, eps=ADAM_EPS)
        if device.type == "cuda":
            fuse_steps(following)
        leading.register_step_post_hook(partial(_follow, following))


def _follow(following: torch.optim.Optimizer, leading: torch.optim.Optimizer, *_: Any) -> None:
    """Step an optimizer after a step of the leading one, at its learning rate."""
    for group in following.param_groups:
        group["lr"] = leading.param_groups[0]["lr"] * group["factor"]
    following.step()
    following.zero_grad(set_to_none=True)
