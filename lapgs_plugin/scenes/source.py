"""What a scene folder says before any pixel is read: posed frames and points, the same for every layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.camera import Camera

HOLD_OUT_EVERY = 8
"""With evaluation every eighth view in name order is held out, starting with the first, as in 3DGS."""

UNDISTORT_HINT = "only pinhole images can be trained on, `lapgs prepare PHOTOS OUT` makes such a scene from photos"


@dataclass(frozen=True)
class Frame:
    """One posed image file.

    Attributes:
        name: unique name, relative to the folder the layout counts from, with forward slashes.
        path: the image file; not yet known to exist.
        camera: float64 pose; its size is the model's, which the file's may be a multiple of.
    """

    name: str
    path: Path
    camera: Camera


@dataclass(frozen=True)
class SceneSource:
    """A scene's frames and points.

    Attributes:
        kind: name of the layout.
        train, test: in name order.
        points: (n, 3) float64 positions in world units.
        colors: (n, 3) float64 RGB in [0, 1].
    """

    kind: str
    train: tuple[Frame, ...]
    test: tuple[Frame, ...]
    points: NDArray[np.float64]  # (n, 3)
    colors: NDArray[np.float64]  # (n, 3)


def is_file(path: Path) -> bool:
    """Whether a file is there; False too for names that the file system cannot have, of more than 255 bytes."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def in_name_order(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    return tuple(sorted(frames, key=lambda frame: frame.name))


def hold_out(frames: Sequence[Frame], evaluate: bool) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    """Training and held-out frames in name order; nothing is held out unless `evaluate`."""
    ordered = in_name_order(frames)
    if not evaluate:
        return ordered, ()
    train = tuple(frame for index, frame in enumerate(ordered) if index % HOLD_OUT_EVERY != 0)
    return train, ordered[::HOLD_OUT_EVERY]
