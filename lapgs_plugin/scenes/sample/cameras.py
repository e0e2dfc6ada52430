"""Place the cameras of the sample scene."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_plugin.fields.camera import Camera

TARGET = (0.0, 0.0, 0.85)
ELEVATIONS = (6.0, 36.0)  # degrees
DISTANCES = (4.2, 5.0)  # metres
SWAY = 0.15  # metres that the target moves either way
FOCAL_RATIO = 1.025  # focal length over the longer side of the image: 52 degrees

STEPS = np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0, 13.0])
"""Steps of azimuth, elevation, distance and target from view to view, in parts of their range, modulo 1.

Multiples of these irrational numbers fill the ranges evenly, both for the first n views and for every eighth view. The
golden ratio does not: eight of its steps are nearly a whole turn, so held-out views would stand side by side."""


def orbit_camera(index: int, size: tuple[int, int], seed: int) -> Camera:
    """Return camera number `index`, from 0. `size` is (width, height) in pixels; `seed` shifts all cameras alike."""
    start = np.random.default_rng([seed, 2]).random(len(STEPS))
    azimuth, elevation, distance, *sway = (start + index * STEPS) % 1.0
    angle = np.radians(np.interp(elevation, (0, 1), ELEVATIONS))
    target = np.array(TARGET) + SWAY * (2 * np.array(sway) - 1)
    outwards = np.array(
        [np.cos(2 * np.pi * azimuth) * np.cos(angle), np.sin(2 * np.pi * azimuth) * np.cos(angle), np.sin(angle)]
    )
    return _looking_at(target + np.interp(distance, (0, 1), DISTANCES) * outwards, target, size)


def _looking_at(centre: NDArray[np.float64], target: NDArray[np.float64], size: tuple[int, int]) -> Camera:
    """Return a camera without roll."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    width, height = size
    focal = FOCAL_RATIO * max(size)
    return Camera(width, height, focal, focal, width / 2, height / 2, torch.from_numpy(pose))
