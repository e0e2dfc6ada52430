"""From the fields of a hierarchy to images: one level added to what the coarser levels made, or all of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from lapgs_plugin.archive import Manifest, RunArchive
from lapgs_plugin.camera import Camera
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.field import GaussianField
from lapgs_plugin.plan import level_size
from lapgs_plugin.pyramid import Pyramid
from lapgs_plugin.raster import Rasterizer

CLAMPED = "clamped"
"""Key of a manifest's settings: whether its levels were composed with `HierarchyRenderer.clamped`."""


@dataclass(frozen=True)
class Composition:
    """One view, level by level; the sums are never clamped.

    Attributes:
        base: (3, h, w) the coarsest level's render, background blended in.
        residuals: by level, finest last: (3, h, w) signed render R_hat^l at that level's size. Base and residuals
            include their gains, where any were asked for.
        composed: by level, finest last: (3, h, w) I_hat^l at that level's size; at the coarsest level it is `base`.
    """

    base: Tensor
    residuals: dict[int, Tensor]
    composed: dict[int, Tensor]


def level_camera(camera: Camera, level: int) -> Camera:
    """The camera of a pyramid level, from the camera of the full-resolution view."""
    return camera.resized(*level_size((camera.width, camera.height), level))


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

    On a GPU every field is rendered in a stream of its own, and so is Up of what it gives: a coarse level, which leaves
    most of a GPU idle, costs little beside a fine one. Nothing here waits for the GPU; images are for the stream that
    is current when `render` is called.

    Attributes:
        fields: by level; contiguous from `levels - 1` down to the finest that is finished.
        levels: number of levels of the whole hierarchy, L.
        pyramid: Up between two levels; on the grid the hierarchy was trained with.
        rasterizer: renders every field.
        background: RGB behind the base. Residuals are always rendered over zero.
        clamped: clamp each field's own render before it is added, the base to [0, 1] and residuals to [-1, 1], as the
            paper authors' release does in training and rendering.
        concurrent: on a GPU, let fields be rendered beside each other instead of one after the other.

    Raises:
        UserInputError: a level between the coarsest and the finest given is missing, or a field is signed where the
            base should be or the reverse.
    """

    fields: Mapping[int, GaussianField]
    levels: int
    pyramid: Pyramid
    rasterizer: Rasterizer
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clamped: bool = False
    concurrent: bool = True

    def __post_init__(self) -> None:
        given = sorted(self.fields, reverse=True)
        expected = list(range(self.levels - 1, -1, -1))[: len(given)]
        if not given or given != expected:
            raise UserInputError(
                f"fields of levels {given}, expected {self.levels - 1}, ..., 0 or the first of these without gaps"
            )
        for level, field in self.fields.items():
            if field.signed != (level != self.levels - 1):
                kind = "signed (a residual)" if field.signed else "unsigned (a base)"
                raise UserInputError(
                    f"the field of level {level} is {kind}; expected the coarsest level, {self.levels - 1}, unsigned "
                    "and all others signed"
                )

    @classmethod
    def from_archive(
        cls, archive: RunArchive, rasterizer: Rasterizer, device: torch.device | str = "cpu"
    ) -> HierarchyRenderer:
        """A renderer of a run's finished levels.

        Args:
            archive: the run.
            rasterizer: renders every field.
            device: where it wants them; they are moved there once, and images stay there.

        Raises:
            RunFolderError: a field is damaged, or no level is finished.
        """
        manifest = archive.manifest
        manifest.record(manifest.levels - 1)
        fields = {level: archive.field(level).to(device) for level in archive.available_levels}
        return cls.of(manifest, fields, rasterizer)

    @classmethod
    def of(cls, manifest: Manifest, fields: Mapping[int, GaussianField], rasterizer: Rasterizer) -> HierarchyRenderer:
        """A renderer of these fields of a run, where they are."""
        return cls(
            fields=fields,
            levels=manifest.levels,
            pyramid=Pyramid(manifest.grid),
            rasterizer=rasterizer,
            background=manifest.scene.background,
            clamped=bool(manifest.settings.get(CLAMPED, False)),
        )

    @property
    def device(self) -> torch.device:
        """Where the fields are, and the images come out."""
        return self.fields[self.levels - 1].means.device

    @property
    def finest(self) -> int:
        """The finest level that can be rendered; 0 for a complete hierarchy."""
        return min(self.fields)

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

    @torch.no_grad()
    def render(self, camera: Camera, level: int = 0, gains: Mapping[int, float] | None = None) -> Composition:
        """Render a view from the coarsest level down to `level`.

        Args:
            camera: of the full-resolution view.
            level: finest level to add.
            gains: by level, what its band is multiplied by; 1 where nothing is said, which is the image as trained. A
                level with gain 0 is not rendered.

        Raises:
            UserInputError: that level is not there, or a gain is given for one that is not.
        """
        self.require_level(level)
        gains = {} if gains is None else gains
        for each in gains:
            self.require_level(each)
        rendered: dict[int, Tensor] = {}
        composed: dict[int, Tensor] = {}
        raised: Tensor | None = None  # Up of what is composed so far
        for each in range(self.levels - 1, level - 1, -1):
            with self._beside(each):
                rendered[each] = self._render_band(each, level_camera(camera, each), gains.get(each, 1.0))
                composed[each] = rendered[each] if raised is None else self._after(each + 1, raised) + rendered[each]
                if each > level:
                    finer = level_camera(camera, each - 1)
                    raised = self.pyramid.up(composed[each], (finer.height, finer.width))
        self._gather([*rendered.values(), *composed.values()])
        base = rendered.pop(self.levels - 1)
        return Composition(base, residuals=rendered, composed=composed)

    def render_level(
        self, camera: Camera, level: int, coarser: Tensor | None, gain: float = 1.0
    ) -> tuple[Tensor, Tensor]:
        """Render one level and add it to what the coarser levels made: I_hat^l = Up(I_hat^(l+1)) + gain * R_hat^l.

        Args:
            camera: of the full-resolution view.
            level: which field to render.
            coarser: (3, h, w) I_hat^(l+1) of the same view, None for the coarsest level.
            gain: what the render is multiplied by; 0 gives zeros without rendering.

        Returns:
            The field's own render times its gain and the composed image I_hat^l, both (3, h, w) at the level's size.
        """
        at_level = level_camera(camera, level)
        image = self._render_band(level, at_level, gain)
        if coarser is None:
            return image, image
        return image, self.pyramid.up(coarser, (at_level.height, at_level.width)) + image

    @cached_property
    def _streams(self) -> dict[int, torch.cuda.Stream]:
        """By level; none where fields are rendered one after the other."""
        if not self.concurrent or self.device.type != "cuda" or len(self.fields) == 1:
            return {}
        torch.cuda.synchronize(self.device)  # the fields are complete: no stream has to wait for them later
        return {level: torch.cuda.Stream(self.device) for level in self.fields}  # type: ignore[no-untyped-call]  # torch's

    @contextmanager
    def _beside(self, level: int) -> Iterator[None]:
        """Let what is inside go to the level's stream, where there are any."""
        if level not in self._streams:
            yield
            return
        with torch.cuda.stream(self._streams[level]):
            yield

    def _after(self, level: int, image: Tensor) -> Tensor:
        """An image that a level's stream makes, for use in the current one."""
        if level in self._streams:
            current = torch.cuda.current_stream(self.device)
            current.wait_stream(self._streams[level])
            image.record_stream(current)
        return image

    def _gather(self, images: Iterable[Tensor]) -> None:
        """Let the current stream go on when the levels' streams are done, and use their images."""
        if not self._streams:
            return
        current = torch.cuda.current_stream(self.device)
        for stream in self._streams.values():
            current.wait_stream(stream)
        for image in images:
            image.record_stream(current)

    def behind(self, level: int) -> Tensor:
        """(3,) what a level's field is rendered over: a residual adds to the image, it would add a background again."""
        return self._black if self.fields[level].signed else self._colored

    @cached_property
    def _black(self) -> Tensor:
        return torch.zeros_like(self._colored)

    @cached_property
    def _colored(self) -> Tensor:
        """(3,) `background` beside the fields, sent there once: sending waits for a GPU."""
        return torch.tensor(self.background).to(self.fields[self.levels - 1].means)

    def _render_band(self, level: int, at_level: Camera, gain: float) -> Tensor:
        """A field's own render times its gain, (3, h, w) at the size of `at_level`."""
        field = self.fields[level]
        if gain == 0.0:
            return field.means.new_zeros(3, at_level.height, at_level.width)
        image = self.rasterizer(field, at_level, background=self.behind(level)).image
        if self.clamped:
            image = image.clamp(-1.0 if field.signed else 0.0, 1.0)
        return image if gain == 1.0 else gain * image
