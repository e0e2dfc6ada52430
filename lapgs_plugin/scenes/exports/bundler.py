"""Read Bundler's files, which RealityCapture, Metashape and others export: bundle.out and a list of the photos.

https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lapgs_plugin.errors import SceneError
from lapgs_plugin.files import is_file
from lapgs_plugin.scenes.exports.base import (
    EXPORT_AGAIN,
    OPENGL,
    Array,
    Export,
    PhotoFinder,
    SceneReader,
    Shot,
    from_world,
    numbers,
    only_file,
    perspective,
    sizes_of,
    skipped,
)
from lapgs_plugin.scenes.point_cloud import PointCloud
from lapgs_plugin.untrusted import read_text

LISTS = ("{stem}.out.list.txt", "{stem}.list.txt", "{stem}-list.txt", "{stem}.lst", "list.txt", "imagelist.lst")
"""Names of lists of photos beside a file `{stem}.out`."""
LINES_A_CAMERA, LINES_A_POINT = 5, 3


class Bundler(SceneReader):
    """Read cameras with two radial terms, whose principal point is the middle of the photo, and their points."""

    title = "a reconstruction of Bundler (.out)"

    def find(self, folder: Path) -> Path | None:
        """Return the .out file."""
        return only_file(folder, ".out", lambda head: head.startswith("# Bundle file"), self.title)

    def read(self, source: Path, photos: PhotoFinder) -> Export:
        """Read the cameras that have a focal length, and all points."""
        text = read_text(source, error=SceneError, advice=EXPORT_AGAIN, written=True)
        lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
        cameras, points = (int(count) for count in numbers(lines[0] if lines else "", 2, f"{source}: its first line"))
        last = 1 + LINES_A_CAMERA * cameras
        if min(cameras, points) < 0 or len(lines) < last + LINES_A_POINT * points:
            raise SceneError(
                f"{source}: {len(lines)} lines for {cameras} cameras and {points} points, expected "
                f"{last + LINES_A_POINT * points}; copy or export it again"
            )
        names = _names(source)
        if len(names) != cameras:
            raise SceneError(f"{source}: {len(names)} photos in its list, expected {cameras}; {EXPORT_AGAIN}")
        parts = [" ".join(lines[start : start + LINES_A_CAMERA]) for start in range(1, last, LINES_A_CAMERA)]
        values = [numbers(part, 15, f"{source}: camera {index}") for index, part in enumerate(parts)]
        placed = [(photos(name), camera) for name, camera in zip(names, values, strict=True) if camera[0]]
        if not placed:
            raise SceneError(f"{source}: none of its {cameras} cameras has a pose; align the photos and {EXPORT_AGAIN}")
        sizes = sizes_of(source, [file for file, _ in placed])
        shots = tuple(_shot(f"{source}: {file.name}", file, sizes[file], camera) for file, camera in placed)
        warnings = skipped(source, {"not placed": cameras - len(shots)}, cameras)
        return Export(source, shots, _points(source, lines[last:], points), warnings)


def _shot(where: str, file: Path, size: tuple[int, int], values: Array) -> Shot:
    """Return a photo of a camera's 15 numbers: f, k1, k2, a rotation and a translation from the world."""
    turn, center = values[3:12].reshape(3, 3), (size[0] / 2.0, size[1] / 2.0)
    known = perspective(size, (values[0], values[0]), center, values[1:3].tolist(), where=where)
    return Shot(file, known, from_world(turn.T @ OPENGL, -turn.T @ values[12:], where))


def _names(source: Path) -> list[str]:
    """Return the names of the photos, of lines that may end with Bundler's 0 and a focal length."""
    choices = [source.with_name(name.format(stem=source.stem)) for name in LISTS]
    file = next(filter(is_file, choices), None)
    if file is None:
        raise SceneError(
            f"{source}: no list of its photos beside it, expected {choices[3].name} or list.txt; put it there"
        )
    lines = read_text(file, error=SceneError, advice=EXPORT_AGAIN, written=True).splitlines()
    return [re.sub(r"\s+0\s+[\d.eE+-]+\s*$", "", line).strip() for line in lines if line.strip()]


def _points(source: Path, lines: Sequence[str], count: int) -> PointCloud | None:
    """Return the points, each of a line with its position, its colour and its views."""
    if not count:
        return None
    inner = range(0, LINES_A_POINT * count, LINES_A_POINT)
    rows = [numbers(f"{lines[at]} {lines[at + 1]}", 6, f"{source}: point {number}") for number, at in enumerate(inner)]
    values = np.stack(rows)
    return PointCloud(values[:, :3], values[:, 3:] / 255.0, "")
