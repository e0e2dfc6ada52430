"""Optimize the finished fields jointly with the residual in the last part of a residual stage.

A frozen coarse level cannot correct errors that the finer level is unable to represent. So towards the end of a stage
the finished fields are rendered instead of being read from a cache, and step whenever the residual does. Each adds the
launches of a render of its own to an iteration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import GROUPS
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.adam import ADAM_EPS
from lapgs_plugin.ops.adam.tensorwise import fuse_steps
from lapgs_plugin.ops.composition import compose
from lapgs_plugin.ops.upsample import upsample
from lapgs_plugin.runner.context import FinishedStage, TrainingRun
from lapgs_plugin.runner.stage_rendering import StageRendering
from lapgs_plugin.runner.stage_views import StageViews

COLORS = ("f_dc", "f_rest")


@dataclass
class _JointField:
    """Hold a finished field that is optimized again.

    Attributes:
        of: the stage that it comes from.
        gaussians: the checkout's model of it.
        rendering: tells the rasterizer's wrapper to render it alone.
        views: level views by key, made when they are first rendered.
    """

    of: FinishedStage
    gaussians: Any
    rendering: StageRendering
    views: dict[str, Any] = field(default_factory=dict)


class JointLevels:
    """Render the predictions of coarser levels in place of cached ones, and optimize the fields behind them.

    Args:
        run: the run, whose archive has the coarser fields.
        finished: the coarser stages, coarsest first.
        views: of the running stage.
    """

    where = "gpu"  # nothing has to be copied

    def __init__(self, run: TrainingRun, finished: Sequence[FinishedStage], views: StageViews) -> None:
        self._context, self._run, self._views = run.context, run, views
        self._pyramid = Pyramid(run.settings.grid)
        self._fields = [self._load(one) for one in finished]

    def _load(self, finished: FinishedStage) -> _JointField:
        adapter, device, call = self._context.adapter, self._context.device, finished.call
        gaussians = adapter.model_of(call, self._run.archive.field(finished.stage.level).to(device))
        rendering = StageRendering(
            signed=finished.stage.signed, path=self._run.color_path, views=self._views.cameras, capture=True
        )
        return _JointField(finished, gaussians, rendering)

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
                    "params": [getattr(one.gaussians, GROUPS[name])],
                    "leader": position,
                    "factor": 1 / residual_color_rate if name in COLORS and not one.of.stage.signed else 1.0,
                }
                for one in self._fields
                for position, name in enumerate(names)
                if name in GROUPS  # archived fields have none of a fork's other parameters
            ]
            if groups:
                following = torch.optim.Adam(groups, lr=0.0, eps=ADAM_EPS)
                if self._context.device.type == "cuda":
                    fuse_steps(following)
                leading.register_step_post_hook(partial(_follow, following))

    def prefetch(self, key: str) -> None:
        """Do nothing: predictions are rendered."""

    def get(self, key: str) -> Tensor:
        """Return the upsampled prediction (3, h, w) of a view, differentiable where gradients are recorded."""
        renders = ((one.of.stage.level, self._render(one, key)) for one in self._fields)
        width, height = self._views.size(key, self._fields[-1].of.stage.level - 1)
        return upsample(self._pyramid, compose(self._pyramid, renders).image, (height, width))

    def _render(self, one: _JointField, key: str) -> Tensor:
        """Return the image (3, h, w) of one field alone."""
        if key not in one.views:
            stage, camera = one.of.stage, self._views.cameras[key]
            size = self._views.size(key, stage.level)
            one.views[key] = self._context.adapter.view_at(camera, size, stage.signed, _no_image)
        return self._context.render(one.rendering, one.of.call, one.views[key], one.gaussians).image

    def fields(self, read: Callable[[Any, bool], GaussianField]) -> dict[int, GaussianField]:
        """Return the fields by level; `read` makes one from the checkout's model and whether it is a residual."""
        return {one.of.stage.level: read(one.gaussians, one.of.stage.signed) for one in self._fields}


def _follow(following: torch.optim.Optimizer, leading: torch.optim.Optimizer, *_: Any) -> None:
    """Step an optimizer after a step of the leading one, at its learning rates."""
    for group in following.param_groups:
        group["lr"] = leading.param_groups[group["leader"]]["lr"] * group["factor"]
    following.step()
    following.zero_grad(set_to_none=True)


def _no_image() -> Tensor:
    raise AssertionError("a finished field has no target of its own")
