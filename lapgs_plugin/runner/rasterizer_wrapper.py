"""Wrap a checkout's rasterizers, so that every caller of its renderers gets the images of the running stage.

The wrappers take the place of the settings, classes and functions of a rasterizer wherever the checkout holds them: the
training loop, score functions and reports get composed images. A wrapped renderer notes the view that it is called
with: its matrices may be copied, moved or made anew on the way to the rasterizer.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial, wraps
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.level_views import view_key
from lapgs_plugin.checkouts.profile import Profile
from lapgs_plugin.checkouts.rewriting import rewritten
from lapgs_plugin.checkouts.screen_points import POINTS, SETTINGS_ZEROS, ScreenPoints, SettingsZeros
from lapgs_plugin.checkouts.whole_sh import SH, WHOLE, WholeSh, joined_attributes
from lapgs_plugin.family.binding import Rasterizer
from lapgs_plugin.family.call import ShParts
from lapgs_plugin.gpu_raster.records import state_of
from lapgs_plugin.runner.running_stage import Stages
from lapgs_plugin.runner.signed_calls import signed_settings
from lapgs_plugin.runner.stage_rendering import KeptZeros
from lapgs_plugin.runner.visible_rows import VisibleRows


@dataclass(frozen=True)
class _RendererCall:
    """Hold what a renderer was called with, and whether it has rasterized the model's colours.

    Attributes:
        way: the renderer, and whether its arguments ask it to evaluate SH itself; None outside of renderers.
        key: key of the view; None for other cameras.
        location: file and line of the call.
        values: numbers of each Gaussian (n, k) among its arguments, such as colours to render instead.
        by_mask: whether the caller needs no indices of visible Gaussians.
        done: not empty once the model's colours were rasterized.
    """

    way: tuple[Callable[..., Any], bool] | None = None
    key: str | None = None
    location: str = "the checkout"
    values: tuple[Tensor, ...] = ()
    by_mask: bool = False
    done: list[bool] = field(default_factory=list)


class RasterizerWrapper:
    """Make the replacements of a checkout's renderers, and of its rasterizers' settings, classes and functions.

    Args:
        stages: say how images are rendered.
        mark: called with "forward" when settings are made, and with "loss" when an image is rasterized.
        rows: how visible Gaussians are listed and their statistics updated; None leaves it to the checkout.
        ours: our modules, by full name, that may render in place of the checkout's rasterizer, with its settings.

    Attributes:
        rows: as given.
        takes_ours: whether they do.
        running: the renderer's call that is running; outside of the renderers one of no view.
    """

    def __init__(
        self,
        stages: Stages,
        mark: Callable[[str], None] = lambda part: None,
        rows: VisibleRows | None = None,
        ours: Mapping[str, ModuleType] | None = None,
    ) -> None:
        self._stages, self._mark, self.rows = stages, mark, rows
        self._ours, self.takes_ours = ours or {}, False
        self.running = _RendererCall()
        self._zeros: Tensor | None = None
        self._kept: dict[str, KeptZeros] = {}  # outside of stages
        self._take_parts: dict[bool, bool] = {}  # by whether ours renders: whether the rasterizers take `ShParts`
        self._parts: dict[type, tuple[str, str] | None] = {}
        # Ways of rendering in which SH were passed on to a rasterizer, kept for the whole run: the dry run and the
        # probe of signed colour find them before a stage trains.
        self._ways_of_sh: set[Any] = set()

    def renderer(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of a function that renders a view."""
        rows = self.rows
        renderer = rewritten(original, WholeSh, {SH: self._sh})
        renderer = rewritten(renderer, ScreenPoints, {POINTS: self._screen_points})
        renderer = rewritten(renderer, SettingsZeros, {SETTINGS_ZEROS: self._settings_zeros})
        renderer = renderer if rows is None else rows.in_renderer(renderer, lambda: self.running.by_mask)

        @wraps(original)
        def render(*args: Any, **kwargs: Any) -> Any:
            outer, (key, values, evaluates_sh) = self.running, _told_by((*args, *kwargs.values()))
            location, by_mask = outer.location, self._takes_image_alone
            if outer.way is None:
                caller = sys._getframe(1)
                location = f"{_file_name(caller.f_code.co_filename)}:{caller.f_lineno}"
                by_mask = rows is not None and rows.is_for_masks(caller.f_code)
            way = original, evaluates_sh
            self.running = _RendererCall(way, key or outer.key, location, (*outer.values, *values), by_mask)
            try:
                return renderer(*args, **kwargs)
            finally:
                self.running = outer

        return render

    def replacements(self, profile: Profile, consumer: str) -> list[Replacement]:
        """Return replacements where a checkout holds its renderers, and looks rasterizers and their settings up."""
        makers = [(holder, self.renderer) for function in profile.renderers for holder in profile.holders(function)]
        for rasterizer in profile.rasterizers:
            # The dry run compares that of the training loop alone.
            compared = rasterizer.module is profile.rasterizers[0].module
            ours = self._ours.get(rasterizer.use.module) if compared else None
            for name in rasterizer.settings:
                makers += [(holder, self.settings) for holder in profile.rasterizer_holders(rasterizer, name)]
            if compared:
                pairs = [(vars(rasterizer.module)[name], getattr(ours, name, None)) for name in rasterizer.entries]
                self._take_parts = {
                    taking: all(map(_takes_parts, [(taking and our) or own for own, our in pairs]))
                    for taking in (False, True)
                }
            for name in rasterizer.entries:
                kind = self.wrap_class if inspect.isclass(vars(rasterizer.module)[name]) else self.wrap_function
                make = partial(kind, ours=getattr(ours, name, None))
                makers += [(holder, make) for holder in profile.rasterizer_holders(rasterizer, name)]
        return [Replacement(*holder, make, consumer) for holder, make in makers]

    @property
    def _renders_by_ours(self) -> bool:
        """Whether our rasterizer is called, be it in place of the checkout's or as the one that it imports."""
        return self._take_parts.get(self.takes_ours, False)

    @property
    def _takes_image_alone(self) -> bool:
        """Whether nothing but the image of a render is used, as in joint training, which renders within a render."""
        return self._stages.rendering is not None and self._stages.rendering.capture

    @contextmanager
    def taking_ours(self) -> Iterator[None]:
        """Render inside with our rasterizer."""
        outer, self.takes_ours = self.takes_ours, True
        try:
            yield
        finally:
            self.takes_ours = outer

    def settings(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of the settings' constructor."""

        def make_settings(*args: Any, **kwargs: Any) -> Any:
            self._mark("forward")
            settings = original(*args, **kwargs)
            rendering = self._stages.rendering
            if rendering is None:
                return settings
            if (key := self.running.key) is not None and key in rendering.views:
                rendering.prefetch(key)
            return signed_settings(settings, rendering.path, self._zero_background) if rendering.signed else settings

        return make_settings

    def wrap_class(self, original: Callable[..., Any], ours: Callable[..., Any] | None = None) -> Callable[..., Any]:
        """Return the replacement of the constructor of a rasterizer, and of ours in its place."""

        def make_rasterizer(*args: Any, **kwargs: Any) -> Any:
            rasterizer = (ours if ours is not None and self.takes_ours else original)(*args, **kwargs)
            if self._stages.rendering is None:
                return rasterizer
            return WrappedRasterizer(rasterizer, self._call_now(next(iter((*args, *kwargs.values())), None)))

        return make_rasterizer

    def wrap_function(self, original: Callable[..., Any], ours: Callable[..., Any] | None = None) -> Callable[..., Any]:
        """Return the replacement of a rasterizer that is a function, and of ours in its place."""

        @wraps(original)
        def rasterize(*args: Any, **kwargs: Any) -> Any:
            chosen = ours if ours is not None and self.takes_ours else original
            if self._stages.rendering is None:
                return chosen(*args, **kwargs)
            inputs = named_inputs(original, args, kwargs)
            settings = next((value for name, value in inputs.items() if "setting" in name), None)
            return self._call_now(settings)(chosen, inputs)

        return rasterize

    def _call_now(self, settings: Any) -> Callable[[Callable[..., Any], dict[str, Any]], Any]:
        """Return a function of a rasterizer and its inputs that calls it for the present stage and view.

        The image is that of the stage if the rasterizer renders the model's colours.
        """
        rendering, running = self._stages.rendering, self.running
        assert rendering is not None, "calls outside of stages are left as they are"

        def call(rasterizer: Callable[..., Any], inputs: dict[str, Any]) -> Any:
            def marked(**inputs: Any) -> Any:
                outputs = rasterizer(**inputs)
                self._mark("loss")
                return outputs

            if isinstance(parts := inputs.get("shs"), ShParts) and not _takes_parts(type(rasterizer)):
                inputs = {**inputs, "shs": parts.whole}
            if not _has_model_colors(inputs, running, self._ways_of_sh):
                return rendering.render_other(marked, inputs, settings, running.location)
            return rendering.render(marked, inputs, settings, running.key, running.location)

        return call

    def _sh(self, model: Any) -> Any:
        """Return the SH coefficients of a model for a rasterizer, in two parts if it takes them."""
        kind, rendering = type(model), self._stages.rendering
        if kind not in self._parts:
            self._parts[kind] = joined_attributes(kind)
        names = self._parts[kind]
        if names is None or rendering is None or not self._renders_by_ours or not rendering.takes_parts:
            return getattr(model, WHOLE)
        return ShParts(getattr(model, names[0]), getattr(model, names[1]))

    def _screen_points(self, make: Callable[..., Tensor], *args: Any, **kwargs: Any) -> Tensor:
        """Return the zeros of a render whose gradients are those by projected centres, the same ones in each iteration.

        They are a leaf, so that PyTorch adds nothing to them and does not copy their gradient.

        Args:
            make: PyTorch's function of zeros.
            args, kwargs: of it.
        """
        if not torch.is_grad_enabled() or torch.is_inference_mode_enabled():
            return make(*args, **kwargs) + 0
        return self._kept_zeros(POINTS, make, args, kwargs).detach().requires_grad_()

    def _settings_zeros(self, make: Callable[..., Tensor], *args: Any, **kwargs: Any) -> Tensor:
        """Return the zeros of a setting, the same ones in each iteration if ours gets them, which writes to none.

        Args:
            make: PyTorch's function of zeros.
            args, kwargs: of it.
        """
        if not self._renders_by_ours or torch.is_inference_mode_enabled():
            return make(*args, **kwargs)
        return self._kept_zeros(SETTINGS_ZEROS, make, args, kwargs)

    def _kept_zeros(
        self, name: str, make: Callable[..., Tensor], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> Tensor:
        """Return the zeros of the last render of this stage, or new ones if others are asked for or they were written.

        Each field of joint training has a rendering of its own, and as many Gaussians in each iteration.
        """
        rendering = self._stages.rendering
        kept = self._kept if rendering is None else rendering.kept
        asked = [make, [(a.shape, a.dtype, a.device) if isinstance(a, Tensor) else a for a in args], kwargs]
        last = kept.get(name)
        if last is None or last.asked != asked or state_of(last.zeros) != last.state:
            zeros = make(*args, **kwargs).detach()
            last = kept[name] = KeptZeros(asked, zeros, state_of(zeros))
        return last.zeros

    def _zero_background(self, like: Tensor) -> Tensor:
        """Return (3,) zeros on the device of a background, the same ones in every call."""
        if self._zeros is None or self._zeros.device != like.device:
            self._zeros = torch.zeros_like(like)
        return self._zeros


def _told_by(arguments: tuple[Any, ...]) -> tuple[str | None, list[Tensor], bool]:
    """Return what a renderer's arguments say: the key of the view, numbers (n, k), whether to evaluate SH in Python."""
    key: str | None = None
    values: list[Tensor] = []
    evaluates_sh = False
    for argument in arguments:
        if isinstance(argument, Tensor):
            if argument.ndim == 2:
                values.append(argument)
        elif key is None and (key := view_key(argument)) is not None:
            continue  # a view is asked for nothing else: modules take long to say what they do not have
        elif getattr(argument, "convert_SHs_python", False) is True:
            evaluates_sh = True
    return key, values, evaluates_sh


@cache
def _file_name(path: str) -> str:
    return Path(path).name


def _takes_parts(rasterizer: Any) -> bool:
    return inspect.isclass(rasterizer) and issubclass(rasterizer, Rasterizer)


def _has_model_colors(inputs: Mapping[str, Any], running: _RendererCall, ways_of_sh: set[Any]) -> bool:
    """Return whether a rasterizer renders the model's colours, and not depths, opacities or features in their place.

    The model's colours are its SH, or colours that the renderer evaluates them to. Forks rasterize other values beside
    the image. So of a renderer that passes on no SH, as far as is known, only the first colours are the model's.

    Args:
        inputs: of the rasterizer.
        running: the renderer's call in which it is called; noted there if these are the model's colours.
        ways_of_sh: of rendering in which SH have been passed on; that of the call is added where it does.
    """
    colors = [value for name, value in inputs.items() if "color" in name and isinstance(value, Tensor)]
    if running.way is not None:
        if not colors:
            ways_of_sh.add(running.way)
        elif running.done or running.way in ways_of_sh:
            return False
    if any(color is argument for color in colors for argument in running.values):
        return False
    running.done.append(True)
    return True


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
