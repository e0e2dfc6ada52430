"""A scene small enough to train in a test: a textured blob field seen from a ring of cameras, in memory."""

from __future__ import annotations

import math
from dataclasses import replace
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


def panned_scene() -> Scene:
    """A smoothly coloured plane z = 0 before cameras that pass it, so that a place is in the middle and in corners."""
    width, height = 56, 40
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    across = 3 * torch.stack([x - width / 2, y - height / 2], -1) / (0.9 * width)  # (h, w, 2) on the plane
    views = []
    for index in range(20):
        place = torch.tensor([0.6 * (index // 4) + 0.1 * (index % 4) - 1.2, 0.6 * (index % 4) - 0.9])
        pose = torch.eye(4)
        pose[:3, 3] = torch.tensor([*-place, 3.0])
        camera = Camera(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2, pose)
        views.append(View(f"{index:02d}.png", camera, plane_colors(across + place).permute(2, 0, 1).contiguous()))
    points = torch.rand(1200, 2, generator=torch.Generator().manual_seed(1)) * torch.tensor([6.0, 5.0])
    points = points - torch.tensor([3.0, 2.5])
    return replace(
        ring_scene(),
        train=tuple(view for index, view in enumerate(views) if index not in (6, 9, 14)),
        test=tuple(views[index] for index in (6, 9, 14)),
        points=torch.cat([points, torch.zeros(1200, 1)], dim=1),
        colors=plane_colors(points),
    )


def plane_colors(places: Tensor) -> Tensor:
    """Return the colours (..., 3) of places (..., 2) on the plane."""
    return 0.45 + 0.2 * torch.sin(places @ torch.tensor([[3.0, 1.5], [-2.25, 3.0], [1.5, -3.75]]).T)
