"""Check that COLMAP's binary files are complete, before pycolmap reads them.

pycolmap trusts the counts in these files. In a truncated file it reads uninitialised memory, or allocates and loops for
minutes. The layout is that of https://colmap.github.io/format.html, and for rigs and frames that of COLMAP's
reconstruction_io_binary.cc.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import pycolmap

from lapgs_plugin.errors import SceneError
from lapgs_plugin.files import refuse_lfs_pointer

COUNT = struct.Struct("<Q")
SMALL_COUNT = struct.Struct("<I")
POSE_BYTES = 7 * 8  # quaternion and translation
SENSOR_BYTES = 4 + 4  # type and id


def check_whole(folder: Path) -> None:
    """Check the binary files of the model in `folder`.

    Raises:
        SceneError: a file ends before its last record, or is a pointer of Git LFS.
    """
    for name in RECORD_ENDS:
        file = folder / f"{name}.bin"
        if not file.is_file():
            continue  # COLMAP before 3.12 writes no rigs and frames
        data = file.read_bytes()
        try:
            for _ in _starts(name, data):
                pass
        # The data ends inside a record, a count or a name, or a camera model does not exist.
        except (struct.error, ValueError) as error:
            refuse_lfs_pointer(file, SceneError)
            raise SceneError(
                f"{file}: the file is damaged or cut short at {len(data)} bytes, expected all records that its header "
                "counts; copy it again"
            ) from error


def disagreement(folder: Path) -> str | None:
    """Return which ids in complete binary files contradict each other, or None."""
    data = {name: (folder / f"{name}.bin").read_bytes() for name in ("cameras", "images", "points3D")}
    ids: dict[str, set[int]] = {}
    for name, kind in (("cameras", "<I"), ("images", "<I"), ("points3D", "<Q")):
        found = ids.setdefault(name, set())
        for start in _starts(name, data[name]):
            (key,) = struct.unpack_from(kind, data[name], start)
            if key in found:
                return f"{name}.bin holds id {key} twice, expected each once"
            found.add(key)
    for start in _starts("images", data["images"]):
        image, camera = (int(struct.unpack_from("<I", data["images"], start + at)[0]) for at in (0, 4 + POSE_BYTES))
        if camera not in ids["cameras"]:
            return f"image {image} of images.bin has camera {camera}, expected one of cameras.bin"
    return None


def _starts(name: str, data: bytes) -> Iterator[int]:
    """Yield the offset of each record that the file's header counts.

    Raises:
        ValueError, struct.error: the data ends before.
    """
    end = COUNT.size
    for _ in range(COUNT.unpack_from(data)[0]):
        start, end = end, RECORD_ENDS[name](data, end)
        if end > len(data):
            raise ValueError(f"a record ends at {end}")
        yield start


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
