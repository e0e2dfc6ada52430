"""Render several fields from one camera by our kernels, each at its own size.

Each field is projected for its own image. Then all are sorted and blended together, as if they were images of several
cameras: their Gaussians are in one list, which gsplat calls packed, each with the number of its image.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import FieldStack
from lapgs_plugin.gpu_raster.cameras import DeviceCameras, cameras_on_device
from lapgs_plugin.gpu_raster.records import RECORD, Parameters
from lapgs_plugin.gpu_raster.tiles import blend_in_tiles


class DirectStack(FieldStack):
    """Hold copies of fields on a device.

    Args:
        fields: float32, on any device. Later changes to them have no effect.
        device: that renders.
    """

    def __init__(self, fields: Sequence[GaussianField], device: torch.device) -> None:
        self._device = device
        self._signed = [field.signed for field in fields]
        self._unsigned = torch.tensor([[not signed] for signed in self._signed], device=device).float()  # (f, 1)
        self._starts = [0, *accumulate(len(field) for field in fields)]  # of each field in the list, and the end
        images = torch.arange(len(fields), device=device)
        self._images = torch.repeat_interleave(images, torch.tensor([len(field) for field in fields], device=device))
        parts = [Parameters.of(field.detach()) for field in fields]
        self._fields = [Parameters(*(part.to(device, copy=True) for part in field)) for field in parts]
        if device.type == "cuda":
            torch.cuda.synchronize(device)  # once: from now on every stream may use it

    @torch.no_grad()
    def render(self, cameras: Sequence[Camera], background: Tensor | None) -> list[Tensor]:
        behind = torch.zeros(3, device=self._device) if background is None else background
        behind = self._unsigned[: len(cameras)] * behind
        size = max(camera.width for camera in cameras), max(camera.height for camera in cameras)
        if self._starts[len(cameras)] == 0:
            images = behind[:, None, None].expand(-1, size[1], size[0], -1)
        else:
            images = self._blended(cameras, behind, size)
        return [
            image[: camera.height, : camera.width].permute(2, 0, 1)
            for image, camera in zip(images, cameras, strict=True)
        ]

    def _blended(self, cameras: Sequence[Camera], behind: Tensor, size: tuple[int, int]) -> Tensor:
        """Return images (f, h, w, 3) of the first fields, over backgrounds (f, 3)."""
        from lapgs_plugin.gpu_raster.kernels import project_into

        count, like = self._starts[len(cameras)], behind
        radii = torch.empty(count, 2, dtype=torch.int32, device=self._device)
        stacked = radii, *(like.new_empty(count, *columns) for columns in ((2,), (), (RECORD,)))
        poses, intrinsics, centres = cameras_on_device(cameras, like)
        for i, (camera, field) in enumerate(zip(cameras, self._fields, strict=False)):
            if len(field.means) > 0:
                on_device = DeviceCameras(poses, intrinsics, centres, camera.width, camera.height)
                project_into(stacked, self._starts[i], field, on_device, i, self._signed[i])
        _, (images, *_) = blend_in_tiles(stacked, behind, size, len(cameras), self._images[:count])
        return images
