"""Render scenes of any size with rasterizers whose near plane and guards have fixed lengths."""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import FieldStack, Rasterizer, RenderResult, Semantics

NEAREST_DEPTH = 3.0
"""Least median depth of a scene's points in the rasterizer's unit. COLMAP's scenes lie between it and its double."""


def unit_of_depth(depth: float) -> float:
    """Return the power of two that brings a scene's median depth to `NEAREST_DEPTH` or more, less than its double."""
    return 2.0 ** math.floor(math.log2(depth / NEAREST_DEPTH))


def in_unit(rasterizer: Rasterizer, unit: float) -> Rasterizer:
    """Wrap a rasterizer so that its near plane and guards are in lengths of `unit`; images stay the same."""
    return rasterizer if unit == 1.0 else InUnit(rasterizer, unit)


class InUnit(Rasterizer):
    """Divide all lengths by a unit before rendering. Fields, cameras and gradients outside keep theirs.

    The unit is in world units; a power of two keeps positions exact.
    """

    def __init__(self, rasterizer: Rasterizer, unit: float) -> None:
        self._inner, self._unit = rasterizer, unit
        self._cameras: dict[int, tuple[weakref.ref[Camera], Camera]] = {}
        self.name, self.devices = rasterizer.name, rasterizer.devices
        self.in_current_stream = rasterizer.in_current_stream

    @property
    def semantics(self) -> Semantics:
        return self._inner.semantics

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        return self._inner(self._field(field), self._camera(camera), background=background, sh_degree=sh_degree)

    def render_image(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> Tensor:
        scaled = self._field(field)
        return self._inner.render_image(scaled, self._camera(camera), background=background, sh_degree=sh_degree)

    @torch.no_grad()
    def render_images(self, field: GaussianField, cameras: Sequence[Camera], *, background: Tensor) -> Tensor:
        scaled = [self._camera(camera) for camera in cameras]
        return self._inner.render_images(self._field(field), scaled, background=background)

    @property
    def can_batch(self) -> bool:
        return self._inner.can_batch

    @property
    def mixes_sizes(self) -> bool:
        return self._inner.mixes_sizes

    def render_batch(
        self,
        field: GaussianField,
        cameras: Sequence[Camera],
        *,
        background: Tensor,
        sh_degree: int | None = None,
        with_geometry: bool = True,
    ) -> RenderResult:
        scaled = [self._camera(camera) for camera in cameras]
        return self._inner.render_batch(
            self._field(field), scaled, background=background, sh_degree=sh_degree, with_geometry=with_geometry
        )

    @property
    def can_stack(self) -> bool:
        return self._inner.can_stack

    def stack(self, fields: Sequence[GaussianField]) -> FieldStack:
        return _StackInUnit(self._inner.stack([self._field(field) for field in fields]), self)

    def _field(self, field: GaussianField) -> GaussianField:
        means, log_scales = field.means / self._unit, field.log_scales - math.log(self._unit)
        return field.with_parameters({"means": means, "log_scales": log_scales})

    def _camera(self, camera: Camera) -> Camera:
        """Return a camera's copy, always the same object: rasterizers know training cameras by that."""
        known = self._cameras.get(id(camera))
        if known is None or known[0]() is not camera:
            with torch.inference_mode(False):  # kept for later calls, which may need gradients
                pose = camera.world_to_camera.clone()
                pose[:3, 3] /= self._unit
            key, cache = id(camera), self._cameras
            reference = weakref.ref(camera, lambda _: cache.pop(key, None))
            known = cache[key] = reference, replace(camera, world_to_camera=pose)
        return known[1]


class _StackInUnit(FieldStack):
    def __init__(self, stack: FieldStack, owner: InUnit) -> None:
        self._stack, self._owner = stack, owner

    def render(self, cameras: Sequence[Camera], background: Tensor | None) -> list[Tensor]:
        return self._stack.render([self._owner._camera(camera) for camera in cameras], background)
