"""Read the cameras of RealityCapture and RealityScan: Export > Registration > Internal/External camera parameters."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lapgs_plugin.errors import SceneError
from lapgs_plugin.scenes.exports.base import (
    EXPORT_AGAIN,
    OPENGL,
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
OTHERS = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
"""Columns that are 0 where they are missing. A user chooses the columns."""
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
        rows = _rows(source)
        files = [photos(row["name"]) for row in rows.values()]
        sizes = sizes_of(source, files)
        shots = [
            _shot(f"{source} line {line}", file, sizes[file], row)
            for (line, row), file in zip(rows.items(), files, strict=True)
        ]
        return Export(source, tuple(shots), points_beside(source))


def _columns(text: str) -> list[str]:
    """Return the names of the columns; none if there is no line that names them at the beginning of a CSV."""
    for line in text.splitlines()[:3]:  # a line may say the number of cameras before
        if line.lower().startswith("#name,"):
            return [name.strip().lstrip("#").lower() for name in line.split(",")]
    return []


def _rows(source: Path) -> dict[int, dict[str, str]]:
    """Return the values of each camera by column, by the number of its line."""
    text = read_text(source, error=SceneError, advice=EXPORT_AGAIN, written=True)
    columns, lines, rows = _columns(text), text.splitlines(), dict[int, dict[str, str]]()
    for line, row in enumerate(_values(source, lines), 1):
        if not row or row[0].startswith("#"):
            continue
        if len(row) != len(columns):
            raise SceneError(
                f"{source} line {line}: {len(row)} values ({shortened(','.join(row))}), expected the {len(columns)} "
                f"that its first line names; {EXPORT_AGAIN}"
            )
        rows[line] = dict(zip(columns, row, strict=True))
    if not rows:
        raise SceneError(f"{source}: no cameras in it; align the photos and export them again")
    return rows


def _values(source: Path, lines: Sequence[str]) -> Iterator[list[str]]:
    """Yield the values of each line of a CSV."""
    try:
        yield from csv.reader(lines)
    except csv.Error as error:  # a value of more than 131,072 characters
        raise SceneError(f"{source}: not readable as CSV ({error}); {EXPORT_AGAIN}") from error


def _shot(where: str, file: Path, size: tuple[int, int], row: Mapping[str, str]) -> Shot:
    values = {name: number(row.get(name, "0"), f"{where}: {name}") for name in (*NEEDED[1:], *OTHERS)}
    width, height = size
    side = max(size)
    camera = perspective(
        size,
        (values["f"] * side / FILM,) * 2,
        (width / 2.0 + values["px"] * side, height / 2.0 + values["py"] * side),
        [values[f"k{power}"] for power in range(1, 5)],
        (values["t1"], values["t2"]),
        where=where,
    )
    angles = (-values["heading"], values["pitch"], values["roll"])
    turn = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()  # of a camera of OpenGL's axes
    position = np.array([values["x"], values["y"], values["alt"]])
    return Shot(file, camera, from_world(turn @ OPENGL, position, where))
