"""Panoramas of our own renders: six faces of a cube, stitched by spherical coordinates in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.scenes.sample.raycast import render
from lapgs_plugin.scenes.sample.solids import ball, box, rod
from lapgs_plugin.scenes.sample.world import PALETTE

Array = NDArray[np.float64]
Renderer = Callable[[Camera], Array]
"""Returns the image of a camera, (h, w, 3)."""

CUBE = {
    "front": np.eye(3),
    "right": np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "back": np.array([[-1, 0, 0], [0, 1, 0], [0, 0, -1]]),
    "left": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "top": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "bottom": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
}
"""Rotations from a panorama's axes to those of a face, whose third row looks along."""
BORDER = 0.02
"""Share of a cube's face beyond 90 degrees, so that neighbours need not be looked up."""
FINER = 3
"""Samples a pixel along both axes."""

COLORS = np.random.default_rng(0).integers(PALETTE.shape[1], size=1 << 16).astype(np.uint8)


def speckled(points: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Paint cubes of 40 cm in random colours, so that no place looks like another."""
    x, y, z = np.floor(points / 0.4 + 0.5).astype(np.int64)
    colors: NDArray[np.uint8] = COLORS[(x * 73856093 ^ y * 19349663 ^ z * 83492791) % len(COLORS)]
    return colors


ROOM = (
    rod((0, 0, -0.2), (0, 0, 3.4), 3.2, speckled, room=True),
    box((1.7, 1.5, 0.4), (0.9, 0.9, 1.0), speckled, 0.4),
    rod((-1.8, 0.9, 0), (-1.8, 0.9, 1.5), 0.35, speckled),
    ball((-1.2, -1.6, 1.2), 0.5, speckled),
)
"""A room with things in it; its middle is free."""


def walk(count: int) -> list[Array]:
    """Return poses (4, 4), world to camera, of a walk through the room; the camera is held nearly upright."""
    poses = []
    for index in range(count):
        share = index / max(count - 1, 1)
        place = np.array([1.4 * share - 0.7, 0.5 * math.sin(5.0 * share), 1.4 + 0.2 * math.cos(7.0 * share)])
        level = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # looks along y
        tilt = Rotation.from_rotvec([0.05 * math.sin(index), 0.6 * share, 0.04 * math.cos(index)]).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = tilt @ level
        pose[:3, 3] = -pose[:3, :3] @ place
        poses.append(pose)
    return poses


def room_view(camera: Camera) -> Array:
    """Render the room."""
    return render(ROOM, camera).astype(np.float64)


def pinhole(pose: Array, turn: Array, size: tuple[int, int], focal: float) -> Camera:
    """Return a camera turned (3, 3) against a pose (4, 4), with its principal point in the middle."""
    turned = np.eye(4)
    turned[:3, :3] = turn
    return Camera(*size, focal, focal, size[0] / 2, size[1] / 2, torch.from_numpy(turned @ pose))


def panorama(view: Renderer, pose: Array, width: int) -> Array:
    """Return the equirectangular image of a pose, (width / 2, width, 3): cube faces seen through its pixels."""
    side = 2 * round(FINER * width / (2 * math.pi))
    focal = side / 2 / (1 + 2 * BORDER)
    faces = {name: view(pinhole(pose, turn, (side, side), focal)) for name, turn in CUBE.items()}
    fine = FINER * width
    longitude = ((np.arange(fine) + 0.5) / fine - 0.5) * 2 * math.pi
    latitude = (0.5 - (np.arange(fine // 2) + 0.5) / (fine // 2)) * math.pi
    x = np.cos(latitude)[:, None] * np.sin(longitude)
    y = np.repeat(-np.sin(latitude)[:, None], fine, 1)
    z = np.cos(latitude)[:, None] * np.cos(longitude)
    rays = np.stack([x, y, z], -1)  # (h, w, 3)
    looks = np.stack([turn[2] for turn in CUBE.values()])
    nearest = (rays @ looks.T).argmax(-1)
    image = np.empty((*rays.shape[:2], 3))
    for index, (name, turn) in enumerate(CUBE.items()):
        here = nearest == index
        local = rays[here] @ turn.T
        columns, rows = (local[:, :2] / local[:, 2:] * focal + side / 2 - 0.5).T
        for channel in range(3):
            image[here, channel] = map_coordinates(faces[name][..., channel], [rows, columns], order=1, mode="nearest")
    mean: Array = image.reshape(width // 2, FINER, width, FINER, 3).mean((1, 3))
    return mean


def save(path: Path, image: Array) -> None:
    """Write an image (h, w, 3), or a mask (h, w)."""
    shown = np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image
    write_image(path, torch.from_numpy(np.ascontiguousarray(shown, np.float32)).permute(2, 0, 1))


def psnr(one: Array, other: Array) -> float:
    """Return the PSNR of images in [0, 1]."""
    return float(-10 * np.log10(((one - other) ** 2).mean()))


def cloud(count: int = 600) -> GaussianField:
    """Return a field of round Gaussians, small against their distances, all around the middle of the room."""
    generator = torch.Generator().manual_seed(3)
    directions = torch.randn((count, 3), generator=generator)
    distances = 2.5 + torch.rand((count, 1), generator=generator)
    middle = torch.tensor([0.0, 0.0, 1.4])
    return GaussianField(
        means=middle + distances * torch.nn.functional.normalize(directions, dim=1),
        quaternions=torch.nn.functional.normalize(torch.randn((count, 4), generator=generator), dim=1),
        log_scales=torch.full((count, 3), math.log(0.11)),
        opacity_logits=torch.full((count,), 2.0),
        sh=torch.randn((count, 1, 3), generator=generator),
    )


def cloud_view(camera: Camera) -> Array:
    """Render the field."""
    with torch.no_grad():
        image = CpuRasterizer()(cloud(), camera.to(dtype=torch.float32), background=torch.full((3,), 0.5)).image
    return image.permute(1, 2, 0).clamp(0, 1).double().numpy()
