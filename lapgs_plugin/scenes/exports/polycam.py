"""Read Polycam's raw data (developer mode): keyframes/ with photos, cameras and depth maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

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
    number,
    perspective,
    size_of,
)
from lapgs_plugin.scenes.exports.points import MILLIMETRES, depth_points
from lapgs_plugin.scenes.images import find_image
from lapgs_plugin.untrusted import read_json, shortened

KEYFRAMES = "keyframes"
FOLDERS = {"corrected_cameras": "corrected_images", "cameras": "images"}
"""Folders of cameras with those of their photos; the first are those that Polycam has optimised."""


class Polycam(SceneReader):
    """Read the optimised cameras, else those of ARKit; points are made of the depth maps."""

    title = "raw data of Polycam (keyframes/)"

    def find(self, folder: Path) -> Path | None:
        """Return the folder of the cameras."""
        inside = folder if folder.name == KEYFRAMES else folder / KEYFRAMES
        known = (inside / cameras for cameras, photos in FOLDERS.items() if is_folder(inside / photos))
        return next((cameras for cameras in known if any(cameras.glob("*.json"))), None)

    def read(self, source: Path, photos: PhotoFinder) -> Export:
        """Read a file for each camera."""
        shots, maps = [], {}
        for file in sorted(source.glob("*.json")):
            values = read_json(file, error=SceneError, advice=EXPORT_AGAIN)
            if not isinstance(values, dict):
                raise SceneError(f"{file}: it holds {shortened(values)}, expected a camera; {EXPORT_AGAIN}")
            fx, fy, cx, cy = (number(values.get(key), f"{file}: {key}") for key in ("fx", "fy", "cx", "cy"))
            camera = perspective(
                size_of(values.get("width"), values.get("height"), str(file)), (fx, fy), (cx, cy), where=str(file)
            )
            entries = [
                [number(values.get(key := f"t_{row}{column}"), f"{file}: {key}") for column in range(4)]
                for row in range(3)
            ]
            pose = np.array(entries)
            photo = find_image(source.parent / FOLDERS[source.name] / f"{file.stem}.jpg")
            shots.append(Shot(photo, camera, from_world(pose[:, :3] @ OPENGL, pose[:, 3], str(file))))
            if is_file(depth := source.parent / "depth" / f"{file.stem}.png"):
                maps[photo] = depth
        return Export(source, tuple(shots), depth_points(shots, maps, MILLIMETRES))
