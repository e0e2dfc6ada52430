"""Read Record3D's export EXR + RGB: photos in rgb/, depth maps in depth/, and metadata.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from lapgs_plugin.errors import SceneError
from lapgs_plugin.files import is_file, is_folder
from lapgs_plugin.scenes.exports.base import (
    EXPORT_AGAIN,
    OPENGL,
    Export,
    PhotoFinder,
    SceneReader,
    Shot,
    from_world,
    numbers,
    perspective,
    size_of,
    skipped,
)
from lapgs_plugin.scenes.exports.points import MILLIMETRES, depth_points
from lapgs_plugin.scenes.images import is_photo
from lapgs_plugin.untrusted import read_json

FOLDERS = (".", "EXR_RGBD")
METADATA, RGB, DEPTH = "metadata.json", "rgb", "depth"


class Record3D(SceneReader):
    """Read ARKit's cameras of the photos that are there; points are made of the depth maps, if there are any."""

    title = "an export of Record3D (EXR + RGB)"

    def find(self, folder: Path) -> Path | None:
        """Return metadata.json beside a folder of photos."""
        inside = (folder / name for name in FOLDERS)
        return next((one / METADATA for one in inside if is_file(one / METADATA) and is_folder(one / RGB)), None)

    def read(self, source: Path, photos: PhotoFinder) -> Export:
        """Read a pose for each photo; its name is its number."""
        values = read_json(source, error=SceneError, advice=EXPORT_AGAIN)
        poses = values.get("poses") if isinstance(values, dict) else None
        if not isinstance(poses, list) or not poses:
            raise SceneError(f"{source}: no poses in it, expected Record3D's of each photo; {EXPORT_AGAIN}")
        files = [file for file in (source.parent / RGB).iterdir() if is_photo(file) and file.stem.isdecimal()]
        if not files:
            raise SceneError(f"{source.parent / RGB}: no photos such as 0.jpg in it; {EXPORT_AGAIN}")
        shots, maps = [], {}
        for file in sorted(files, key=lambda file: int(file.stem)):
            index = int(file.stem)
            if index >= len(poses):
                raise SceneError(f"{file}: {source.name} has {len(poses)} poses, expected one of it; {EXPORT_AGAIN}")
            where = f"{source}: pose {index}"
            pose = numbers(poses[index], 7, where)  # a quaternion x, y, z, w, and the position
            if abs(np.linalg.norm(pose[:4]) - 1.0) > 1e-2:
                raise SceneError(f"{where} begins with no quaternion of length 1; {EXPORT_AGAIN}")
            turn = Rotation.from_quat(pose[:4]).as_matrix()
            shots.append(Shot(file, _lens(source, values, index), from_world(turn @ OPENGL, pose[4:], where)))
            known = (source.parent / DEPTH / f"{file.stem}{suffix}" for suffix in (".exr", ".png"))
            if (depth := next(filter(is_file, known), None)) is not None:
                maps[file] = depth
        warnings = skipped(source, {"not there": len(poses) - len(shots)}, len(poses))
        return Export(source, tuple(shots), depth_points(shots, maps, MILLIMETRES), warnings)


def _lens(source: Path, values: dict[str, Any], index: int) -> pycolmap.Camera:
    """Return the lens of a photo, else that of all."""
    size = size_of(values.get("w"), values.get("h"), str(source))
    per_photo = values.get("perFrameIntrinsicCoeffs")
    if isinstance(per_photo, list) and index < len(per_photo):
        fx, fy, cx, cy = numbers(per_photo[index], 4, f"{source}: intrinsics {index}")
    else:
        fx, _, _, _, fy, _, cx, cy, _ = numbers(values.get("K"), 9, f"{source}: K")  # by columns
    return perspective(size, (fx, fy), (cx, cy), where=str(source))
