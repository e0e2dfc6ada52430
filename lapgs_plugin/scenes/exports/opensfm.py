"""Read reconstructions of OpenSfM and OpenDroneMap: reconstruction.json, or shots.geojson with cameras.json.

https://opensfm.org/docs/geometry.html has the lens models. Lengths in images are shares of the longer side.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from lapgs_plugin.errors import SceneError
from lapgs_plugin.files import is_file
from lapgs_plugin.scenes.exports.base import (
    ALL_AROUND_LENSES,
    EXPORT_AGAIN,
    Array,
    Export,
    PhotoFinder,
    SceneReader,
    Shot,
    from_world,
    lens,
    number,
    numbers,
    perspective,
    size_of,
    skipped,
    unknown_lens,
)
from lapgs_plugin.scenes.panorama import panorama_lens
from lapgs_plugin.scenes.point_cloud import PointCloud
from lapgs_plugin.untrusted import read_json, shortened

FILES = (
    "opensfm/reconstruction.json",
    "reconstruction.json",
    "odm_report/shots.geojson",
    "shots.geojson",
)
"""Where cameras are, in the order in which they are looked for."""
LENSES = ("perspective", "simple_radial", "radial", "brown", "fisheye", "fisheye_opencv", "spherical")

Values = Mapping[str, Any]


class OpenSfM(SceneReader):
    """Read the largest part of a reconstruction, and its points."""

    title = "a reconstruction of OpenDroneMap or OpenSfM"

    def find(self, folder: Path) -> Path | None:
        """Return the file of the shots."""
        return next(filter(is_file, map(folder.joinpath, FILES)), None)

    def read(self, source: Path, photos: PhotoFinder) -> Export:
        """Read the shots."""
        data = read_json(source, error=SceneError, advice=EXPORT_AGAIN)
        if source.suffix == ".geojson":
            return _from_geojson(source, data, photos)
        parts = [part for part in data if isinstance(part, dict)] if isinstance(data, list) else []
        if not parts:
            raise SceneError(f"{source}: no reconstruction in it, expected OpenSfM's list of them; {EXPORT_AGAIN}")
        part = max(parts, key=lambda part: len(_table(source, part, "shots")))
        lenses = _lenses(source, _table(source, part, "cameras"))
        shots = []
        for name, shot in _table(source, part, "shots").items():
            where = f"{source}: shot {shortened(name)}"
            values = shot if isinstance(shot, dict) else {}
            turn, shift = (numbers(values.get(key), 3, f"{where}: {key}") for key in ("rotation", "translation"))
            rotation = Rotation.from_rotvec(turn).as_matrix()
            pose = from_world(rotation.T, -rotation.T @ shift, where)
            shots.append(Shot(photos(name), _lens_of(where, values.get("camera"), lenses), pose))
        if not shots:
            raise SceneError(f"{source}: no shots in it, expected posed photos; reconstruct them again")
        total = sum(len(_table(source, other, "shots")) for other in parts)
        warnings = skipped(source, {"in smaller reconstructions": total - len(shots)}, total)
        return Export(source, tuple(shots), _points(source, _table(source, part, "points")), warnings)


def _table(source: Path, part: Values, key: str) -> Values:
    table = part.get(key, {})
    if not isinstance(table, dict):
        raise SceneError(f"{source}: {key} is {shortened(table)}, expected a table by name; {EXPORT_AGAIN}")
    return table


def _points(source: Path, table: Values) -> PointCloud | None:
    if not table:
        return None
    rows = []
    for key, point in table.items():
        values = point if isinstance(point, dict) else {}
        parts = [values.get(part) for part in ("coordinates", "color")]
        joined = [value for part in parts if isinstance(part, list) for value in part]
        rows.append(numbers(joined, 6, f"{source}: point {shortened(key)}"))
    stacked = np.stack(rows)
    return PointCloud(stacked[:, :3], stacked[:, 3:] / 255.0, "")


def _from_geojson(source: Path, data: Any, photos: PhotoFinder) -> Export:
    """Read the shots of a report, in metres of a map, moved to the origin; their lenses are in cameras.json."""
    file = next(filter(is_file, (folder / "cameras.json" for folder in (source.parent, source.parent.parent))), None)
    if file is None:
        raise SceneError(f"{source}: no cameras.json beside it or above, expected its lenses; put it there")
    cameras = read_json(file, error=SceneError, advice=EXPORT_AGAIN)
    lenses = _lenses(file, cameras if isinstance(cameras, dict) else {})
    features = data.get("features") if isinstance(data, dict) else None
    if not isinstance(features, list) or not features:
        raise SceneError(f"{source}: no features in it, expected the shots of a report; {EXPORT_AGAIN}")
    poses: list[tuple[str, pycolmap.Camera, Array, Array]] = []
    for index, feature in enumerate(features):
        where = f"{source}: feature {index}"
        values = feature.get("properties") if isinstance(feature, dict) else None
        if not isinstance(values, dict) or not isinstance(values.get("filename"), str):
            raise SceneError(f"{where} has no filename, expected that of its photo; {EXPORT_AGAIN}")
        turn, center = (numbers(values.get(key), 3, f"{where}: {key}") for key in ("rotation", "translation"))
        only = next(iter(lenses)) if len(lenses) == 1 else None
        known = _lens_of(where, values.get("camera", only), lenses)
        poses.append((values["filename"], known, Rotation.from_rotvec(turn).as_matrix().T, center))
    middle = np.mean([center for *_, center in poses], axis=0).round()
    shots = [
        Shot(photos(name), known, from_world(turn, center - middle, f"{source}: {shortened(name)}"))
        for name, known, turn, center in poses
    ]
    return Export(source, tuple(shots))


def _lenses(source: Path, cameras: Values) -> dict[str, pycolmap.Camera]:
    return {name: _lens(f"{source}: camera {shortened(name)}", camera) for name, camera in cameras.items()}


def _lens_of(where: str, name: Any, lenses: Mapping[str, pycolmap.Camera]) -> pycolmap.Camera:
    if not isinstance(name, str) or name not in lenses:
        raise SceneError(
            f"{where} has the camera {shortened(name)}, expected one of {shortened(list(lenses))}; {EXPORT_AGAIN}"
        )
    return lenses[name]


def _lens(where: str, camera: Any) -> pycolmap.Camera:
    values = camera if isinstance(camera, dict) else {}
    kind = values.get("projection_type")
    width, height = size_of(values.get("width"), values.get("height"), where)
    if kind in ALL_AROUND_LENSES:
        return panorama_lens((width, height), where)
    if kind not in LENSES:
        raise unknown_lens(where, kind, LENSES)

    def term(key: str, otherwise: float = 0.0) -> float:
        return number(values.get(key, otherwise), f"{where}: {key}")

    side = max(width, height)
    across = term("focal_x", term("focal"))
    down = term("focal_y", across * term("aspect_ratio", 1.0))
    focal, center = (across * side, down * side), (width / 2 + term("c_x") * side, height / 2 + term("c_y") * side)
    k1, k2, k3, k4 = (term(f"k{power}") for power in range(1, 5))
    if kind in ("fisheye", "fisheye_opencv"):
        return lens("OPENCV_FISHEYE", (width, height), [*focal, *center, k1, k2, k3, k4])
    return perspective((width, height), focal, center, (k1, k2, k3), (term("p1"), term("p2")), where=where)
