"""A scene small enough to train in a test: a textured blob field seen from a ring of cameras, in memory."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.scenes.scene import Scene, View

WIDTH, HEIGHT = 56, 40


def ring_camera(angle: float, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    """A camera 4 units from the origin, looking at it."""
    position = torch.tensor([4 * math.sin(angle), -1.0, -4 * math.cos(angle)])
    forward = -position / position.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), forward)
    right = right / right.norm()
    down = torch.linalg.cross(forward, right)
    pose = torch.eye(4)
    pose[:3, :3] = torch.stack([right, down, forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera(width, height, width * 0.9, width * 0.9, width / 2, height / 2, pose)


def blob_field(count: int = 300, seed: int = 0) -> GaussianField:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    return GaussianField(
        means=0.7 * normal(count, 3),
        quaternions=normal(count, 4),
        log_scales=-2.2 + 0.4 * normal(count, 3),
        opacity_logits=1.0 + normal(count),
        sh=normal(count, 1, 3),
    )


def ring_scene(train: int = 6, test: int = 2, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Scene:
    field = blob_field()
    count = train + test
    views = []
    for i in range(count):
        camera = ring_camera(2 * math.pi * i / count, *size)
        with torch.no_grad():
            image = CpuRasterizer()(field, camera, background=torch.zeros(3)).image
        views.append(View(f"view_{i}.png", camera, image.clamp(0, 1)))
    held_out = views[:: count // test][:test] if test else []
    return Scene(
        path=Path("ring"),
        kind="colmap",
        train=tuple(view for view in views if view not in held_out),
        test=tuple(held_out),
        points=field.means[::3],
        colors=torch.full((100, 3), 0.5),
        extent=4.4,
        background=(0.0, 0.0, 0.0),
    )
