"""Give a checkout the views of a stage, and render its model from them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.level_views import PrefetchingViews
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.evaluation.metrics import mean_quality
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.runner.context import RunContext, TrainingRun
from lapgs_plugin.runner.stage_images import StageImages
from lapgs_plugin.runner.stage_rendering import StageRendering
from lapgs_plugin.runs.layout import CACHE
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
        self._changed: dict[str, set[str]] = {}  # attributes of each view that depend on the level
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
            weights=self.images.weights,
            masked=frozenset(self.images.key(camera) for camera in self.images.train),
            composed=self.images.composed_keys,
            on_image=context.hooks.on_image if context.hooks else None,
        )

    def train_views(self) -> list[Any]:
        """Return the training views; each draw prefetches the next view's images if they are not on the device."""
        views = [self._view(camera) for camera in self.images.train]
        keys = {id(view): key for key, view in self._views.items()}

        def prefetch(view: Any) -> None:
            rendering = self._context.wrapper.stage  # of the running stage: views may outlive this one
            if rendering is not None:
                rendering.prefetch(keys[id(view)])

        return PrefetchingViews(views, prefetch)

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
        """Return means of PSNR in dB and SSIM over the held-out views, upsampled, inside of their masks."""
        images = self._context.images
        masks = {key: mask.to(self._device) for key, mask in images.masks.items()}
        return mean_quality(
            (self._full_size(gaussians, camera), images[key].load(self._device), masks.get(key))
            for camera, key in ((camera, self.images.key(camera)) for camera in self.images.test)
        )

    def render_train_view(self, rendering: StageRendering, gaussians: Any, camera: Any) -> Tensor:
        """Return the image (3, h, w) of a training camera over black; `rendering` replaces the stage's meanwhile."""
        background = torch.zeros(3, device=self._device)
        return self._context.render(rendering, self._call, self._view(camera), gaussians, background)

    def take_over(self, before: StageViews) -> None:
        """Bring the views of another stage to this one's level: the checkout's training holds the objects."""
        self._views, before._views = before._views, {}
        for camera in self.images.cameras:
            if (view := self._views.get(key := self.images.key(camera))) is not None:
                fresh = vars(self._make_view(camera))
                names = before._changed[key] | self._changed[key]
                vars(view).update({name: value for name, value in fresh.items() if name in names})

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
            self._views[key] = self._make_view(camera)
        return self._views[key]

    def _make_view(self, camera: Any) -> Any:
        """Return a copy of the camera at this stage's level, and note which of its attributes are other ones."""
        key = self.images.key(camera)
        size = self.images.size(camera, self._stage.level)
        view = self._context.adapter.view_at(camera, size, self._stage.signed, lambda: self.rendering.target(key))
        before = vars(camera)
        self._changed[key] = {name for name, value in vars(view).items() if value is not before.get(name, self)}
        return view

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
