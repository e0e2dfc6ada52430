"""Describe pinhole cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """Describe a pinhole camera without distortion, in OpenCV/COLMAP axes (x right, y down, z forward).

    Pixel (i, j) covers [j, j+1) x [i, i+1) of the image plane, so its centre is at (j + 0.5, i + 0.5) and a centred
    principal point is (width / 2, height / 2), as in COLMAP.

    Attributes:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels.
        world_to_camera: (4, 4) rigid transform, world to camera coordinates, float32 or float64.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: Tensor  # (4, 4)

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

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera with exactly the same field of view at another image size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Camera:
        """Return the camera with its pose on another device or in another precision."""
        return replace(self, world_to_camera=self.world_to_camera.to(device=device, dtype=dtype))
