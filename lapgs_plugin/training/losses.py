"""Compute the losses of a stage's views from their renders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hooks import FieldInTraining, HookDispatcher, StageContext
from lapgs_plugin.ops.mixed_sizes import Sizes, if_mixed, own_part, own_parts
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.vignetting import vignette
from lapgs_plugin.runs.profiling import Breakdown
from lapgs_plugin.runs.run_files import Falloffs
from lapgs_plugin.stages.appearance import ViewAppearance
from lapgs_plugin.stages.images import StageImages
from lapgs_plugin.stages.joint import Predictions, RenderedPredictions

LossOf = Callable[[Tensor, GaussianField], Tensor]
"""Computes the mean loss of some views from their renders, (3, h, w) or (b, 3, h, w), and the field rendered."""


@dataclass
class ViewLosses:
    """Compose the renders of views with the coarser levels, and compare them with the targets.

    Attributes:
        stage: in training.
        images: of the stage.
        breakdown: gets the time in which coarser levels are rendered.
        hooks: compose, and compute losses.
        rasterizer: renders more of the field for hooks that ask for it.
        appearance: transforms of the views' images; None with `--appearance none`.
        falloffs: brightness of the corners of views, see `measure_vignetting`.
        ssim_weight: share of SSIM in a loss.
    """

    stage: Stage
    images: StageImages
    breakdown: Breakdown
    hooks: HookDispatcher
    rasterizer: Rasterizer
    appearance: ViewAppearance | None
    falloffs: Falloffs
    ssim_weight: float

    @cached_property
    def is_plain(self) -> bool:
        """Whether the loss needs nothing but the composed image and the target, so that both can stay as stored."""
        return self.images.photos.weights is None and self.hooks.is_plain(self.stage)

    def below(self) -> Predictions | None:
        """Return the predictions of the views by coarser levels, for use in an iteration; None without such levels."""
        if isinstance(self.images.predictions, RenderedPredictions):
            self.breakdown.mark("forward")
        return self.images.predictions

    def plain(self, names: Sequence[str], cameras: Sequence[Camera]) -> LossOf:
        """Return the loss of some views without hooks."""
        sizes = if_mixed([camera.size for camera in cameras])
        target = self.images.photos.targets.get_stored(*names)
        below = self.below()
        add = None if below is None else below.adder(names)

        def loss(rendered: Tensor, _: GaussianField) -> Tensor:
            composed = rendered if add is None else add(rendered)
            return photometric_loss(self.as_photographed(names, composed, sizes), target, self.ssim_weight, sizes)

        return loss

    def hooked(self, contexts: Sequence[StageContext], names: Sequence[str], cameras: Sequence[Camera]) -> LossOf:
        """Return the loss of some views by all hooks.

        Args:
            contexts: result of `contexts`.
            names, cameras: of the views.
        """
        sizes = [camera.size for camera in cameras]
        together = self._batches_hooks(cameras)

        def of(context: StageContext, shown: Sequence[str], image: Tensor) -> Tensor:
            return self.hooks.loss(context, self.as_photographed(shown, self.hooks.compose(context, image)))

        def loss(rendered: Tensor, field: GaussianField) -> Tensor:
            if together:
                return of(contexts[0], names, rendered)
            images = [rendered] if rendered.ndim == 3 else own_parts(rendered, sizes)
            losses = []
            for context, name, camera, image in zip(contexts, names, cameras, images, strict=True):
                here = replace(context, field=FieldInTraining(field, camera, self.rasterizer))
                losses.append(of(here, [name], image))
            return losses[0] if len(losses) == 1 else torch.stack(losses).mean()

        return loss

    def contexts(
        self, iterations: Sequence[int], names: Sequence[str], cameras: Sequence[Camera]
    ) -> list[StageContext]:
        """Return the contexts of hooks: one for each view, or one for all if every hook takes batches."""
        (target, coarse_target), below = self.images.photos.get(*names), self.below()
        context = StageContext(
            stage=self.stage,
            iteration=iterations[-1],
            view=names[-1],
            target=target,
            accumulated=None if below is None else below.get(*names),
            coarse_target=coarse_target,
            weight=self.images.photos.get_weights(*names),
        )
        if len(names) == 1 or self._batches_hooks(cameras):
            return [context]

        def of(images: Tensor | None, index: int) -> Tensor | None:
            return None if images is None else own_part(images[index], cameras[index].size)

        return [
            replace(
                context,
                iteration=iteration,
                view=name,
                target=own_part(target[index], cameras[index].size),
                accumulated=of(context.accumulated, index),
                coarse_target=of(coarse_target, index),
                weight=of(context.weight, index),
            )
            for index, (iteration, name) in enumerate(zip(iterations, names, strict=True))
        ]

    def _batches_hooks(self, cameras: Sequence[Camera]) -> bool:
        """Return whether hooks are called once for all views, which takes images of one size."""
        return self.hooks.takes_batches and not if_mixed([camera.size for camera in cameras])

    def as_photographed(self, names: Sequence[str], image: Tensor, sizes: Sizes | None = None) -> Tensor:
        """Return the composed image of a view, or images of several, with falloff and appearance of their photos.

        Args:
            names, image: of the views.
            sizes: of views whose sizes differ, see `mixed_sizes`.
        """
        if self.falloffs:
            image = vignette(image, [self.falloffs.get(name, 0.0) for name in names], sizes)
        return image if self.appearance is None else self.appearance.apply(names, image, sizes)
