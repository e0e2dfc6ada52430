"""Render finished models and step them with the residual, in the joint part of its stage."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import GROUPS
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.gpu_raster.records import state_of
from lapgs_plugin.ops.adam import ADAM_EPS
from lapgs_plugin.ops.adam.multi_tensor import fuse_steps
from lapgs_plugin.runner.context import FinishedStage, TrainingRun
from lapgs_plugin.runner.stage_model import fuse_rotations
from lapgs_plugin.runner.stage_rendering import StageRendering
from lapgs_plugin.runner.stage_views import StageViews
from lapgs_plugin.stages.joint import RenderedPredictions

COLORS = ("f_dc", "f_rest")


@dataclass(frozen=True)
class _JointField:
    """Hold a finished field that is optimized again.

    Attributes:
        finished: the stage that it comes from.
        gaussians: the checkout's model of it.
        rendering: tells the rasterizer's wrapper to render it alone.
        views: level views by key, made when they are first rendered.
    """

    finished: FinishedStage
    gaussians: Any
    rendering: StageRendering
    views: dict[str, Any] = field(default_factory=dict)


class _Shown(NamedTuple):
    """Hold the last image that was rendered without gradients: score functions render each view twice.

    Attributes:
        key: of the view.
        states: of the field's tensors, which change in all but steps of our optimizer.
        image: (3, h, w).
    """

    key: str
    states: list[tuple[int, int]]
    image: Tensor


class JointModels:
    """Optimize the fields of finished stages.

    Args:
        run: the run, whose archive has the fields.
        finished: their stages, coarsest first.
        views: of the running stage.
    """

    def __init__(self, run: TrainingRun, finished: Sequence[FinishedStage], views: StageViews) -> None:
        self._context, self._run, self._views = run.context, run, views
        self._fields = {stage.stage.level: self._load(stage) for stage in finished}
        self._shown: dict[int, _Shown] = {}  # by level

    def _load(self, finished: FinishedStage) -> _JointField:
        adapter, call, stage = self._context.adapter, finished.call, finished.stage
        gaussians = adapter.model_of(call, self._run.archive.field(stage.level).to(self._run.device))
        if self._run.device.type == "cuda":
            fuse_rotations(gaussians)
        path, cameras = self._run.color_path, self._views.cameras
        rendering = StageRendering(stage.signed, path, cameras, capture=True, for_image=True)
        return _JointField(finished, gaussians, rendering)

    def predictions(self) -> RenderedPredictions:
        """Return predictions by these fields, differentiable where gradients are recorded."""
        return RenderedPredictions(tuple(self._fields), self._render, self._views.sizes, self._run.pyramid)

    def follow(self, gaussians: Any, residual_color_rate: float) -> None:
        """Step the finished fields whenever an optimizer of the running stage steps, at its learning rates.

        Args:
            gaussians: the running stage's model.
            residual_color_rate: factor on its SH learning rates, which a base does not have.
        """
        for leading in self._context.adapter.optimizers(gaussians):
            names = [group.get("name") for group in leading.param_groups]
            groups = [
                {
                    "params": [getattr(joint.gaussians, GROUPS[name])],
                    "leader": position,
                    "factor": 1 / residual_color_rate if name in COLORS and not joint.finished.stage.signed else 1.0,
                }
                for joint in self._fields.values()
                for position, name in enumerate(names)
                if name in GROUPS  # archived fields have none of a fork's other parameters
            ]
            if groups:
                following = torch.optim.Adam(groups, lr=0.0, eps=ADAM_EPS)
                if self._run.device.type == "cuda":
                    fuse_steps(following)
                leading.register_step_post_hook(partial(self._step, following))

    def _step(self, following: torch.optim.Optimizer, leading: torch.optim.Optimizer, *_: Any) -> None:
        """Step finished fields, whose images are others then."""
        _follow(following, leading)
        self._shown.clear()

    def _render(self, level: int, keys: Sequence[str]) -> Tensor:
        """Return the image (3, h, w) of a level's field alone; `keys` is that of one view."""
        (key,), joint = keys, self._fields[level]
        if key not in joint.views:
            camera, size = self._views.cameras[key], self._views.size(key, level)
            joint.views[key] = self._context.adapter.view_at(camera, size, joint.finished.stage.signed, _no_image)
        if torch.is_grad_enabled():
            return self._rendered(joint, key)
        shown, states = self._shown.get(level), [state_of(getattr(joint.gaussians, name)) for name in GROUPS.values()]
        if shown is None or shown.key != key or shown.states != states:
            shown = self._shown[level] = _Shown(key, states, self._rendered(joint, key))
        return shown.image

    def _rendered(self, joint: _JointField, key: str) -> Tensor:
        return self._context.render(joint.rendering, joint.finished.call, joint.views[key], joint.gaussians).image

    def fields(self, read: Callable[[Any, bool], GaussianField]) -> dict[int, GaussianField]:
        """Return the fields by level; `read` makes one from the checkout's model and whether it is a residual."""
        return {level: read(joint.gaussians, joint.finished.stage.signed) for level, joint in self._fields.items()}


def _follow(following: torch.optim.Optimizer, leading: torch.optim.Optimizer) -> None:
    """Step an optimizer after a step of the leading one, at its learning rates."""
    for group in following.param_groups:
        group["lr"] = leading.param_groups[group["leader"]]["lr"] * group["factor"]
    following.step()
    following.zero_grad(set_to_none=True)


def _no_image() -> Tensor:
    raise AssertionError("a finished field has no target of its own")
