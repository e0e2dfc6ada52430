"""Read captures of ARKitScenes: photos, .pincam files of their lenses, and the .traj file of ARKit's poses.

https://github.com/apple/ARKitScenes/blob/main/DATA.md
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lapgs_plugin.errors import SceneError
from lapgs_plugin.files import is_file, is_folder
from lapgs_plugin.scenes.exports.base import (
    EXPORT_AGAIN,
    Array,
    Export,
    PhotoFinder,
    SceneReader,
    Shot,
    angle_axis,
    from_world,
    image_side,
    numbers,
    perspective,
    skipped,
)
from lapgs_plugin.scenes.exports.points import MILLIMETRES, depth_points, points_beside
from lapgs_plugin.scenes.images import is_photo
from lapgs_plugin.untrusted import read_text

TRAJECTORY = "lowres_wide.traj"
PHOTOS = ("wide", "vga_wide", "lowres_wide")
"""Folders of the same photos, the largest first."""
DEPTHS = ("lowres_depth", "highres_depth")
APART = 5e-3
"""Most seconds between a photo and its pose, as in the tools of ARKitScenes."""
ROUNDED = 1.5e-3
"""Most seconds between the names of a photo and its lens, which are rounded apart."""


class ARKitScenes(SceneReader):
    """Read the photos that have a pose; points are those of a PLY, else of the depth maps."""

    title = "a capture of ARKitScenes"

    def find(self, folder: Path) -> Path | None:
        """Return the .traj file."""
        inside = [folder, *sorted(folder.glob("*_frames"))]
        return next((one / TRAJECTORY for one in inside if is_file(one / TRAJECTORY)), None)

    def read(self, source: Path, photos: PhotoFinder) -> Export:
        """Read the lens and the nearest pose of each photo of the largest size."""
        folder = next(
            (source.parent / name for name in PHOTOS if is_folder(source.parent / f"{name}_intrinsics")), None
        )
        files = [file for file in sorted(folder.glob("*")) if is_photo(file)] if folder and is_folder(folder) else []
        if folder is None or not files:
            raise SceneError(
                f"{source.parent}: no photos with lenses beside {TRAJECTORY}, expected {PHOTOS[0]} or {PHOTOS[2]}, and "
                f"{PHOTOS[2]}_intrinsics or alike; download these, too"
            )
        lines = read_text(source, error=SceneError, advice=EXPORT_AGAIN, written=True).splitlines()
        rows = [numbers(line, 7, f"{source} line {index}") for index, line in enumerate(lines, 1) if line.strip()]
        lenses = {_time(file): file for file in folder.with_name(f"{folder.name}_intrinsics").glob("*.pincam")}
        if not rows or not lenses:
            raise SceneError(f"{source}: no poses in it, or no .pincam files for {folder.name}; download them again")
        path, shots, maps = np.stack(rows), [], {}
        for file in files:
            time = _time(file)
            pose = path[np.abs(path[:, 0] - time).argmin()]
            if abs(pose[0] - time) > APART:
                continue
            nearest = min(lenses, key=lambda other: abs(other - time))
            if abs(nearest - time) > ROUNDED:
                raise SceneError(f"{file}: no .pincam file of its lens; download it again")
            shots.append(_shot(file, lenses[nearest], pose, f"{source}: time {pose[0]:.3f}"))
            known = (source.parent / name / f"{file.stem}.png" for name in DEPTHS)
            if (depth := next(filter(is_file, known), None)) is not None:
                maps[file] = depth
        if not shots:
            raise SceneError(f"{source}: no pose within {APART:g} s of any photo in {folder}; download them again")
        cloud = points_beside(source, source.parent.parent) or depth_points(shots, maps, MILLIMETRES)
        return Export(
            source, tuple(shots), cloud, skipped(source, {"without a pose": len(files) - len(shots)}, len(files))
        )


def _time(file: Path) -> float:
    """Return the seconds at the end of a name such as 41069021_305.377.png."""
    try:
        return float(file.stem.rpartition("_")[2])
    except ValueError:
        raise SceneError(f"{file}: its name has no time, expected one such as 41069021_305.377{file.suffix}") from None


def _shot(photo: Path, pincam: Path, pose: Array, where: str) -> Shot:
    values = numbers(read_text(pincam, error=SceneError, advice=EXPORT_AGAIN), 6, str(pincam))
    size = (image_side(values[0], f"{pincam}: its width"), image_side(values[1], f"{pincam}: its height"))
    camera = perspective(size, (values[2], values[3]), (values[4], values[5]), where=str(pincam))
    rotation = angle_axis(pose[1:4])  # world to camera, of axes as COLMAP's
    return Shot(photo, camera, from_world(rotation.T, -rotation.T @ pose[4:], where))
