"""Read captures of ARKitScenes: photos, .pincam files of their lenses, and the .traj file of ARKit's poses.

https://github.com/apple/ARKitScenes/blob/main/DATA.md
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lapgs_plugin.errors import SceneError
from lapgs_plugin.files import is_file, is_folder
from lapgs_plugin.scenes.exports.base import (
    EXPORT_AGAIN,
    Array,
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
        text = read_text(source, error=SceneError, advice=EXPORT_AGAIN, written=True)
        lines = [(index, line) for index, line in enumerate(text.splitlines(), 1) if line.strip()]
        path = np.array([numbers(line, 7, f"{source} line {index}") for index, line in lines]).reshape(-1, 7)
        choices = [(folder, *_posed(folder, path)) for name in PHOTOS if is_folder(folder := source.parent / name)]
        folder, posed, total = max(choices, key=lambda choice: len(choice[1]), default=(source.parent, {}, 0))
        if not posed:
            raise SceneError(
                f"{source}: of {total} photos in {folder} none has a pose within {APART:g} s, expected photos in "
                f"{' or '.join(PHOTOS)}; download them again"
            )
        lenses = {_time(file): file for file in folder.with_name(f"{folder.name}_intrinsics").glob("*.pincam")}
        shots, maps = [], {}
        for file, pose in posed.items():
            nearest = min(lenses, key=lambda time: abs(time - _time(file)), default=np.inf)
            if abs(nearest - _time(file)) > ROUNDED:
                raise SceneError(f"{file}: no .pincam file of its lens in {folder.name}_intrinsics; download it again")
            shots.append(_shot(file, lenses[nearest], pose, f"{source}: time {pose[0]:.3f}"))
            known = (source.parent / name / f"{file.stem}.png" for name in DEPTHS)
            if (depth := next(filter(is_file, known), None)) is not None:
                maps[file] = depth
        cloud = points_beside(source, source.parent.parent) or depth_points(shots, maps, MILLIMETRES)
        return Export(source, tuple(shots), cloud, skipped(source, {"without a pose": total - len(shots)}, total))


def _posed(folder: Path, path: Array) -> tuple[dict[Path, Array], int]:
    """Return the photos of a folder that have a row of the path (n, 7) in time, and how many photos there are."""
    files = [file for file in sorted(folder.iterdir()) if is_photo(file)]
    rows = {file: path[np.abs(path[:, 0] - _time(file)).argmin()] for file in files} if len(path) else {}
    return {file: row for file, row in rows.items() if abs(row[0] - _time(file)) <= APART}, len(files)


def _time(file: Path) -> float:
    """Return the seconds at the end of a name such as 41069021_305.377.png."""
    try:
        return float(file.stem.rpartition("_")[2])
    except ValueError:
        raise SceneError(f"{file}: its name has no time, expected one such as 41069021_305.377{file.suffix}") from None


def _shot(photo: Path, pincam: Path, pose: Array, where: str) -> Shot:
    values = numbers(read_text(pincam, error=SceneError, advice=EXPORT_AGAIN), 6, str(pincam))
    size = size_of(values[0], values[1], str(pincam))
    camera = perspective(size, (values[2], values[3]), (values[4], values[5]), where=str(pincam))
    rotation = Rotation.from_rotvec(pose[1:4]).as_matrix()  # world to camera, of axes as COLMAP's
    return Shot(photo, camera, from_world(rotation.T, -rotation.T @ pose[4:], where))
