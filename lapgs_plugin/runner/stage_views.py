"""Give a checkout the views of a stage, and render its model from them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.adapters.base import TrainingCall
from lapgs_plugin.checkouts.level_views import PrefetchingViews
from lapgs_plugin.evaluation.metrics import mean_quality
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.runner.context import RunContext, TrainingRun
from lapgs_plugin.runner.rasterizer_wrapper import StageRendering
from lapgs_plugin.runner.stage_images import StageImages
from lapgs_plugin.runs.archive import CACHE
from lapgs_plugin.runs.upsampled_images import UpsampledImages


class StageViews:
    """Hold the cameras of a stage at its level's size with their images.

    Args:
        context, run, stage: the stage and its run.
        call: the script's call of `training` for this stage.
        predictions: Up(I_hat^(l+1)) of every view, closed with the other images; None for the base and nested levels.

    Attributes:
        images: targets and predictions; empty until `load`.
        rendering: the stage as the wrapped rasterizer sees it.
    """

    def __init__(
        self,
        context: RunContext,
        run: TrainingRun,
        stage: Stage,
        call: TrainingCall,
        predictions: UpsampledImages | None,
    ) -> None:
        self._context, self._call, self._stage = context, call, stage
        self._pyramid = Pyramid(context.options.grid)
        self._views: dict[str, Any] = {}
        self.images = StageImages(
            context.images, run.scene, stage, context.options, context.device, run.archive.path(CACHE), predictions
        )
        self.rendering = StageRendering(
            signed=stage.signed,
            path=run.color_path,
            views={self.images.key(camera): camera for camera in self.images.cameras},
            targets=self.images.targets,
            accumulated=self.images.accumulated,
            coarse=self.images.coarse,
            composed=self.images.composed_keys,
            on_image=context.hooks.on_image if context.hooks else None,
        )

    def train_views(self) -> list[Any]:
        """Return the training views; each draw prefetches the next view's images if they are not on the device."""
        views = [self._view(camera) for camera in self.images.train]
        if not self.images.wait_elsewhere:
            return views
        keys = {id(view): key for key, view in self._views.items()}
        return PrefetchingViews(views, lambda view: self.rendering.prefetch(keys[id(view)]))

    def test_views(self) -> list[Any]:
        """Return the held-out views."""
        return [self._view(camera) for camera in self.images.test]

    @torch.no_grad()
    def predict(self, gaussians: Any) -> UpsampledImages:
        """Return the composed image of every view for the next level."""
        predictions = self.images.new_predictions()
        for camera in self.images.cameras:
            width, height = self.images.size(camera, self._stage.level - 1)
            predictions.put(self.images.key(camera), self._composed(gaussians, camera), (height, width))
        predictions.get(self.images.key(self.images.cameras[0]))  # compiles Up now, outside the next stage's clock
        return predictions

    @torch.no_grad()
    def held_out_quality(self, gaussians: Any) -> dict[str, float]:
        """Return means of PSNR in dB and SSIM over the held-out views, upsampled to full resolution."""
        return mean_quality(
            (self._full_size(gaussians, camera), self._context.images[self.images.key(camera)].load(self._device))
            for camera in self.images.test
        )

    def render_train_view(self, rendering: StageRendering, gaussians: Any, camera: Any) -> Tensor:
        """Return the image (3, h, w) of a training camera over black; `rendering` replaces the stage's meanwhile."""
        background = torch.zeros(3, device=self._device)
        return self._context.render(rendering, self._call, self._view(camera), gaussians, background)

    def close(self) -> None:
        """Drop the stage's images, except the predictions for the next stage."""
        self.rendering.accumulated = None
        self.images.close()
        self._views.clear()

    @property
    def _device(self) -> torch.device:
        return self._context.device

    def _view(self, camera: Any) -> Any:
        """Return the camera at this stage's level, the same object on every call."""
        key = self.images.key(camera)
        if key not in self._views:
            size = self.images.size(camera, self._stage.level)
            self._views[key] = self._context.adapter.view_at(
                camera, size, self._stage.signed, lambda: self.rendering.target(key)
            )
        return self._views[key]

    def _composed(self, gaussians: Any, camera: Any) -> Tensor:
        """Return I_hat^l (3, h, w) of a view, before exposure and clamping."""
        rendering = replace(self.rendering, composed=self.images.keys, capture=True)
        background = torch.full((3,), float(self._call.white_background), device=self._device)
        return self._context.render(rendering, self._call, self._view(camera), gaussians, background)

    def _full_size(self, gaussians: Any, camera: Any) -> Tensor:
        """Return a view (3, h, w) at full resolution, with finer residuals of zero."""
        image = self._composed(gaussians, camera)
        for level in range(self._stage.level - 1, -1, -1):
            width, height = self.images.size(camera, level)
            image = self._pyramid.up(image, (height, width))
        return image
