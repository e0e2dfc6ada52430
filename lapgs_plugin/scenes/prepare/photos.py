"""Find photos, convert those that COLMAP does not read, and identify their cameras by EXIF."""

from __future__ import annotations

import io
import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags, Image

from lapgs_plugin.errors import SceneError, counted, printable, require_extra
from lapgs_plugin.files import whole_file
from lapgs_plugin.scenes.images import JPEG, open_by_pillow
from lapgs_plugin.scenes.masks import HEIC, has_photo_suffix

SHOWN = 10
"""File names in a message, at most."""
HEADER_BYTES = 1 << 17
"""Beginning of a photo in which its metadata are."""
CONVERTED = (*HEIC, ".webp")
"""Photos that pycolmap does not read."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Photos:
    """Name the files to make a scene from.

    Attributes:
        folder: of the files.
        files: by the name that COLMAP gets, sorted: relative to the folder; of HEIC and WebP photos that of their JPEG.
        clip: the video, if frames are to be picked from one; `files` is empty then.
        converted: names of the photos that COLMAP does not read.
    """

    folder: Path
    files: dict[str, Path]
    clip: Path | None = None
    converted: tuple[str, ...] = ()

    @property
    def needs_copies(self) -> bool:
        """Whether COLMAP cannot read the files where they are."""
        return self.clip is not None or bool(self.converted)


def find_photos(source: Path, masks: Path | None = None) -> Photos:
    """Return the photos in a folder and below, or the video. Hidden files and a folder of masks are left out.

    Raises:
        SceneError: there are fewer than two photos, or two would have the same name after undistortion.
        MissingExtraError: there are HEIC photos, and pillow-heif is not installed.
    """
    if source.is_file() and has_photo_suffix(source):
        raise SceneError(
            f"{source}: one photo, expected a folder of at least 2, better 30, or a video; give the folder"
        )
    if source.is_file():
        return Photos(source.parent, {}, source)
    if not source.is_dir():
        problem = "a pipe, socket or device" if source.exists() else "no such folder of photos or video"
        raise SceneError(f"{source}: {problem}; give a folder of photos, or a video")
    aside = None if masks is None or masks.resolve() == source.resolve() else masks.resolve()
    entries = sorted(
        entry
        for entry in source.rglob("*")
        if not entry.is_dir() and not any(part.startswith(".") for part in entry.relative_to(source).parts)
    )
    present = [file for file in entries if file.is_file() and not (aside and file.resolve().is_relative_to(aside))]
    if unreadable := [entry.name for entry in entries if has_photo_suffix(entry) and not entry.is_file()]:
        logger.warning("links that lead nowhere, pipes or devices, left out: %s", listed(unreadable))
    chosen = [file for file in present if has_photo_suffix(file)]
    if heic := [file.name for file in chosen if _kind(file) in HEIC]:
        subject = f"{source}: reading {counted(len(heic), 'HEIC photo')} ({listed(heic)})"
        require_extra("pillow_heif", "heic", subject, "convert them to JPEG")
    others = sorted({file.suffix.lower() or file.name for file in present if not has_photo_suffix(file)})
    if len(chosen) < 2:
        more = f" (and files of type {', '.join(others)})" if others else ""
        raise SceneError(
            f"{source}: {counted(len(chosen), 'photo')}{more}, expected at least 2, better 30, as "
            "JPEG, PNG, TIFF, BMP, WebP or HEIC; of a video give the file itself"
        )
    if others:
        left = [file.name for file in present if not has_photo_suffix(file)]
        logger.warning("not photos, left out: %s", listed(left))
    converted = {file for file in chosen if _kind(file) in CONVERTED}
    originals = [file.relative_to(source) for file in chosen]
    names = [
        (original.with_suffix(".jpg") if file in converted else original).as_posix()
        for original, file in zip(originals, chosen, strict=True)
    ]
    check_targets(source, list(zip(names, originals, strict=True)))
    files = dict(sorted(zip(names, chosen, strict=True)))
    return Photos(source, files, converted=tuple(name for name, file in files.items() if file in converted))


def check_targets(source: Path, photos: Sequence[tuple[str, str | Path]]) -> None:
    """Raise a SceneError if two photos, (name, original file name), would have the same name in the scene."""
    by_target: dict[str, str | Path] = {}
    for name, file in photos:
        if (other := by_target.setdefault(target_name(name), file)) != file:
            raise SceneError(f"{source}: {other} and {file} would both become {target_name(name)}; rename one of them")


def _kind(photo: Path) -> str:
    """Return the file type of a photo in lower case; phones and browsers name HEIC and WebP photos .jpg, too."""
    with suppress(OSError), photo.open("rb") as stream:  # reading the photo will fail with a message
        start = stream.read(12)
        if start[4:8] == b"ftyp":
            return HEIC[0]
        if start[:4] == b"RIFF" and start[8:] == b"WEBP":
            return ".webp"
    return photo.suffix.lower()


def target_name(name: str) -> str:
    """Return the name of the undistorted image: JPEG and EXR stay, all else becomes PNG."""
    path = Path(name)
    return name if path.suffix.lower() in (".jpg", ".jpeg", ".exr") else path.with_suffix(".png").as_posix()


def listed(names: list[str]) -> str:
    """Return names for a message, the first few of many."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return printable(", ".join(names[:SHOWN])) + more


def convert_photo(source: Path, target: Path) -> None:
    """Write a HEIC or WebP photo as JPEG, HEIC upright, with its EXIF data, which hold the focal length.

    Raises:
        SceneError: it cannot be decoded, or is a WebP file with transparent pixels, which JPEG cannot keep.
    """
    if _kind(source) in HEIC:
        import pillow_heif

        pillow_heif.register_heif_opener()
    encoded = io.BytesIO()
    with open_by_pillow(source, "the photo cannot be decoded") as photo:
        if photo.format == "WEBP" and photo.has_transparency_data:
            raise SceneError(f"{source}: a WebP photo with transparency, expected none in WebP; convert it to PNG")
        exif = photo.getexif()  # pillow-heif turns the pixels, and resets the orientation
        photo.convert("RGB").save(encoded, **JPEG, exif=exif)
    with whole_file(target, "photo") as unfinished:
        unfinished.write_bytes(encoded.getbuffer())


def camera_of(photo: Path) -> tuple[str, ...]:
    """Return maker, model and focal lengths by EXIF, empty where a photo has none."""
    with suppress(Exception), Image.open(photo) as opened:  # other software reads the photo; EXIF only helps
        exif = opened.getexif()
        inner, tags = exif.get_ifd(ExifTags.IFD.Exif), ExifTags.Base
        values = [exif.get(tag) for tag in (tags.Make, tags.Model)]
        values += [inner.get(tag) for tag in (tags.FocalLength, tags.FocalLengthIn35mmFilm)]
        return tuple("" if value is None else str(value).strip("\0 ") for value in values)
    return ("",) * 4


def says_all_around(photo: Path) -> bool:
    """Return whether a photo says in its XMP data (GPano) that it is equirectangular."""
    with suppress(OSError), photo.open("rb") as stream:  # reading the photo will fail with a message
        return b"equirectangular" in (start := stream.read(HEADER_BYTES)) and b"ProjectionType" in start
    return False


def quarter_turns(photo: Path) -> int | None:
    """Return the quarter turns clockwise that make a photo upright by EXIF; None without EXIF or if it is mirrored."""
    with suppress(Exception), Image.open(photo) as opened:  # as above
        return {1: 0, 6: 1, 3: 2, 8: 3}.get(opened.getexif().get(ExifTags.Base.Orientation, 0))
    return None
