"""Describe cameras: pinholes, and those whose lens bends rays."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from lapgs_plugin.fields.lens import Lens

ANYWHERE = torch.eye(4)
"""A pose for what does not depend on one."""
PIXELS_OF_A_STRIP = 1 << 15
"""Pixels whose rays are sought together: few enough for a processor's cache."""


@dataclass(frozen=True)
class Camera:
    """Describe a camera in OpenCV/COLMAP axes (x right, y down, z forward).

    Pixel (i, j) covers [j, j+1) x [i, i+1) of the image plane, so its centre is at (j + 0.5, i + 0.5) and a centred
    principal point is (width / 2, height / 2), as in COLMAP.

    Attributes:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels.
        world_to_camera: (4, 4) rigid transform, world to camera coordinates, float32 or float64.
        lens: bends rays; None for a pinhole. Only rasterizers that evaluate Gaussians along rays take it into account.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Tensor  # (4, 4)
    lens: Lens | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.width, self.height

    @property
    def tan_half_fov(self) -> tuple[float, float]:
        """Half the width and half the height of the image plane at depth 1."""
        return self.width / (2.0 * self.fx), self.height / (2.0 * self.fy)

    @property
    def position(self) -> Tensor:
        """Camera centre in world coordinates, (3,)."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    @property
    def intrinsics(self) -> Tensor:
        """The (3, 3) matrix K, with the pose's type and device."""
        return self.world_to_camera.new_tensor([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def local(self, points: Tensor) -> Tensor:
        """Return points (n, 3) of the world in the camera's axes, with their type and device; the last is the depth."""
        pose = self.world_to_camera.to(points, non_blocking=points.is_cuda)  # in a step, which must not wait
        return points @ pose[:3, :3].T + pose[:3, 3]

    def projected(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return where points (..., 3) in the camera's axes are shown, also beside the image.

        Returns:
            Pixels (..., 2), and whether they have any meaning (...): points behind the camera have none.
        """
        if self.lens is None:
            x, y, depths = points.unbind(-1)
            return torch.stack([self.fx * x / depths + self.cx, self.fy * y / depths + self.cy], -1), depths > 0
        plane, valid = self.lens.bent(points, self._furthest)
        return plane * plane.new_tensor([self.fx, self.fy]) + plane.new_tensor([self.cx, self.cy]), valid

    def shown(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return pixels as `projected`, and which of them are on the image."""
        pixels, valid = self.projected(points)
        return pixels, valid & ((pixels > 0) & (pixels < pixels.new_tensor(self.size))).all(-1)

    def rays(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return the directions (n, 3) at points of the image (n, 2) in float64, in the camera's axes and of length 1.

        Returns:
            The directions, and which points have one (n,): a lens shows nothing to the others.
        """
        plane = (pixels - pixels.new_tensor([self.cx, self.cy])) / pixels.new_tensor([self.fx, self.fy])
        return (self.lens or Lens()).rays(plane, self._furthest)

    def pixel_rays(self) -> tuple[Tensor, Tensor]:
        """Return the directions (h, w, 3) at the pixels' centres, float64, and which have one; see `rays`."""
        return _pixel_rays(replace(self, world_to_camera=ANYWHERE))

    def lit_pixels(self) -> Tensor:
        """Return the pixels (h, w) that have a ray; the rays are not kept, which take 24 times as much memory."""
        return _lit_pixels(replace(self, world_to_camera=ANYWHERE))

    @property
    def _furthest(self) -> float:
        """Largest distance of a corner of the image from the axis, at depth 1, as if a longer side had both."""
        across, down = max(self.width - self.cx, self.cx), max(self.height - self.cy, self.cy)
        return math.hypot(across, down) / min(self.fx, self.fy)

    def straight(self) -> Camera:
        """Return the pinhole camera of the same numbers."""
        return replace(self, lens=None)

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera with exactly the same field of view at another image size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Camera:
        """Return the camera with its pose on another device or in another precision."""
        return replace(self, world_to_camera=self.world_to_camera.to(device=device, dtype=dtype))


@lru_cache(maxsize=4)
@torch.inference_mode(False)  # kept for later calls
def _pixel_rays(camera: Camera) -> tuple[Tensor, Tensor]:
    """Return `Camera.pixel_rays`; cameras with the same lens are equal once all have the pose `ANYWHERE`."""
    rays, seen = zip(*_rays_of_strips(camera), strict=True)
    return torch.cat(rays), torch.cat(seen)


@lru_cache(maxsize=4)
@torch.inference_mode(False)
def _lit_pixels(camera: Camera) -> Tensor:
    """Return `Camera.lit_pixels`; see `_pixel_rays`."""
    return torch.cat([seen for _, seen in _rays_of_strips(camera)])


def _rays_of_strips(camera: Camera) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the rays (rows, w, 3) of some rows at a time, and which pixels have one (rows, w)."""
    columns, rows = (torch.arange(side, dtype=torch.float64) + 0.5 for side in camera.size)
    for strip in torch.split(rows, max(1, PIXELS_OF_A_STRIP // camera.width)):
        pixels = torch.stack(torch.meshgrid(columns, strip, indexing="xy"), -1)  # (rows, w, 2)
        rays, seen = camera.rays(pixels.view(-1, 2))
        yield rays.view(*pixels.shape[:2], 3), seen.view(pixels.shape[:2])
