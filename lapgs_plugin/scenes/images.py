"""Images in and out, and their resizing. OpenImageIO reads; Pillow encodes what has 8 bits.

Pixel values are used as the file codes them, scaled to [0, 1] for integer formats: photos stay gamma-encoded, as in
every 3DGS codebase, and EXR stays linear and unbounded. Pixels keep the order in which the file stores them: an EXIF
orientation is ignored, because COLMAP ignores it when it makes the cameras.
"""

from __future__ import annotations

import io
import os
from contextlib import suppress
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lapgs_plugin.errors import LapgsError, SceneError, UserInputError

JPEG_QUALITY = 95
PNG_LEVEL = 4
"""2.5 times as fast as zlib's default of 6, for files 4 % larger (fox, 1062x1894)."""
FLOAT_FORMATS = (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file in pixels, from its header.

    Raises:
        SceneError: the file is missing or no image.
    """
    source = _open(path)
    spec = source.spec()
    return (spec.full_width, spec.full_height) if _has_display_window(source) else (spec.width, spec.height)


def read_image(
    path: Path, *, size: tuple[int, int] | None = None, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Tensor:
    """Read a JPEG, PNG, TIFF or EXR file of any bit depth as RGB.

    Grey becomes RGB, channels beyond colour and alpha are ignored, alpha is blended over `background` at full size.

    Args:
        path: the file.
        size: (width, height) to resize to; None keeps the file's. The filter's overshoot next to strong edges is
            clamped to [0, 1] for integer formats and kept for floating-point ones.
        background: RGB that shows through transparent pixels.

    Returns:
        (3, h, w) float32, contiguous.

    Raises:
        SceneError: the file is missing, no image, cut short, or holds NaN or inf.
    """
    source = _open(path)
    spec = source.spec()
    pixels = source.read_image(oiio.FLOAT)  # (h, w, channels)
    # A JPEG that ends early is decoded into grey and reported only by the message left behind.
    complaint = source.geterror()
    if pixels is None or complaint:
        raise SceneError(
            f"{path}: the image is damaged or cut short ({_one_line(complaint)}), expected a whole file; copy it again"
        )
    if _has_display_window(source):
        pixels = _in_display_window(pixels, spec)
    image = torch.from_numpy(_blend(pixels, spec, background)).permute(2, 0, 1)
    is_float = spec.format.basetype in FLOAT_FORMATS
    if is_float and not bool(torch.isfinite(image).all()):
        raise SceneError(f"{path}: the image holds NaN or inf, expected finite values; render or export it again")
    if size is not None:
        image = resize_image(image, size)
        image = image if is_float else image.clamp(0.0, 1.0)
    return image.contiguous()


def read_as_3dgs(path: Path, size: tuple[int, int], background: tuple[float, float, float] | None) -> Tensor:
    """Read an image as the loaders of 3DGS codebases do: with Pillow, resized by it in 8 bits.

    Args:
        path: the file, of a format that Pillow knows.
        size: (width, height) to resize to, with Pillow's default filter (bicubic).
        background: RGB to blend transparent pixels over, before resizing and rounded down, as these loaders do with
            transforms scenes; None leaves alpha out, as they do with COLMAP scenes.

    Returns:
        (3, h, w) float32, k / 255.

    Raises:
        SceneError: the file is missing, no image, or cut short.
    """
    try:
        with Image.open(path) as source:
            picture: Image.Image = source if source.mode in ("RGB", "RGBA") else source.convert("RGBA")
            if background is not None:
                picture = _blend_8_bits(picture, background)
            levels = np.asarray(picture.resize(size))[..., :3]  # (h, w, 3)
    except FileNotFoundError as error:
        raise SceneError(f"{path}: no such image; put it there or choose another folder with --images") from error
    except (OSError, SyntaxError, ValueError) as error:  # what Pillow's decoders raise
        raise SceneError(
            f"{path}: Pillow, which 3DGS codebases read images with, cannot read it ({_one_line(str(error))}); "
            "expected a whole 8-bit image, copy or convert it again"
        ) from error
    return torch.from_numpy(levels.transpose(2, 0, 1).copy()) / 255.0


def _blend_8_bits(picture: Image.Image, background: tuple[float, float, float]) -> Image.Image:
    values = np.asarray(picture.convert("RGBA")) / 255.0  # (h, w, 4) float64
    colour, alpha = values[..., :3], values[..., 3:]
    return Image.fromarray(((colour * alpha + np.asarray(background) * (1 - alpha)) * 255.0).astype(np.uint8))


def resize_image(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize with an anti-aliasing bicubic filter (a = -0.5, widened by the factor of reduction).

    This is the filter of 3DGS's own loader, in floating point instead of 8 bits. Both images cover the same image
    plane: centres lie at half-integer coordinates, and outside the border the filter is cut off and renormalised.

    Args:
        image: (3, h, w) floating point.
        size: (width, height) of the result.

    Returns:
        (3, height, width); may overshoot the range of `image` next to strong edges.
    """
    width, height = size
    if image.shape[1:] == (height, width):
        return image
    # OpenImageIO's own resize agrees to 5e-6 away from the border but takes 25 times as long.
    return torch.nn.functional.interpolate(image[None], (height, width), mode="bicubic", antialias=True)[0]


def write_image(path: Path, image: Tensor) -> None:
    """Write an image; the file appears under its name only when it is complete.

    Args:
        path: .png or .jpg (8 bits, values clamped to [0, 1] and rounded) or .exr (float32, values as they are).
            Missing folders are made.
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
    pixels = image.detach().to("cpu", torch.float32).permute(1, 2, 0)  # (h, w, 3)
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.unfinished{suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if suffix == ".exr":
            _write_exr(unfinished, pixels.contiguous().numpy())
        else:
            levels = (pixels.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8)
            unfinished.write_bytes(_encode_8_bits(levels.contiguous().numpy(), suffix))
        unfinished.replace(path)
    except OSError as error:
        raise LapgsError(
            f"{path}: the image cannot be written ({_one_line(str(error))}); check free space and permissions"
        ) from error
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


def _encode_8_bits(levels: NDArray[np.uint8], suffix: str) -> bytes:
    """A PNG or JPEG file of (h, w, 3) pixels.

    Encoded in memory by Pillow: on a full disk OpenImageIO's JPEG writer ends the process and its PNG writer reports
    success.
    """
    encoded = io.BytesIO()
    if suffix == ".png":
        Image.fromarray(levels).save(encoded, "PNG", compress_level=PNG_LEVEL)
    else:
        Image.fromarray(levels).save(encoded, "JPEG", quality=JPEG_QUALITY, subsampling="4:4:4")
    return encoded.getvalue()


def _write_exr(path: Path, pixels: NDArray[np.float32]) -> None:
    """Write (h, w, 3) pixels as they are; OSError with the writer's reason."""
    target = oiio.ImageOutput.create(str(path))
    if target is None:
        raise OSError(oiio.geterror())
    height, width, channels = pixels.shape
    written = target.open(str(path), oiio.ImageSpec(width, height, channels, oiio.FLOAT)) and target.write_image(pixels)
    complaint = target.geterror()
    if not (target.close() and written):
        raise OSError(complaint or target.geterror())


def _open(path: Path) -> oiio.ImageInput:
    if not path.is_file():
        raise SceneError(f"{path}: no such image; put it there or choose another folder with --images")
    options = oiio.ImageSpec()
    # Otherwise 8-bit colour is multiplied by alpha in 8 bits, which loses up to 5 levels where alpha is small.
    options.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), options)
    if source is None:
        reason = _one_line(oiio.geterror())
        raise SceneError(f"{path}: not a readable image ({reason}), expected JPEG, PNG, TIFF or EXR; replace the file")
    return source


def _has_display_window(source: oiio.ImageInput) -> bool:
    """Whether the pixels may cover only a part of the image; TIFF and PNG offsets are page layout, no such thing."""
    return bool(source.format_name() == "openexr")


def _in_display_window(pixels: NDArray[np.float32], spec: oiio.ImageSpec) -> NDArray[np.float32]:
    """The whole image (full_height, full_width, c) from the part that the file stores; zero (transparent) elsewhere."""
    left, top = spec.x - spec.full_x, spec.y - spec.full_y
    if (left, top, spec.width, spec.height) == (0, 0, spec.full_width, spec.full_height):
        return pixels
    whole = np.zeros((spec.full_height, spec.full_width, pixels.shape[2]), np.float32)
    rows = slice(max(top, 0), max(min(top + spec.height, spec.full_height), 0))
    columns = slice(max(left, 0), max(min(left + spec.width, spec.full_width), 0))
    whole[rows, columns] = pixels[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
    return whole


def _blend(
    pixels: NDArray[np.float32], spec: oiio.ImageSpec, background: tuple[float, float, float]
) -> NDArray[np.float32]:
    """RGB (h, w, 3) over the background from (h, w, channels)."""
    colour_channels = [channel for channel in range(spec.nchannels) if channel != spec.alpha_channel][:3]
    if len(colour_channels) < 3:
        colour_channels = colour_channels[:1] * 3
    colour = pixels[..., colour_channels]
    if spec.alpha_channel < 0:
        return colour
    alpha = pixels[..., spec.alpha_channel, None]
    if spec.get_int_attribute("oiio:UnassociatedAlpha"):
        colour = colour * alpha
    return colour + (1.0 - alpha) * np.asarray(background, np.float32)


def _one_line(text: str) -> str:
    return "; ".join(line.strip() for line in text.splitlines() if line.strip()) or "no reason given"
