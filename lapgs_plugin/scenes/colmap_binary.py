"""Check that COLMAP's binary files are complete, before pycolmap reads them.

pycolmap trusts the counts in these files. In a truncated file it reads uninitialised memory, or allocates and loops for
minutes. The layout is that of https://colmap.github.io/format.html, and for rigs and frames that of COLMAP's
reconstruction_io_binary.cc.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pycolmap

from lapgs_plugin.errors import SceneError

COUNT = struct.Struct("<Q")
SMALL_COUNT = struct.Struct("<I")
POSE_BYTES = 7 * 8  # quaternion and translation
SENSOR_BYTES = 4 + 4  # type and id


def check_whole(folder: Path) -> None:
    """Check the binary files of the model in `folder`.

    Raises:
        SceneError: a file ends before its last record.
    """
    for name, record_end in RECORD_ENDS.items():
        file = folder / f"{name}.bin"
        if not file.is_file():
            continue  # COLMAP before 3.12 writes no rigs and frames
        data = file.read_bytes()
        if not _holds_all(data, record_end):
            raise SceneError(
                f"{file}: the file is damaged or cut short at {len(data)} bytes, expected all records that its header "
                "counts; copy it again"
            )


def _holds_all(data: bytes, record_end: Callable[[bytes, int], int]) -> bool:
    """Return whether the data holds as many records as it counts."""
    try:
        offset = COUNT.size
        for _ in range(COUNT.unpack_from(data)[0]):
            offset = record_end(data, offset)
            if offset > len(data):
                return False
    except (struct.error, ValueError):  # the data ends inside a count or a name, or a camera model does not exist
        return False
    return True


def disagreement(folder: Path) -> str | None:
    """Return which ids in complete binary files contradict each other, or None."""
    cameras, images, points = (_records(folder / f"{name}.bin") for name in ("cameras", "images", "points3D"))
    files = {"cameras": (cameras, "<I"), "images": (images, "<I"), "points3D": (points, "<Q")}
    ids: dict[str, set[int]] = {}
    for name, ((data, starts), kind) in files.items():
        found = ids.setdefault(name, set())
        for start in starts:
            (key,) = struct.unpack_from(kind, data, start)
            if key in found:
                return f"{name}.bin holds id {key} twice, expected each once"
            found.add(key)
    data, starts = images
    for start in starts:
        image, camera = (int(struct.unpack_from("<I", data, start + at)[0]) for at in (0, 4 + POSE_BYTES))
        if camera not in ids["cameras"]:
            return f"image {image} of images.bin has camera {camera}, expected one of cameras.bin"
    return None


def _records(file: Path) -> tuple[bytes, list[int]]:
    """Return the bytes of a complete file and the offsets of its records."""
    data = file.read_bytes()
    starts = [COUNT.size]
    for _ in range(COUNT.unpack_from(data)[0]):
        starts.append(RECORD_ENDS[file.stem](data, starts[-1]))
    return data, starts[:-1]


def _camera_end(data: bytes, start: int) -> int:
    (model,) = struct.unpack_from("<i", data, start + 4)
    camera = pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId(model), 1.0, 1, 1)
    return start + 4 + 4 + 8 + 8 + 8 * len(camera.params)


def _image_end(data: bytes, start: int) -> int:
    name_end = data.index(b"\0", start + 4 + POSE_BYTES + 4) + 1
    return name_end + COUNT.size + (8 + 8 + 8) * int(COUNT.unpack_from(data, name_end)[0])


def _point_end(data: bytes, start: int) -> int:
    track = start + 8 + 3 * 8 + 3 + 8
    return track + COUNT.size + (4 + 4) * int(COUNT.unpack_from(data, track)[0])


def _rig_end(data: bytes, start: int) -> int:
    (sensors,) = SMALL_COUNT.unpack_from(data, start + 4)
    end = start + 4 + SMALL_COUNT.size + (SENSOR_BYTES if sensors else 0)  # the reference sensor has no pose
    for _ in range(sensors - 1):
        (has_pose,) = struct.unpack_from("<?", data, end + SENSOR_BYTES)
        end += SENSOR_BYTES + 1 + (POSE_BYTES if has_pose else 0)
    return end


def _frame_end(data: bytes, start: int) -> int:
    images = start + 4 + 4 + POSE_BYTES
    return images + SMALL_COUNT.size + (SENSOR_BYTES + 8) * int(SMALL_COUNT.unpack_from(data, images)[0])


RECORD_ENDS: dict[str, Callable[[bytes, int], int]] = {
    "cameras": _camera_end,
    "images": _image_end,
    "points3D": _point_end,
    "rigs": _rig_end,
    "frames": _frame_end,
}
"""For each file, the end of the record that starts at an offset."""
