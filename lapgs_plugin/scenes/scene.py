"""Scenes: posed views with their images in memory, and the sparse points training starts from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from lapgs_plugin.camera import Camera


@dataclass(frozen=True)
class View:
    """One photo and the camera that took it.

    Attributes:
        name: the image's name in the scene, relative to its image folder, such as "0001.jpg".
        camera: size, intrinsics and pose; float32. Its size is the image's.
        image: (3, h, w) float32 RGB, in [0, 1] unless the file holds wider values (EXR), on the CPU.
    """

    name: str
    camera: Camera
    image: Tensor  # (3, h, w)


@dataclass(frozen=True)
class Scene:
    """Everything training reads from a scene folder.

    Attributes:
        path: the scene folder.
        kind: "colmap" or "transforms".
        train: views to train on, in name order.
        test: views held out, in name order; empty unless asked for.
        points: (n, 3) float32 positions of the sparse points, in world units, n at least 1.
        colors: (n, 3) float32 RGB of the points, in [0, 1].
        extent: size of the scene in world units as 3DGS measures it: 1.1 times the largest distance of a training
            camera's centre from the mean of all of them.
        background: RGB in [0, 1] that transparent pixels were blended over.
    """

    path: Path
    kind: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: Tensor  # (n, 3)
    colors: Tensor  # (n, 3)
    extent: float
    background: tuple[float, float, float]

    @property
    def smallest_size(self) -> tuple[int, int]:
        """Smallest width and smallest height over all views, in pixels: what a plan must fit into."""
        cameras = [view.camera for view in (*self.train, *self.test)]
        return min(camera.width for camera in cameras), min(camera.height for camera in cameras)
