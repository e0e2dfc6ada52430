"""What the stages of a run over a checkout share, and what each hands on to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter, TrainingCall
from lapgs_plugin.checkouts.level_views import PhotoAlbum
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.runner.hooking import HookCaller
from lapgs_plugin.runner.iteration_parts import IterationParts
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runner.shim import RasterizerShim, StageRendering
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.runs.watcher import Watcher


@dataclass(frozen=True)
class RunContext:
    """What all stages of a run share.

    Attributes:
        adapter: of the checkout.
        options: of the hierarchy.
        device: where the checkout renders.
        album: the images of its scene.
        shim: between its render and its rasterizer.
        hooks: of the user.
        parts: told which part of an iteration begins.
        test_every: iterations between two measurements of held-out views; None measures them at the end of the run.
        watcher: may look at the fields between iterations.
    """

    adapter: BackboneAdapter
    options: RunSettings
    device: torch.device
    album: PhotoAlbum
    shim: RasterizerShim
    hooks: HookCaller
    parts: IterationParts
    watcher: Watcher
    test_every: int | None

    def image(
        self, rendering: StageRendering, call: TrainingCall, view: Any, gaussians: Any, background: Tensor
    ) -> Tensor:
        """(3, h, w) what the checkout's render makes of a view, before exposure or clamping.

        Args:
            rendering: takes the running stage's place meanwhile; it captures.
            call: of the script's `training`, as the stage of these Gaussians made it.
            view: the checkout's camera at that stage's level.
            gaussians: the checkout's model.
            background: (3,) behind them.
        """
        outer, self.shim.stage = self.shim.stage, rendering
        try:
            self.adapter.render(call, view, gaussians, background)
        finally:
            self.shim.stage = outer
        image, rendering.captured = rendering.captured, None
        assert image is not None, "a rendering that captures"
        return image


@dataclass(frozen=True)
class LoadedScene:
    """A checkout's scene, its cameras without images."""

    scene: Any
    points: Any  # the checkout's BasicPointCloud
    others: tuple[Any, ...]  # what create_from_pcd takes after the points

    @property
    def train(self) -> list[Any]:
        return list(self.scene.getTrainCameras())

    @property
    def test(self) -> list[Any]:
        return list(self.scene.getTestCameras())


@dataclass(frozen=True)
class Finished:
    """What a stage leaves for the next one.

    Attributes:
        field: its Gaussians, on the CPU.
        predictions: Up(I_hat^l) of every view by key; None after the finest level, and where levels are nested.
        carried: attributes for the next model.
        moments: optimizer state by parameter group, for full inheritance.
    """

    field: GaussianField
    predictions: UpsampledImages | None
    carried: Mapping[str, Any]
    moments: Mapping[str, dict[str, Tensor]]
