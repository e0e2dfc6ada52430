"""The finished fields, trained along in the last part of a residual stage.

A finished level cannot learn any more that what it left to the next one is more than that one can express; its
mistakes on views that nobody photographed stay as well. So towards the end of a stage the finished fields are rendered
again instead of being read from a cache, and step whenever the residual does. They are small, and rendered at their
own sizes, but on a GPU that waits for the next launch more than it computes, they double what an iteration takes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import GROUPS, TrainingCall
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.adam import ADAM_EPS
from lapgs_plugin.ops.composition import compose
from lapgs_plugin.ops.upsample import upsample
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.run_state import RunContext
from lapgs_plugin.runner.shim import StageRendering
from lapgs_plugin.runner.stage_images import StageImages
from lapgs_plugin.runs.archive import RunArchive

COLORS = ("f_dc", "f_rest")


@dataclass(frozen=True)
class FinishedStage:
    """A stage whose field is in the archive.

    Attributes:
        stage: what was trained.
        call: of the script's `training`, as that stage made it.
    """

    stage: Stage
    call: TrainingCall


@dataclass
class _FinishedField:
    """A finished field on its way again.

    Attributes:
        of: where it comes from.
        gaussians: the checkout's model of it.
        rendering: what the shim has to know to render it by itself.
        background: (3,) behind it.
        views: level views by key, made when they are first rendered.
    """

    of: FinishedStage
    gaussians: Any
    rendering: StageRendering
    background: Tensor
    views: dict[str, Any] = field(default_factory=dict)


class JointLevels:
    """Takes the place of a stage's cached predictions, and trains what they are made of.

    Args:
        context: what the stages share.
        finished: the coarser stages, coarsest first.
        archive: holds their fields.
        images: of the running stage.
        path: how signed colour is evaluated.
    """

    def __init__(
        self,
        context: RunContext,
        finished: Sequence[FinishedStage],
        archive: RunArchive,
        images: StageImages,
        path: ColorPath,
    ) -> None:
        self._context, self._archive, self._images = context, archive, images
        self._pyramid = Pyramid(context.options.grid)
        self._cameras = {images.key(camera): camera for camera in images.cameras}
        views = {id(camera.world_view_transform): key for key, camera in self._cameras.items()}
        self._fields = [self._unfrozen(one, views, path) for one in finished]

    def _unfrozen(self, finished: FinishedStage, views: dict[int, str], path: ColorPath) -> _FinishedField:
        adapter, device, call = self._context.adapter, self._context.device, finished.call
        gaussians = adapter.model_of(call, self._archive.field(finished.stage.level).to(device))
        rendering = StageRendering(signed=finished.stage.signed, path=path, views=views, capture=True)
        background = torch.full((3,), float(call.dataset.white_background), device=device)
        return _FinishedField(finished, gaussians, rendering, background)

    def follow(self, gaussians: Any, residual_color_rate: float) -> None:
        """Step the finished fields whenever an optimizer of the running stage does, at that one's rates.

        Args:
            gaussians: the running stage's model.
            residual_color_rate: factor that the rates of its colours have, and those of a base do not.
        """
        for leading in self._context.adapter.optimizers(gaussians):
            names = [group["name"] for group in leading.param_groups]
            groups = [
                {
                    "params": [getattr(one.gaussians, GROUPS[name])],
                    "leader": position,
                    "factor": 1 / residual_color_rate if name in COLORS and not one.of.stage.signed else 1.0,
                }
                for one in self._fields
                for position, name in enumerate(names)
            ]
            on_gpu = self._context.device.type == "cuda"
            following = torch.optim.Adam(groups, lr=0.0, eps=ADAM_EPS, fused=on_gpu)
            leading.register_step_post_hook(_Follow(following))

    def prefetch(self, key: str) -> None:
        """Nothing has to be brought from anywhere."""

    def get(self, key: str) -> Tensor:
        """(3, h, w) Up of what the finished fields make of a view, with gradients where they are recorded."""
        camera = self._cameras[key]
        levels = [(one, one.of.stage.level) for one in self._fields]
        renders = ((level, self._render(one, key, self._images.size(camera, level))) for one, level in levels)
        width, height = self._images.size(camera, levels[-1][1] - 1)
        return upsample(self._pyramid, compose(self._pyramid, renders).image, (height, width))

    def _render(self, one: _FinishedField, key: str, size: tuple[int, int]) -> Tensor:
        """(3, h, w) of one field alone."""
        if key not in one.views:
            one.views[key] = self._context.adapter.view_at(self._cameras[key], size, one.of.stage.signed, _no_image)
        return self._context.image(one.rendering, one.of.call, one.views[key], one.gaussians, one.background)

    @property
    def fields(self) -> dict[int, GaussianField]:
        """What the fields are now, by level."""
        adapter = self._context.adapter
        return {one.of.stage.level: adapter.snapshot(one.gaussians, one.of.stage.signed) for one in self._fields}

    def export_fields(self) -> dict[int, GaussianField]:
        """What the fields have become, by level, as `BackboneAdapter.export_field` gives them, on the CPU."""
        adapter = self._context.adapter
        exported = {}
        for one in self._fields:
            stage = one.of.stage
            exported[stage.level] = adapter.export_field(one.gaussians, signed=stage.signed).to("cpu")
        return exported


class _Follow:
    """Called after a step of the leading optimizer: the same step for those who follow."""

    def __init__(self, following: torch.optim.Optimizer) -> None:
        self._following = following

    def __call__(self, leading: torch.optim.Optimizer, *_: Any) -> None:
        for group in self._following.param_groups:
            group["lr"] = leading.param_groups[group["leader"]]["lr"] * group["factor"]
        self._following.step()
        self._following.zero_grad(set_to_none=True)


def _no_image() -> Tensor:
    raise AssertionError("a finished field is compared with nothing of its own")
