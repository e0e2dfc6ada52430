"""Wrap a checkout's rasterizers to add signed colour, a zero background and composition.

The wrappers take the place of the settings, classes and functions of a rasterizer wherever the checkout holds them. So
every caller of its renderers (the training loop, score functions, reports) gets composed images. A wrapped renderer
notes the view that it is called with: its matrices may be copied, moved or made anew on the way to the rasterizer.
"""

from __future__ import annotations

import copy
import dataclasses
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import wraps
from types import ModuleType
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.checkouts.level_views import view_key, view_name
from lapgs_plugin.checkouts.profile import Profile
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.hierarchy.masks import fill_outside
from lapgs_plugin.ops.composition import add_prediction
from lapgs_plugin.rasterizers.signed_color import ColorPath, signed_degree
from lapgs_plugin.runs.image_store import ImageStore
from lapgs_plugin.runs.level_images import HeldImages

GREY = 0.5
"""Value added to residuals for cameras that are no view of the scene, such as a viewer's."""

BACKGROUNDS, DEGREES = ("bg", "bg_color", "background"), ("sh_degree", "active_sh_degree")
"""Names that rasterizers give to these settings."""


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
        views: the checkout's camera of each view by key.
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
    views: Mapping[str, Any]
    targets: ImageStore | None = None
    accumulated: Predictions | None = None
    coarse: Predictions | None = None
    weights: ImageStore | HeldImages | None = None
    masked: frozenset[str] = frozenset()
    composed: frozenset[str] = frozenset()
    on_image: Callable[[str, Tensor, Tensor | None], Tensor] | None = None
    capture: bool = False
    captured: Tensor | None = field(default=None, repr=False)
    _by_matrix: dict[bytes, str] = field(default_factory=dict, repr=False)

    def key(self, noted: str | None, settings: Any) -> str | None:
        """Return the key of a view; None for any other camera.

        Args:
            noted: key of the view that a renderer was called with; None if it was called with none.
            settings: of the rasterizer, whose matrices are compared if no view was noted and this matters.
        """
        if noted is not None and noted in self.views:
            return noted
        if noted is not None or not self.views or not (self._needs_views or self.on_image is not None):
            return None
        if not self._by_matrix:
            for key, camera in self.views.items():
                for matrix in _matrices(camera.world_view_transform):
                    self._by_matrix[matrix] = key
        found = (self._by_matrix.get(m) for value in _values(settings) for m in _matrices(value))
        return next((key for key in found if key is not None), None)

    def _fits(self, key: str, image: Tensor) -> bool:
        """Return whether an image has the size of a view at this level, as far as that is known."""
        return self.accumulated is None or self.accumulated.get(key).shape == image.shape

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
        """Return the composed image (3, h, w) of a view, given the rendered one; `key` is None for other cameras.

        Raises:
            UserInputError: the image has another size than its level; in the backward pass: no view was recognised.
        """
        if key is None:
            if not self._needs_views:
                return image
            image = image + (GREY if self.signed else 0)
            if image.requires_grad:
                image.register_hook(_refuse_unrecognised)  # type: ignore[no-untyped-call]  # torch's
            return image
        below = None
        if self.accumulated is not None and key in self.composed:
            below = self.accumulated.get(key)
            if below.shape != image.shape:
                raise UserInputError(
                    f"the checkout renders view {view_name(key)} at {image.shape[2]}x{image.shape[1]}, expected "
                    f"{below.shape[2]}x{below.shape[1]}, the size of its level; switch its own resolution schedule "
                    "off, or train with --hierarchy nested"
                )
            image = add_prediction(image, below)
        if self.on_image is not None and torch.is_grad_enabled():
            image = self.on_image(key, image, below)
        if self.weights is not None and key in self.masked and not self.capture:
            # Whatever the loop's loss is, it compares the target with itself outside of the mask.
            image = fill_outside(image, self.target(key), self.weights.get(key))
        return image

    def render(self, rasterizer: Callable[..., Any], inputs: dict[str, Any], settings: Any, noted: str | None) -> Any:
        """Return the outputs of the checkout's rasterizer for its inputs and settings, with the composed image."""
        if self.signed and self.path is ColorPath.PRECOMPUTED:
            inputs = _with_signed_colors(inputs, settings)
        outputs = rasterizer(**inputs)
        size = _size(settings)
        place = _image_place(outputs, size)
        stored = outputs if place is None else outputs[place]
        channels_last = stored.shape[-1] == 3 and (stored.shape[-3] != 3 or stored.shape[-3:-1] == size)
        image = stored.reshape(stored.shape[-3:])  # some have a leading axis for several views
        image = image.permute(2, 0, 1) if channels_last else image
        key = self.key(noted, settings)
        if noted is None and key is not None and not self._fits(key, image):
            key = None  # a viewer's camera at the place of a photo's
        image = self.compose(key, image)
        if self.capture:
            self.captured = image
        image = (image.permute(1, 2, 0) if channels_last else image).reshape(stored.shape)
        return image if place is None else _with_item(outputs, place, image)

    @property
    def _needs_views(self) -> bool:
        """Whether training on an image of no known view would train something else."""
        return self.signed or self.weights is not None

    @property
    def _below_target(self) -> Predictions | None:
        """Images to subtract from targets where residuals are supervised alone."""
        return self.accumulated if self.coarse is None else self.coarse


class RasterizerWrapper:
    """Make the replacements of a checkout's renderers, and of its rasterizers' settings, classes and functions.

    Attributes:
        stage: the running stage; None leaves every call unchanged.
        noted: key of the view that is being rendered; None outside of the renderers, and for other cameras.
        mark: called with "forward" when settings are made, and with "loss" when an image is rasterized.
    """

    def __init__(self) -> None:
        self.stage: StageRendering | None = None
        self.noted: str | None = None
        self.mark: Callable[[str], None] = lambda part: None
        self._zeros: Tensor | None = None

    def renderer(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of a function that renders a view."""

        @wraps(original)
        def render(*args: Any, **kwargs: Any) -> Any:
            outer = self.noted
            self.noted = next((key for v in (*args, *kwargs.values()) if (key := view_key(v)) is not None), outer)
            try:
                return original(*args, **kwargs)
            finally:
                self.noted = outer

        return render

    def settings(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of the settings' constructor."""

        def make_settings(*args: Any, **kwargs: Any) -> Any:
            self.mark("forward")
            settings = original(*args, **kwargs)
            stage = self.stage
            if stage is None:
                return settings
            if self.noted is not None and self.noted in stage.views:
                stage.prefetch(self.noted)
            return self._signed(stage, settings) if stage.signed else settings

        return make_settings

    def entries(self, profile: Profile) -> list[tuple[ModuleType, str, Callable[..., Any]]]:
        """Return where a checkout looks rasterizers up, as owners and names, each with its replacement's maker."""
        return [
            (*place, self._class if inspect.isclass(vars(rasterizer.module)[name]) else self._function)
            for rasterizer in profile.rasterizers
            for name in rasterizer.entries
            for place in profile.places(rasterizer, name)
        ]

    def _class(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def make_rasterizer(*args: Any, **kwargs: Any) -> Any:
            made = original(*args, **kwargs)
            stage, noted = self.stage, self.noted
            if stage is None:
                return made
            settings = next(iter((*args, *kwargs.values())), None)
            return WrappedRasterizer(
                made, lambda call, inputs: stage.render(self._marking(call), inputs, settings, noted)
            )

        return make_rasterizer

    def _function(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def rasterize(*args: Any, **kwargs: Any) -> Any:
            if self.stage is None:
                return original(*args, **kwargs)
            inputs = named_inputs(original, args, kwargs)
            settings = next((value for name, value in inputs.items() if "setting" in name), None)
            return self.stage.render(self._marking(original), inputs, settings, self.noted)

        return rasterize

    def _marking(self, rasterizer: Callable[..., Any]) -> Callable[..., Any]:
        def rasterize(**inputs: Any) -> Any:
            outputs = rasterizer(**inputs)
            self.mark("loss")
            return outputs

        return rasterize

    def _signed(self, stage: StageRendering, settings: Any) -> Any:
        """Return settings with a zero background, and with the flag of signed colour where it is native."""
        fields = _fields(settings)
        changes: dict[str, Any] = {}
        for name in BACKGROUNDS:
            if isinstance(fields.get(name), Tensor):
                changes[name] = self._zero_background(fields[name])
        if stage.path is ColorPath.NATIVE:
            for name in DEGREES:
                if name in fields:
                    changes[name] = signed_degree(fields[name])
        return _replaced(settings, changes)

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

    def __call__(self, *args: Any, **inputs: Any) -> Any:
        return self._call(self._original, named_inputs(self._original.forward, args, inputs))


def named_inputs(function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of a call by parameter name."""
    return dict(inspect.signature(function).bind(*args, **kwargs).arguments) if args else kwargs


def _with_signed_colors(inputs: dict[str, Any], settings: Any) -> dict[str, Any]:
    """Return a rasterizer's inputs with colours instead of SH, evaluated as patched kernels do.

    Raises:
        UserInputError: the rasterizer takes no colours.
    """
    if inputs.get("colors_precomp") is not None:
        return inputs
    fields = _fields(settings)
    degree = next((fields[name] for name in DEGREES if name in fields), None)
    if not {"shs", "means3D"} <= inputs.keys() or degree is None or "campos" not in fields:
        raise UserInputError(
            f"the checkout's rasterizer takes {', '.join(inputs)}, expected means3D and shs, or colors_precomp, by "
            "which a residual has colours of both signs; train with --hierarchy nested"
        )
    dc, rest, means = inputs.get("dc"), inputs["shs"], inputs["means3D"]
    sh = rest if dc is None else torch.cat([dc, rest], dim=1)  # (n, k, 3)
    directions = torch.nn.functional.normalize(means - fields["campos"], dim=-1)  # (n, 3)
    colors = sh_to_color(sh, directions, degree, signed=True)  # (n, 3)
    others = {name: value for name, value in inputs.items() if name not in ("dc", "shs")}
    return {**others, "colors_precomp": colors}


def _refuse_unrecognised(_: Tensor) -> None:
    raise UserInputError(
        "the checkout trains on a camera that is no view of its scene: no renderer was called with one, and the "
        "rasterizer's matrices are none of the scene's; so no residual can be composed with coarser levels, nor a "
        "mask be applied: train with --hierarchy nested and without --masks"
    )


def _fields(settings: Any) -> dict[str, Any]:
    """Return settings by name: those of a named tuple, a dataclass or any other object."""
    if hasattr(settings, "_asdict"):
        return dict(zip(settings._fields, settings, strict=True))
    return dict(vars(settings)) if hasattr(settings, "__dict__") else {}


def _replaced(settings: Any, changes: dict[str, Any]) -> Any:
    if hasattr(settings, "_replace"):
        return settings._replace(**changes)
    if dataclasses.is_dataclass(settings) and not isinstance(settings, type):
        return dataclasses.replace(settings, **changes)
    changed = copy.copy(settings)
    for name, value in changes.items():
        setattr(changed, name, value)
    return changed


def _values(settings: Any) -> list[Tensor]:
    """Return the (4, 4) matrices among settings."""
    return [value for value in _fields(settings).values() if isinstance(value, Tensor) and value.shape == (4, 4)]


def _matrices(matrix: Any) -> tuple[bytes, bytes]:
    """Return the values of a matrix and of its transpose, by which views are recognised wherever the matrix is."""
    values = np.asarray(torch.as_tensor(matrix).detach().to("cpu", torch.float32))
    return values.tobytes(), np.ascontiguousarray(values.T).tobytes()


def _size(settings: Any) -> tuple[int, ...]:
    """Return (height, width) of the view, empty if the settings do not say it."""
    fields = _fields(settings)
    return tuple(int(fields[name]) for name in ("image_height", "image_width") if name in fields)


def _image_place(outputs: Any, size: tuple[int, ...]) -> Any:
    """Return where the image is among a rasterizer's outputs, None if they are the image.

    It is the first with three channels, before or after its axes of pixels, and the size of the view.

    Raises:
        UserInputError: there is none.
    """
    if isinstance(outputs, Tensor):
        return None
    items = outputs.items() if isinstance(outputs, dict) else enumerate(outputs)
    found = {place: tuple(v.shape) for place, v in items if isinstance(v, Tensor) and v.is_floating_point()}
    for place, shape in found.items():
        if 3 <= len(shape) <= 4 and all(one == 1 for one in shape[:-3]):
            first, last = shape[-3] == 3 and shape[-2:] == size, shape[-1] == 3 and shape[-3:-1] == size
            if first or last or (not size and 3 in (shape[-3], shape[-1])):
                return place
    shapes = ", ".join(map(str, found.values())) or "no tensor"
    raise UserInputError(
        f"the checkout's rasterizer returns {shapes}, expected an image (3, h, w)"
        f"{' of ' + 'x'.join(map(str, size[::-1])) if size else ''}; `lapgs run --off` runs the script as it is"
    )


def _with_item(outputs: Any, place: Any, image: Tensor) -> Any:
    """Return a tuple, list or dict of outputs with another image."""
    if isinstance(outputs, dict):
        return {**outputs, place: image}
    items = [image if i == place else value for i, value in enumerate(outputs)]
    return type(outputs)(*items) if hasattr(outputs, "_fields") else type(outputs)(items)
