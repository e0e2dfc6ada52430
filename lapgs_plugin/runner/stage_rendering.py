"""Render a stage through a checkout's rasterizer: recognise the view, and compose its image with coarser levels."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.level_views import view_name
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.masks import fill_outside
from lapgs_plugin.ops.composition import add_prediction
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.object_values import RasterOutputs, fields_of, matrix_keys, size_of
from lapgs_plugin.runner.signed_calls import with_signed_colors
from lapgs_plugin.runs.level_images import LevelImages
from lapgs_plugin.stages.joint import Predictions

logger = logging.getLogger(__name__)

OnCall = Callable[[str, Tensor, Callable[..., Any], Mapping[str, Any], Any], Tensor]
GREY = 0.5
"""Value added to residuals for cameras that are no view of the scene, such as a viewer's."""


@dataclass(frozen=True)
class Captured:
    """Hold the last call of a checkout's rasterizer for a model's colours.

    Attributes:
        image: (3, h, w) composed image, before exposure or clamping.
        rasterizer: with its settings.
        inputs: by name.
        settings: of the rasterizer.
    """

    image: Tensor
    rasterizer: Callable[..., Any]
    inputs: Mapping[str, Any]
    settings: Any

    def repeated(self, **others: Any) -> Tensor:
        """Return the image (3, h, w) with other values of some inputs, not composed."""
        return RasterOutputs.of(self.rasterizer(**{**self.inputs, **others}), size_of(self.settings)).image


@dataclass(frozen=True)
class KeptZeros:
    """Hold zeros that a renderer makes in each call.

    Attributes:
        asked: the function that makes them, and its arguments.
        zeros: on the device.
        state: `state_of` them, by which it is seen whether they were written or got other memory.
    """

    asked: list[Any]
    zeros: Tensor
    state: tuple[int, int]


@dataclass
class StageRendering:
    """Describe to the rasterizer's wrapper how a stage is rendered.

    Attributes:
        signed: whether the field is a residual.
        path: how signed colour is evaluated.
        views: the checkout's camera of each view by key.
        images: targets I^l, other images of the supervision, and weights of masks; None if nothing is trained.
        accumulated: Up(I_hat^(l+1)) by key; None for the base.
        masked: keys of the training views whose masks the loop's losses and scores have to honour.
        composed: keys of the views to compose; the residuals of all others are compared with a residual.
        on_image: called when gradients are recorded with key, composed image, and the upsampled prediction in it (None
            without composition); returns the image to use instead.
        as_photographed: called with key and composed image; returns the image with the appearance of its photo, which
            the loop compares with the photo. None with `--appearance none`.
        on_call: called when gradients are recorded with key, composed image, rasterizer, its inputs and its settings;
            returns the image to use instead.
        capture: keep the last call in `captured`, its image without the appearance of a photo.
        for_image: whether nothing but the image is read of calls that are captured.
        kept: zeros of the last render, by what they are for.
    """

    signed: bool
    path: ColorPath
    views: Mapping[str, Any]
    images: LevelImages | None = None
    accumulated: Predictions | None = None
    masked: frozenset[str] = frozenset()
    composed: frozenset[str] = frozenset()
    on_image: Callable[[str, Tensor, Tensor | None], Tensor] | None = None
    as_photographed: Callable[[str, Tensor], Tensor] | None = None
    on_call: OnCall | None = None
    capture: bool = False
    for_image: bool = False
    captured: Captured | None = field(default=None, repr=False)
    kept: dict[str, KeptZeros] = field(default_factory=dict, repr=False)
    _told: bool = field(default=False, repr=False)
    _by_matrix: dict[bytes, set[str]] = field(default_factory=dict, repr=False)

    def key(self, noted: str | None, settings: Any) -> str | None:
        """Return the key of a view; None for any other camera.

        Args:
            noted: key of the view that a renderer was called with; None if it was called with none.
            settings: of the rasterizer, whose matrices are compared if no view was noted and this matters.

        Raises:
            UserInputError: several photos have these matrices, and it matters which one is rendered.
        """
        if noted is not None and noted in self.views:
            return noted
        if noted is not None or not self.views or not (self._needs_views or self._asks_for_views):
            return None
        keys = self._keys_by_matrix(settings)
        # Photos of one camera have the same prediction, but not the same mask or target.
        differ = self._needs_photos or self._asks_for_views or 0 < len(keys & self.composed) < len(keys)
        if len(keys) > 1 and differ:
            names = " and ".join(view_name(key) for key in sorted(keys)[:2])
            raise UserInputError(
                f"{names} have the same camera, and the checkout's rasterizer gets only that: which photo it renders "
                "is unknown; leave one of them out, or train with --hierarchy nested, without --masks, --depth, "
                "--appearance and hooks"
            )
        return min(keys, default=None)

    def _keys_by_matrix(self, settings: Any) -> set[str]:
        """Return the keys of the views that have the settings' matrices: poses, and projections where they have any."""
        if not self._by_matrix:
            for key, camera in self.views.items():
                for whole in (camera.world_view_transform, getattr(camera, "full_proj_transform", None)):
                    for matrix in () if whole is None else matrix_keys(whole):
                        self._by_matrix.setdefault(matrix, set()).add(key)
        matrices = [value for value in fields_of(settings).values() if isinstance(value, Tensor)]
        rows = [matrix for value in matrices if value.shape == (4, 4) for matrix in matrix_keys(value)]
        candidates = [keys for matrix in rows if (keys := self._by_matrix.get(matrix))]
        return set.intersection(*candidates) if candidates else set()

    @property
    def takes_parts(self) -> bool:
        """Whether a rasterizer may get SH in parts: nothing else reads its inputs, and gradients are recorded."""
        precomputed = self.signed and self.path is ColorPath.PRECOMPUTED
        return torch.is_grad_enabled() and (self.for_image or not self.capture) and not precomputed

    def prefetch(self, key: str) -> None:
        """Copy a view's images to the device while it is being rendered."""
        images = self.images
        stores = () if images is None else (images.targets, images.weights)
        for store in (*stores, self.accumulated if key in self.composed else self._below_target):
            if store is not None:
                store.prefetch(key)

    @property
    def prefetches(self) -> bool:
        """Whether images of the running stage are anywhere but on the GPU."""
        stores = () if self.images is None else self.images.stores
        return any(store is not None and store.where != "gpu" for store in (*stores, self.accumulated))

    def target(self, key: str) -> Tensor:
        """Return the target (3, h, w) of a view: I^l, or the target residual where residuals are supervised alone."""
        assert self.images is not None, "a stage that is trained has targets"
        target, below = self.images.targets.get(key), None if key in self.composed else self._below_target
        return target if below is None else target - below.get(key)

    def compose(self, key: str | None, image: Tensor, *, by_matrix: bool = False) -> Tensor:
        """Return the composed image (3, h, w) of a view.

        Args:
            key: of the view; None for other cameras.
            image: (3, h, w) as rendered.
            by_matrix: whether the view was recognised by its matrix alone. If the image has another size than its
                level, it is of a viewer's camera at the same pose.

        Raises:
            UserInputError: the image has another size than its level; in the backward pass: no view was recognised.
        """
        below = None
        if key is not None and self.accumulated is not None and (by_matrix or key in self.composed):
            below = self.accumulated.get(key)
            if below.shape != image.shape:
                if not by_matrix:
                    raise UserInputError(
                        f"the checkout renders view {view_name(key)} at {image.shape[2]}x{image.shape[1]}, expected "
                        f"{below.shape[2]}x{below.shape[1]}, the size of its level; switch its own resolution schedule "
                        "off, or train with --hierarchy nested"
                    )
                key = None
        if key is None:
            if not self._needs_views:
                return image
            image = image + (GREY if self.signed else 0)
            if image.requires_grad:
                image.register_hook(_refuse_unrecognised)  # type: ignore[no-untyped-call]  # torch's
            return image
        below = below if key in self.composed else None
        if below is not None:
            image = add_prediction(image, below)
        if self.on_image is not None and torch.is_grad_enabled():
            image = self.on_image(key, image, below)
        if self.as_photographed is not None and not self.capture:
            image = self.as_photographed(key, image)
        if self.images is not None and key in self.masked and not self.capture:
            # Outside of the mask any loss then compares the target with itself.
            image = fill_outside(image, self.target(key), self.images.get_weights(key))
        return image

    def render(
        self,
        rasterizer: Callable[..., Any],
        inputs: dict[str, Any],
        settings: Any,
        noted: str | None,
        called_at: str = "the checkout",
    ) -> Any:
        """Return the outputs of the checkout's rasterizer for its inputs and settings, with the composed image.

        Args:
            rasterizer, inputs, settings: of the call.
            noted: key of the view that a renderer was called with; None if it was called with none.
            called_at: file and line where the checkout renders it.

        Raises:
            UserInputError: as `compose`; in the backward pass of a residual's maps beside the image, because they do
                not show the whole scene.
        """
        if self.signed and self.path is ColorPath.PRECOMPUTED:
            inputs = with_signed_colors(inputs, settings)
        outputs = RasterOutputs.of(rasterizer(**inputs), size_of(settings))
        key = self.key(noted, settings)
        image = self.compose(key, outputs.image, by_matrix=noted is None)
        if key is not None and self.on_call is not None and torch.is_grad_enabled():
            image = self.on_call(key, image, rasterizer, inputs, settings)
        if self.capture:
            self.captured = Captured(image, rasterizer, inputs, settings)
        for values in outputs.maps_beside if self.signed else ():
            values.register_hook(partial(_refuse_other_colors, called_at))  # type: ignore[no-untyped-call]  # torch's
        return outputs.with_image(image)

    def render_other(
        self, rasterizer: Callable[..., Any], inputs: dict[str, Any], settings: Any, called_at: str = "the checkout"
    ) -> Any:
        """Return the outputs for colours that are not the model's, such as features or scores, unchanged.

        Nothing of the photos belongs into such an image. Of a residual it is its own only, of which a warning tells.

        Args:
            rasterizer, inputs, settings: as of `render`.
            called_at: file and line where the checkout renders them.

        Raises:
            UserInputError: in the backward pass of a residual's: it is no image of the whole scene.
        """
        outputs = rasterizer(**inputs)
        if not self.signed:
            return outputs
        if self.images is not None and not (self.capture or self._told):
            self._told = True
            logger.warning(
                "%s also renders other values than colours, such as depths or opacities; in a residual they are those "
                "of its own Gaussians, not the scene's: leave out options that use them, or train with "
                "--hierarchy nested",
                called_at,
            )
        parts = RasterOutputs.of(outputs, size_of(settings))
        image = parts.image.clone()  # the hook is to see uses of this image alone
        if image.requires_grad:
            image.register_hook(partial(_refuse_other_colors, called_at))  # type: ignore[no-untyped-call]  # torch's
        return parts.with_image(image)

    @property
    def _needs_views(self) -> bool:
        """Whether training on an image of no known view would train something else."""
        return self.signed or self._needs_photos

    @property
    def _needs_photos(self) -> bool:
        """Whether images are trained otherwise for each photo."""
        return bool(self.masked) or self.as_photographed is not None

    @property
    def _asks_for_views(self) -> bool:
        """Whether something besides the image depends on the view."""
        return self.on_image is not None or self.on_call is not None

    @property
    def _below_target(self) -> Predictions | None:
        """Images to subtract from targets where residuals are supervised alone."""
        coarse = None if self.images is None else self.images.coarse
        return self.accumulated if coarse is None else coarse


def _refuse_other_colors(called_at: str, gradient: Tensor | None) -> None:
    if gradient is None or not bool(gradient.any()):  # its loss has no weight
        return
    raise UserInputError(
        f"{called_at}: the loop trains on an image of other colours than the model's, such as depths or features; a "
        "residual covers a part of the scene only, so its image of them is not the whole one: leave the option out "
        "that asks for it, or train with --hierarchy nested"
    )


def _refuse_unrecognised(_: Tensor) -> None:
    raise UserInputError(
        "the checkout trains on a camera that is no view of its scene: no renderer was called with one, and the "
        "rasterizer's matrices are none of the scene's; so no residual can be composed with coarser levels, nor a "
        "mask or an appearance be applied: train with --hierarchy nested and without --masks and --appearance"
    )
