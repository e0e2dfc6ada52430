"""Render several fields from one camera in one set of gsplat's launches, each at its own size.

For small images launching a field's kernels takes longer than running them. So the fields of a view are sorted into
tiles and blended together, as if they were images of several cameras: the Gaussians of all fields are in one list,
which gsplat calls packed, each with the number of its image.

Only projection takes a launch for each field. gsplat culls and limits the Jacobian by the image size, so that a coarse
field projected for the canvas of a finer one would differ near its border and be blended outside its image as well.
Hence this is not `gsplat.rasterization` with one more dimension.

Tested with gsplat 1.5.3, whose `rasterization` consists of the same five functions, and with the signatures of 1.6.0.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import FieldStack
from lapgs_plugin.gpu_raster.cameras import cameras_on_device
from lapgs_plugin.gpu_raster.records import TILE
from lapgs_plugin.rasterizers.gsplat.stock import raw_sh_values
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH, PIXEL_VARIANCE


class GsplatStack(FieldStack):
    """Hold activated copies of fields on a device, concatenated in one tensor per parameter.

    Args:
        fields: float32, on any device. Later changes to them have no effect.
        device: that renders.
        antialiased: dim Gaussians that are smaller than a pixel.
    """

    def __init__(self, fields: Sequence[GaussianField], device: torch.device, *, antialiased: bool = False) -> None:
        self._antialiased = antialiased
        self._signed = [field.signed for field in fields]
        self._starts = [0, *accumulate(len(field) for field in fields)]  # of each field, and the end
        self._means = _joined([field.means for field in fields], device)  # (n, 3)
        self._quaternions = _joined([field.quaternions for field in fields], device)  # (n, 4)
        self._scales = _joined([field.log_scales for field in fields], device).exp_()  # (n, 3)
        self._opacities = _joined([field.opacity_logits for field in fields], device).sigmoid_()  # (n,)
        self._sh = _joined([field.sh for field in fields], device)  # (n, k, 3)
        images = torch.arange(len(fields), device=device)
        self._images = torch.repeat_interleave(images, torch.tensor([len(field) for field in fields], device=device))
        if device.type == "cuda":
            torch.cuda.synchronize(device)  # once: from now on every stream may use it

    @torch.no_grad()
    def render(self, cameras: Sequence[Camera], background: Tensor | None) -> list[Tensor]:
        height, width = max(camera.height for camera in cameras), max(camera.width for camera in cameras)
        viewmats, intrinsics, positions = cameras_on_device(cameras, self._means)
        if self._starts[len(cameras)] == 0:
            images, alphas = (self._means.new_zeros(len(cameras), height, width, planes) for planes in (3, 1))
        else:
            projected = self._project(cameras, viewmats, intrinsics)
            images, alphas = self._blend(projected, self._colors(viewmats, positions), len(cameras), (height, width))
        rendered = []
        for i, camera in enumerate(cameras):
            image = images[i, : camera.height, : camera.width]  # (h, w, 3)
            if background is not None and not self._signed[i]:
                image = torch.addcmul(image, 1 - alphas[i, : camera.height, : camera.width], background)
            rendered.append(image.permute(2, 0, 1))
        return rendered

    def _rows(self, index: int) -> slice:
        return slice(self._starts[index], self._starts[index + 1])

    def _project(self, cameras: Sequence[Camera], viewmats: Tensor, intrinsics: Tensor) -> list[Tensor]:
        """Return radii (n, 2), centres (n, 2), depths (n,), conics (n, 3) and opacities (n,) of the first fields."""
        from gsplat import fully_fused_projection

        fields = []
        for i, camera in enumerate(cameras):
            rows = self._rows(i)
            if rows.start == rows.stop:
                continue  # gsplat divides by their number
            *projected, dimmed = fully_fused_projection(
                self._means[rows],
                None,
                self._quaternions[rows],
                self._scales[rows],
                viewmats[i : i + 1],
                intrinsics[i : i + 1],
                camera.width,
                camera.height,
                eps2d=PIXEL_VARIANCE,
                near_plane=NEAR_DEPTH,
                calc_compensations=self._antialiased,
                opacities=self._opacities[rows],
            )  # (1, n_i, ...) each
            fields.append([values[0] for values in (*projected, *([dimmed] if self._antialiased else []))])
        joined = [torch.cat(parts) if len(parts) > 1 else parts[0] for parts in zip(*fields, strict=True)]
        opacities = self._opacities[: self._starts[len(cameras)]]
        return [*joined[:4], opacities * joined[4] if self._antialiased else opacities]

    def _colors(self, viewmats: Tensor, positions: Tensor) -> Tensor:
        """Return colours (n, 3) of the first f fields, from poses (f, 4, 4) with the same centres (f, 3)."""
        count = self._starts[len(positions)]
        degree = math.isqrt(self._sh.shape[1]) - 1
        colors = raw_sh_values(degree, self._means[:count], self._sh[:count], viewmats[:1], positions[:1])[0]
        for i in range(len(positions)):
            if not self._signed[i]:
                colors[self._rows(i)].add_(0.5).clamp_min_(0.0)
        return colors

    def _blend(
        self, projected: Sequence[Tensor], colors: Tensor, count: int, size: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """Return colours (f, h, w, 3) and opacities (f, h, w, 1) of `count` images of one size (h, w)."""
        from gsplat import isect_offset_encode, isect_tiles, rasterize_to_pixels

        radii, means2d, depths, conics, opacities = projected
        height, width = size
        columns, rows = -(-width // TILE), -(-height // TILE)
        of_image = self._images[: len(depths)]
        # From 1.6.0 on: leave out tiles that the ellipse alpha = 1/255 does not meet. The image is the same.
        known = inspect.signature(isect_tiles).parameters
        ellipses = {"conics": conics, "opacities": opacities} if "conics" in known else {}
        # gsplat also takes the index of each Gaussian, but does not use it.
        _, keys, order = isect_tiles(
            means2d, radii, depths, TILE, columns, rows,
            packed=True, n_images=count, image_ids=of_image, gaussian_ids=of_image, **ellipses,
        )  # fmt: skip
        offsets = isect_offset_encode(keys, count, columns, rows)  # (f, rows, columns)
        # Without backgrounds: for a packed list gsplat 1.5.3 takes one background, not one per image.
        images, alphas = rasterize_to_pixels(
            means2d, conics, colors, opacities, width, height, TILE, offsets, order, packed=True
        )
        return images, alphas


def _joined(values: Sequence[Tensor], device: torch.device) -> Tensor:
    """Concatenate (n_i, ...) of several fields to (n, ...) on `device`; missing SH coefficients are zeros."""
    shape = [max(value.shape[axis] for value in values) for axis in range(1, values[0].ndim)]
    joined = torch.zeros(sum(len(value) for value in values), *shape, device=device)
    start = 0
    for value in values:
        # One by one into one tensor: torch.cat of copies on the device would take twice the memory.
        joined[(slice(start, start + len(value)), *map(slice, value.shape[1:]))] = value.detach()
        start += len(value)
    return joined
