"""Wrap a checkout's CUDA rasterizer to add signed colour, a zero background and composition.

The wrapper replaces the two names that every `render` of the family looks up in its own module. So every caller of
`render` (the training loop, score functions, reports) gets composed images.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.hierarchy.masks import fill_outside
from lapgs_plugin.ops.composition import add_prediction
from lapgs_plugin.rasterizers.signed_color import ColorPath, signed_degree
from lapgs_plugin.runs.image_store import ImageStore
from lapgs_plugin.runs.level_images import HeldImages

GREY = 0.5
"""Value added to residuals for cameras that are no view of the scene, such as a viewer's."""


class Predictions(Protocol):
    """Return upsampled predictions of coarser levels by view: cached images, or renders of finished fields."""

    def prefetch(self, key: str, /) -> None:
        """Prepare for a `get` of this view."""

    def get(self, key: str, /) -> Tensor:
        """Return the prediction (3, h, w) on the device, float32, at the size of the finer level."""


@dataclass
class StageRendering:
    """Describe to the rasterizer's wrapper how a stage is rendered.

    Attributes:
        signed: whether the field is a residual.
        path: how signed colour is evaluated.
        views: key of each view by the identity of its world-to-camera matrix, which level views share with the
            checkout's cameras.
        targets: I^l by key; None if images are compared with nothing.
        accumulated: Up(I_hat^(l+1)) by key; None for the base.
        coarse: Up(I^(l+1)) of training views by key; None unless the supervision needs it.
        weights: share of each pixel inside of the view's mask by key; None without masks.
        masked: keys of the training views, whose masks the loop's losses and scores have to honour.
        composed: keys of the views to compose; the residuals of all others are compared with a residual.
        on_image: called when gradients are recorded with key, composed image, and the upsampled prediction in it (None
            without composition); returns the image to use instead.
        capture: keep the last composed image, before exposure or clamping, in `captured`.
    """

    signed: bool
    path: ColorPath
    views: Mapping[int, str]
    targets: ImageStore | None = None
    accumulated: Predictions | None = None
    coarse: Predictions | None = None
    weights: ImageStore | HeldImages | None = None
    masked: frozenset[str] = frozenset()
    composed: frozenset[str] = frozenset()
    on_image: Callable[[str, Tensor, Tensor | None], Tensor] | None = None
    capture: bool = False
    captured: Tensor | None = field(default=None, repr=False)

    def key(self, settings: Any) -> str | None:
        """Return the key of the view that settings of the rasterizer belong to; None for any other camera."""
        return self.views.get(id(settings.viewmatrix))

    def prefetch(self, key: str) -> None:
        """Copy a view's images to the device while it is being rendered."""
        if self.targets is not None:
            self.targets.prefetch(key)
        below = self.accumulated if key in self.composed else self._below_target
        if below is not None:
            below.prefetch(key)
        if self.weights is not None:
            self.weights.prefetch(key)

    def target(self, key: str) -> Tensor:
        """Return the target (3, h, w) of a view: I^l, or the target residual where residuals are supervised alone."""
        assert self.targets is not None, "a stage that is trained has targets"
        target = self.targets.get(key)
        if key in self.composed or self._below_target is None:
            return target
        return target - self._below_target.get(key)

    def compose(self, key: str | None, image: Tensor) -> Tensor:
        """Return the composed image (3, h, w) of a view, given the rendered one; `key` is None for other cameras."""
        if key is None:
            return image + GREY if self.signed else image
        below = None
        if self.accumulated is not None and key in self.composed:
            below = self.accumulated.get(key)
            image = add_prediction(image, below)
        if self.on_image is not None and torch.is_grad_enabled():
            image = self.on_image(key, image, below)
        if self.weights is not None and key in self.masked and not self.capture:
            # Whatever the loop's loss is, it compares the target with itself outside of the mask.
            image = fill_outside(image, self.target(key), self.weights.get(key))
        return image

    def render(self, rasterizer: Any, inputs: dict[str, Any], settings: Any) -> tuple[Any, ...]:
        """Return the outputs of the checkout's rasterizer for its inputs and settings, with the composed image."""
        if self.signed and self.path is ColorPath.PRECOMPUTED:
            inputs = _with_signed_colors(inputs, settings)
        image, *others = rasterizer(**inputs)
        image = self.compose(self.key(settings), image)
        if self.capture:
            self.captured = image
        return (image, *others)

    @property
    def _below_target(self) -> Predictions | None:
        """Images to subtract from targets where residuals are supervised alone."""
        return self.accumulated if self.coarse is None else self.coarse


class RasterizerWrapper:
    """Make the replacements of `GaussianRasterizationSettings` and `GaussianRasterizer`.

    Attributes:
        stage: the running stage; None leaves every call unchanged.
    """

    def __init__(self) -> None:
        self.stage: StageRendering | None = None
        self._zeros: Tensor | None = None

    def settings(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of the settings' constructor."""

        def make_settings(*args: Any, **kwargs: Any) -> Any:
            settings = original(*args, **kwargs)
            stage = self.stage
            if stage is None:
                return settings
            if (key := stage.key(settings)) is not None:
                stage.prefetch(key)
            if not stage.signed:
                return settings
            degree = settings.sh_degree
            if stage.path is ColorPath.NATIVE:
                degree = signed_degree(degree)
            return settings._replace(bg=self._zero_background(settings.bg), sh_degree=degree)

        return make_settings

    def rasterizer(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of the rasterizer's constructor."""

        def make_rasterizer(raster_settings: Any) -> Any:
            made = original(raster_settings=raster_settings)
            stage = self.stage
            if stage is None:
                return made
            return WrappedRasterizer(made, lambda call, inputs: stage.render(call, inputs, raster_settings))

        return make_rasterizer

    def _zero_background(self, like: Tensor) -> Tensor:
        if self._zeros is None or self._zeros.device != like.device:
            self._zeros = torch.zeros_like(like)
        return self._zeros


class WrappedRasterizer:
    """Replace the call of a checkout's rasterizer for one view by `call(rasterizer, inputs)`; keep all else."""

    def __init__(self, original: Any, call: Callable[[Any, dict[str, Any]], Any]) -> None:
        self._original, self._call = original, call

    def __getattr__(self, name: str) -> Any:
        return getattr(self._original, name)

    def __call__(self, **inputs: Any) -> Any:
        return self._call(self._original, inputs)


def _with_signed_colors(inputs: dict[str, Any], settings: Any) -> dict[str, Any]:
    """Return a rasterizer's inputs with colours instead of SH, evaluated as patched kernels do."""
    if inputs.get("colors_precomp") is not None:
        return inputs
    dc, rest, means = inputs.get("dc"), inputs["shs"], inputs["means3D"]
    sh = rest if dc is None else torch.cat([dc, rest], dim=1)  # (n, k, 3)
    directions = torch.nn.functional.normalize(means - settings.campos, dim=-1)  # (n, 3)
    colors = sh_to_color(sh, directions, settings.sh_degree, signed=True)  # (n, 3)
    others = {name: value for name, value in inputs.items() if name not in ("dc", "shs")}
    return {**others, "colors_precomp": colors}
