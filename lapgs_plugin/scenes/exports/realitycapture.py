"""Read the cameras of RealityCapture and RealityScan: Export > Registration > Internal/External camera parameters."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from lapgs_plugin.errors import SceneError
from lapgs_plugin.scenes.exports.base import (
    EXPORT_AGAIN,
    OPENGL,
    Array,
    Export,
    PhotoFinder,
    SceneReader,
    Shot,
    from_world,
    number,
    only_file,
    perspective,
    sizes_of,
)
from lapgs_plugin.scenes.exports.points import points_beside
from lapgs_plugin.untrusted import read_text, shortened

NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
"""Columns without which a CSV is another one."""
FILM = 36.0
"""Width of 35 mm film in mm, of which focal lengths are given."""


class RealityCapture(SceneReader):
    """Read the CSV of Brown's lens models. Its points are those of a PLY beside it."""

    title = "cameras of RealityCapture (CSV)"

    def find(self, folder: Path) -> Path | None:
        """Return the CSV file."""
        return only_file(folder, ".csv", lambda head: set(NEEDED) <= set(_columns(head)), self.title)

    def read(self, source: Path, photos: PhotoFinder) -> Export:
        """Read a camera of each row."""
        text = read_text(source, error=SceneError, advice=EXPORT_AGAIN, written=True)
        columns, lines = _columns(text), text.splitlines()
        first = next(number for number, line in enumerate(lines, 1) if line.split(",")[0].lower() == "#name")
        rows = [(line, row) for line, row in enumerate(csv.reader(lines[first:]), first + 1) if any(row)]
        for line, row in rows:
            if len(row) != len(columns):
                raise SceneError(
                    f"{source} line {line}: {len(row)} values ({shortened(','.join(row))}), expected the "
                    f"{len(columns)} that its first line names; {EXPORT_AGAIN}"
                )
        if not rows:
            raise SceneError(f"{source}: no cameras in it; align the photos and export them again")
        files = [photos(row[columns.index("name")]) for _, row in rows]
        sizes = sizes_of(source, files)
        shots = []
        for (line, row), file in zip(rows, files, strict=True):
            where = f"{source} line {line}"
            values = {
                name: number(text, f"{where}: {name}") for name, text in zip(columns, row, strict=True) if name in KNOWN
            }
            width, height = sizes[file]
            side, zero = max(width, height), dict.fromkeys(KNOWN, 0.0)
            values = {**zero, **values}
            camera = perspective(
                (width, height),
                (values["f"] * side / FILM,) * 2,
                (width / 2.0 + values["px"] * side, height / 2.0 + values["py"] * side),
                [values[f"k{power}"] for power in range(1, 5)],
                (values["t1"], values["t2"]),
                where=where,
            )
            position = np.array([values["x"], values["y"], values["alt"]])
            turn = _turn(*(values[name] for name in ("heading", "pitch", "roll")))
            shots.append(Shot(file, camera, from_world(turn @ OPENGL, position, where)))
        return Export(source, tuple(shots), points_beside(source))


KNOWN = (*NEEDED[1:], "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
"""Columns of numbers that are read."""


def _columns(text: str) -> list[str]:
    """Return the names of the columns; none if there is no line that names them at the beginning of a CSV."""
    for line in text.splitlines()[:3]:  # a line may say the number of cameras before
        if line.lower().startswith("#name,"):
            return [name.strip().lstrip("#").lower() for name in line.split(",")]
    return []


def _turn(heading: float, pitch: float, roll: float) -> Array:
    """Return the rotation (3, 3) from a camera of OpenGL's axes to the world, of angles in degrees."""
    (sh, sp, sr), (ch, cp, cr) = np.sin(angles := np.radians([-heading, pitch, roll])), np.cos(angles)
    about_z = np.array([[ch, -sh, 0.0], [sh, ch, 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
    about_y = np.array([[cr, 0.0, sr], [0.0, 1.0, 0.0], [-sr, 0.0, cr]])
    turn: Array = about_z @ about_x @ about_y
    return turn
