"""From the fields of a hierarchy to images: one level added to what the coarser levels made, or all of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from lapgs_plugin.errors import DeviceMemoryError, RunFolderError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import FieldStack, ImageRasterizer, Rasterizer, StackingRasterizer, render_images
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.upsample import upsample_add
from lapgs_plugin.rendering.field_offload import FieldOffload
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import Manifest

CLAMPED = "clamped"
"""Key of a manifest's settings: whether its levels were composed with `HierarchyRenderer.clamped`."""

AT_ONCE_PIXELS = 3_000_000
"""Of the finest level rendered. With two fields of a third of a million Gaussians an H200 takes 0.98 ms for all at once
and 1.23 in streams at 1.7 million pixels, 1.81 and 1.68 at 4.4 million."""

LARGEST_GAIN = 1000.0
"""Of a band. More is a slip: a residual of one step of 8 bits becomes 4 times the whole range with it."""


@dataclass(frozen=True)
class Composition:
    """One view, or a batch of views of one size, level by level; the sums are never clamped.

    Attributes:
        base: (3, h, w) the coarsest level's render, background blended in; of a batch (b, 3, h, w), as all images.
        residuals: by level, finest last: (3, h, w) signed render R_hat^l at that level's size, or of nested levels what
            one adds to the coarser ones, I_hat^l - Up(I_hat^(l+1)). Base and residuals include their gains, where any
            were asked for.
        composed: by level, finest last: (3, h, w) I_hat^l at that level's size; at the coarsest level it is `base`.
    """

    base: Tensor
    residuals: dict[int, Tensor]
    composed: dict[int, Tensor]

    def view(self, index: int) -> Composition:
        """One view of a batch."""
        residuals, composed = (
            {level: images[index] for level, images in band.items()} for band in (self.residuals, self.composed)
        )
        return Composition(self.base[index], residuals, composed)


def to_full_size(image: Tensor, camera: Camera, level: int, pyramid: Pyramid) -> Tensor:
    """Up, `level` times: a composed image of that level at the size of the full-resolution view, as if every finer
    residual were zero.

    Args:
        image: (3, h, w) at the size of `level`.
        camera: of the full-resolution view.
    """
    for finer in range(level - 1, -1, -1):
        width, height = level_size((camera.width, camera.height), finer)
        image = pyramid.up(image, (height, width))
    return image


@dataclass(frozen=True)
class HierarchyRenderer:
    """Renders the finished levels of a hierarchy and adds them up.

    A signed field is added to what the coarser ones make. Where levels are nested (`plan.Hierarchy`) no field is
    signed: each makes its level's whole image, and an image takes the rendering of one field alone.

    On a GPU all fields of a view are rendered in one set of launches, where the rasterizer can and as long as launching
    is what takes the time. Otherwise every field is rendered in a stream of its own: a coarse level, which leaves most
    of a GPU idle, costs little beside a fine one. Up and the sum of a level are one kernel, in the stream that is
    current when `render` is called, and that images are for. Nothing here waits for the GPU, but for a field that has
    to be brought there first.

    Attributes:
        fields: by level; contiguous from `levels - 1` down to the finest that is finished. Wherever they are, with a
            `residence`, or else all on the device that renders them.
        levels: number of levels of the whole hierarchy, L.
        pyramid: Up between two levels; on the grid the hierarchy was trained with.
        rasterizer: renders every field.
        background: RGB behind the base. Residuals are always rendered over zero.
        clamped: clamp each field's own render before it is added, the base to [0, 1] and residuals to [-1, 1], as the
            paper authors' release does in training and rendering.
        concurrent: on a GPU, let fields be rendered beside each other instead of one after the other, where the
            rasterizer can. The extensions of 3DGS codebases cannot: their kernels all go to one stream of their own.
        at_once: with `concurrent`, the most pixels of the finest level rendered for which all fields of a view are
            rendered in one set of launches; 0 for never. Only with a `residence` that keeps fields on the device: it
            holds finished ones, and these are a copy.
        residence: brings fields to the device when they are needed; None where they are there, and may still change.

    Raises:
        UserInputError: a level between the coarsest and the finest given is missing, the base is signed, or some of
            the finer fields are and others not.
    """

    fields: Mapping[int, GaussianField]
    levels: int
    pyramid: Pyramid
    rasterizer: Rasterizer
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clamped: bool = False
    concurrent: bool = True
    at_once: int = AT_ONCE_PIXELS
    residence: FieldOffload | None = None

    def __post_init__(self) -> None:
        given = sorted(self.fields, reverse=True)
        expected = list(range(self.levels - 1, -1, -1))[: len(given)]
        if not given or given != expected:
            raise UserInputError(
                f"fields of levels {given}, expected {self.levels - 1}, ..., 0 or the first of these without gaps"
            )
        signed = [self.fields[level].signed for level in expected]
        if signed[0] or len(set(signed[1:])) > 1:
            kinds = zip(given, ("signed" if one else "unsigned" for one in signed), strict=True)
            found = ", ".join(f"{level} {kind}" for level, kind in kinds)
            raise UserInputError(
                f"fields of levels {found}; expected the coarsest, {self.levels - 1}, unsigned (the base), and the "
                "others all signed (residuals) or, where levels are nested, all unsigned"
            )

    @classmethod
    def from_archive(
        cls,
        archive: RunArchive,
        rasterizer: Rasterizer,
        device: torch.device | str = "cpu",
        *,
        finest: int = 0,
        keep: bool = True,
    ) -> HierarchyRenderer:
        """A renderer of a run's finished levels.

        Args:
            archive: the run.
            rasterizer: renders every field.
            device: where it wants them, and images come out. Fields are brought there when they are first rendered.
            finest: the finest level that is wanted; fields of finer ones are not read.
            keep: let fields stay on the device. Otherwise they wait in page-locked memory and come for each frame anew,
                which costs time and leaves the device's memory to images.

        Raises:
            RunFolderError: a field is damaged, or no level is finished.
        """
        manifest = archive.manifest
        manifest.record(manifest.levels - 1)
        fields: dict[int, GaussianField] = {}
        for level in (each for each in archive.available_levels if each >= finest):
            try:
                fields[level] = archive.field(level)
            except RunFolderError as error:
                raise _with_what_is_left(error, list(fields)) from error
        return cls.of(manifest, fields, rasterizer, FieldOffload(torch.device(device), keep))

    @classmethod
    def of(
        cls,
        manifest: Manifest,
        fields: Mapping[int, GaussianField],
        rasterizer: Rasterizer,
        residence: FieldOffload | None = None,
    ) -> HierarchyRenderer:
        """A renderer of these fields of a run, where they are, or with a `residence` where that brings them."""
        return cls(
            fields=fields,
            levels=manifest.levels,
            pyramid=Pyramid(manifest.grid),
            rasterizer=rasterizer,
            background=manifest.scene.background,
            clamped=bool(manifest.settings.get(CLAMPED, False)),
            residence=residence,
        )

    @property
    def device(self) -> torch.device:
        """Where fields are rendered, and the images come out."""
        return self.fields[self.levels - 1].means.device if self.residence is None else self.residence.device

    def field(self, level: int) -> GaussianField:
        """A level's field on `device`."""
        field = self.fields[level]
        return field if self.residence is None else self.residence.bring(level, field)

    @property
    def finest(self) -> int:
        """The finest level that can be rendered; 0 for a complete hierarchy."""
        return min(self.fields)

    @property
    def nested(self) -> bool:
        """Whether each field makes its level's whole image."""
        return self.finest < self.levels - 1 and not self.fields[self.finest].signed

    def fields_for(self, level: int, gains: Mapping[int, float] | None = None) -> list[int]:
        """The levels whose fields `images` renders, coarsest first; arguments as it takes them."""
        gains = gains or {}
        levels = range(self.levels - 1, level - 1, -1)
        if not self.nested:
            return [each for each in levels if gains.get(each, 1.0) != 0.0]
        return [level] if all(gains.get(each, 1.0) == 1.0 for each in levels) else list(levels)

    def fields_for_band(self, level: int, gain: float = 1.0) -> list[int]:
        """The levels whose fields `band` renders, coarsest first; arguments as it takes them."""
        if self.nested and level < self.levels - 1:
            return [level + 1, level]
        return [level] if gain != 0.0 else []

    def require_level(self, level: int) -> None:
        """Check that `level` can be rendered.

        Raises:
            UserInputError: it is not there.
        """
        if not self.finest <= level < self.levels:
            raise UserInputError(
                f"level {level} cannot be rendered, expected {self.finest} to {self.levels - 1}; "
                "levels count from 0, the finest, and this run has no others"
            )

    def level_for_size(self, camera: Camera, size: tuple[int, int]) -> int:
        """The level of detail for an image of (width, height) pixels: the coarsest whose image is not smaller.

        Args:
            camera: of the full-resolution view.
            size: what the image is shown at.

        Returns:
            One that can be rendered; the finest of them where even that is smaller.
        """
        for level in range(self.levels - 1, self.finest, -1):
            width, height = level_size((camera.width, camera.height), level)
            if width >= size[0] and height >= size[1]:
                return level
        return self.finest

    def render(self, camera: Camera, level: int = 0, gains: Mapping[int, float] | None = None) -> Composition:
        """Render a view from the coarsest level down to `level`.

        Args:
            camera: of the full-resolution view.
            level: finest level to add.
            gains: by level, what its band is multiplied by, at least 0; 1 where nothing is said, which is the image as
                trained. A residual of gain 0 is not rendered.

        Raises:
            UserInputError: that level is not there, or a gain is out of range or for a level that is not there.
            DeviceMemoryError: the GPU is full.
        """
        return self.render_batch([camera], level, gains).view(0)

    @torch.no_grad()
    def render_batch(
        self, cameras: Sequence[Camera], level: int = 0, gains: Mapping[int, float] | None = None
    ) -> Composition:
        """Render several views at once, which spares launches where the rasterizer takes several cameras.

        Args:
            cameras: of full-resolution views, all of one size; at least one.
            level, gains: as `render` takes them.

        Returns:
            A composition of images (b, 3, h, w).

        Raises:
            UserInputError: as `render`, or the cameras differ in size.
        """
        return self._compose(cameras, range(self.levels - 1, level - 1, -1), self._checked(level, gains))

    @torch.no_grad()
    def images(self, cameras: Sequence[Camera], level: int = 0, gains: Mapping[int, float] | None = None) -> Tensor:
        """(b, 3, h, w) I_hat of `level`, without the bands it is made of: of nested levels one field is rendered.

        Args, Raises:
            As `render_batch`.
        """
        gains = self._checked(level, gains)
        needed = self.fields_for(level, gains) if self.nested else range(self.levels - 1, level - 1, -1)
        return self._compose(cameras, needed, gains).composed[level]

    @torch.no_grad()
    def band(self, camera: Camera, level: int, gain: float = 1.0) -> Tensor:
        """(3, h, w) what one level adds to the coarser ones, at its size; of the coarsest, its image.

        Args:
            camera: of the full-resolution view.
            level: whose band.
            gain: what the band is multiplied by, at least 0; 0 gives zeros.

        Raises:
            UserInputError: as `render`.
        """
        gains = self._checked(level, {level: gain})
        if len(needed := self.fields_for_band(level, gain)) > 1:
            return self._compose([camera], needed, gains).residuals[level][0]
        return self._render_band(level, [level_camera(camera, level)], gain)[0]

    def _compose(self, cameras: Sequence[Camera], levels: Sequence[int], gains: Mapping[int, float]) -> Composition:
        """Of these levels, coarsest first; a base that is finer than the hierarchy's makes its image by itself."""
        if len(sizes := {(camera.width, camera.height) for camera in cameras}) != 1:
            found = ", ".join(f"{width}x{height}" for width, height in sorted(sizes)) or "none"
            raise UserInputError(f"cameras of {found} pixels, expected one size in a batch; render them by size")
        nested, as_trained = self.nested, all(gains.get(each, 1.0) == 1.0 for each in levels)
        weights = {} if nested else gains  # a nested field's image has the coarser bands in it
        renders = self._at_once if self._goes_at_once(cameras, levels, weights) else self._field_by_field
        residuals: dict[int, Tensor] = {}
        composed: dict[int, Tensor] = {}
        coarser: Tensor | None = None  # of nested levels, the last image before its gains
        for each, images in renders(cameras, levels, weights):
            if each == levels[0]:
                base_gain = gains.get(each, 1.0) if nested and each == self.levels - 1 else 1.0
                composed[each] = _times(base_gain, images)
            elif not nested:
                residuals[each] = images
                composed[each] = upsample_add(self.pyramid, composed[each + 1], images)
            else:
                assert coarser is not None, "the first level was another one"
                adds = images - self.pyramid.up(coarser, (images.shape[-2], images.shape[-1]))
                residuals[each] = _times(gains.get(each, 1.0), adds)
                composed[each] = (
                    images if as_trained else upsample_add(self.pyramid, composed[each + 1], residuals[each])
                )
            coarser = images
        return Composition(composed[levels[0]], residuals, composed)

    def _checked(self, level: int, gains: Mapping[int, float] | None) -> Mapping[int, float]:
        self.require_level(level)
        for each, gain in (gains or {}).items():
            self.require_level(each)
            if not (math.isfinite(gain) and 0.0 <= gain <= LARGEST_GAIN):
                raise UserInputError(
                    f"gain {gain:g} of level {each}: expected a number from 0 (leave the band out) to "
                    f"{LARGEST_GAIN:g}; 1 is the band as trained"
                )
        return gains or {}

    @cached_property
    def can_be_at_once(self) -> bool:
        """Whether all fields of a view can be rendered in one set of launches, whatever `at_once` says."""
        keeps = self.residence is not None and self.residence.keep
        return keeps and isinstance(self.rasterizer, StackingRasterizer) and self.rasterizer.can_stack

    def _goes_at_once(self, cameras: Sequence[Camera], levels: Sequence[int], gains: Mapping[int, float]) -> bool:
        if not self.concurrent or len(cameras) > 1 or not self.can_be_at_once:
            return False  # a batch shares its launches among its views
        finest = level_camera(cameras[0], levels[-1])
        return finest.width * finest.height <= self.at_once and all(gains.get(each, 1) for each in levels)

    def _at_once(
        self, cameras: Sequence[Camera], levels: Sequence[int], gains: Mapping[int, float]
    ) -> Iterator[tuple[int, Tensor]]:
        """As `_field_by_field`, of one camera, all fields together."""
        with self._memory_for(levels, level_camera(cameras[0], levels[-1])):
            background = self._colored if any(self.background) else None
            images = self._stack(levels).render([level_camera(cameras[0], each) for each in levels], background)
            for each, image in zip(levels, images, strict=True):
                yield each, self._weighed(each, image[None], gains.get(each, 1.0))

    def _stack(self, levels: Sequence[int]) -> FieldStack:
        """The fields of these levels on the device, with finer ones after them or none."""
        wanted = tuple(levels)
        if all(there[: len(wanted)] != wanted for there in self._stacks):
            assert isinstance(self.rasterizer, StackingRasterizer)
            self._stacks.clear()  # first, so that they are not there twice
            self._stacks[wanted] = self.rasterizer.stack([self.fields[each] for each in wanted])
        return next(iter(self._stacks.values()))

    @cached_property
    def _stacks(self) -> dict[tuple[int, ...], FieldStack]:
        """By the levels in it, the one that was needed last."""
        return {}

    def _field_by_field(
        self, cameras: Sequence[Camera], levels: Sequence[int], gains: Mapping[int, float]
    ) -> Iterator[tuple[int, Tensor]]:
        """Levels, coarsest first, with their renders times their gain, (b, 3, h, w), for the current stream."""
        rendered: dict[int, Tensor] = {}
        # The finest first: it takes longest, and coarser levels are rendered in its shadow.
        for each in reversed(levels):
            at_level = [level_camera(camera, each) for camera in cameras]
            with self._beside(each):
                rendered[each] = self._render_band(each, at_level, gains.get(each, 1.0))
        for each in levels:
            yield each, self._for_current(each, rendered[each])

    @property
    def can_be_concurrent(self) -> bool:
        """Whether there are fields that can be rendered beside each other."""
        return self.device.type == "cuda" and len(self.fields) > 1 and isinstance(self.rasterizer, ImageRasterizer)

    @cached_property
    def _streams(self) -> dict[int, torch.cuda.Stream]:
        """By level; none where fields are rendered one after the other."""
        if not self.concurrent or not self.can_be_concurrent:
            return {}
        for level in self.fields:
            self.behind(level)  # makes what all of them share
        torch.cuda.synchronize(self.device)  # it and the fields are complete: no stream has to wait for them later
        # Coarser levels go first wherever the finer ones, which fill the GPU, leave room.
        return {
            level: torch.cuda.Stream(self.device, priority=-min(level - self.finest, 1))  # type: ignore[no-untyped-call]  # torch's
            for level in self.fields
        }

    @contextmanager
    def _beside(self, level: int) -> Iterator[None]:
        """Let what is inside go to the level's stream, where there are any."""
        if level not in self._streams:
            yield
            return
        with torch.cuda.stream(self._streams[level]):
            yield

    def _for_current(self, level: int, images: Tensor) -> Tensor:
        """Images that a level's stream makes, for use in the current one."""
        if level in self._streams:
            current = torch.cuda.current_stream(self.device)
            current.wait_stream(self._streams[level])
            images.record_stream(current)
        return images

    def behind(self, level: int) -> Tensor:
        """(3,) what a level's field is rendered over: a residual adds to the image, it would add a background again."""
        return self._black if self.fields[level].signed else self._colored

    @cached_property
    def _black(self) -> Tensor:
        return torch.zeros_like(self._colored)

    @cached_property
    def _colored(self) -> Tensor:
        """(3,) `background` where fields are rendered, sent there once: sending waits for a GPU."""
        return torch.tensor(self.background, dtype=self.fields[self.levels - 1].means.dtype, device=self.device)

    def _render_band(self, level: int, at_level: Sequence[Camera], gain: float) -> Tensor:
        """A field's own renders times its gain, (b, 3, h, w) at the size of `at_level`."""
        if gain == 0.0:
            return self._black.new_zeros(len(at_level), 3, at_level[0].height, at_level[0].width)
        with self._memory_for([level], at_level[0]):
            images = render_images(self.rasterizer, self.field(level), at_level, self.behind(level))
            return self._weighed(level, images, gain)

    def _weighed(self, level: int, images: Tensor, gain: float) -> Tensor:
        """A level's renders, clamped where its hierarchy is, times its gain."""
        if self.clamped:
            images = images.clamp(-1.0 if self.fields[level].signed else 0.0, 1.0)
        return _times(gain, images)

    @contextmanager
    def _memory_for(self, levels: Sequence[int], camera: Camera) -> Iterator[None]:
        """Say in one line that what is inside, which renders these levels, finds the GPU full."""
        try:
            yield
        except torch.cuda.OutOfMemoryError as error:
            which = f"level {levels[0]}" if len(levels) == 1 else f"levels {levels[0]} to {levels[-1]}"
            count = sum(len(self.fields[each]) for each in levels)
            raise DeviceMemoryError(
                f"the GPU has no memory left to render {which}, {count:,} Gaussians at {camera.width}x{camera.height}; "
                "render a coarser --level, a smaller size, or with --device cpu"
            ) from error


def _times(gain: float, images: Tensor) -> Tensor:
    return images if gain == 1.0 else gain * images


def _with_what_is_left(error: RunFolderError, whole: Sequence[int]) -> RunFolderError:
    """The error of a damaged level, with how to render those before it."""
    if not whole:
        return error
    return RunFolderError(f"{error}; what was trained before it is whole: `lapgs render --level {min(whole)}`")
