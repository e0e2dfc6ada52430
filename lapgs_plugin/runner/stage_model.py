"""Initialise the checkout's model of a stage, and collect the state that the next stage's model inherits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from lapgs_plugin.adapters.base import GROUPS
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.ops.adam.multi_tensor import fuse_steps
from lapgs_plugin.ops.unit_quaternions import unit_quaternions
from lapgs_plugin.runner.context import StageResult, TrainingRun
from lapgs_plugin.runner.object_values import fields_of, with_values
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import OPTIMIZER

SH_REST = "f_rest"
"""Parameter group of SH above degree 0 in the family's optimizers."""

ROTATION = "rotation_activation"
"""Attribute of the family's models: the function that normalises quaternions."""


class StageModel:
    """Pass Gaussians and optimizer state from one stage's model to the next; `before` is None for the base."""

    def __init__(self, run: TrainingRun, stage: Stage, before: StageResult | None) -> None:
        self._options, self._adapter, self._device = run.settings, run.context.adapter, run.device
        self._run, self._scene, self._stage, self._before = run, run.scene, stage, before
        self._kept: Tensor  # (n,) Gaussians of the level before that are inherited

    def initialise(self, gaussians: Any) -> None:
        """Create the model's Gaussians: from points for the base, inherited for a finer level."""
        points, others = self._scene.points, self._scene.others
        if self._before is None:
            gaussians.create_from_pcd(points, *others)
            return
        mode = self._options.inherit_mode
        field, self._kept = self._run.inherited(self._before.field)
        positions = field.means.numpy().astype(np.float64)
        grey = np.full_like(positions, 0.5)  # the colour whose SH coefficient is zero
        # Other values that a fork has of each point of the scene are unknown here.
        count, known = len(points.points), fields_of(points).items()
        unknown = {
            name: np.zeros((len(positions), *value.shape[1:]), value.dtype)
            for name, value in known
            if isinstance(value, np.ndarray) and value.shape[:1] == (count,)
        }
        gaussians.create_from_pcd(with_values(points, {**unknown, "points": positions, "colors": grey}), *others)
        if mode != "xyz":
            names = ["_rotation", "_scaling", "_opacity"]
            if mode == "full":
                names += ["_features_dc", "_features_rest"]
            self._adapter.import_field(gaussians, field.to(self._device), names)
        for name, value in self._before.carried.items():
            setattr(gaussians, name, value)

    def prepare_optimizers(self, gaussians: Any, inherit: bool) -> None:
        """Set the rate of SH in the checkout's new optimizers, and let them inherit state; fuse operations on a GPU.

        Args:
            gaussians: the checkout's model.
            inherit: whether the stage begins; optimizers that a loop makes later start anew in the checkout, too.
        """
        if self._device.type == "cuda":
            fuse_rotations(gaussians)
        optimizers = self._adapter.optimizers(gaussians)
        if self._options.sh_rate != 1.0:
            _scale_sh_rate(optimizers, self._options.sh_rate)
        for optimizer in optimizers:
            if inherit and self._before is not None:
                self._inherit_moments(optimizer, self._before.moments)
            if self._options.fused_adam and self._device.type == "cuda":
                fuse_steps(optimizer)

    def carried(self, gaussians: Any) -> dict[str, Any]:
        """Return attributes for the next model besides its Gaussians. SH of a residual start again at degree 0."""
        degree = {"active_sh_degree": gaussians.active_sh_degree} if self._options.nested else {}
        return {**self._adapter.carried_over(gaussians), **degree}

    def moments(self, gaussians: Any) -> dict[str, dict[str, Tensor]]:
        """Return optimizer state by parameter group on the CPU; empty unless the next stage inherits it."""
        if self._options.inherit_mode != "full" or self._stage.level == 0:
            return {}
        state = {}
        for optimizer in self._adapter.optimizers(gaussians):
            for group in _of_gaussians(optimizer):
                values = optimizer.state.get(group["params"][0], {})
                state[group["name"]] = {n: torch.as_tensor(v).detach().cpu().clone() for n, v in values.items()}
        return state

    def load_inherited(self, archive: RunArchive) -> tuple[dict[str, Any], dict[str, dict[str, Tensor]]]:
        """Return `carried` and `moments` of this stage from the archive.

        Raises:
            RunFolderError: the file is damaged.
        """
        path = archive.path(f"level_{self._stage.level}", OPTIMIZER)
        if not path.exists():
            return {}, {}
        stored = archive.optimizer_state(self._stage.level)
        if not all(isinstance(stored.get(part), dict) for part in ("carried", "moments")):
            raise RunFolderError(
                f"{path} holds {', '.join(map(str, stored))}, expected carried and moments; start again with "
                "--overwrite"
            )
        carried = {
            name: torch.nn.Parameter(value.detach().to(self._device)) if isinstance(value, Tensor) else value
            for name, value in stored["carried"].items()
        }
        return carried, stored["moments"]

    def _inherit_moments(self, optimizer: torch.optim.Optimizer, moments: Mapping[str, dict[str, Tensor]]) -> None:
        for group in _of_gaussians(optimizer):
            if state := moments.get(group["name"]):
                optimizer.state[group["params"][0]] = {
                    name: value[self._kept].to(self._device) if value.ndim else value for name, value in state.items()
                }


def _of_gaussians(optimizer: torch.optim.Optimizer) -> list[dict[str, Any]]:
    """Return the parameter groups that inherit: a fork's own may have another row than one a Gaussian, or no name."""
    return [group for group in optimizer.param_groups if group.get("name") in GROUPS]


def _scale_sh_rate(optimizers: Sequence[torch.optim.Optimizer], factor: float) -> None:
    groups = [group for optimizer in optimizers for group in optimizer.param_groups if group.get("name") == SH_REST]
    if not groups:
        raise UserInputError(
            f"--sh-rate {factor:g}: the checkout's optimizers have no parameter group {SH_REST}; leave it "
            "out, and give its script the learning rate"
        )
    for group in groups:
        group["lr"] *= factor


def fuse_rotations(gaussians: Any) -> None:
    """Let a checkout's model normalise quaternions in our kernels, if it does in PyTorch's 17 operations."""
    if getattr(gaussians, ROTATION, None) is normalize:
        setattr(gaussians, ROTATION, unit_quaternions)
