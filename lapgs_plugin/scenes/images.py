"""Read, write and resize images. OpenImageIO reads them; Pillow writes PNG and JPEG.

Values are those of the file, scaled to [0, 1] for integer formats: photos stay gamma-encoded, as in every 3DGS
codebase, and EXR stays linear and unbounded. EXIF orientation is ignored, because COLMAP ignores it too.
"""

from __future__ import annotations

import io
import logging
import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenImageIO as oiio
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lapgs_plugin.errors import SceneError, UserInputError, joined
from lapgs_plugin.files import is_file, is_folder, refuse_lfs_pointer, whole_file
from lapgs_plugin.limits import LONGEST_NAME
from lapgs_plugin.scenes.image_files import check_before_decoding, check_size, damaged, reaches_its_end
from lapgs_plugin.untrusted import require_regular

JPEG: dict[str, Any] = {"format": "JPEG", "quality": 95, "subsampling": "4:4:4"}
"""How Pillow writes JPEG files."""
PNG_LEVEL = 4
"""Faster than zlib's default of 6, for slightly larger files."""
Image.MAX_IMAGE_PIXELS = None  # sizes are checked here; Pillow's own limit is below that of phones, and only warns
FLOAT_FORMATS = (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
CUT_SHORT = re.compile("premature end|marker 0xd9 instead", re.IGNORECASE)
"""Complaints of libjpeg about an image that ends early."""
NAMED_DAMAGE = 5
"""Most photos of a folder whose damage is logged, because a camera writes all of its photos alike."""
STRIP_VALUES = 1 << 23
"""Values in a strip of rows. Large images are in memory as floating point one strip at a time."""

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")

logger = logging.getLogger(__name__)

_named: defaultdict[Path, list[Path]] = defaultdict(list)
"""The photos whose complaints were shown, by folder."""


def find_image(path: Path) -> Path:
    """Return an image file, or the only file beside it whose name differs in case, Unicode form or format alone.

    Cameras and operating systems rename photos so. Smaller copies of JPEG files are often PNG files, as gsplat's.
    Without such a file `path` is returned.
    """
    if is_file(path) or not is_folder(path.parent):
        return path
    files = _by_plain_name(path.parent, path.parent.stat().st_mtime_ns)
    alike = files.get(_plain(path.name)) or (files.get(_any_format(path), []) if is_photo(path) else [])
    return alike[0] if len(alike) == 1 else path


@lru_cache(maxsize=8)
def _by_plain_name(folder: Path, changed: int) -> dict[str, list[Path]]:
    """Return the files of a folder by `_plain` name, and photos by `_any_format`. `changed` renews the cache."""
    files: dict[str, list[Path]] = {}
    with suppress(PermissionError):  # opening the image will fail with a message
        for file in filter(is_file, folder.iterdir()):
            files.setdefault(_plain(file.name), []).append(file)
            if is_photo(file):
                files.setdefault(_any_format(file), []).append(file)
    return files


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def is_photo(file: Path) -> bool:
    """Return whether a file's name is that of an image that is read here."""
    return file.suffix.lower() in SUFFIXES


def _any_format(file: Path) -> str:
    return f"{_plain(file.stem)}.*"


def where_else(scene: Path, name: str) -> str:
    """Return advice about a missing image: choose the folder of the scene that has it, or put the photos there."""
    inside = [*sorted(folder.name for folder in scene.iterdir() if is_folder(folder)), "."]
    others = [folder for folder in inside if is_file(find_image(scene / folder / name))]
    return f"choose {' or '.join(others)} with --images" if others else "put the photos there"


def not_there(path: Path) -> str:
    """Return the beginning of the message about a missing image, with the target of a broken link."""
    link = f": it is a link to {path.readlink()}, which is not there" if path.is_symlink() else ""
    return f"{path}: no such image{link}"


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of an image file in pixels, from its header.

    Raises:
        SceneError: the file is missing, no image, or has more pixels than `limits.PHOTO_PIXELS`.
    """
    return _image_plane(path, _open(path))


def has_alpha(path: Path) -> bool:
    """Return whether an image file has an alpha channel.

    Raises:
        SceneError: as `image_size`.
    """
    return _channels(_open(path).spec()).alpha >= 0


def same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether images of these sizes may be copies of each other, whose sides resizing rounded by up to a pixel.

    >>> same_shape((1599, 1066), (3118, 2078)), same_shape((1600, 1200), (3118, 2078))
    (True, False)
    """
    return abs(one[0] / other[0] - one[1] / other[1]) <= 1.0 / other[0] + 1.0 / other[1]


def check_image(path: Path) -> tuple[int, int]:
    """Decode an image file completely, a few rows at a time, and return its width and height in pixels.

    Raises:
        SceneError: as `read_image`.
    """
    source = _open(path, pixels=True)
    size = _image_plane(path, source)
    for _ in _strips(path, source, size, (0.0, 0.0, 0.0)):
        pass
    return size


def read_image(
    path: Path,
    *,
    size: tuple[int, int] | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    clamp: bool = True,
) -> Tensor:
    """Read a JPEG, PNG, TIFF or EXR file of any bit depth as RGB.

    Grey becomes RGB. Channels other than colour and alpha are ignored. Transparent pixels are blended over `background`
    at full size. Large images are resized in strips, to save memory.

    Args:
        path: the file.
        size: (width, height) to resize to; None keeps the file's. The filter overshoots next to strong edges: values
            are clamped to [0, 1] for integer formats and kept for floating-point formats.
        background: RGB behind transparent pixels.
        clamp: False never clamps, for images that are resampled again.

    Returns:
        (3, h, w) float32, contiguous.

    Raises:
        SceneError: the file is missing, no image, cut short, holds NaN or inf, or has more pixels than
            `limits.PHOTO_PIXELS`.
    """
    source = _open(path, pixels=True)
    full_width, full_height = _image_plane(path, source)
    width, height = size or (full_width, full_height)
    if _has_levels(source, (width, height)):
        return _in_unit_range(_read_levels(path, source))
    # The filter is separable: first along the rows of each strip, then along columns.
    narrowed = torch.empty(3, full_height, width)
    for top, strip in _strips(path, source, (full_width, full_height), background):
        rows = slice(top, top + strip.shape[1])
        narrowed[:, rows] = resize_image(strip, (width, strip.shape[1]))
    image = resize_image(narrowed, (width, height))
    if clamp and size is not None and source.spec().format.basetype not in FLOAT_FORMATS:
        image = image.clamp_(0.0, 1.0)
    return image.contiguous()


@dataclass(frozen=True)
class PhotoFile:
    """Read a photo from its file at each call.

    Attributes:
        path: the file.
        size: (width, height) of the result.
        background: RGB behind transparent pixels.
    """

    path: Path
    size: tuple[int, int]
    background: tuple[float, float, float]

    def __call__(self) -> Tensor:
        """Return the photo as `read_image` does."""
        return read_image(self.path, size=self.size, background=self.background)

    @property
    def has_levels(self) -> bool:
        """Whether the file holds opaque 8-bit pixels at this size. Only its header is read.

        Raises:
            SceneError: as `image_size`.
        """
        source = _open(self.path)
        _image_plane(self.path, source)
        return _has_levels(source, self.size)

    def levels(self) -> Tensor:
        """Return the levels k of a photo of k / 255, (3, h, w) uint8 with channels last in memory.

        The file `has_levels`. This takes a quarter of the memory of floats, and less time.

        Raises:
            SceneError: as `read_image`, or the file was replaced by one that has no such levels.
        """
        source = _open(self.path, pixels=True)
        _image_plane(self.path, source)
        if not _has_levels(source, self.size):
            width, height = self.size
            raise SceneError(
                f"{self.path}: the file changed while it was used, expected {width}x{height} opaque pixels of 8 bits; "
                "put the photo back"
            )
        return torch.from_numpy(_read_levels(self.path, source)).permute(2, 0, 1)


def _has_levels(source: oiio.ImageInput, size: tuple[int, int]) -> bool:
    """Return whether an open file holds opaque 8-bit pixels of this (width, height)."""
    spec = source.spec()
    channels = _channels(spec)
    flat = spec.depth <= 1 and not spec.deep and bool(channels.colour)
    return flat and channels.alpha < 0 and spec.format.basetype == oiio.UINT8 and (spec.width, spec.height) == size


def _read_levels(path: Path, source: oiio.ImageInput) -> NDArray[np.uint8]:
    """Read a file that `_has_levels` as RGB, (h, w, 3)."""
    spec = source.spec()
    levels: NDArray[np.uint8] = _read_rows(path, source, 0, spec.height, max(_channels(spec).colour) + 1, oiio.UINT8)
    return levels if levels.shape[2] == 3 else levels.repeat(3, axis=2)


def _in_unit_range(levels: NDArray[np.uint8]) -> Tensor:
    """Return levels k of RGB (h, w, 3) as k / 255, (3, h, w) float32, rounded as OpenImageIO does."""
    image = np.empty((3, *levels.shape[:2]), np.float32)
    for channel in range(3):  # faster than decoding to floats, then moving channels
        np.multiply(levels[..., channel], np.float32(1 / 255), out=image[channel], dtype=np.float32)
    return torch.from_numpy(image)


def read_depth(path: Path, unit: float) -> NDArray[np.float32]:
    """Read the first channel of a depth map, (h, w); floating-point values as they are, integers times `unit`.

    Raises:
        SceneError: the file is missing, no image, a picture in colours, or has more pixels than `limits.PHOTO_PIXELS`.
    """
    source = _open(path, pixels=True)
    _image_plane(path, source)
    spec = source.spec()
    if spec.nchannels > 2 and spec.format.basetype not in FLOAT_FORMATS:
        raise SceneError(f"{path}: a picture in colours, expected a depth map: numbers in one channel")
    values = _read_rows(path, source, 0, spec.height, 1)[:, :, 0]
    if spec.format.basetype in FLOAT_FORMATS:
        return values
    return values * np.float32(unit * (2 ** (8 * spec.format.size()) - 1))  # 1 is the largest integer


def read_as_3dgs(path: Path, size: tuple[int, int], background: tuple[float, float, float] | None) -> Tensor:
    """Read an image as 3DGS codebases do: decoded and resized by Pillow in 8 bits.

    Args:
        path: the file, of a format that Pillow knows.
        size: (width, height) to resize to, with Pillow's default filter (bicubic).
        background: RGB to blend transparent pixels over before resizing, rounded down, as 3DGS does for transforms
            scenes; None ignores alpha, as 3DGS does for COLMAP scenes.

    Returns:
        (3, h, w) float32, k / 255.

    Raises:
        SceneError: the file is missing, no image, cut short, or has more pixels than `limits.PHOTO_PIXELS`.
    """
    image_size(path)  # refuses damaged files with a reason
    why = "Pillow, with which 3DGS codebases read images, cannot read it, expected a whole 8-bit image"
    with open_by_pillow(path, why) as source:
        source.load()
        levels = np.asarray(_resize_8_bits(source, size, background))[..., :3]  # (h, w, 3)
    return torch.from_numpy(levels.transpose(2, 0, 1).copy()) / 255.0


@contextmanager
def open_by_pillow(path: Path, problem: str) -> Iterator[Image.Image]:
    """Open an image, which Pillow decodes in the block.

    Args:
        path: the file.
        problem: of an image that Pillow cannot decode, for the message.

    Raises:
        SceneError: the image is too large, or the block raised an error.
    """
    try:
        with Image.open(path) as image:
            check_size(path, *image.size)
            yield image
    except SceneError:
        raise
    except Exception as error:  # of damaged files decoders raise errors of any type
        reason = joined(str(error) or type(error).__name__)
        raise SceneError(f"{path}: {problem} ({reason}); copy or convert it again") from error


def _resize_8_bits(
    source: Image.Image, size: tuple[int, int], background: tuple[float, float, float] | None
) -> Image.Image:
    """Resize an image as Pillow's `resize` does, after blending it over the background if there is one; RGB or RGBA.

    A large image is converted one strip of rows at a time. Pillow, too, resizes along rows first, then along columns,
    and rounds to 8 bits after each.
    """
    width, step = size[0], max(1, STRIP_VALUES // (4 * source.width))
    tables = None if background is None else _blend_tables(background)
    narrowed: Image.Image | None = None
    for top in range(0, source.height, step):
        strip = source.crop((0, top, source.width, min(top + step, source.height)))
        if strip.mode != "RGB":
            strip = strip.convert("RGBA")
            if tables is not None:
                strip = _blend_8_bits(strip, tables)
            elif source.size != size:
                strip = strip.convert("RGBa")  # Pillow multiplies by alpha while it resizes
        strip = strip.resize((width, strip.height))
        narrowed = narrowed or Image.new(strip.mode, (width, source.height))
        narrowed.paste(strip, (0, top))
    assert narrowed is not None, "an image has at least one row"
    image = narrowed.resize(size)
    return image.convert("RGBA") if image.mode == "RGBa" else image


def _blend_tables(background: tuple[float, float, float]) -> list[NDArray[np.uint8]]:
    """Return by channel its blended values, (256, 256), by alpha and value."""
    steps = np.arange(256) / 255.0
    alpha = steps[:, None]
    return [((steps * alpha + value * (1 - alpha)) * 255.0).astype(np.uint8) for value in background]


def _blend_8_bits(picture: Image.Image, tables: list[NDArray[np.uint8]]) -> Image.Image:
    """Blend RGBA by tables, because float64 arithmetic on a large photo is slow."""
    pixels = np.asarray(picture)  # (h, w, 4)
    return Image.fromarray(np.stack([table[pixels[..., 3], pixels[..., i]] for i, table in enumerate(tables)], axis=-1))


def resize_image(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize with an anti-aliasing bicubic filter (a = -0.5, widened by the factor of reduction).

    This is the filter of 3DGS's loader, in floating point instead of 8 bits. Pixel centres are at half-integer
    coordinates. The filter is cut off at the border and renormalised.

    Args:
        image: (3, h, w) floating point.
        size: (width, height) of the result.

    Returns:
        (3, height, width); may overshoot the range of `image` next to strong edges.
    """
    width, height = size
    if image.shape[1:] == (height, width):
        return image
    # OpenImageIO's resize gives the same values but is much slower.
    return torch.nn.functional.interpolate(image[None], (height, width), mode="bicubic", antialias=True)[0]


def write_image(path: Path, image: Tensor) -> None:
    """Write an image. The file appears only when it is complete.

    Args:
        path: .png or .jpg (8 bits, clamped to [0, 1] and rounded) or .exr (float32, unclamped). Missing folders are
            made.
        image: (3, h, w) RGB.

    Raises:
        UserInputError: another file type.
        LapgsError: the file cannot be written, for example because the disk is full.
    """
    suffix = path.suffix.lower()
    if suffix not in (".png", ".jpg", ".jpeg", ".exr"):
        raise UserInputError(
            f"{path}: cannot write {suffix or 'a file without extension'}, expected .png, .jpg or .exr"
        )
    with whole_file(path, "image") as unfinished:
        if suffix == ".exr":
            _write_exr(unfinished, image.detach().to("cpu", torch.float32).permute(1, 2, 0).contiguous().numpy())
        else:
            unfinished.write_bytes(encode_image(image, suffix))


def encode_image(image: Tensor, suffix: str) -> bytes:
    """Encode an image (3, h, w) in 8 bits, clamped to [0, 1] and rounded, as .png or .jpg.

    Pillow does it in memory: on a full disk OpenImageIO's JPEG writer aborts the process and its PNG writer reports
    success.
    """
    levels = as_bytes(image.detach().float().clamp(0.0, 1.0))
    encoded = io.BytesIO()
    if suffix == ".png":
        Image.fromarray(levels).save(encoded, "PNG", compress_level=PNG_LEVEL)
    else:
        Image.fromarray(levels).save(encoded, **JPEG)
    return encoded.getvalue()


def as_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Convert an image (3, h, w) in [0, 1] to (h, w, 3) pixels of 8 bits."""
    planes = image.mul(255.0).add_(0.5).to(torch.uint8)
    # Stacking planes is faster than copying a permuted image, which jumps between planes for each byte.
    return np.asarray(torch.stack(planes.unbind(0), dim=-1).cpu().numpy())


def _write_exr(path: Path, pixels: NDArray[np.float32]) -> None:
    """Write (h, w, 3) pixels as float32.

    Raises:
        OSError: the file cannot be written.
    """
    target = oiio.ImageOutput.create(str(path))
    if target is None:
        raise OSError(oiio.geterror())
    height, width, channels = pixels.shape
    written = target.open(str(path), oiio.ImageSpec(width, height, channels, oiio.FLOAT)) and target.write_image(pixels)
    complaint = target.geterror()
    if not (target.close() and written):
        raise OSError(complaint or target.geterror())


def require_readable(path: Path) -> None:
    """Raise a SceneError if this user has no permission to read a file."""
    if not os.access(path, os.R_OK):
        raise SceneError(f"{path}: no permission to read it; give this user the permission, or copy the file")


def _open(path: Path, pixels: bool = False) -> oiio.ImageInput:
    """Open an image file for its header, or also for its pixels."""
    if (length := len(path.name.encode(errors="surrogatepass"))) > LONGEST_NAME:
        raise SceneError(
            f"{path.parent}: the name of image {path.name[:32]}... has {length} bytes, expected at most "
            f"{LONGEST_NAME}; rename the photo and reconstruct or export again"
        )
    try:
        require_regular(path)
    except (FileNotFoundError, ValueError):  # ValueError: no file can have such a name
        raise SceneError(f"{not_there(path)}; put it there") from None
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}; expected an image file, replace it") from error
    if str(path).encode(errors="replace").decode() != str(path):
        raise SceneError(f"{path}: its name is not UTF-8; rename it and reconstruct or export again")
    require_readable(path)
    check_before_decoding(path, whole=pixels)
    options = oiio.ImageSpec()
    # Without it, 8-bit colour is multiplied by alpha in 8 bits, which loses precision where alpha is small.
    options.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), options)
    if source is None:
        reason = joined(oiio.geterror())
        refuse_lfs_pointer(path, SceneError)
        raise SceneError(f"{path}: not a readable image ({reason}), expected JPEG, PNG, TIFF or EXR; replace the file")
    return source


def _image_plane(path: Path, source: oiio.ImageInput) -> tuple[int, int]:
    """Return width and height of the image, after checking the limits.

    An EXR may store only a window of its image. Offsets in TIFF and PNG are page layout and are ignored.
    """
    spec = source.spec()
    stored = (spec.width, spec.height)
    whole = (spec.full_width, spec.full_height) if source.format_name() == "openexr" else stored
    for width, height in (stored, whole):
        check_size(path, width, height)
    return whole


def _strips(
    path: Path, source: oiio.ImageInput, size: tuple[int, int], background: tuple[float, float, float]
) -> Iterator[tuple[int, Tensor]]:
    """Yield an image from top to bottom: the first row of each strip of rows, and its RGB (3, rows, width).

    Pixels of an EXR that are not stored are zero and transparent.
    """
    spec = source.spec()
    width, height = size
    windowed = source.format_name() == "openexr"
    left, top = (spec.x - spec.full_x, spec.y - spec.full_y) if windowed else (0, 0)
    channels = _channels(spec)
    if not channels.colour or spec.depth > 1 or spec.deep:
        problem = "is a volume" if spec.depth > 1 or spec.deep else "has no colours"
        raise SceneError(f"{path}: the image {problem}, expected grey or RGB pixels; render or export it again")
    count = max(*channels.colour, channels.alpha) + 1
    step = max(1, STRIP_VALUES // (count * max(width, spec.width)))
    step = -(-step // spec.tile_height) * spec.tile_height if spec.tile_width else step
    columns = slice(max(left, 0), max(min(left + spec.width, width), 0))
    is_float = spec.format.basetype in FLOAT_FORMATS

    def strip(first: int, last: int, stored: NDArray[np.float32] | None) -> tuple[int, Tensor]:
        if stored is None or left or spec.width != width:
            pixels = np.zeros((last - first, width, count), np.float32)
            if stored is not None:
                pixels[:, columns] = stored[:, columns.start - left : columns.stop - left]
            stored = pixels
        image = torch.from_numpy(_blend(stored, channels, background)).permute(2, 0, 1)
        if is_float and not bool(torch.isfinite(image).all()):
            raise SceneError(f"{path}: the image holds NaN or inf, expected finite values; render or export it again")
        return first, image

    for first in range(0, min(top, height), step):
        yield strip(first, min(first + step, top, height), None)
    for row in range(0, spec.height, step):
        first, last = max(row + top, 0), min(row + step + top, spec.height + top, height)
        if first < last:
            pixels = _read_rows(path, source, row, min(row + step, spec.height), count)
            yield strip(first, last, pixels[first - top - row : last - top - row])
    for first in range(max(spec.height + top, 0), height, step):
        yield strip(first, min(first + step, height), None)


def _read_rows(
    path: Path, source: oiio.ImageInput, first: int, last: int, channels: int, kind: oiio.BASETYPE = oiio.FLOAT
) -> NDArray[Any]:
    """Read rows of the file with its first channels as numbers of a kind, (last - first, width, channels)."""
    spec = source.spec()
    rows = (spec.y + first, spec.y + last)
    if spec.tile_width:
        window = (spec.x, spec.x + spec.width, *rows, spec.z, spec.z + max(1, spec.depth))
        pixels = source.read_tiles(*window, 0, channels, kind)
    else:
        pixels = source.read_scanlines(*rows, spec.z, 0, channels, kind)
    complaint = source.geterror()
    if pixels is None or (complaint and source.format_name() != "jpeg"):
        raise damaged(path, joined(complaint))
    if complaint:
        _refuse_cut_jpeg(path, joined(complaint))
    read: NDArray[Any] = pixels.reshape(last - first, spec.width, channels)
    return read


def _refuse_cut_jpeg(path: Path, complaint: str) -> None:
    """Refuse a JPEG that ends early, whose rest decoders make grey; log complaints about other damage.

    Only the decoder's first complaint is known. It may be about harmless bytes between segments.
    """
    if CUT_SHORT.search(complaint):
        raise damaged(path, complaint)
    if not reaches_its_end(path):
        raise damaged(path, "it has no end")
    if "extraneous bytes" not in complaint:
        _log_once(path, complaint)


def _log_once(path: Path, complaint: str) -> None:
    """Log a complaint about a photo, which may be read several times, unless enough of its folder's are named."""
    named = _named[path.parent]
    if path in named or len(named) >= NAMED_DAMAGE:
        return
    named.append(path)
    more = "; more photos of this folder are not named" if len(named) == NAMED_DAMAGE else ""
    logger.warning("%s: parts of the photo may be wrong (%s); copy it again if they are%s", path, complaint, more)


class _Channels(NamedTuple):
    """Indices of an image's channels.

    Attributes:
        colour: of red, green and blue.
        alpha: of alpha; -1 for none.
        straight: whether colour is not premultiplied by alpha.
    """

    colour: list[int]
    alpha: int
    straight: bool


def _channels(spec: oiio.ImageSpec) -> _Channels:
    alpha, straight = spec.alpha_channel, bool(spec.get_int_attribute("oiio:UnassociatedAlpha"))
    if alpha >= spec.nchannels:  # OpenImageIO's GIF reader counts from one, and leaves out that colour is straight
        alpha, straight = spec.channelindex("A"), True
    colour = [channel for channel in range(spec.nchannels) if channel != alpha][:3]
    return _Channels(colour if len(colour) == 3 else colour[:1] * 3, alpha, straight)


def _blend(
    pixels: NDArray[np.float32], channels: _Channels, background: tuple[float, float, float]
) -> NDArray[np.float32]:
    """Blend (h, w, channels) over the background to RGB (h, w, 3)."""
    colour = pixels[..., channels.colour]
    if channels.alpha < 0:
        return colour
    alpha = pixels[..., channels.alpha, None]
    if channels.straight:
        colour = colour * alpha
    return colour + (1.0 - alpha) * np.asarray(background, np.float32)
