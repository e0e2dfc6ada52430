"""Read COLMAP's binary files (https://colmap.github.io/format.html) by their counts, which damage makes absurd.

pycolmap trusts these counts: in a truncated file it reads uninitialised memory, or allocates and loops for minutes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pycolmap

from lapgs_plugin.errors import SceneError
from lapgs_plugin.files import refuse_lfs_pointer
from lapgs_plugin.scenes.colmap_records import LARGEST_ID, NO_FEATURES, OTHER_LENS, Points, PosedImage, file_name
from lapgs_plugin.untrusted import require_regular

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT_BYTES = 8 + 3 * 8 + 3 + 8  # id, position, colour, error
_OBSERVATION_BYTES = 2 * 8 + 8
_TRACK_BYTES = 4 + 4


KINDS = frozenset(int(kind) for name, kind in pycolmap.CameraModelId.__members__.items() if name != "INVALID")
"""Numbers of COLMAP's camera models."""


class BinaryRecords:
    """Take the bytes of a file one after the other. Bytes after the last record do not matter."""

    def __init__(self, file: Path) -> None:
        try:
            require_regular(file)
            self.data = file.read_bytes()
        except OSError as error:
            raise SceneError(f"{file} cannot be read: {error.strerror}; copy or export the model again") from error
        self.at = 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Return the next values; raise struct.error at the end of the file."""
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def take_count(self) -> int:
        return int(self.take(_COUNT)[0])

    def skip(self, size: int) -> int:
        """Return the offset before `size` bytes; raise struct.error where the file ends before them."""
        start, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise struct.error
        return start


def read_cameras(file: Path) -> dict[int, pycolmap.Camera]:
    """Return the cameras of cameras.bin by id.

    Raises:
        SceneError: the file is damaged, holds an id twice or a camera model that is none of COLMAP's.
    """
    cameras: dict[int, pycolmap.Camera] = {}
    with _whole(file) as records:
        for _ in range(records.take_count()):
            key, kind, width, height = records.take(_CAMERA)
            if kind not in KINDS:
                _refuse_kind(file, key, kind)
            camera = pycolmap.Camera.create_from_model_id(key, pycolmap.CameraModelId(kind), 1.0, 1, 1)
            camera.width, camera.height = width, height
            camera.params = list(records.take(struct.Struct(f"<{len(camera.params)}d")))
            _check_id(file, key, cameras)
            cameras[key] = camera
    return cameras


def read_images(file: Path, observations: bool = False) -> dict[int, PosedImage]:
    """Return the images of images.bin by id, with their features if `observations`.

    Raises:
        SceneError: the file is damaged, holds an id twice or a name that is no UTF-8.
    """
    images: dict[int, PosedImage] = {}
    with _whole(file) as records:
        for _ in range(records.take_count()):
            key, *numbers, camera = records.take(_IMAGE)
            name = records.data[records.at : records.data.index(b"\0", records.at)]
            records.skip(len(name) + 1)
            count = records.take_count()
            start = records.skip(count * _OBSERVATION_BYTES)
            _check_id(file, key, images)
            features = NO_FEATURES
            if observations:
                rows = np.frombuffer(records.data, "<f8", count * 3, start).reshape(count, 3)
                features = rows[:, :2].copy()  # the third has the bytes of an integer, the point's id
            images[key] = PosedImage(_decoded(file, key, name), camera, np.array(numbers), features)
    return images


def read_points(file: Path, observations: bool = False) -> Points:
    """Return the points of points3D.bin, with their tracks if `observations`.

    Raises:
        SceneError: the file is damaged.
    """
    starts, tracks = [], []
    with _whole(file) as records:
        for _ in range(records.take_count()):
            starts.append(records.skip(_POINT_BYTES))
            length = records.take_count()
            track = records.skip(length * _TRACK_BYTES)
            if observations:
                tracks.append(np.frombuffer(records.data, "<u4", 2 * length, track).reshape(-1, 2).astype(np.int64))
    rows = np.frombuffer(records.data, np.uint8)[np.array(starts, np.int64)[:, None] + np.arange(8, _POINT_BYTES)]
    xyz, errors = (np.ascontiguousarray(part).view("<f8").astype(np.float64) for part in (rows[:, :24], rows[:, 27:]))
    return Points(xyz, rows[:, 24:27].astype(np.float64), errors.ravel().tolist() if observations else (), tracks)


def count_images(file: Path) -> int:
    """Return how many images images.bin counts; 0 if it is too short for them."""
    with file.open("rb") as stream:
        count = int.from_bytes(stream.read(_COUNT.size), "little")
    return count if count * _IMAGE.size <= file.stat().st_size else 0


@contextmanager
def _whole(file: Path) -> Iterator[BinaryRecords]:
    records = BinaryRecords(file)
    try:
        yield records
    except SceneError:
        raise
    except (struct.error, ValueError) as error:  # the data ends inside a record or a name
        refuse_lfs_pointer(file, SceneError)
        raise SceneError(
            f"{file}: the file is damaged or cut short at {len(records.data)} bytes, expected all records that its "
            "header counts; copy it again"
        ) from error


def _refuse_kind(file: Path, key: int, kind: int) -> NoReturn:
    refuse_lfs_pointer(file, SceneError)
    raise SceneError(
        f"{file}: camera {key} has the camera model of number {kind}, expected one of COLMAP's from {min(KINDS)} to "
        f"{max(KINDS)}; copy the file again if it is damaged, else {OTHER_LENS}"
    )


def _check_id(file: Path, key: int, known: dict[int, Any]) -> None:
    if key in known or key > LARGEST_ID:
        problem = f"id {key} twice, expected each once" if key in known else f"id {key}, expected at most {LARGEST_ID}"
        raise SceneError(f"{file}: {file.name} holds {problem}; copy or export the model again")


def _decoded(file: Path, key: int, name: bytes) -> str:
    try:
        return file_name(name.decode())
    except UnicodeDecodeError as error:
        raise SceneError(
            f"{file}: the name of image {key} is {name!r}, expected UTF-8; rename it and reconstruct again"
        ) from error
