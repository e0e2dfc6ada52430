"""Hold the cameras and points of a scene folder of any layout, before images are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError
from lapgs_plugin.fields.camera import Camera

HOLD_OUT_EVERY = 8
"""Step in name order from each view that --eval holds out to the next, from the first view on, as in 3DGS."""

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Camera models that are pinhole cameras if their distortion parameters are zero; fisheye models never are."""

ALL_AROUND = "EQUIRECTANGULAR"
"""COLMAP's camera model of panoramas, which see all around."""

LARGEST = 1e12
"""Largest coordinate in world units. Training in float32 multiplies squares of coordinates."""

LONGEST_SIDE = 1 << 31
"""Longest side of a camera's image in pixels, before it is compared with the image file."""

SHORTEST_FOCAL = 0.02
"""Shortest focal length as a share of the image's side. A shorter one was not written in pixels."""

LONGEST_FOCAL = 1e6
"""Longest focal length in sides of the image, longer than that of any telescope."""


@dataclass(frozen=True)
class Frame:
    """A posed image file.

    Attributes:
        name: unique name, relative to the image or scene folder, with forward slashes.
        path: the image file, which may not exist.
        camera: float64 pose; its size is the model's, of which the file's may be a multiple.
    """

    name: str
    path: Path
    camera: Camera


@dataclass(frozen=True)
class SceneSource:
    """The frames and points of a scene.

    Attributes:
        kind: layout, "colmap", "transforms" or the program that exported it.
        train, test: in name order.
        points: (n, 3) float64 positions in world units.
        colors: (n, 3) float64 RGB in [0, 1].
        warnings: lines for the user who trains on the scene.
    """

    kind: str
    train: tuple[Frame, ...]
    test: tuple[Frame, ...]
    points: NDArray[np.float64]  # (n, 3)
    colors: NDArray[np.float64]  # (n, 3)
    warnings: tuple[str, ...] = ()


def undistort_hint(scene: Path, model: str) -> str:
    """Return advice about a scene's distorted cameras of this camera model."""
    if model == ALL_AROUND:
        return f"it sees all around; cut its photos into pinhole images with `lapgs prepare {quote(str(scene))} OUT`"
    return (
        f"undistort its photos with `lapgs prepare {quote(str(scene))} OUT`, or train on them as they are, which is "
        "slower, with --distorted of `lapgs train`"
    )


def check_camera(subject: str, camera: Camera) -> None:
    """Refuse a camera that cannot be trained on or rendered from.

    Args:
        subject: of messages: the file and its camera.
        camera: the camera, in float64.

    Raises:
        SceneError: the camera has NaN, inf, numbers too large for float32, or a size or focal length out of range.
    """
    numbers = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    pose, size = camera.world_to_camera.numpy(), camera.size
    furthest, lens = np.abs(pose).max(), f"focal lengths {camera.fx:g} and {camera.fy:g}"
    for wrong, problem in (
        (not (np.isfinite(numbers).all() and np.isfinite(pose).all()), "NaN or inf"),
        (furthest > LARGEST, f"{furthest:g} in its pose, expected at most {LARGEST:g}"),
        (min(camera.fx, camera.fy, *size) <= 0, f"{size[0]}x{size[1]} pixels and {lens}, expected positive numbers"),
        (max(size) > LONGEST_SIDE, f"an image {max(size):.3g} pixels wide or high, expected at most {LONGEST_SIDE}"),
        (
            camera.fx < SHORTEST_FOCAL * size[0] or camera.fy < SHORTEST_FOCAL * size[1],
            f"{lens} for {size[0]}x{size[1]}, expected pixels, at least {SHORTEST_FOCAL:g} sides of the image",
        ),
        (
            (np.abs(numbers) > LONGEST_FOCAL * np.array([*size, *size])).any(),
            f"{lens} and a principal point ({camera.cx:g}, {camera.cy:g}), expected at most {LONGEST_FOCAL:g} sides of "
            "the image",
        ),
    ):
        if wrong:
            raise SceneError(f"{subject} has {problem}; reconstruct or export it again")


def in_name_order(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """Return the frames sorted by name."""
    return tuple(sorted(frames, key=lambda frame: frame.name))


def hold_out(frames: Sequence[Frame], evaluate: bool) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    """Return training and held-out frames in name order: every eighth, or none unless `evaluate`."""
    ordered = in_name_order(frames)
    if not evaluate:
        return ordered, ()
    return tuple(f for i, f in enumerate(ordered) if i % HOLD_OUT_EVERY), ordered[::HOLD_OUT_EVERY]
