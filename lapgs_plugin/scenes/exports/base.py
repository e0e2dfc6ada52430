"""Describe exports of other programs: posed photos with COLMAP's lenses, and points; what their readers share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np
import pycolmap
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError, counted
from lapgs_plugin.files import is_file, is_folder
from lapgs_plugin.scenes.colmap_records import file_name
from lapgs_plugin.scenes.exports.fourth_term import rational_terms
from lapgs_plugin.scenes.images import find_image, image_size, is_photo
from lapgs_plugin.scenes.masks import has_photo_suffix
from lapgs_plugin.scenes.point_cloud import PointCloud
from lapgs_plugin.scenes.source import LARGEST
from lapgs_plugin.untrusted import shortened

Array = NDArray[np.float64]

PHOTO_FOLDERS = ("images", "input", ".")
"""Where the photos of an export are looked for."""
NO_PHOTOS = ("masks", "depth", "normals")
"""Folders of images that are named as photos are."""
HEAD_CHARACTERS = 4096
"""Beginning of a file by which it is recognised."""
NOT_RIGID = 1e-3
"""Largest error of a rotation matrix; files round to a few digits."""
OPENGL = np.diag([1.0, -1.0, -1.0])
"""From axes of OpenGL (x right, y up, z backwards) to those of COLMAP (x right, y down, z forward), and back."""
INEXACT = 0.1
"""Largest error in pixels of a lens that COLMAP has no model for."""
LARGEST_CORNER = 1e3
"""Largest diagonal of a perspective image, in focal lengths, whose distortion is fitted."""
ALL_AROUND_LENSES = ("spherical", "equirectangular")
EXPORT_AGAIN = "export it again"


@dataclass(frozen=True, eq=False)
class Shot:
    """A posed photo.

    Attributes:
        photo: its file, which may be missing.
        camera: size in pixels and lens; its id is ignored. The centre of the first pixel is (0.5, 0.5).
        world_to_camera: (4, 4) rigid, camera axes x right, y down, z forward.
    """

    photo: Path
    camera: pycolmap.Camera
    world_to_camera: Array  # (4, 4)


@dataclass(frozen=True, eq=False)
class Export:
    """What another program exported.

    Attributes:
        source: file or folder that says the cameras.
        shots: at least one, in any order.
        points: in the world of the cameras, to start training from; None starts from random ones.
        warnings: lines for the user.
    """

    source: Path
    shots: tuple[Shot, ...]
    points: PointCloud | None = None
    warnings: tuple[str, ...] = ()


class SceneReader(ABC):
    """Read the exports of one program. Instances are created without arguments.

    Attributes:
        title: of such an export, for messages.
    """

    title: ClassVar[str]

    @abstractmethod
    def find(self, folder: Path) -> Path | None:
        """Return the file or folder of the cameras in a scene folder; None if it holds no export of this program.

        Decide by names and beginnings of files: every folder without a model of COLMAP is asked.

        Raises:
            SceneError: there are several.
        """

    @abstractmethod
    def read(self, source: Path, photos: PhotoFinder) -> Export:
        """Read the cameras and points.

        Args:
            source: from `find`.
            photos: finds photos by the names in the export.

        Raises:
            SceneError: it is damaged, or says something that is unknown here.
        """


class PhotoFinder:
    """Find the photos of an export by the names that it has for them.

    Args:
        root: folder of the scene, or of the photos.
        images: folder of smaller copies in `root`; "images" also looks beside it.
    """

    def __init__(self, root: Path, images: str = PHOTO_FOLDERS[0]) -> None:
        folders = PHOTO_FOLDERS if images == PHOTO_FOLDERS[0] else (images,)
        self._root = root
        self._folders = [root / folder for folder in folders if is_folder(root / folder)] or [root]

    def __call__(self, name: str) -> Path:
        """Return the file of a photo, or where it should be.

        Args:
            name: with or without suffix and folders, which may be those of another machine.
        """
        written = PurePosixPath(file_name(name))
        parts = [part for part in written.parts if part not in ("/", "..")]
        for folder in self._folders if parts else ():  # exports may have photos without a name
            for place in (folder.joinpath(*parts), folder / written.name):
                if is_file(file := self._spelled(place)):
                    return file
        named = (self._stem(written.name), self._stem(written.stem))  # raw photos are exported as JPEG
        below = next((files for name in named if (files := self._below.get(name))), [])
        return below[0] if len(below) == 1 else self._folders[0].joinpath(*parts)

    def _spelled(self, place: Path) -> Path:
        return find_image(place if is_photo(place) else place.with_name(f"{place.name}.jpg"))

    @cached_property
    def _below(self) -> Mapping[str, list[Path]]:
        """Photos in other folders, such as those of a memory card, by their names without suffix."""
        files: dict[str, list[Path]] = {}
        for file in sorted(self._root.rglob("*")):
            if has_photo_suffix(file) and is_file(file) and file.relative_to(self._root).parts[0] not in NO_PHOTOS:
                files.setdefault(self._stem(file.name), []).append(file)
        return files

    @staticmethod
    def _stem(name: str) -> str:
        return (Path(name).stem if is_photo(Path(name)) else name).casefold()


def only_file(folder: Path, suffix: str, begins: Callable[[str], bool], title: str) -> Path | None:
    """Return the only file of a folder with this suffix whose beginning is recognised.

    Raises:
        SceneError: there are several.
    """
    files = [file for file in sorted(folder.glob("*")) if file.suffix.lower() == suffix and is_file(file)]
    known = [file for file in files if begins(_head(file))]
    if len(known) > 1:
        raise SceneError(
            f"{folder}: {known[0].name} and {known[1].name} are both {title}, expected one; move the other elsewhere"
        )
    return known[0] if known else None


def _head(file: Path) -> str:
    try:
        with file.open("rb") as stream:
            return stream.read(HEAD_CHARACTERS).decode("utf-8-sig", errors="replace")
    except OSError:
        return ""


def numbers(text: Any, count: int, where: str) -> Array:
    """Return numbers of a text, separated by spaces, or of a list.

    Raises:
        SceneError: there are not `count`, or one is NaN or too large.
    """
    values: Array = np.empty(0)
    with suppress(TypeError, ValueError, OverflowError):
        values = np.array(text.split() if isinstance(text, str) else text, np.float64)
    if values.shape != (count,) or not (np.abs(values) <= LARGEST).all():
        wanted = "a finite number" if count == 1 else f"{count} finite numbers"
        raise SceneError(f"{where} is {shortened(text)}, expected {wanted}; {EXPORT_AGAIN}")
    return values


def number(value: Any, where: str) -> float:
    """Return one number of text or JSON; errors as of `numbers`."""
    return float(numbers(value if isinstance(value, str | list | dict | None) else [value], 1, where)[0])


def size_of(width: Any, height: Any, where: str) -> tuple[int, int]:
    """Return a width and a height in pixels, which have to be whole numbers; errors as of `numbers`."""
    sides = number(width, f"{where}: width"), number(height, f"{where}: height")
    if min(sides) < 1 or any(side % 1 for side in sides):
        raise SceneError(f"{where}: {sides[0]:g}x{sides[1]:g}, expected whole numbers of pixels; {EXPORT_AGAIN}")
    return int(sides[0]), int(sides[1])


def from_world(turn: Array, position: Array, where: str) -> Array:
    """Return world to camera (4, 4) from a camera's axes and position in the world.

    Args:
        turn: (3, 3) camera to world, of COLMAP's axes.
        position: (3,) of the camera.
        where: begins a message.

    Raises:
        SceneError: `turn` is no rotation.
    """
    u, _, vt = np.linalg.svd(turn)
    rigid = u @ vt
    if np.abs(rigid - turn).max() > NOT_RIGID or np.linalg.det(rigid) < 0:
        raise SceneError(f"{where} has a matrix that is no rotation; {EXPORT_AGAIN}")
    result: Array = np.eye(4)
    result[:3, :3], result[:3, 3] = rigid.T, -rigid.T @ position
    return result


def perspective(
    size: tuple[int, int],
    focal: tuple[float, float],
    center: tuple[float, float],
    radial: Sequence[float] = (),
    tangential: tuple[float, float] = (0.0, 0.0),
    *,
    where: str,
) -> pycolmap.Camera:
    """Return a lens with Brown's distortion, as OpenCV writes it.

    Args:
        size: width and height in pixels.
        focal: fx and fy in pixels.
        center: cx and cy in pixels from the corner of the image.
        radial: up to four factors k1, k2, ... of the second, fourth, ... power of the radius.
        tangential: OpenCV's p1 and p2.
        where: begins a message.

    Raises:
        SceneError: the polynomial has a fourth factor and cannot be expressed by a lens of COLMAP, or it has one and
            the focal lengths are not positive pixels.
    """
    if not any((*radial, *tangential)):
        return lens("PINHOLE", size, [*focal, *center])
    k1, k2, k3, *others = (*radial, *(0.0,) * (6 - len(radial)))
    if others[0]:
        diagonal = float(np.hypot(*size))
        if not min(focal) > diagonal / LARGEST_CORNER:
            raise SceneError(
                f"{where} has the focal lengths {focal[0]:g} and {focal[1]:g}, expected positive numbers of pixels; "
                f"{EXPORT_AGAIN}"
            )
        terms, error = rational_terms((k1, k2, k3, others[0]), diagonal / (2.0 * min(focal)))
        if not error * max(focal) <= INEXACT:
            raise SceneError(
                f"{where} has the distortion k4 = {others[0]:g}, which COLMAP's lenses cannot express within {INEXACT} "
                "pixels; align again without k4, or export undistorted photos with their cameras"
            )
        k1, k2, k3, *others = terms.tolist()
    return lens("FULL_OPENCV", size, [*focal, *center, k1, k2, *tangential, k3, *others])


def lens(model: str, size: tuple[int, int], params: Sequence[float]) -> pycolmap.Camera:
    """Return a lens of COLMAP's model of this name."""
    return pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(params))


def unknown_lens(where: str, kind: object, known: Sequence[str]) -> SceneError:
    """Return the error for a lens model that is not known here."""
    return SceneError(
        f"{where} has the lens model {shortened(kind)}, expected {', '.join(known)}; undistort the photos in the "
        "program that wrote it, and export these with their pinhole cameras"
    )


def skipped(source: Path, reasons: Mapping[str, int], total: int) -> tuple[str, ...]:
    """Return a warning about photos without a pose: how many of all, by reason."""
    named = [f"{count} {reason}" for reason, count in reasons.items() if count]
    return (f"{source}: of {counted(total, 'photo')} {', '.join(named)}: left out",) if named else ()


def sizes_of(source: Path, photos: Sequence[Path]) -> dict[Path, tuple[int, int]]:
    """Return width and height of each photo of an export that does not say them; of missing ones those of another.

    Raises:
        SceneError: all are missing.
    """
    known = {photo: image_size(photo) for photo in photos if is_file(photo)}
    if not known:
        raise SceneError(
            f"{photos[0]}: no such image, nor any other of the {len(photos)} of {source}, which does not say their "
            "sizes; put the photos there"
        )
    first = next(iter(known.values()))
    return {photo: known.get(photo, first) for photo in photos}
