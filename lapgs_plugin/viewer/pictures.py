"""Render the picture of a client: chosen bands, gains and detail, of one run or of two side by side."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult
from lapgs_plugin.ops.composition import to_full_size
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.images import around_grey
from lapgs_plugin.rendering.rig import Rig

DIVIDER_PIXELS = 2


class TimedRasterizer(Rasterizer):
    """Record the milliseconds in which a rasterizer renders each field, in the order of rendering."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._rasterizer = rasterizer
        self.name = rasterizer.name
        self.laps: list[float] = []

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        """Render without timing, see `Rasterizer`."""
        return self._rasterizer(field, camera, background=background, sh_degree=sh_degree)

    def render_images(self, field: GaussianField, cameras: Sequence[Camera], *, background: Tensor) -> Tensor:
        """Render and record the time, see `Rasterizer`."""
        begin = time.perf_counter()
        images = self._rasterizer.render_images(field, cameras, background=background)
        if images.is_cuda:
            torch.cuda.synchronize(images.device)
        self.laps.append(1e3 * (time.perf_counter() - begin))
        return images


@dataclass(frozen=True)
class ShownRun:
    """A run in the viewer.

    Attributes:
        name: its name on the page.
        renderer: renders its finished levels.
        pixels_per_angle: focal length of the training images in pixels, at full resolution; None when the cameras are
            unknown.
        distance: from the training cameras to their subject, in world units.
    """

    name: str
    renderer: HierarchyRenderer
    pixels_per_angle: float | None
    distance: float

    @classmethod
    def of(cls, name: str, renderer: HierarchyRenderer, rig: Rig | None) -> ShownRun:
        """Make a run with the training cameras of `rig`, if they are known."""
        if rig is None:
            return cls(name, renderer, None, 1.0)
        return cls(name, renderer, sorted(camera.fy for camera in rig.cameras)[len(rig.cameras) // 2], rig.distance)

    @property
    def counts(self) -> dict[int, int]:
        """Gaussians by level, coarsest first."""
        fields = self.renderer.fields
        return {level: len(fields[level]) for level in sorted(fields, reverse=True)}

    def fitting_level(self, camera: Camera, distance: float) -> int:
        """Return the finest level whose detail the picture's pixels can show.

        Args:
            camera: camera of the picture.
            distance: from the camera to its subject, in world units.

        Returns:
            A finished level. Detail doubles from level to level; between two levels the finer one is returned.
        """
        if self.pixels_per_angle is None:
            return self.renderer.finest
        trained = self.pixels_per_angle / self.distance  # pixels a world unit
        shown = camera.fy / max(distance, 1e-9)
        octaves = math.log2(trained / shown)
        return self._finished(math.floor(octaves + 1e-6))  # tolerates rounding for a window of exactly half the size

    def level_for(self, settings: PictureSettings, window: Camera, distance: float) -> int:
        """Return the finest level to add: the finished one nearest to the chosen one or to `fitting_level`."""
        return self.fitting_level(window, distance) if settings.level is None else self._finished(settings.level)

    def _finished(self, level: int) -> int:
        return min(max(level, self.renderer.finest), self.renderer.levels - 1)


@dataclass(frozen=True)
class PictureSettings:
    """The choices of a client.

    Attributes:
        gains: by level; 0 switches a level off.
        band: the only level to show, residuals around mid-grey; None for the composition.
        level: finest level to add; None for `ShownRun.fitting_level`.
        divider: where the picture changes from one run to the other, as a share of its width; None shows only the
            first run.
    """

    gains: Mapping[int, float] = field(default_factory=dict)
    band: int | None = None
    level: int | None = 0
    divider: float | None = None


@dataclass(frozen=True)
class Picture:
    """A rendered picture.

    Attributes:
        image: (3, h, w) in [0, 1].
        level: the finest level that was added.
        milliseconds: time of each rendered level.
    """

    image: Tensor
    level: int
    milliseconds: dict[int, float]


def draw(
    run: ShownRun, other: ShownRun | None, camera: Camera, settings: PictureSettings, *, distance: float, zoom: float
) -> Picture:
    """Render a picture.

    Args:
        run: the run that the settings apply to.
        other: the run on the right of the divider, shown as trained.
        camera: camera of the picture, at its size.
        settings: the client's choices.
        distance: from the camera to its subject, in world units.
        zoom: size of the window as a multiple of the picture's.

    Raises:
        UserInputError: the settings name a level that is not finished.
    """
    window = camera.resized(round(camera.width * zoom), round(camera.height * zoom))
    timed = TimedRasterizer(run.renderer.rasterizer)
    # One field after the other, so that each can be timed.
    shown = replace(run, renderer=replace(run.renderer, rasterizer=timed, concurrent=False))
    image, level = _shown(shown, camera, settings, shown.level_for(settings, window, distance))
    if settings.divider is not None and other is not None:
        as_trained = PictureSettings(level=settings.level)
        right, _ = _shown(other, camera, as_trained, other.level_for(settings, window, distance))
        image = side_by_side(image, right.to(image), settings.divider)
    # Rendered from the finest level on. Fields are not compared, because an offloaded one comes as another object.
    if settings.band is None:
        rendered = run.renderer.fields_for(level, settings.gains)
    else:
        rendered = run.renderer.fields_for_band(level, settings.gains.get(level, 1.0))
    return Picture(image, level, dict(zip(reversed(rendered), timed.laps, strict=True)))


def side_by_side(left: Tensor, right: Tensor, divider: float) -> Tensor:
    """Join two (3, h, w) images at the divider, with a white line between them.

    Args:
        divider: share of the width of `left`, in [0, 1].
    """
    width = left.shape[2]
    column = round(divider * width)
    image = torch.cat([left[:, :, :column], right[:, :, column:]], dim=2)
    if 0 < column < width:
        image[:, :, max(column - DIVIDER_PIXELS // 2, 0) : column + DIVIDER_PIXELS // 2] = 1.0
    return image


def _shown(run: ShownRun, camera: Camera, settings: PictureSettings, level: int) -> tuple[Tensor, int]:
    """Render one run: (3, h, w) in [0, 1] at the camera's size, and the finest level in it."""
    renderer = run.renderer
    if settings.band is not None:
        level = settings.band
    # With a chosen level the picture has full resolution, and a coarser level is magnified. Otherwise the picture has
    # the resolution of `level`, and full resolution would be that of a larger window.
    top = level if settings.level is None else 0
    full = camera.resized(camera.width << top, camera.height << top)
    if settings.band is None:
        image = renderer.images([full], level, settings.gains)[0]
    else:
        image = renderer.band(full, level, settings.gains.get(level, 1.0))
        if level < renderer.levels - 1:
            image = around_grey(image)
    return to_full_size(image, full.size, level, renderer.pyramid, top).clamp(0.0, 1.0), level
