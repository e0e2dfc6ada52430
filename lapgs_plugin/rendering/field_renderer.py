"""Render the fields of several levels: in one set of launches, in a stream each, or one after the other."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from lapgs_plugin.errors import DeviceMemoryError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import FieldStack, Rasterizer
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.hierarchy.pyramid import Pyramid

STACK_PIXELS = 3_000_000
"""Pixels of the finest rendered level up to which one set of launches for all fields is faster than streams."""


@dataclass
class FieldOffload:
    """Keep fields in host memory and copy them to the device for rendering, once or for each frame.

    Attributes:
        device: that renders.
        keep: keep a field there after the first copy. Otherwise it stays in page-locked memory and is copied for every
            frame, in the stream that renders it, while other streams work.
    """

    device: torch.device
    keep: bool = True
    _ready: dict[int, GaussianField] = field(default_factory=dict, repr=False)

    def bring(self, level: int, wanted: GaussianField) -> GaussianField:
        """Return a level's field, which may be on any device, on `device`, for use in the current stream."""
        if wanted.means.device.type == self.device.type == "cpu":
            return wanted
        if level not in self._ready:
            self._ready[level] = wanted.to(self.device) if self.keep else _page_locked(wanted)
            torch.cuda.synchronize(self.device)  # once: from now on every stream may use it
        ready = self._ready[level]
        return ready if self.keep else _copied(ready, self.device)


@dataclass(frozen=True)
class FieldRenderer:
    """Render each level's field by itself, at its level's size.

    For one camera and an image of at most `stack_pixels`, launching takes most of the time: a rasterizer that can
    renders all fields in one set of launches. Otherwise a GPU renders every field in a stream of its own, so that a
    coarse level, which leaves most of the GPU idle, costs little beside a fine one. Nothing here waits for the GPU,
    except for a field that has to be copied there first.

    Attributes:
        fields: by level; contiguous from `levels - 1` down to the finest that is finished. On the device that renders
            them, or anywhere when there is an `offload`.
        levels: number of levels of the whole hierarchy, L.
        pyramid: Up between two levels; on the grid the hierarchy was trained with.
        rasterizer: renders every field.
        background: RGB behind the base. Residuals are always rendered over zero.
        clamped: clamp each field's own render before it is added, the base to [0, 1] and residuals to [-1, 1], as the
            paper authors' release does in training and rendering.
        concurrent: on a GPU, let fields be rendered at the same time if the rasterizer can. The extensions of 3DGS
            codebases cannot: all their kernels go to one stream.
        stack_pixels: with `concurrent`, the most pixels of the finest rendered level for which all fields of a view are
            rendered in one set of launches; 0 for never. It needs an `offload` that keeps fields on the device, because
            it renders a copy of them.
        offload: copies fields to the device when they are needed; None when they are there, and may still change.
    """

    fields: Mapping[int, GaussianField]
    levels: int
    pyramid: Pyramid
    rasterizer: Rasterizer
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clamped: bool = False
    concurrent: bool = True
    stack_pixels: int = STACK_PIXELS
    offload: FieldOffload | None = None

    @cached_property
    def device(self) -> torch.device:
        """The device that renders, on which images come out."""
        return self.fields[max(self.fields)].means.device if self.offload is None else self.offload.device

    def field(self, level: int) -> GaussianField:
        """Return a level's field on `device`."""
        wanted = self.fields[level]
        return wanted if self.offload is None else self.offload.bring(level, wanted)

    def render_fields(
        self, cameras: Sequence[Camera], levels: Sequence[int], omitted: Collection[int] = ()
    ) -> Iterator[tuple[int, Tensor]]:
        """Yield each level and its field's renders (b, 3, h, w), for use in the current stream.

        Args:
            cameras: of b full-resolution views of one size.
            levels: to render, coarsest first.
            omitted: levels that are not rendered; their images are zero.

        Raises:
            DeviceMemoryError: the GPU is full.
        """
        stacked = not omitted and self._stacks_at(cameras, levels[-1])
        return self._render_stacked(cameras[0], levels) if stacked else self._render_each(cameras, levels, omitted)

    def render_level(self, cameras: Sequence[Camera], level: int) -> Tensor:
        """Render one field in the current stream; arguments and errors as `render_fields`."""
        at_level = [level_camera(camera, level) for camera in cameras]
        with self._full_memory_explained([level], at_level[0]):
            background = self.background_of(level)
            images = self.rasterizer.render_images(self.field(level), at_level, background=background)
            return self._within_range(level, images)

    def zeros(self, cameras: Sequence[Camera], level: int) -> Tensor:
        """Return zero images of a level, (b, 3, h, w)."""
        camera = level_camera(cameras[0], level)
        return self._black.new_zeros(len(cameras), 3, camera.height, camera.width)

    @cached_property
    def can_stack(self) -> bool:
        """Whether all fields of a view can be rendered in one set of launches, whatever `stack_pixels` is."""
        return self.offload is not None and self.offload.keep and self.rasterizer.can_stack

    @property
    def can_use_streams(self) -> bool:
        """Whether several fields can be rendered concurrently, each in its own stream."""
        return self.device.type == "cuda" and len(self.fields) > 1 and self.rasterizer.in_current_stream

    def background_of(self, level: int) -> Tensor:
        """Return the background (3,) of a level's field: black for a residual, which would add the colour again."""
        return self._black if self.fields[level].signed else self._background

    def _stacks_at(self, cameras: Sequence[Camera], finest: int) -> bool:
        """Return whether to render these views in one set of launches. A batch shares its launches among its views."""
        if not self.concurrent or len(cameras) > 1 or not self.can_stack:
            return False
        camera = level_camera(cameras[0], finest)
        return camera.width * camera.height <= self.stack_pixels

    def _render_stacked(self, camera: Camera, levels: Sequence[int]) -> Iterator[tuple[int, Tensor]]:
        with self._full_memory_explained(levels, level_camera(camera, levels[-1])):
            background = self._background if any(self.background) else None
            images = self._stack(levels).render([level_camera(camera, level) for level in levels], background)
            for level, image in zip(levels, images, strict=True):
                yield level, self._within_range(level, image[None])

    def _stack(self, levels: Sequence[int]) -> FieldStack:
        """Return a stack that begins with the fields of these levels; finer ones may follow."""
        wanted = tuple(levels)
        if all(stacked[: len(wanted)] != wanted for stacked in self._stacks):
            self._stacks.clear()  # before making another, so that the fields are not on the device twice
            self._stacks[wanted] = self.rasterizer.stack([self.fields[level] for level in wanted])
        return next(iter(self._stacks.values()))

    @cached_property
    def _stacks(self) -> dict[tuple[int, ...], FieldStack]:
        """The stack that was needed last, by its levels."""
        return {}

    def _render_each(
        self, cameras: Sequence[Camera], levels: Sequence[int], omitted: Collection[int]
    ) -> Iterator[tuple[int, Tensor]]:
        rendered: dict[int, Tensor] = {}
        # The finest first: it takes longest, and the coarser levels are rendered meanwhile.
        for level in reversed(levels):
            with self._in_its_stream(level):
                skipped = level in omitted
                rendered[level] = self.zeros(cameras, level) if skipped else self.render_level(cameras, level)
        for level in levels:
            yield level, self._for_current_stream(level, rendered[level])

    @cached_property
    def _streams(self) -> dict[int, torch.cuda.Stream]:
        """Streams by level; empty where fields are rendered one after the other."""
        if not self.concurrent or not self.can_use_streams:
            return {}
        for level in self.fields:
            self.background_of(level)  # makes the tensors that all streams share
        torch.cuda.synchronize(self.device)  # these and the fields are complete: no stream has to wait for them later
        # Coarser levels have priority where the finer ones, which fill the GPU, leave room.
        finest = min(self.fields)
        return {
            level: torch.cuda.Stream(self.device, priority=-min(level - finest, 1))  # type: ignore[no-untyped-call]  # torch's
            for level in self.fields
        }

    @contextmanager
    def _in_its_stream(self, level: int) -> Iterator[None]:
        """Launch the block's kernels in the level's stream, if it has one."""
        if level not in self._streams:
            yield
            return
        with torch.cuda.stream(self._streams[level]):
            yield

    def _for_current_stream(self, level: int, images: Tensor) -> Tensor:
        """Let the current stream wait for the images of a level's stream."""
        if level in self._streams:
            current = torch.cuda.current_stream(self.device)
            current.wait_stream(self._streams[level])
            images.record_stream(current)
        return images

    @cached_property
    def _black(self) -> Tensor:
        return torch.zeros_like(self._background)

    @cached_property
    def _background(self) -> Tensor:
        """`background` (3,) on the device, copied once because a copy waits for the GPU."""
        return torch.tensor(self.background, dtype=self.fields[max(self.fields)].means.dtype, device=self.device)

    def _within_range(self, level: int, images: Tensor) -> Tensor:
        """Clamp a level's renders if the hierarchy was trained so."""
        return images.clamp(-1.0 if self.fields[level].signed else 0.0, 1.0) if self.clamped else images

    @contextmanager
    def _full_memory_explained(self, levels: Sequence[int], camera: Camera) -> Iterator[None]:
        """Turn CUDA's out-of-memory error while rendering these levels into one line."""
        try:
            yield
        except torch.cuda.OutOfMemoryError as error:
            which = f"level {levels[0]}" if len(levels) == 1 else f"levels {levels[0]} to {levels[-1]}"
            count = sum(len(self.fields[level]) for level in levels)
            raise DeviceMemoryError(
                f"the GPU has no memory left to render {which}, {count:,} Gaussians at {camera.width}x{camera.height}; "
                "render a coarser --level, a smaller size, or with --device cpu"
            ) from error


def _page_locked(wanted: GaussianField) -> GaussianField:
    return wanted.with_parameters({name: value.cpu().pin_memory() for name, value in wanted.parameters.items()})


def _copied(waiting: GaussianField, device: torch.device) -> GaussianField:
    """Start copying a field to the device, without waiting for it."""
    return waiting.with_parameters(
        {name: value.to(device, non_blocking=True) for name, value in waiting.parameters.items()}
    )
