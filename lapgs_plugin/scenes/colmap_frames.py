"""Read COLMAP's rigs and frames, which hold the poses of images again, to find out whether they are outdated.

COLMAP writes them since version 3.12, and prefers their poses to those of the images' file. Codebases of 3DGS, and
scripts that edit models, know the latter alone. The layout is that of COLMAP's reconstruction_io_binary.cc, and the
values of its text files follow each other in the same order.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pycolmap

from lapgs_plugin.scenes.colmap_binary import BinaryRecords
from lapgs_plugin.scenes.colmap_records import rigid
from lapgs_plugin.untrusted import require_regular

Take = Callable[[str], float]
"""Return the next value of a file; the argument is its format for `struct` in a binary file."""

SENSORS = {"CAMERA": 0, "IMU": 1, "INVALID": -1}
"""Types of sensors in text files. Only cameras have images."""


def frame_poses(folder: Path, suffix: str) -> dict[int, pycolmap.Rigid3d]:
    """Return the poses of images, world to camera, by id.

    Raises:
        ValueError, LookupError, ArithmeticError, OSError, struct.error: a file is damaged or missing.
    """
    rigs, frames = (folder / f"{name}.{suffix}" for name in ("rigs", "frames"))
    sensors: dict[tuple[float, ...], pycolmap.Rigid3d] = {}  # by rig, type and id
    poses: dict[int, pycolmap.Rigid3d] = {}
    for take in _records(rigs):
        rig, count = take("I"), take("I")
        for number in range(int(count)):
            sensor = (rig, take("i"), take("I"))
            if number == 0:  # the reference has no pose
                sensors[sensor] = pycolmap.Rigid3d()
            elif take("?"):
                sensors[sensor] = _pose(take)
    for take in _records(frames):
        _, rig, pose = take("I"), take("I"), _pose(take)
        for _ in range(int(take("I"))):
            sensor, data = (rig, take("i"), take("I")), int(take("Q"))
            if sensor[1] == SENSORS["CAMERA"] and sensor in sensors:
                poses[data] = sensors[sensor] * pose
    return poses


def _records(file: Path) -> Iterator[Take]:
    """Yield for each record of a file a function that takes its values."""
    if file.suffix == ".bin":
        records = BinaryRecords(file)
        for _ in range(records.take_count()):
            yield lambda kind: float(records.take(struct.Struct(f"<{kind}"))[0])
    else:
        require_regular(file)
        for line in file.read_text("utf-8-sig").splitlines():
            if words := line.partition("#")[0].split():
                values = [float(SENSORS.get(word, word)) for word in words][::-1]
                yield lambda _, values=values: values.pop()  # type: ignore[misc]  # one argument


def _pose(take: Take) -> pycolmap.Rigid3d:
    return rigid(np.array([take("d") for _ in range(7)]))
