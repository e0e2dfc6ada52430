"""Between a checkout's `render` and its CUDA rasterizer: signed colour, a zero background, and composition.

The two names that every `render` of the family looks up in its own module are replaced. So whoever renders - the
training loop, score functions, reports - gets composed images, and no consumer of `render` has to be known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.ops.composition import add_prediction
from lapgs_plugin.rasterizers.signed_color import ColorPath, signed_degree
from lapgs_plugin.runs.image_store import ImageStore

GREY = 0.5
"""Around which a residual is shown to a camera that is no view of the scene, such as a viewer's."""


class Predictions(Protocol):
    """What lies below every view, by key: kept images, raised, or finished levels that render it."""

    def prefetch(self, key: str, /) -> None:
        """Told of a view that will be asked for soon."""

    def get(self, key: str, /) -> Tensor:
        """(3, h, w) on the device, float32, at the size of what is rendered over it."""


@dataclass
class StageRendering:
    """What has to be known of the running stage whenever something is rendered.

    Attributes:
        signed: whether residuals are rendered.
        path: how signed colour is evaluated.
        views: key of each view by the identity of its world-to-camera matrix, which level views share with the
            checkout's cameras.
        targets: I^l by key; None where nothing is compared.
        accumulated: Up(I_hat^(l+1)) by key; None for the base.
        coarse: Up(I^(l+1)) of training views by key; None unless the supervision needs it.
        composed: keys of the views that composition is done for; of the others, a residual is compared with a residual.
        on_image: called with key, composed image and what of it lies below when gradients are recorded; what it returns
            takes the image's place.
        capture: keep what was composed last, before exposure or clamping, in `captured`.
    """

    signed: bool
    path: ColorPath
    views: Mapping[int, str]
    targets: ImageStore | None = None
    accumulated: Predictions | None = None
    coarse: Predictions | None = None
    composed: frozenset[str] = frozenset()
    on_image: Callable[[str, Tensor, Tensor | None], Tensor] | None = None
    capture: bool = False
    captured: Tensor | None = field(default=None, repr=False)

    def key(self, settings: Any) -> str | None:
        return self.views.get(id(settings.viewmatrix))

    def prefetch(self, key: str) -> None:
        """Bring a view's images while it is being rendered."""
        if self.targets is not None:
            self.targets.prefetch(key)
        below = self.accumulated if key in self.composed else self._below_target
        if below is not None:
            below.prefetch(key)

    def target(self, key: str) -> Tensor:
        """(3, h, w) what `compose` is compared with: I^l, or what is missing of it."""
        assert self.targets is not None, "there is something to compare with"
        target = self.targets.get(key)
        if key in self.composed or self._below_target is None:
            return target
        return target - self._below_target.get(key)

    def compose(self, key: str | None, image: Tensor) -> Tensor:
        """(3, h, w) what a rasterizer made of a view -> what `render` returns of it."""
        if key is None:
            return image + GREY if self.signed else image
        below = None
        if self.accumulated is not None and key in self.composed:
            below = self.accumulated.get(key)
            image = add_prediction(image, below)
        if self.on_image is not None and torch.is_grad_enabled():
            image = self.on_image(key, image, below)
        return image

    @property
    def _below_target(self) -> Predictions | None:
        """What is taken from a target where a residual is supervised alone."""
        return self.accumulated if self.coarse is None else self.coarse


class RasterizerShim:
    """Makes the replacements of `GaussianRasterizationSettings` and `GaussianRasterizer`.

    Attributes:
        stage: the running stage; None lets every call through unchanged.
    """

    def __init__(self) -> None:
        self.stage: StageRendering | None = None
        self._zeros: Tensor | None = None

    def settings(self, original: Callable[..., Any]) -> Callable[..., Any]:
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
        def make_rasterizer(raster_settings: Any) -> Any:
            made = original(raster_settings=raster_settings)
            return made if self.stage is None else _ComposingRasterizer(made, raster_settings, self.stage)

        return make_rasterizer

    def _zero_background(self, like: Tensor) -> Tensor:
        if self._zeros is None or self._zeros.device != like.device:
            self._zeros = torch.zeros_like(like)
        return self._zeros


class _ComposingRasterizer:
    """A rasterizer of the checkout for one view; everything but the call is the original's."""

    def __init__(self, original: Any, settings: Any, stage: StageRendering) -> None:
        self._original, self._settings, self._stage = original, settings, stage

    def __getattr__(self, name: str) -> Any:
        return getattr(self._original, name)

    def __call__(self, **inputs: Any) -> tuple[Any, ...]:
        stage = self._stage
        if stage.signed and stage.path is ColorPath.PRECOMPUTED:
            inputs = _with_signed_colors(inputs, self._settings)
        image, *others = self._original(**inputs)
        image = stage.compose(stage.key(self._settings), image)
        if stage.capture:
            stage.captured = image
        return (image, *others)


def _with_signed_colors(inputs: dict[str, Any], settings: Any) -> dict[str, Any]:
    """The inputs with SH evaluated here, as the patched kernels do it."""
    if inputs.get("colors_precomp") is not None:
        return inputs
    dc, rest, means = inputs.get("dc"), inputs["shs"], inputs["means3D"]
    sh = rest if dc is None else torch.cat([dc, rest], dim=1)  # (n, k, 3)
    directions = torch.nn.functional.normalize(means - settings.campos, dim=-1)  # (n, 3)
    colors = sh_to_color(sh, directions, settings.sh_degree, signed=True)  # (n, 3)
    others = {name: value for name, value in inputs.items() if name not in ("dc", "shs")}
    return {**others, "colors_precomp": colors}
