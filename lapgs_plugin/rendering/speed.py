"""Measure how fast a run renders: frames a second over real cameras, level by level, with and without streams."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median

import torch

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.runs.profiling import clock_on

ROUNDS = 5
"""Times that each view is rendered."""
BATCH = 8
"""Views in a batch; batches are measured on a GPU if there are as many views of one size."""

Frame = Callable[[Sequence[Camera]], object]


@dataclass(frozen=True)
class Speed:
    """Hold the time of frames of one kind.

    Attributes:
        what: the kind.
        size: (width, height) of a frame of the first camera.
        gaussians: of all fields that are rendered for it.
        milliseconds: median over cameras and rounds, from the end of one frame to the end of the next; for a batch,
            divided by its views.
    """

    what: str
    size: tuple[int, int]
    gaussians: int
    milliseconds: float

    @property
    def fps(self) -> float:
        return 1000.0 / self.milliseconds


def measure_speed(
    renderer: HierarchyRenderer, cameras: Sequence[Camera], level: int, rounds: int = ROUNDS
) -> list[Speed]:
    """Measure a hierarchy: composed down to `level`, to each coarser level, and each field alone.

    Images are composed and clamped, and stay on the device. Each kind is run over all cameras once before it is timed
    in so many rounds over them.
    """
    one_size = len({camera.size for camera in cameras}) == 1
    batches = renderer.device.type == "cuda" and one_size and len(cameras) >= BATCH
    return [_measured(renderer, kind, cameras, rounds) for kind in _kinds(renderer, level, batches)]


def composed_speed(renderer: HierarchyRenderer, cameras: Sequence[Camera], rounds: int = ROUNDS) -> Speed:
    """Measure the fastest way to compose all levels; arguments as `measure_speed` takes them."""
    kinds = [kind for kind in _kinds(renderer, 0) if kind.whole]
    return max((_measured(renderer, kind, cameras, rounds) for kind in kinds), key=lambda speed: speed.fps)


@dataclass(frozen=True)
class _Kind:
    """Describe a kind of frame to measure.

    Attributes:
        fields: levels whose fields are rendered.
        size_level: level whose size a frame has.
        views: of a frame.
        whole: whether a frame is the complete hierarchy's image at full resolution.
    """

    what: str
    frame: Frame
    fields: Sequence[int]
    size_level: int
    views: int = 1
    whole: bool = False


def _measured(renderer: HierarchyRenderer, kind: _Kind, cameras: Sequence[Camera], rounds: int) -> Speed:
    shown = level_camera(cameras[0], kind.size_level)
    frames = [cameras[i : i + kind.views] for i in range(0, len(cameras) - kind.views + 1, kind.views)]
    milliseconds = _median_milliseconds(kind.frame, frames * (rounds + 1), len(frames), renderer.device) / kind.views
    gaussians = sum(len(renderer.fields[level]) for level in kind.fields)
    return Speed(kind.what, (shown.width, shown.height), gaussians, milliseconds)


def _kinds(renderer: HierarchyRenderer, level: int, batches: bool = False) -> Iterator[_Kind]:
    sequential = replace(renderer, concurrent=False)
    ways = {"one after the other": sequential}
    if renderer.can_use_streams:
        ways["beside each other"] = replace(renderer, concurrent=True, stack_pixels=0)
    # At any size: these figures show up to which size it is faster.
    can_stack = renderer.can_stack
    stacked = replace(renderer, concurrent=True, stack_pixels=sys.maxsize) if can_stack else None
    if stacked is not None:
        ways["all at once"] = stacked
    coarsest = renderer.levels - 1
    for finest in range(level, coarsest):
        fields = renderer.fields_for(finest)
        if len(fields) == 1:  # nested levels: one field, which has nothing to be concurrent with
            what, of_field = f"level {finest}", {"": sequential, **({", at once": stacked} if stacked else {})}
        else:
            what, of_field = f"levels {coarsest} to {finest}", {f", {way}": composer for way, composer in ways.items()}
        for way, composer in of_field.items():
            yield _Kind(f"{what}{way}", _composing(composer, finest), fields, finest, whole=finest == 0)
    if batches:
        fields = renderer.fields_for(level)
        what = "all" if len(fields) > 1 else "field" if coarsest == 0 else f"level {level}"
        yield _Kind(f"{what}, {BATCH} views at once", _composing(renderer, level), fields, level, views=BATCH)
    base = "base" if coarsest > 0 else "field"
    yield _Kind(base, _composing(sequential, coarsest), [coarsest], coarsest, whole=coarsest == 0)
    if stacked is not None and coarsest == 0:  # to compare a stacked hierarchy with
        yield _Kind("field, at once", _composing(stacked, 0), [0], 0, whole=True)
    if coarsest > level:  # the cost of rendering the base at full size instead of upsampling it
        yield _Kind(f"base as large as level {level}", _alone(sequential, coarsest, level), [coarsest], level)
    for residual in range(coarsest - 1, level - 1, -1) if not renderer.nested else ():
        yield _Kind(f"residual {residual} alone", _alone(sequential, residual, residual), [residual], residual)


def _composing(renderer: HierarchyRenderer, level: int) -> Frame:
    return lambda cameras: renderer.frames(cameras, level)


def _alone(renderer: HierarchyRenderer, level: int, size_level: int) -> Frame:
    field, background = renderer.field(level), renderer.background_of(level)
    return lambda cameras: renderer.rasterizer.render_images(
        field, [level_camera(camera, size_level) for camera in cameras], background=background
    )


@torch.no_grad()
def _median_milliseconds(frame: Frame, frames: Sequence[Sequence[Camera]], warm: int, device: torch.device) -> float:
    """Return the median time of a frame. The first `warm` frames are not timed: they compile and fill caches."""
    for cameras in frames[:warm]:
        frame(cameras)
    clock = clock_on(device)
    clock.wait()
    ends = [clock.stamp()]
    for cameras in frames[warm:]:
        frame(cameras)
        ends.append(clock.stamp())
    clock.wait()
    return 1000.0 * median(clock.between(before, after) for before, after in pairwise(ends))
