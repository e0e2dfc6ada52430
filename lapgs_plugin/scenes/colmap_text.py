"""Read COLMAP's text files (https://colmap.github.io/format.html), as COLMAP writes them and as people do.

pycolmap ends a name at its first space, reads -96 pixels as 18446744073709551520, and refuses tracks that do not agree
with the images. Lines of images.txt are told apart by their contents: COLMAP writes two for each image, other programs
write one, or empty lines in between.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
import pycolmap
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError
from lapgs_plugin.scenes.colmap_records import (
    LARGEST_ID,
    NO_FEATURES,
    NO_TRACK,
    OTHER_LENS,
    UNIT_TOLERANCE,
    Points,
    PosedImage,
    file_name,
)
from lapgs_plugin.untrusted import require_regular

SHOWN = 60
"""Characters of a line that are quoted in a message."""
NUMBERS = frozenset("0123456789+-.einfaEINFA \t")
"""Characters of lines of numbers. Names of photos have others, at least in their suffixes."""

CAMERA = "CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS"
IMAGE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME with finite numbers"
POINT = "POINT3D_ID X Y Z R G B with finite numbers"
COLORS = "whole colours R G B from 0 to 255"


class _Line:
    """Split a line of a file into its first words, and the rest as the last one."""

    def __init__(self, file: Path, number: int, text: str, first_words: int) -> None:
        self.file, self.number, self.text = file, number, text
        self.words = text.split(maxsplit=first_words)

    def refuse(self, expected: str, advice: str = "copy or export the model again") -> NoReturn:
        quoted = self.text if len(self.text) <= SHOWN else f"{self.text[:SHOWN]}..."
        raise SceneError(f"{self.file}: line {self.number} is {quoted!r}, expected {expected}; {advice}")

    def whole(self, words: Sequence[str], expected: str) -> list[int]:
        """Return words as whole numbers, such as 7 or numpy's 7.0, or refuse the line."""
        values = self.finite(words, expected)  # exact, because ids and sizes are below 2 ** 53
        if not all(value.is_integer() for value in values):
            self.refuse(expected)
        return [int(value) for value in values]

    def finite(self, words: Sequence[str], expected: str) -> list[float]:
        """Return words as finite numbers, or refuse the line."""
        try:
            values = [float(word) for word in words]
        except ValueError:
            self.refuse(expected)
        if not all(map(math.isfinite, values)):
            self.refuse(expected)
        return values


def _lines(file: Path, first_words: int = -1) -> Iterator[_Line]:
    """Yield the lines of a file that are neither empty nor comments.

    Raises:
        SceneError: the file is no text in UTF-8, with or without a byte-order mark.
    """
    try:
        require_regular(file)
        with file.open(encoding="utf-8-sig") as stream:
            for number, text in enumerate(stream, start=1):
                if (stripped := text.strip()) and not stripped.startswith("#"):
                    yield _Line(file, number, stripped, first_words)
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{file}: not readable as text in UTF-8 ({error}); copy or export the model again") from error


def read_cameras(file: Path) -> dict[int, pycolmap.Camera]:
    """Return the cameras of cameras.txt by id.

    Raises:
        SceneError: a line is wrong.
    """
    cameras: dict[int, pycolmap.Camera] = {}
    for line in _lines(file):
        if len(line.words) < 4:
            line.refuse(CAMERA)
        key, width, height = line.whole([line.words[0], *line.words[2:4]], CAMERA)
        _check_id(line, key, cameras)
        if min(width, height) < 1:
            line.refuse(f"{CAMERA} with positive numbers")
        model = line.words[1].upper()
        if model not in pycolmap.CameraModelId.__members__ or model == "INVALID":
            line.refuse(f"a camera model of COLMAP in place of {model[:SHOWN]}", OTHER_LENS)
        camera = pycolmap.Camera.create_from_model_name(key, model, 1.0, 1, 1)
        count = len(camera.params)
        if len(values := line.finite(line.words[4:], f"{count} finite parameters of {model}")) != count:
            line.refuse(f"{count} parameters of {model}, not {len(values)}")
        camera.width, camera.height, camera.params = min(width, 2**64 - 1), min(height, 2**64 - 1), values
        cameras[key] = camera
    return cameras


def read_images(file: Path, observations: bool = False) -> dict[int, PosedImage]:
    """Return the images of images.txt by id, with their features if `observations`.

    Lines of features that are damaged count as none.

    Raises:
        SceneError: the line of an image is wrong.
    """
    images: dict[int, PosedImage] = {}
    key, next_number = -1, 0  # of the last image, and the line that COLMAP writes its features in
    one_line = False  # an image each
    for line in _lines(file, 9):
        follows = line.number == next_number
        if set(line.text) <= NUMBERS and _holds_features(words := line.text.split(), follows and not one_line):
            if observations and key in images:
                images[key] = replace(images[key], features=_features(words))
            key = -1
            continue
        one_line |= follows
        if len(line.words) < 10:
            line.refuse(IMAGE)
        key, camera = line.whole([line.words[0], line.words[8]], IMAGE)
        _check_id(line, key, images)
        pose = np.array(line.finite(line.words[1:8], IMAGE))
        images[key], next_number = PosedImage(file_name(line.words[9]), camera, pose, NO_FEATURES), line.number + 1
    return images


def _holds_features(words: list[str], expected: bool) -> bool:
    """Return whether a line of numbers holds features, and not an image that is cut short or whose name is a number."""
    triples = len(words) % 3 == 0
    try:
        key, *quaternion = map(float, words[:5])
    except ValueError:
        return expected
    length = math.hypot(*quaternion)
    image = key.is_integer() and (
        length <= 1.0 + UNIT_TOLERANCE if len(quaternion) < 4 else abs(length - 1.0) < UNIT_TOLERANCE
    )
    return expected and triples if image else expected or triples


def _features(words: list[str]) -> NDArray[np.float64]:
    with suppress(ValueError):
        return np.array(words, np.float64).reshape(-1, 3)[:, :2]
    return NO_FEATURES


def read_points(file: Path, observations: bool = False) -> Points:
    """Return the points of points3D.txt, with their tracks if `observations`. Damaged tracks count as none.

    Raises:
        SceneError: a position or a colour is wrong.
    """
    xyz: list[list[float]] = []
    rgb: list[list[int]] = []
    errors: list[float] = []
    tracks: list[NDArray[np.int64]] = []
    for line in _lines(file, 8):
        if len(line.words) < 7:
            line.refuse(POINT)
        xyz.append(line.finite(line.words[1:4], POINT))
        rgb.append(line.whole(line.words[4:7], COLORS))
        if not 0 <= min(rgb[-1]) <= max(rgb[-1]) <= 255:
            line.refuse(COLORS)
        if observations:
            errors.append(_number(line.words[7:8]))
            tracks.append(_track(line.words[8:]))
    positions, colors = (np.array(rows, np.float64).reshape(-1, 3) for rows in (xyz, rgb))
    return Points(positions, colors, errors, tracks)


def _number(words: list[str]) -> float:
    with suppress(ValueError, IndexError):
        return float(words[0])
    return math.nan


def _track(rest: list[str]) -> NDArray[np.int64]:
    with suppress(ValueError, OverflowError):
        return np.array([int(word) for text in rest for word in text.split()], np.int64).reshape(-1, 2)
    return NO_TRACK


def _check_id(line: _Line, key: int, known: Mapping[int, object]) -> None:
    if not 0 <= key <= LARGEST_ID:
        line.refuse(f"an id from 0 to {LARGEST_ID}")
    if key in known:
        line.refuse(f"each id once, {key} was there before")
