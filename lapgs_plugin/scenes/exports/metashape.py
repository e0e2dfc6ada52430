"""Read the cameras of Agisoft Metashape: File > Export > Export Cameras > Agisoft XML.

The lens models are those of appendix D of its user manual.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from lapgs_plugin.errors import SceneError
from lapgs_plugin.scenes.exports.base import (
    ALL_AROUND_LENSES,
    EXPORT_AGAIN,
    INEXACT,
    Array,
    Export,
    PhotoFinder,
    SceneReader,
    Shot,
    from_world,
    lens,
    number,
    numbers,
    only_file,
    perspective,
    size_of,
    skipped,
    unknown_lens,
)
from lapgs_plugin.scenes.exports.points import points_beside
from lapgs_plugin.scenes.panorama import panorama_lens
from lapgs_plugin.untrusted import read_xml, shortened

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from lapgs_plugin.scenes.point_cloud import PointCloud

LENSES = ("frame", "fisheye", "spherical")
FAR = 1e4
"""Distance from the origin, in extents of the cameras, of coordinates of the earth."""
CLOSER = 100.0
"""Ratio of the distances from points to cameras, in the world and in the chunk, that says which of them the points are
in. That cameras see them does not: photos taken straight down see the centre of the earth, too."""


@dataclass(frozen=True, eq=False)
class _Placed:
    """A photo with its lens and its pose in a chunk, camera to chunk."""

    photo: Path
    camera: pycolmap.Camera
    pose: Array  # (4, 4)


@dataclass(frozen=True, eq=False)
class _World:
    """A similarity transform from a chunk to its world."""

    turn: Array  # (3, 3)
    shift: Array  # (3,)
    scale: float

    def center(self, placed: _Placed) -> Array:
        """Return the position of a camera in the world, (3,)."""
        return self.scale * self.turn @ placed.pose[:3, 3] + self.shift

    def shot(self, placed: _Placed) -> Shot:
        """Return a photo in the world."""
        pose = from_world(self.turn @ placed.pose[:3, :3], self.center(placed), str(placed.photo))
        return Shot(placed.photo, placed.camera, pose)


CHUNK = _World(np.eye(3), np.zeros(3), 1.0)


class Metashape(SceneReader):
    """Read one chunk. Its points are those of a PLY beside the XML."""

    title = "cameras of Metashape (XML)"

    def find(self, folder: Path) -> Path | None:
        """Return the XML file."""
        return only_file(folder, ".xml", lambda head: "<document version=" in head, self.title)

    def read(self, source: Path, photos: PhotoFinder) -> Export:
        """Read the aligned, enabled cameras of the chunk's largest component."""
        chunk = _only_chunk(source)
        cameras = chunk.findall("cameras//camera")
        enabled = [camera for camera in cameras if camera.get("enabled", "1") not in ("0", "false")]
        posed = [camera for camera in enabled if camera.find("transform") is not None]
        sensors = {sensor.get("id", ""): sensor for sensor in chunk.findall("sensors/sensor")}
        needed = sensors.keys() & {camera.get("sensor_id", "") for camera in posed}
        lenses = {key: _lens(sensors[key], source) for key in sorted(needed)}
        aligned = [
            (camera, known) for camera in posed if (known := lenses.get(camera.get("sensor_id", ""))) is not None
        ]
        if not aligned:
            problem = f"none of its {len(cameras)} cameras is aligned and enabled" if cameras else "has no cameras"
            raise SceneError(
                f"{source}: the chunk {shortened(chunk.get('label', ''))}: {problem}, expected aligned photos; align "
                "them and export the cameras again"
            )
        component = Counter(camera.get("component_id") for camera, _ in aligned).most_common(1)[0][0]
        used = [(camera, known) for camera, known in aligned if camera.get("component_id") == component]
        placed = [_Placed(photos(camera.get("label", "")), known, _pose(camera, source)) for camera, known in used]
        cloud = points_beside(source)
        shots, warnings = _in_fitting_world(source, _world(chunk, component, source), placed, cloud)
        reasons = {
            "disabled": len(cameras) - len(enabled),
            "not aligned": len(enabled) - len(aligned),
            "in smaller components": len(aligned) - len(used),
        }
        return Export(source, shots, cloud, (*warnings, *skipped(source, reasons, len(cameras))))


def _only_chunk(source: Path) -> Element:
    root = read_xml(source, error=SceneError, advice=EXPORT_AGAIN)
    chunks = root.findall("chunk")
    if root.tag != "document" or len(chunks) != 1:
        labels = ", ".join(shortened(chunk.get("label", "")) for chunk in chunks[:3])
        raise SceneError(
            f"{source}: it holds {len(chunks)} chunks{f' ({labels})' if labels else ''}, expected one; merge or "
            "choose one in Metashape, and export its cameras"
        )
    return chunks[0]


def _pose(camera: Element, source: Path) -> Array:
    """Return a camera's pose (4, 4), camera to chunk, in COLMAP's axes."""
    where = f"{source}: the transform of camera {shortened(camera.get('label', ''))}"
    return numbers(camera.findtext("transform"), 16, where).reshape(4, 4)


def _world(chunk: Element, component: str | None, source: Path) -> _World:
    """Return the transform of a component, or that of the chunk in files of older versions."""
    own = [item for item in chunk.findall("components/component") if item.get("id") == component]
    known = [item for parent in (*own, chunk) if (item := parent.find("transform")) is not None]
    transform = known[0] if known else None
    if transform is None:
        return CHUNK
    turn, shift, scale = (transform.findtext(name) for name in ("rotation", "translation", "scale"))
    where = f"{source}: the chunk's"
    size = 1.0 if scale is None else number(scale, f"{where} scale")
    if size <= 0.0:  # a negative one would mirror positions but not rotations
        raise SceneError(f"{where} scale is {size:g}, expected a number above 0; {EXPORT_AGAIN}")
    return _World(
        np.eye(3) if turn is None else numbers(turn, 9, f"{where} rotation").reshape(3, 3),
        np.zeros(3) if shift is None else numbers(shift, 3, f"{where} translation"),
        size,
    )


def _in_fitting_world(
    source: Path, world: _World, placed: list[_Placed], cloud: PointCloud | None
) -> tuple[tuple[Shot, ...], tuple[str, ...]]:
    """Return shots in the world, or in the chunk's own coordinates if its world is the earth and the points are not."""
    centers = np.stack([world.center(one) for one in placed])
    extent = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    in_world, in_chunk = np.linalg.norm(centers.mean(axis=0)) <= FAR * extent, False
    if cloud is not None and len(cloud.xyz):
        middle = np.median(cloud.xyz, axis=0)
        away = float(np.linalg.norm(centers.mean(axis=0) - middle)) / world.scale
        away_in_chunk = float(np.linalg.norm(np.mean([one.pose[:3, 3] for one in placed], axis=0) - middle))
        in_world |= away * CLOSER < away_in_chunk
        in_chunk = away_in_chunk * CLOSER < away
    if in_world and not in_chunk:
        return tuple(map(world.shot, placed)), ()
    line = f"{source}: its world is the earth's; the chunk's own coordinates and units are used"
    return tuple(map(CHUNK.shot, placed)), (line,)


def _lens(sensor: Element, source: Path) -> pycolmap.Camera | None:
    """Return a sensor's adjusted lens, else its initial one; None if it is not calibrated. Spherical ones are exact."""
    where = f"{source}: sensor {shortened(sensor.get('label', ''))}"
    if sensor.get("type") in ALL_AROUND_LENSES:
        return panorama_lens(_size(sensor, where), where)
    known = sensor.findall("calibration")
    calibration = next((one for one in known if one.get("class") == "adjusted"), known[-1] if known else None)
    if calibration is None:
        return None
    width, height = _size(calibration, where)
    kind = calibration.get("type", "frame")
    if kind in ALL_AROUND_LENSES:
        return panorama_lens((width, height), where)
    if kind not in LENSES:
        raise unknown_lens(where, kind, LENSES)

    def term(name: str) -> float:
        return number(calibration.findtext(name, "0"), f"{where}: its {name}")

    f, b1, b2, p1, p2 = (term(name) for name in ("f", "b1", "b2", "p1", "p2"))
    if abs(b2) * height > 2.0 * INEXACT * abs(f):  # at the upper border b2 shifts by that times half the height over f
        raise SceneError(f"{where} has the skew b2 = {b2:g}, which COLMAP's lenses lack; align again without b1 and b2")
    focal, center = (f + b1, f), (width / 2.0 + term("cx"), height / 2.0 + term("cy"))
    radial = [term(f"k{power}") for power in range(1, 5)]
    # OpenCV's p1 is the term along y, Metashape's that along x.
    if kind == "frame":
        return perspective((width, height), focal, center, radial, (p2, p1), where=where)
    return lens("THIN_PRISM_FISHEYE", (width, height), [*focal, *center, *radial[:2], p2, p1, *radial[2:], 0.0, 0.0])


def _size(parent: Element, where: str) -> tuple[int, int]:
    """Return width and height in an element `resolution`."""
    resolution = parent.find("resolution")
    sides = {} if resolution is None else resolution.attrib
    return size_of(sides.get("width"), sides.get("height"), where)
