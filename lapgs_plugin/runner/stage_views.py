"""Give a checkout the views of a stage with their images, and render its model from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.level_views import PrefetchingViews, view_name
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.evaluation.metrics import psnr, qualities
from lapgs_plugin.hierarchy.plan import Stage, level_size
from lapgs_plugin.ops.mixed_sizes import largest_size
from lapgs_plugin.registry import NONE
from lapgs_plugin.runner.context import TrainingRun
from lapgs_plugin.runner.stage_rendering import Captured, StageRendering
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.stages.appearance import KINDS, ViewAppearance, identities
from lapgs_plugin.stages.images import StageImages
from lapgs_plugin.stages.joint import RenderedPredictions


class StageViews:
    """Hold the cameras of a stage at its level's size, and their images.

    Views are named by the keys of `SceneImages`.

    Args:
        run, stage: the stage and its run.
        call: the script's call of `training` for this stage.
        predictions: Up(I_hat^(l+1)) of every view, closed with the other images; None for the base and nested levels.

    Attributes:
        cameras: the scene's cameras by key.
        sizes: (width, height) of their photos by key.
        train, test: keys of the training and of the held-out views.
        images: photos and predictions of all views; photos only after `load_images`.
        appearance: learned of each training view; None with `--appearance none`.
        rendering: the stage as the wrapped rasterizer sees it.
    """

    def __init__(
        self,
        run: TrainingRun,
        stage: Stage,
        call: TrainingCall,
        predictions: UpsampledImages | None,
    ) -> None:
        self._context, self._run, self._call, self._stage = run.context, run, call, stage
        photos = run.context.images
        train, test = (
            {photos.key(camera): camera for camera in cameras} for cameras in (run.scene.train, run.scene.test)
        )
        self.cameras, self.train, self.test = {**train, **test}, list(train), list(test)
        self._training = frozenset(train)
        self.sizes = {key: photos[key].size for key in self.cameras}
        self._views: dict[str, Any] = {}
        self._changed: dict[str, set[str]] = {}  # attributes of each view that depend on the level
        self.images = StageImages(run, stage, self.sizes, eight_bit=photos.exact, masked=photos.masked)
        self.images.predictions = self.images.held_out = predictions
        self.appearance = _first_appearance(run, stage, {view_name(key): self.sizes[key] for key in train})
        self.rendering = StageRendering(
            signed=stage.signed,
            path=run.color_path,
            views=self.cameras,
            images=self.images.photos,
            accumulated=predictions,
            masked=frozenset(train if photos.masked else ()),
            composed=frozenset(self.cameras if run.supervision.composes else test),
            on_image=run.context.hooks.on_image if run.context.hooks else None,
            as_photographed=None if self.appearance is None else self._as_photographed,
        )
        if run.context.depth is not None and not stage.signed:
            sizes = {key: self.size(key, stage.level) for key in self.train}
            self.rendering.on_call = run.context.depth.in_stage(run.plan, stage, sizes)

    def load_images(self) -> None:
        """Make I^l of every view, and Up(I^(l+1)) of training views if the supervision needs it."""
        photos = self._context.images
        for key in self.cameras:
            photo = photos[key].load(self._run.device)
            self.images.photos.put(key, photo, photos.mask(key), with_coarse=key in self._training)

    def size(self, key: str, level: int) -> tuple[int, int]:
        """Return (width, height) of a view's image at a level."""
        return level_size(self.sizes[key], level)

    def train_views(self) -> list[Any]:
        """Return the training views; each draw prefetches the next view's images if they are not on the device."""

        def prefetch(next_view: Callable[[], Any]) -> None:
            rendering = self._context.stages.rendering  # of the running stage: views may outlive this one
            if rendering is not None and rendering.prefetches:
                rendering.prefetch(self._context.images.key(next_view()))

        return PrefetchingViews([self._view(key) for key in self.train], prefetch)

    def test_views(self) -> list[Any]:
        """Return the held-out views."""
        return [self._view(key) for key in self.test]

    @torch.no_grad()
    def predict(self, gaussians: Any) -> UpsampledImages:
        """Return the composed image of every view for the next level."""
        level = self._stage.level
        composed = partial(self._composed, gaussians)
        predictions = self.images.cache(level, f"predictions_{level}", self.sizes, composed)
        predictions.get(next(iter(self.cameras)))  # compiles Up now, outside the next stage's clock
        return predictions

    @torch.no_grad()
    def held_out_qualities(self, gaussians: Any) -> list[dict[str, float]]:
        """Return PSNR in dB and SSIM of each held-out view, upsampled, inside of its mask."""
        return qualities(self._beside_photo(key, self._composed(gaussians, key)) for key in self.test)

    @torch.no_grad()
    def held_out_without(self) -> list[float]:
        """Return the PSNR in dB of each held-out view without the level; empty unless it is a residual."""
        predictions = self.images.predictions
        return (
            [] if predictions is None else [psnr(*self._beside_photo(key, predictions.get(key))) for key in self.test]
        )

    def _beside_photo(self, key: str, image: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return an image (3, h, w) of the level at full size, the view's photo and its mask."""
        run, photos = self._run, self._context.images
        return run.beside_photo(self._stage.level, image, photos[key].load(run.device), photos.mask(key))

    def render_alone(self, rendering: StageRendering, gaussians: Any, key: str, *, black: bool = True) -> Captured:
        """Render a view; `rendering` replaces the stage's, `black` the call's background."""
        return self._context.render(rendering, self._call, self._view(key), gaussians, black=black)

    def take_over(self, before: StageViews) -> None:
        """Bring the views of another stage to this one's level: the checkout's training holds the objects."""
        self._views, before._views = before._views, {}
        for key, view in self._views.items():
            fresh = vars(self._make_view(key))
            names = before._changed[key] | self._changed[key]
            vars(view).update({name: value for name, value in fresh.items() if name in names})

    def predict_jointly(self, rendered: RenderedPredictions) -> None:
        """Render the predictions of coarser levels from now on."""
        self.images.predictions = self.images.held_out = self.rendering.accumulated = rendered

    def close(self) -> None:
        """Drop the stage's images, except the predictions for the next stage."""
        self.rendering.accumulated = None
        self.images.close()
        self._views.clear()

    def _view(self, key: str) -> Any:
        """Return the camera of a view at this stage's level, the same object on every call."""
        if key not in self._views:
            self._views[key] = self._make_view(key)
        return self._views[key]

    def _make_view(self, key: str) -> Any:
        """Return a copy of a camera at this stage's level, and note which of its attributes are other ones."""
        camera, size = self.cameras[key], self.size(key, self._stage.level)
        view = self._context.adapter.view_at(camera, size, self._stage.signed, lambda: self.rendering.target(key))
        before = vars(camera)
        self._changed[key] = {name for name, value in vars(view).items() if value is not before.get(name, self)}
        return view

    def _as_photographed(self, key: str, image: Tensor) -> Tensor:
        """Return the composed image (3, h, w) of a view with the appearance of its photo if it is a training view."""
        assert self.appearance is not None, "else it is not called"
        return self.appearance.apply([view_name(key)], image) if key in self._training else image

    def _composed(self, gaussians: Any, key: str) -> Tensor:
        """Return I_hat^l (3, h, w) of a view, before exposure and clamping."""
        rendering = replace(self.rendering, composed=frozenset(self.cameras), capture=True)
        return self._context.render(rendering, self._call, self._view(key), gaussians).image


def _first_appearance(run: TrainingRun, stage: Stage, photos: Mapping[str, tuple[int, int]]) -> ViewAppearance | None:
    """Return what a stage starts with: what the coarser level learned of photos, by name with their sizes."""
    if (choice := run.settings.appearance) == NONE:
        return None
    kind, names, levels = KINDS[choice], list(photos), run.archive.available_levels
    start = kind.read(run.archive, levels[-1], names) if levels else None
    if start is None:
        start = kind.uniform(identities(len(names)), largest_size(list(photos.values())))
    return kind.create(names, start, run.device, run.plan.iterations_before(stage.level), run.plan.iterations)
