"""Check COLMAP's text files (https://colmap.github.io/format.html), before pycolmap reads them.

pycolmap's messages about mistakes quote its own source code, and it reads -96 pixels as 18446744073709551520.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NoReturn, TypeVar

import pycolmap

from lapgs_plugin.errors import SceneError

_Number = TypeVar("_Number", int, float)

LARGEST_ID = 2**32 - 2
"""Largest id of a camera or an image; the next number means none."""
SHOWN = 60
"""Characters of a line that are quoted in a message."""


def check_text(folder: Path) -> dict[int, str]:
    """Check the numbers in the text files of a model and that the ids they refer to exist. Return the images' names.

    pycolmap ends a name at its first space.

    Raises:
        SceneError: a line is wrong.
    """
    cameras = _ids(folder / "cameras.txt", _check_camera)
    names: dict[int, str] = {}
    images = _ids(folder / "images.txt", lambda line: _check_image(line, cameras, names), pairs=True)
    _ids(folder / "points3D.txt", lambda line: _check_point(line, images))
    return names


class _Line:
    """A line of a file and its words."""

    def __init__(self, file: Path, number: int, text: str) -> None:
        self.file, self.number, self.text = file, number, text
        self.words = text.split()

    def refuse(self, expected: str) -> NoReturn:
        quoted = self.text if len(self.text) <= SHOWN else f"{self.text[:SHOWN]}..."
        raise SceneError(
            f"{self.file}: line {self.number} is {quoted!r}, expected {expected}; copy or export the model again"
        )

    def numbers(self, kind: Callable[[str], _Number], words: Sequence[str], what: str) -> list[_Number]:
        """Return words as finite numbers, or refuse the line; `what` was expected."""
        try:
            found = [kind(word) for word in words]
        except ValueError:
            self.refuse(what)
        if not all(map(math.isfinite, found)):
            self.refuse(what)
        return found


def _ids(file: Path, check: Callable[[_Line], int], pairs: bool = False) -> set[int]:
    """Check the lines of a file and return their ids. With `pairs`, every second line lists observations."""
    ids: set[int] = set()
    for line in _lines(file, pairs):
        key = check(line)
        if key in ids:
            line.refuse(f"each id once, {key} was there before")
        ids.add(key)
    return ids


def _lines(file: Path, pairs: bool) -> Iterator[_Line]:
    try:
        with file.open(encoding="utf-8") as stream:
            numbered = enumerate(stream, start=1)
            for number, text in numbered:
                if (stripped := text.strip()) and not stripped.startswith("#"):
                    yield _Line(file, number, stripped)
                    if not pairs:
                        continue
                    observations = _Line(file, number + 1, next(numbered, (0, ""))[1].strip())
                    if len(observations.words) % 3:
                        observations.refuse("X Y POINT3D_ID for each observation")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{file}: not readable as text in UTF-8 ({error}); copy or export the model again") from error


def _check_camera(line: _Line) -> int:
    expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS"
    if len(line.words) < 4:
        line.refuse(expected)
    key, width, height = line.numbers(int, [line.words[0], *line.words[2:4]], expected)
    if not 0 <= key <= LARGEST_ID or min(width, height) < 1:
        line.refuse(f"{expected} with positive numbers")
    model = line.words[1]
    if model not in pycolmap.CameraModelId.__members__ or model == "INVALID":
        line.refuse(f"a camera model of COLMAP, such as PINHOLE, in place of {model[:SHOWN]}")
    count = len(pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params)
    if len(line.numbers(float, line.words[4:], f"{count} finite parameters of {model}")) != count:
        line.refuse(f"{count} parameters of {model}, not {len(line.words) - 4}")
    return key


def _check_image(line: _Line, cameras: set[int], names: dict[int, str]) -> int:
    expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME with finite numbers"
    if len(line.words) < 10:
        line.refuse(expected)
    key, camera = line.numbers(int, [line.words[0], line.words[8]], expected)
    quaternion = line.numbers(float, line.words[1:8], expected)[:4]
    if not 0 <= key <= LARGEST_ID:
        line.refuse(f"an id from 0 to {LARGEST_ID}")
    if not 0.0 < math.hypot(*quaternion) < math.inf:
        line.refuse("a rotation, the quaternion QW QX QY QZ of length 1")
    if camera not in cameras:
        line.refuse(f"the id of a camera in cameras.txt, there is no {camera}")
    names[key] = line.text.split(maxsplit=9)[9]
    return key


def _check_point(line: _Line, images: set[int]) -> int:
    expected = "POINT3D_ID X Y Z R G B ERROR TRACK with finite numbers"
    if len(line.words) < 8:
        line.refuse(expected)
    (key,) = line.numbers(int, line.words[:1], expected)
    line.numbers(float, [*line.words[1:4], line.words[7]], expected)
    if key < 0 or not all(0 <= channel <= 255 for channel in line.numbers(int, line.words[4:7], expected)):
        line.refuse("a positive id and colours from 0 to 255")
    track = line.numbers(int, line.words[8:], expected)
    if len(track) % 2:
        line.refuse("IMAGE_ID POINT2D_IDX for each image of the track")
    if unknown := set(track[::2]) - images:
        line.refuse(f"ids of images in images.txt, there is no {min(unknown)}")
    return key
