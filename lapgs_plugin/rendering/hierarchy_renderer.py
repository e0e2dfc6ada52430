"""Render the finished levels of a hierarchy and compose them to images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lapgs_plugin.errors import RunFolderError, UserInputError, errors_about
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.files import MANIFEST
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.composition import AS_TRAINED, Composition, compose, scaled
from lapgs_plugin.rendering.field_renderer import FieldOffload, FieldRenderer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import Manifest

CLAMPED = "clamped"
"""Key of a manifest's settings: whether its levels were composed with `HierarchyRenderer.clamped`."""

LARGEST_GAIN = 1000.0
"""Largest gain of a band; more is a typing error."""


@dataclass(frozen=True)
class HierarchyRenderer(FieldRenderer):
    """Render the finished levels of a hierarchy and compose them.

    A signed field is added to the upsampled image of the coarser ones. With nested levels no field is signed: each
    makes its level's whole image, so that an image takes the rendering of one field.

    Upsampling and adding a level is one kernel, in the stream that is current when `render` is called.

    Raises:
        UserInputError: a level between the coarsest and the finest given is missing, the base is signed, or some of
            the finer fields are and others not.
    """

    def __post_init__(self) -> None:
        finished = sorted(self.fields, reverse=True)
        expected = list(range(self.levels - 1, -1, -1))[: len(finished)]
        if not finished or finished != expected:
            raise UserInputError(
                f"fields of levels {finished}, expected {self.levels - 1}, ..., 0 or the first of these without gaps"
            )
        signed = [self.fields[level].signed for level in expected]
        if signed[0] or len(set(signed[1:])) > 1:
            kinds = zip(finished, ("signed" if one else "unsigned" for one in signed), strict=True)
            listed = ", ".join(f"{level} {kind}" for level, kind in kinds)
            raise UserInputError(
                f"fields of levels {listed}; expected the coarsest, {self.levels - 1}, unsigned (the base), and the "
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
        """Return a renderer of a run's finished levels.

        Args:
            archive: the run.
            rasterizer: renders every field.
            device: of the rasterizer; images come out there. Fields are copied to it when they are first rendered.
            finest: the finest level to read.
            keep: keep fields on the device. Otherwise they are copied from page-locked memory for every frame, which
                takes time and saves device memory.

        Raises:
            RunFolderError: a field is damaged, or no level is finished.
        """
        manifest = archive.manifest
        manifest.record(manifest.levels - 1)
        fields: dict[int, GaussianField] = {}
        for level in filter(lambda available: available >= finest, archive.available_levels):
            try:
                fields[level] = archive.field(level)
            except RunFolderError as error:
                if not fields:
                    raise
                whole = f"what was trained before it is whole: `lapgs render --level {min(fields)}`"
                raise RunFolderError(f"{error}; {whole}") from error
        with errors_about(archive.path(MANIFEST)):
            return cls.of(manifest, fields, rasterizer, FieldOffload(torch.device(device), keep))

    @classmethod
    def of(
        cls,
        manifest: Manifest,
        fields: Mapping[int, GaussianField],
        rasterizer: Rasterizer,
        offload: FieldOffload | None = None,
        levels: int | None = None,
    ) -> HierarchyRenderer:
        """Return a renderer of these fields of a run; `levels` is 1 for a field that they were merged to."""
        return cls(
            fields=fields,
            levels=levels or manifest.levels,
            pyramid=Pyramid(manifest.grid),
            rasterizer=rasterizer,
            background=manifest.scene.background,
            clamped=bool(manifest.settings.get(CLAMPED, False)),
            offload=offload,
        )

    @property
    def finest(self) -> int:
        """The finest level that can be rendered; 0 for a complete hierarchy."""
        return min(self.fields)

    @property
    def nested(self) -> bool:
        """Whether each field makes its level's whole image."""
        return self.finest < self.levels - 1 and not self.fields[self.finest].signed

    def fields_for(self, level: int, gains: Mapping[int, float] = AS_TRAINED) -> list[int]:
        """Return the levels whose fields `images` renders, coarsest first; arguments as it takes them."""
        levels = range(self.levels - 1, level - 1, -1)
        if not self.nested:
            return [coarser for coarser in levels if gains.get(coarser, 1.0) != 0.0]
        return [level] if all(gains.get(coarser, 1.0) == 1.0 for coarser in levels) else list(levels)

    def fields_for_band(self, level: int, gain: float = 1.0) -> list[int]:
        """Return the levels whose fields `band` renders, coarsest first; arguments as it takes them."""
        if self.nested and level < self.levels - 1:
            return [level + 1, level]
        return [level] if gain != 0.0 else []

    def require_level(self, level: int) -> None:
        """Check that `level` can be rendered.

        Raises:
            UserInputError: it is not there.
        """
        if not self.finest <= level < self.levels:
            last = self.levels - 1
            expected = str(last) if self.finest == last else f"{self.finest} to {last}"
            why = "finer levels are not finished, or were not read" if 0 <= level < self.finest else "0 is the finest"
            raise UserInputError(f"level {level} cannot be rendered, expected {expected}; {why}")

    def level_for_size(self, camera: Camera, size: tuple[int, int]) -> int:
        """Return the coarsest level of a full-size view that is not smaller than the shown size, or else the finest."""
        for level in range(self.levels - 1, self.finest, -1):
            width, height = level_size(camera.size, level)
            if width >= size[0] and height >= size[1]:
                return level
        return self.finest

    def render(self, camera: Camera, level: int = 0, gains: Mapping[int, float] | None = None) -> Composition:
        """Render a view from the coarsest level down to `level`.

        Args:
            camera: of the full-resolution view.
            gains: by level, the factor on its band, at least 0; 1 for levels that are not in it. A residual of gain 0
                is not rendered.

        Raises:
            UserInputError: the level is not there, or a gain is out of range or of a level that is not there.
            DeviceMemoryError: the GPU is full.
        """
        return self.render_batch([camera], level, gains).view(0)

    @torch.no_grad()
    def render_batch(
        self, cameras: Sequence[Camera], level: int = 0, gains: Mapping[int, float] | None = None
    ) -> Composition:
        """Render several views together, with fewer launches if the rasterizer takes several cameras.

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
        """Return I_hat of `level`, (b, 3, h, w), without its bands: with nested levels one field is rendered.

        Arguments and errors are those of `render_batch`.
        """
        gains = self._checked(level, gains)
        needed = self.fields_for(level, gains) if self.nested else range(self.levels - 1, level - 1, -1)
        return self._compose(cameras, needed, gains).composed[level]

    @torch.no_grad()
    def frames(self, cameras: Sequence[Camera], level: int = 0) -> Tensor:
        """Return `images` clamped to [0, 1], to be shown or measured."""
        if self.nested or level == self.levels - 1:
            return self.images(cameras, level).clamp(0.0, 1.0)
        self.require_level(level)
        # The kernel that adds the last residual also clamps.
        return self._compose(cameras, range(self.levels - 1, level - 1, -1), AS_TRAINED, level).composed[level]

    @torch.no_grad()
    def band(self, camera: Camera, level: int, gain: float = 1.0) -> Tensor:
        """Return one level's part of the image, (3, h, w) at its size: a residual, or the coarsest level's image.

        The factor on the band is at least 0; 0 gives zeros.

        Raises:
            UserInputError: as `render`.
        """
        gains = self._checked(level, {level: gain})
        needed = self.fields_for_band(level, gain)
        if len(needed) > 1:
            return self._compose([camera], needed, gains).residuals[level][0]
        if not needed:
            return self.zeros([camera], level)[0]
        return scaled(self.render_level([camera], level), gain)[0]

    def _compose(
        self, cameras: Sequence[Camera], levels: Sequence[int], gains: Mapping[int, float], clamped: int | None = None
    ) -> Composition:
        """Render and compose these levels, coarsest first. With nested levels the first may be any."""
        if len(sizes := {camera.size for camera in cameras}) != 1:
            listed = ", ".join(f"{width}x{height}" for width, height in sorted(sizes)) or "none"
            raise UserInputError(f"cameras of {listed} pixels, expected one size in a batch; render them by size")
        nested = self.nested  # a nested field's image includes the coarser bands, so none can be omitted
        omitted = [] if nested else [level for level in levels if gains.get(level, 1.0) == 0.0]
        renders = self.render_fields(cameras, levels, omitted)
        return compose(self.pyramid, renders, nested=nested, gains=gains, clamped=clamped)

    def _checked(self, level: int, gains: Mapping[int, float] | None) -> Mapping[int, float]:
        """Check a level and gains, and return the gains."""
        self.require_level(level)
        for band, gain in (gains or {}).items():
            self.require_level(band)
            if not (math.isfinite(gain) and 0.0 <= gain <= LARGEST_GAIN):
                raise UserInputError(
                    f"gain {gain:g} of level {band}: expected a number from 0 (leave the band out) to "
                    f"{LARGEST_GAIN:g}; 1 is the band as trained"
                )
        return gains or AS_TRAINED
