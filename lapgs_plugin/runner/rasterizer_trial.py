"""Render the same Gaussians with a checkout's rasterizer and with ours: time both, and compare what they return."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.runner.object_values import RasterOutputs, size_of
from lapgs_plugin.runner.rasterizer_choice import Times, Trial
from lapgs_plugin.runner.stage_rendering import Captured

WARM_UP = 3
"""Renders before those that are timed."""
REPEATS = 7
"""Timed renders, of which the median is taken."""

LATER_COUNT = 300_000
"""About how many Gaussians the family's models have after some thousand iterations."""

PIXEL_TOLERANCE = 4e-3
"""Difference within which pixels agree: the step of an opacity of 1/255, which rounding may leave out."""
PIXEL_SHARE = 1e-3
"""Largest share of pixels that differ by more than `PIXEL_TOLERANCE`."""

LARGE_TOLERANCE = 0.05
"""Difference of a pixel that another order of two Gaussians at the same depth may exceed."""
LARGE_SHARE = 1e-4
"""Largest share of pixels that differ by more than `LARGE_TOLERANCE`: few have such a pair."""

RADIUS_TOLERANCE = 1
"""Difference in pixels within which radii agree: they are rounded up to pixels."""
RADIUS_SHARE = 1e-3
"""Largest share of Gaussians whose radii differ by more than `RADIUS_TOLERANCE`."""

STRETCH = 0.5
"""Standard deviation of the logarithms by which the axes of compared Gaussians are stretched."""

GRADIENT_TOLERANCE = 0.02
"""Largest norm of the difference of an input's gradients, in norms of the gradient."""


@dataclass(frozen=True)
class RasterizerCall:
    """Hold a view's call of the checkout's own rasterizer, and ours for the same settings.

    Attributes:
        view: name of the view.
        own, ours: rasterizers with the view's settings.
        inputs: by name, as the checkout passes them to its own.
        settings: of the view.
    """

    view: str
    own: Callable[..., Any]
    ours: Callable[..., Any]
    inputs: Mapping[str, Any]
    settings: Any

    @classmethod
    def of(cls, view: str, own: Captured, ours: Captured) -> RasterizerCall:
        """Return the call of a view that was rendered with both."""
        return cls(view, own.rasterizer, ours.rasterizer, own.inputs, own.settings)

    @property
    def size(self) -> tuple[int, ...]:
        """(height, width) of the view."""
        return size_of(self.settings)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(next(v for v in self.inputs.values() if isinstance(v, Tensor) and v.ndim == 2))


@dataclass(frozen=True)
class Rendered:
    """Hold what a rasterizer returned for a call, and its times.

    Attributes:
        image: (3, h, w).
        radii: (n,); None if there are none among its outputs.
        gradients: of a weighted sum of the image, by input.
        times: medians.
    """

    image: Tensor
    radii: Tensor | None
    gradients: Mapping[str, Tensor]
    times: Times


def trials_of(calls: Iterable[RasterizerCall], device: torch.device) -> Iterator[Trial]:
    """Yield the measurements of calls, and of as many Gaussians as later in a run, until a difference is found."""
    for first in calls:
        call = stretched(first)
        yield (trial := tried(call, device))
        later = repeated(call, LATER_COUNT)
        if not trial.difference and later is not None:
            with suppress(torch.cuda.OutOfMemoryError):
                yield (trial := tried(later, device))
        if trial.difference:
            return


def tried(call: RasterizerCall, device: torch.device) -> Trial:
    """Return the measurements of a call."""
    own, ours = (rendered(function, call, device) for function in (call.own, call.ours))
    height, width = own.image.shape[1:]
    return Trial(call.view, (width, height), call.count, own.times, ours.times, difference(own, ours))


@torch.enable_grad()
def rendered(rasterizer: Callable[..., Any], call: RasterizerCall, device: torch.device) -> Rendered:
    """Render a call several times, and differentiate it by its inputs."""
    clock, times = _Clock(device), list[tuple[Any, Any, Any]]()
    weights: Tensor | None = None
    for _ in range(WARM_UP + REPEATS):
        inputs = {name: _leaf(value) for name, value in call.inputs.items()}
        wanted = {name: v for name, v in inputs.items() if isinstance(v, Tensor) and v.requires_grad}
        start = clock.now()
        outputs = rasterizer(**inputs)
        image = RasterOutputs.of(outputs, call.size).image
        if weights is None:
            weights = _weights(image)
        middle = clock.now()
        grads = torch.autograd.grad(image, tuple(wanted.values()), weights, allow_unused=True)
        times.append((start, middle, clock.now()))
    forward = statistics.median(clock.milliseconds(start, middle) for start, middle, _ in times[WARM_UP:])
    backward = statistics.median(clock.milliseconds(middle, end) for _, middle, end in times[WARM_UP:])
    gradients = {name: gradient for name, gradient in zip(wanted, grads, strict=True) if gradient is not None}
    return Rendered(image.detach(), _radii(outputs, call.count), gradients, Times(forward, backward))


def stretched(call: RasterizerCall) -> RasterizerCall:
    """Return a call whose Gaussians have three different axes, turned at random.

    A scene's first Gaussians are spheres: the gradient by their rotations is rounding alone, which differs.
    """
    scales, rotations = call.inputs.get("scales"), call.inputs.get("rotations")
    if not isinstance(scales, Tensor) or not isinstance(rotations, Tensor):
        return call
    generator = torch.Generator().manual_seed(0)
    factors = torch.randn(scales.shape, generator=generator).mul(STRETCH).exp().to(scales)
    turned = torch.nn.functional.normalize(torch.randn(rotations.shape, generator=generator), dim=1).to(rotations)
    inputs = {
        **call.inputs,
        "scales": (scales.detach() * factors).requires_grad_(scales.requires_grad),
        "rotations": turned.requires_grad_(rotations.requires_grad),
    }
    return RasterizerCall(call.view, call.own, call.ours, inputs, call.settings)


def repeated(call: RasterizerCall, count: int) -> RasterizerCall | None:
    """Return a call with about `count` Gaussians, as later in a run; None if it has as many.

    Each Gaussian becomes several smaller ones around its place.
    """
    times, number = count // max(1, call.count), call.count
    if times < 2:
        return None
    generator = torch.Generator().manual_seed(0)
    inputs = dict(call.inputs)
    for name, value in call.inputs.items():
        if isinstance(value, Tensor) and value.ndim and len(value) == number:
            inputs[name] = value.detach().repeat_interleave(times, 0).requires_grad_(value.requires_grad)
    with torch.no_grad():
        scales = inputs.get("scales")
        if isinstance(scales, Tensor) and "means3D" in inputs and bool((scales > 0).all()):
            means = inputs["means3D"]
            noise = torch.randn(means.shape, generator=generator).to(means)
            means += noise * scales.mean(1, keepdim=True)
            scales *= times ** (-1 / 3)  # together they fill the volume of the one
    return RasterizerCall(call.view, call.own, call.ours, inputs, call.settings)


def difference(own: Rendered, ours: Rendered) -> str:
    """Return where two results differ by more than rounding explains, as a clause; empty if they agree."""
    return (
        _of_images(own.image, ours.image)
        or _of_radii(own.radii, ours.radii)
        or next(filter(None, (_of_gradients(name, own, ours) for name in own.gradients)), "")
    )


def _of_images(own: Tensor, ours: Tensor) -> str:
    if own.shape != ours.shape:
        return f"its image is {tuple(ours.shape)}, with its own {tuple(own.shape)}"
    error = (own - ours).abs().amax(0).nan_to_num(torch.inf)  # (h, w)
    share, large = (float((error > tolerance).float().mean()) for tolerance in (PIXEL_TOLERANCE, LARGE_TOLERANCE))
    if share <= PIXEL_SHARE and large <= LARGE_SHARE:
        return ""
    y, x = divmod(int(error.argmax()), error.shape[1])
    colors = (" ".join(f"{value:.4f}" for value in image[:, y, x].tolist()) for image in (ours, own))
    return (
        f"{100 * share:.2g} % of the pixels by more than {PIXEL_TOLERANCE:g}, most at x {x}, y {y}: "
        f"{' instead of '.join(colors)} with its own"
    )


def _of_radii(own: Tensor | None, ours: Tensor | None) -> str:
    if own is None or ours is None:
        return ""
    error = (own - ours).abs()
    unlike = (error > RADIUS_TOLERANCE) | ((own > 0) != (ours > 0))
    share = float(unlike.float().mean())
    if share <= RADIUS_SHARE:
        return ""
    row = int((error + unlike).argmax())
    return f"{100 * share:.2g} % of the radii, most of Gaussian {row}: {int(ours[row])} instead of {int(own[row])} px"


def _of_gradients(name: str, own: Rendered, ours: Rendered) -> str:
    expected, gradient = own.gradients[name], ours.gradients.get(name)
    if gradient is None or gradient.shape != expected.shape:
        return f"it has no gradient by {name} of the shape {tuple(expected.shape)}"
    error, norm = float((gradient - expected).norm()), float(expected.norm())
    if error <= GRADIENT_TOLERANCE * norm:
        return ""
    worst = int((gradient - expected).abs().nan_to_num(torch.inf).argmax())
    row = worst // max(1, expected[0].numel())
    values = (f"{float(tensor.flatten()[worst]):.4g}" for tensor in (gradient, expected))
    share = f"{100 * error / norm:.2g} %" if norm else "all"
    return f"the gradient by {name} by {share} of its norm, most of Gaussian {row}: {' instead of '.join(values)}"


def _radii(outputs: Any, count: int) -> Tensor | None:
    """Return the first whole numbers of Gaussians among a rasterizer's outputs."""
    values = outputs.values() if isinstance(outputs, Mapping) else outputs if isinstance(outputs, (tuple, list)) else ()
    kinds = (torch.int32, torch.int64)
    return next((v for v in values if isinstance(v, Tensor) and v.dtype in kinds and v.shape == (count,)), None)


def _leaf(value: Any) -> Any:
    return value.detach().clone().requires_grad_(value.requires_grad) if isinstance(value, Tensor) else value


def _weights(image: Tensor) -> Tensor:
    """Return the gradient of a loss by an image, the same for both rasterizers: smooth, as errors of photos are."""
    _, height, width = image.shape
    coarse = torch.randn(1, 3, height // 8 + 1, width // 8 + 1, generator=torch.Generator().manual_seed(0))
    smooth = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")[0]
    return smooth.to(image) / image.numel()


class _Clock:
    """Take times of a device's work: events of a GPU, which has not done it when a call returns."""

    def __init__(self, device: torch.device) -> None:
        self._events = device.type == "cuda"

    def now(self) -> Any:
        if not self._events:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]  # torch's
        event.record()
        return event

    def milliseconds(self, start: Any, end: Any) -> float:
        if not self._events:
            return 1e3 * float(end - start)
        end.synchronize()
        return float(start.elapsed_time(end))
