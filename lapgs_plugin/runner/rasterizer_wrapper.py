"""Wrap a checkout's rasterizers, so that every caller of its renderers gets the images of the running stage.

The wrappers take the place of the settings, classes and functions of a rasterizer wherever the checkout holds them: the
training loop, score functions and reports get composed images. A wrapped renderer notes the view that it is called
with: its matrices may be copied, moved or made anew on the way to the rasterizer.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.level_views import view_key
from lapgs_plugin.checkouts.profile import Profile
from lapgs_plugin.runner.signed_calls import signed_settings
from lapgs_plugin.runner.stage_rendering import StageRendering


class RasterizerWrapper:
    """Make the replacements of a checkout's renderers, and of its rasterizers' settings, classes and functions.

    Args:
        mark: called with "forward" when settings are made, and with "loss" when an image is rasterized.

    Attributes:
        rendering: how the running stage is rendered; None leaves every call unchanged.
        noted: key of the view that is being rendered; None outside of the renderers, and for other cameras.
        given: values of each Gaussian (n, k) that the renderer was called with, such as colours to render instead.
    """

    def __init__(self, mark: Callable[[str], None] = lambda part: None) -> None:
        self._mark = mark
        self.rendering: StageRendering | None = None
        self.noted: str | None = None
        self.given: tuple[Tensor, ...] = ()
        self._zeros: Tensor | None = None

    def renderer(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of a function that renders a view."""

        @wraps(original)
        def render(*args: Any, **kwargs: Any) -> Any:
            outer, given = (self.noted, self.given), (*args, *kwargs.values())
            self.noted = next((key for v in given if (key := view_key(v)) is not None), self.noted)
            self.given = (*self.given, *(v for v in given if isinstance(v, Tensor) and v.ndim == 2))
            try:
                return original(*args, **kwargs)
            finally:
                self.noted, self.given = outer

        return render

    def settings(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of the settings' constructor."""

        def make_settings(*args: Any, **kwargs: Any) -> Any:
            self._mark("forward")
            settings = original(*args, **kwargs)
            rendering = self.rendering
            if rendering is None:
                return settings
            if self.noted is not None and self.noted in rendering.views:
                rendering.prefetch(self.noted)
            return signed_settings(settings, rendering.path, self._zero_background) if rendering.signed else settings

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
            if self.rendering is None:
                return made
            return WrappedRasterizer(made, self._call_now(next(iter((*args, *kwargs.values())), None)))

        return make_rasterizer

    def _function(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def rasterize(*args: Any, **kwargs: Any) -> Any:
            if self.rendering is None:
                return original(*args, **kwargs)
            inputs = named_inputs(original, args, kwargs)
            settings = next((value for name, value in inputs.items() if "setting" in name), None)
            return self._call_now(settings)(original, inputs)

        return rasterize

    def _call_now(self, settings: Any) -> Callable[[Callable[..., Any], dict[str, Any]], Any]:
        """Return a function of a rasterizer and its inputs that calls it for the present stage and view.

        The image is that of the stage if the rasterizer renders the model's colours.
        """
        rendering, noted, given = self.rendering, self.noted, self.given
        assert rendering is not None, "calls outside of stages are left as they are"

        def call(rasterizer: Callable[..., Any], inputs: dict[str, Any]) -> Any:
            def marked(**inputs: Any) -> Any:
                outputs = rasterizer(**inputs)
                self._mark("loss")
                return outputs

            colors = [value for name, value in inputs.items() if "color" in name and isinstance(value, Tensor)]
            if any(color is each for color in colors for each in given):
                return rendering.render_other(marked, inputs, settings)
            return rendering.render(marked, inputs, settings, noted)

        return call

    def _zero_background(self, like: Tensor) -> Tensor:
        """Return (3,) zeros on the device of a background, the same ones in every call."""
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
