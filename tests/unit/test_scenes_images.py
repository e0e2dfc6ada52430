"""Reading, writing and resizing images against OpenCV, Pillow and closed forms."""

from __future__ import annotations

import io
import os
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lapgs_plugin.errors import LapgsError, SceneError, UserInputError
from lapgs_plugin.files import whole_file
from lapgs_plugin.scenes.images import (
    PhotoFile,
    check_image,
    image_size,
    read_as_3dgs,
    read_image,
    resize_image,
    write_image,
)
from tests.refusals import refuses


def noise(*shape: int) -> NDArray[np.float32]:
    return np.random.default_rng(1).random(shape, dtype=np.float32)


def smooth(width: int, height: int) -> NDArray[np.float32]:
    """(h, w, 3) with detail of about a fifth of the image."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    x, y = (x + 0.5) / width, (y + 0.5) / height
    waves = [np.sin(9 * x + 4 * y), np.cos(7 * y - 3 * x), np.sin(6 * x) * np.cos(8 * y)]
    return (0.5 + 0.4 * np.stack(waves, axis=-1)).astype(np.float32)


def save(path: Path, pixels: NDArray[np.generic], kind: str, **attributes: object) -> None:
    """Write (h, w, c) as it is, in the given OpenImageIO type."""
    pixels = np.ascontiguousarray(pixels)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    target = oiio.ImageOutput.create(str(path))
    assert target.open(str(path), spec)
    assert target.write_image(pixels)
    assert target.close()


def as_tensor(pixels: NDArray[np.generic]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1)


# Reading


@pytest.mark.parametrize(("name", "mode"), [("a.png", "RGB"), ("a.jpg", "RGB"), ("a.png", "L"), ("a.png", "P")])
def test_photos_of_8_bits_are_read_as_they_are(tmp_path: Path, name: str, mode: str) -> None:
    pixels = Image.fromarray((255 * smooth(57, 43)).astype(np.uint8)).convert(mode)
    pixels.save(tmp_path / name)
    expected = cv2.imread(str(tmp_path / name))[..., ::-1]
    photo = PhotoFile(tmp_path / name, (57, 43), (0.0, 0.0, 0.0))
    assert photo.has_levels
    assert torch.equal(photo.levels(), as_tensor(expected))
    assert torch.equal(photo().mul(255).round(), as_tensor(expected).float())
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-300])
    with pytest.raises(SceneError, match=r"damaged or cut short|not a readable image"):
        photo.levels()


def test_photos_in_tiles_are_read_as_they_are(tmp_path: Path) -> None:
    pixels = (255 * smooth(57, 43)).astype(np.uint8)
    spec = oiio.ImageSpec(57, 43, 3, "uint8")
    spec.tile_width = spec.tile_height = 16
    target = oiio.ImageOutput.create("a.tif")
    assert target.open(str(tmp_path / "a.tif"), spec)
    assert target.write_image(pixels)
    assert target.close()
    assert torch.equal(PhotoFile(tmp_path / "a.tif", (57, 43), (0.0, 0.0, 0.0)).levels(), as_tensor(pixels))


def test_photos_that_reading_changes_have_no_levels(tmp_path: Path) -> None:
    save(tmp_path / "deep.png", noise(43, 57, 3), "uint16")
    save(tmp_path / "float.exr", noise(43, 57, 3), "half")
    save(tmp_path / "alpha.png", noise(43, 57, 4), "uint8")
    save(tmp_path / "large.png", noise(86, 114, 3), "uint8")
    for path in sorted(tmp_path.iterdir()):
        photo = PhotoFile(path, (57, 43), (0.0, 0.0, 0.0))
        assert not photo.has_levels
        assert photo().shape == (3, 43, 57)
        with pytest.raises(SceneError, match="changed while it was used, expected 57x43 opaque pixels of 8 bits"):
            photo.levels()


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 255), (np.uint16, 65535)])
def test_integer_formats_scale_to_one(tmp_path: Path, suffix: str, dtype: type, top: int) -> None:
    pixels = np.random.default_rng(0).integers(0, top + 1, (13, 17, 3)).astype(dtype)
    pixels[0, 0], pixels[0, 1] = 0, top
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), pixels[..., ::-1])
    image = read_image(path)
    assert (image.dtype, image.shape, image.is_contiguous()) == (torch.float32, (3, 13, 17), True)
    assert (float(image.min()), float(image.max())) == (0.0, 1.0)
    # 7.4e-8 seen.
    torch.testing.assert_close(image.double(), as_tensor(pixels.astype(np.float64) / top), rtol=0, atol=1e-7)
    assert image_size(path) == (17, 13)


def test_jpeg_decodes_as_opencv_does(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), (smooth(64, 48) * 255).astype(np.uint8))
    expected = cv2.imread(str(path))[..., ::-1].astype(np.float32) / 255
    # Decoders may differ by a level in the chroma upsampling; seen: 0.
    torch.testing.assert_close(read_image(path), as_tensor(expected), rtol=0, atol=1.1 / 255)


@pytest.mark.parametrize(("suffix", "kind"), [(".exr", oiio.HALF), (".exr", oiio.FLOAT), (".tif", oiio.FLOAT)])
def test_float_formats_keep_their_range(tmp_path: Path, suffix: str, kind: str) -> None:
    pixels = (noise(9, 11, 3) * 8 - 2).astype(np.float16).astype(np.float32)
    path = tmp_path / f"a{suffix}"
    save(path, pixels, kind)
    torch.testing.assert_close(read_image(path), as_tensor(pixels), rtol=0, atol=0)
    assert float(read_image(path, size=(5, 4)).max()) > 1.0


def test_linear_exr_is_not_converted(tmp_path: Path) -> None:
    save(tmp_path / "a.exr", np.full((4, 4, 3), 0.5, np.float32), oiio.HALF)
    assert torch.equal(read_image(tmp_path / "a.exr"), torch.full((3, 4, 4), 0.5))


@pytest.mark.parametrize("mode", ["L", "P", "1", "I;16"])
def test_grey_and_palette_become_rgb(tmp_path: Path, mode: str) -> None:
    ramp = np.tile(np.arange(0, 256, 8, dtype=np.uint8), (8, 1))
    pixels = ramp.astype(np.uint16) * 257 if mode == "I;16" else ramp
    picture = Image.fromarray(pixels)
    picture = picture if mode == "I;16" else picture.convert(mode)
    picture.save(tmp_path / "a.png")
    expected = ramp / 255 if mode == "I;16" else np.asarray(picture.convert("L")) / 255
    image = read_image(tmp_path / "a.png")
    assert image.shape == (3, 8, 32)
    # 7.4e-8 seen.
    torch.testing.assert_close(image[0].double(), torch.from_numpy(expected.astype(np.float64)), rtol=0, atol=1e-7)
    assert torch.equal(image[0], image[1])
    assert torch.equal(image[0], image[2])


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.2, 0.5, 0.9)])
def test_straight_alpha_over_the_background(tmp_path: Path, background: tuple[float, float, float]) -> None:
    rgba = np.random.default_rng(0).integers(0, 256, (20, 30, 4)).astype(np.uint8)
    rgba[0, :, 3], rgba[1, :, 3] = 0, 255
    Image.fromarray(rgba).save(tmp_path / "a.png")
    colour, alpha = rgba[..., :3] / 255.0, rgba[..., 3:] / 255.0
    expected = colour * alpha + np.array(background) * (1 - alpha)
    image = read_image(tmp_path / "a.png", background=background)
    torch.testing.assert_close(image.double(), as_tensor(expected), rtol=0, atol=3e-7)  # seen 1.2e-7


def test_grey_with_alpha(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (5, 6, 2)).astype(np.uint8)
    Image.fromarray(pixels, "LA").save(tmp_path / "a.png")
    grey, alpha = pixels[..., :1] / 255.0, pixels[..., 1:] / 255.0
    expected = np.repeat(grey * alpha + (1 - alpha), 3, axis=2)
    image = read_image(tmp_path / "a.png", background=(1.0, 1.0, 1.0))
    torch.testing.assert_close(image.double(), as_tensor(expected), rtol=0, atol=3e-7)


@pytest.mark.parametrize(("suffix", "straight"), [(".exr", False), (".tif", False), (".tif", True)])
def test_float_alpha_premultiplied_or_straight(tmp_path: Path, suffix: str, straight: bool) -> None:
    rgba = noise(7, 9, 4)
    stored = rgba if straight else np.concatenate([rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]], axis=2)
    path = tmp_path / f"a{suffix}"
    save(path, stored, oiio.FLOAT, oiio__UnassociatedAlpha=int(straight))
    expected = rgba[..., :3] * rgba[..., 3:] + 0.25 * (1 - rgba[..., 3:])
    image = read_image(path, background=(0.25, 0.25, 0.25))
    torch.testing.assert_close(image, as_tensor(expected), rtol=0, atol=3e-7)


def test_depth_and_other_channels_are_ignored(tmp_path: Path) -> None:
    pixels = noise(6, 8, 5)
    pixels[..., 3] = 1.0
    spec = oiio.ImageSpec(8, 6, 5, oiio.FLOAT)
    spec.channelnames = ("R", "G", "B", "A", "Z")
    target = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert target.open(str(tmp_path / "a.exr"), spec)
    assert target.write_image(pixels)
    assert target.close()
    torch.testing.assert_close(read_image(tmp_path / "a.exr"), as_tensor(pixels[..., :3]), rtol=0, atol=0)


@pytest.mark.parametrize(("left", "top"), [(2, 3), (-2, -1), (8, 6)])
def test_exr_data_window_is_placed_in_the_image(tmp_path: Path, left: int, top: int) -> None:
    pixels = noise(5, 6, 3)
    spec = oiio.ImageSpec(6, 5, 3, oiio.FLOAT)
    spec.x, spec.y = left, top
    spec.full_x, spec.full_y, spec.full_width, spec.full_height = 0, 0, 12, 9
    path = tmp_path / "a.exr"
    target = oiio.ImageOutput.create(str(path))
    assert target.open(str(path), spec)
    assert target.write_image(pixels)
    assert target.close()
    expected = np.zeros((9, 12, 3), np.float32)
    for y in range(5):
        for x in range(6):
            if 0 <= y + top < 9 and 0 <= x + left < 12:
                expected[y + top, x + left] = pixels[y, x]
    assert image_size(path) == (12, 9)
    assert torch.equal(read_image(path), as_tensor(expected))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_ignored_as_colmap_ignores_it(tmp_path: Path, orientation: int) -> None:
    pixels = (smooth(40, 24) * 255).astype(np.uint8)
    path = tmp_path / "a.jpg"
    picture = Image.fromarray(pixels)
    exif = picture.getexif()
    exif[0x0112] = orientation
    picture.save(path, exif=exif, quality=95, subsampling=0)
    plain = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)[..., ::-1]
    if orientation > 4:
        assert cv2.imread(str(path)).shape[:2] == (40, 24)  # the file does ask for a rotation
    bitmap = pycolmap.Bitmap.read(str(path), True)
    assert (bitmap.width, bitmap.height) == image_size(path) == (40, 24)
    # 6.0e-8 seen.
    torch.testing.assert_close(read_image(path), as_tensor(plain.astype(np.float32) / 255), rtol=0, atol=1.1 / 255)


def stored_as(folder: Path, kind: str) -> Path:
    """A noisy image of 211x157, in a format that is read in its own way."""
    rng = np.random.default_rng(7)
    path = folder / f"a{kind.removeprefix('tiled')}"
    if kind == ".exr":
        save(path, rng.normal(size=(157, 211, 4)).astype(np.float32), oiio.FLOAT)
    elif kind == "tiled.tif":
        source = oiio.ImageBuf(oiio.ImageSpec(211, 157, 3, oiio.UINT8))
        source.set_pixels(oiio.ROI(), rng.random((157, 211, 3), dtype=np.float32))
        source.set_write_tiles(64, 32)
        assert source.write(str(path))
        assert oiio.ImageInput.open(str(path)).spec().tile_height == 32
    else:
        assert cv2.imwrite(str(path), rng.integers(0, 256, (157, 211, 3 if kind == ".jpg" else 4)).astype(np.uint8))
    return path


@pytest.mark.parametrize("kind", [".png", ".jpg", ".exr", ".webp", "tiled.tif"])
@pytest.mark.parametrize("size", [None, (211, 157), (80, 60), (211, 40), (50, 157), (300, 200)])
def test_strips_of_rows_make_the_same_bits(
    tmp_path: Path, kind: str, size: tuple[int, int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against all rows at once, and that against the whole image in one call of OpenImageIO and one of the filter."""
    path = stored_as(tmp_path, kind)
    background = (0.2, 0.4, 0.9)
    whole = read_image(path, size=size, background=background)
    monkeypatch.setattr("lapgs_plugin.scenes.images.STRIP_VALUES", 4000)
    assert torch.equal(read_image(path, size=size, background=background), whole)
    assert check_image(path) == (211, 157)
    source = oiio.ImageInput.open(str(path))
    pixels = source.read_image(oiio.FLOAT)
    if source.spec().nchannels == 3:
        expected = resize_image(as_tensor(pixels), size or (211, 157))
        assert torch.equal(whole, expected.clamp(0, 1))


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P", "LA", "I;16"])
@pytest.mark.parametrize("size", [(157, 211), (80, 100), (157, 50), (30, 211), (300, 400)])
def test_bands_of_an_8_bit_image_make_pillows_bytes(tmp_path: Path, mode: str, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    if mode == "I;16":
        picture = Image.fromarray(rng.integers(0, 65536, (211, 157)).astype(np.uint16))
    else:
        picture = Image.fromarray(rng.integers(0, 256, (211, 157, 4)).astype(np.uint8)).convert(
            "RGB" if mode == "P" else mode
        )
        picture = picture.convert(mode)
    picture.save(tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as opened:
        colour = opened if opened.mode in ("RGB", "RGBA") else opened.convert("RGBA")
        expected = np.asarray(colour.resize(size))[..., :3]
        values = np.asarray(colour.convert("RGBA")) / 255.0
    blended = ((values[..., :3] * values[..., 3:] + 0.4 * (1 - values[..., 3:])) * 255.0).astype(np.uint8)
    over = np.asarray(Image.fromarray(blended).resize(size))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lapgs_plugin.scenes.images.STRIP_VALUES", 4000)
        for background, bytes_ in ((None, expected), ((0.4, 0.4, 0.4), over)):
            read = read_as_3dgs(tmp_path / "a.png", size, background)
            assert np.array_equal((read * 255).round().byte().permute(1, 2, 0).numpy(), bytes_)


@pytest.mark.parametrize("transparent", [False, True])
def test_gif_of_a_palette(tmp_path: Path, transparent: bool) -> None:
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8)).convert("P")
    picture.save(tmp_path / "a.gif", **({"transparency": int(np.asarray(picture)[0, 0])} if transparent else {}))
    with Image.open(tmp_path / "a.gif") as opened:
        rgba = np.asarray(opened.convert("RGBA")) / 255.0
    expected = rgba[..., :3] * rgba[..., 3:] + 0.25 * (1 - rgba[..., 3:])
    assert bool((rgba[..., 3] < 1).any()) == transparent
    image = read_image(tmp_path / "a.gif", background=(0.25, 0.25, 0.25))
    torch.testing.assert_close(image.double(), as_tensor(expected), rtol=0, atol=3e-7)


def test_channels_without_a_colour_are_refused(tmp_path: Path) -> None:
    spec = oiio.ImageSpec(4, 3, 1, oiio.FLOAT)
    spec.channelnames, spec.alpha_channel = ("A",), 0
    target = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert target.open(str(tmp_path / "a.exr"), spec)
    assert target.write_image(np.ones((3, 4, 1), np.float32))
    assert target.close()
    refuses(SceneError, r"a\.exr: the image has no colours, expected grey or RGB", read_image, tmp_path / "a.exr")


def test_names_that_no_file_can_have(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"image a{32}\.\.\. has 304 bytes, expected at most 255"):
        read_image(tmp_path / ("a" * 300 + ".png"))
    for name in ("a\0b.png", "\ud800.png"):
        refuses(SceneError, "no such image", read_image, tmp_path / name)


def test_a_name_that_is_no_utf_8(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"t\xfcr.png")
    path.write_bytes(b"")
    refuses(SceneError, r"t\\udcfcr\.png: its name is not UTF-8; rename it", read_image, path)


# Files that are no images


def damaged(path: Path, how: str) -> None:
    """A file of the suffix's format, then spoilt."""
    if path.suffix == ".exr":
        save(path, noise(60, 80, 3), oiio.FLOAT)
    else:
        cv2.imwrite(str(path), (noise(60, 80, 3) * 255).astype(np.uint8))
    content = path.read_bytes()
    spoilt = {"empty": b"", "half": content[: len(content) // 2], "text": b"not an image\n" * 40, "not": content}
    path.write_bytes(spoilt[how])


@pytest.mark.parametrize("how", ["empty", "half", "text"])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".exr"])
def test_damaged_file_is_named(tmp_path: Path, suffix: str, how: str) -> None:
    path = tmp_path / f"broken{suffix}"
    damaged(path, how)
    refuses(SceneError, f"broken{suffix}", read_image, path)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".exr"])
def test_cut_anywhere_is_refused_or_loses_nothing(tmp_path: Path, suffix: str) -> None:
    """Some formats end in bytes that carry no pixels."""
    path = tmp_path / f"a{suffix}"
    damaged(path, "not")
    content, whole = path.read_bytes(), read_image(path)
    lengths = {*range(0, len(content), 1 + len(content) // 60), *range(len(content) - 12, len(content))}
    for length in sorted(lengths):
        path.write_bytes(content[:length])
        try:
            image = read_image(path)
        except SceneError:
            continue
        assert torch.equal(image, whole), f"{length} of {len(content)} bytes were read as another image"


def test_progressive_jpeg_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), (noise(60, 80, 3) * 255).astype(np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    path.write_bytes(path.read_bytes()[:-400])
    refuses(SceneError, r"a\.jpg: the image is damaged or cut short", read_image, path)


def jpeg(**options: object) -> bytes:
    file = io.BytesIO()
    Image.fromarray((smooth(80, 60) * 255).astype(np.uint8)).save(file, "JPEG", quality=90, **options)
    return file.getvalue()


def with_bytes_between(content: bytes, filling: bytes, markers: bytes) -> bytes:
    """Insert bytes before each of these markers."""
    return re.sub(rb"(?=\xff[" + re.escape(markers) + rb"])", lambda _: filling, content)


TABLES, RESTARTS = b"\xdb\xc4\xc0\xda", bytes(range(0xD0, 0xD8))


@pytest.mark.parametrize(
    ("options", "filling", "markers"),
    [
        ({}, b"\0\0", TABLES),
        ({}, b"\x12\x34\xff\0\x56", TABLES),
        ({"progressive": True}, b"\0\0", TABLES),
        ({"restart_marker_rows": 1}, b"", b"\0"),
        ({"restart_marker_rows": 1}, b"\0\0\0", RESTARTS),
        ({"restart_marker_blocks": 3}, b"\xff\xff", RESTARTS),
        ({}, b"\0\0", b"\xd9"),
    ],
)
def test_bytes_between_the_parts_of_a_jpeg(
    tmp_path: Path, options: dict[str, object], filling: bytes, markers: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """Drones write such files, which all decoders show; what follows their end is another image."""
    path, plain = tmp_path / "a.jpg", jpeg(**options)
    path.write_bytes(plain)
    expected = read_image(path)
    whole = with_bytes_between(plain, filling, markers)
    path.write_bytes(whole + plain)
    assert torch.equal(read_image(path), expected)
    assert check_image(path) == (80, 60)
    assert not caplog.records
    for share in (0.3, 0.6, 0.95):
        path.write_bytes(whole[: int(share * len(whole))])
        refuses(SceneError, r"a\.jpg: (the image is damaged or cut short|not a readable image)", read_image, path)


def test_a_jpeg_that_ends_early_or_holds_wrong_bits(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, content = tmp_path / "a.jpg", jpeg(restart_marker_rows=1)
    first, second = (marker.start() for marker in list(re.finditer(rb"\xff[\xd0-\xd7]", content))[:2])
    for end in (first, first - 20, second + 30):
        path.write_bytes(content[:end] + b"\xff\xd9")
        refuses(SceneError, r"a\.jpg: the image is damaged or cut short", read_image, path)
    path.write_bytes(content[:first] + content[second:])  # every decoder shows most of it
    for _ in range(2):
        assert read_image(path).shape == (3, 60, 80)
    assert caplog.text.count("a.jpg: parts of the photo may be wrong (JPEG error: ") == 1
    for number in range(8):  # of a camera that writes all of them so
        (tmp_path / f"{number}.jpg").write_bytes(path.read_bytes())
        read_image(tmp_path / f"{number}.jpg")
    assert caplog.text.count("may be wrong") == 5
    assert caplog.text.endswith("; more photos of this folder are not named\n")


def png_chunks(content: bytes) -> list[bytes]:
    chunks, at = [], 8
    while at < len(content):
        chunks.append(content[at : at + 12 + int.from_bytes(content[at : at + 4], "big")])
        at += len(chunks[-1])
    return chunks


def test_a_damaged_png_is_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """libpng prints a line of its own; chunks that no pixel depends on may be damaged."""
    path = tmp_path / "a.png"
    damaged(path, "not")
    content, whole = path.read_bytes(), read_image(path)
    header, *others = png_chunks(content)
    flipped = [bytes([*content[:at], content[at] ^ 4, *content[at + 1 :]]) for at in (8, 13, 18, 25, 31, 40, 60, 9000)]
    cut = [content[: int(len(content) * share)] for share in (0.0006, 0.001, 0.0015, 0.01, 0.5, 0.99)]
    for spoilt in (*flipped, *cut, content[:8] + b"".join(others), content[:8] + header + others[-1]):
        path.write_bytes(spoilt)
        refuses(SceneError, r"a\.png: (the image is damaged or cut short|not a readable image)", read_image, path)
    text = b"\0\0\0\3tEXta\0b????"
    for harmless in (content[:-12], content + b"more", content[:8] + header + text + b"".join(others)):
        path.write_bytes(harmless)
        assert torch.equal(read_image(path), whole)
    assert capfd.readouterr() == ("", "")


def announcing(kind: str, side: int) -> bytes:
    """A file of noise whose header says side x side pixels."""
    file = io.BytesIO()
    options = {"progressive": True} if kind == "JPEG" else {}
    Image.fromarray((noise(60, 80, 3) * 255).astype(np.uint8)).save(file, kind, **options)
    content, at = bytearray(file.getvalue()), 0
    if kind == "JPEG":
        at = content.index(b"\xff\xc2") + 5
        content[at : at + 4] = struct.pack(">HH", side, side)
        content += bytes(3_000_000)  # OpenImageIO refuses sizes that no file of so few bytes has
    elif kind == "PNG":
        content[16:24] = struct.pack(">II", side, side)
        content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    elif kind == "BMP":
        content[18:26] = struct.pack("<II", side, side)
    else:
        at = struct.unpack("<I", content[4:8])[0]
        for entry in range(at + 2, at + 2 + 12 * struct.unpack("<H", content[at : at + 2])[0], 12):
            if struct.unpack("<H", content[entry : entry + 2])[0] in (256, 257):  # width and height
                content[entry + 2 : entry + 12] = struct.pack("<HII", 4, 1, side)
    return bytes(content)


@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak of memory in KiB")
@pytest.mark.parametrize("kind", ["JPEG", "PNG", "BMP", "TIFF"])
def test_sizes_that_no_photo_has_take_no_memory(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a.{kind.lower()}"
    path.write_bytes(announcing(kind, 60_000))
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for read in (read_image, image_size, lambda file: read_as_3dgs(file, (8, 6), None)):
        refuses(SceneError, r"a\.\w+: (the image is 60000x60000 pixels|not a readable image .*claims)", read, path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak < 300_000  # KiB; seen 6,200


def test_a_photo_that_is_no_file(tmp_path: Path) -> None:
    for name, aim, message in (
        ("loop.png", "loop.png", "cannot be read: Too many levels of symbolic links"),
        ("device.png", "/dev/zero", "cannot be read: a pipe, socket or device"),
        ("folder.png", ".", "cannot be read: Is a directory"),
        ("astray.png", "nowhere", "no such image: it is a link to nowhere, which is not there"),
    ):
        (tmp_path / name).symlink_to(aim)
        refuses(SceneError, f"{name}:? {message}", read_image, tmp_path / name)


def test_missing_file(tmp_path: Path) -> None:
    refuses(SceneError, "no such image", read_image, tmp_path / "none.png")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_and_inf_are_refused(tmp_path: Path, value: float) -> None:
    pixels = noise(4, 5, 3)
    pixels[2, 3, 1] = value
    save(tmp_path / "a.exr", pixels, oiio.FLOAT)
    refuses(SceneError, r"a\.exr: the image holds NaN or inf", read_image, tmp_path / "a.exr")


# Resizing


@pytest.mark.parametrize("size", [(96, 64), (48, 32), (77, 51), (191, 127), (64, 100)])
def test_resize_is_pillows_bicubic(size: tuple[int, int]) -> None:
    pixels = noise(128, 192, 3)
    channels = [np.asarray(Image.fromarray(pixels[..., c]).resize(size, Image.Resampling.BICUBIC)) for c in range(3)]
    # Pillow computes the weights in float64, torch in float32; seen 4e-6.
    torch.testing.assert_close(
        resize_image(as_tensor(pixels), size), torch.from_numpy(np.stack(channels)), rtol=0, atol=2e-5
    )


@pytest.mark.parametrize("factor", [2, 3, 4, 8])
def test_resize_agrees_with_area_averages_on_smooth_images(factor: int) -> None:
    pixels = smooth(384, 240)
    expected = cv2.resize(pixels, (384 // factor, 240 // factor), interpolation=cv2.INTER_AREA)
    image = resize_image(as_tensor(pixels), (384 // factor, 240 // factor))
    # Seen 2.8e-3 at 8, at the border, where both filters are one-sided.
    torch.testing.assert_close(image, as_tensor(expected), rtol=0, atol=5e-3)
    assert abs(float(image.mean()) - float(pixels.mean())) < 1e-4


@settings(deadline=None, max_examples=40)
@given(st.integers(40, 90), st.integers(40, 90), st.integers(20, 90), st.integers(20, 90))
def test_resize_neither_shifts_nor_brightens(width: int, height: int, new_width: int, new_height: int) -> None:
    """A plane a + b x + c y over the unit square stays that plane, away from the border's one-sided filter."""
    new_width, new_height = min(width, new_width), min(height, new_height)

    def plane(w: int, h: int) -> Tensor:
        y, x = torch.meshgrid(
            (torch.arange(h, dtype=torch.float64) + 0.5) / h,
            (torch.arange(w, dtype=torch.float64) + 0.5) / w,
            indexing="ij",
        )
        return torch.stack([x, y, torch.full_like(x, 0.7)])

    image = resize_image(plane(width, height), (new_width, new_height))
    expected = plane(new_width, new_height)
    assert image.shape == expected.shape
    inner = (slice(None), slice(2, -2), slice(2, -2))
    # A twentieth of a pixel; at ratios that are no integers the sampled kernel is not exactly symmetric, seen 0.011.
    limit = 0.05 / min(new_width, new_height)
    torch.testing.assert_close(image[inner], expected[inner], rtol=0, atol=limit)
    torch.testing.assert_close(image[2], expected[2], rtol=0, atol=1e-6)


def test_resize_averages_fine_detail_away() -> None:
    board = (torch.arange(64)[:, None] + torch.arange(64)[None, :]) % 2
    image = resize_image(board.float().expand(3, 64, 64), (16, 16))
    # Without anti-aliasing it would be 0 or 1; seen 0.002.
    torch.testing.assert_close(image[:, 1:-1, 1:-1], torch.full((3, 14, 14), 0.5), rtol=0, atol=0.01)


def test_overshoot_is_clamped_for_integer_files_only(tmp_path: Path) -> None:
    edge = np.zeros((32, 32, 3), np.float32)
    edge[:, 16:] = 1.0
    cv2.imwrite(str(tmp_path / "a.png"), (edge * 255).astype(np.uint8))
    save(tmp_path / "a.exr", edge, oiio.FLOAT)
    unclamped = resize_image(as_tensor(edge), (12, 12))
    assert float(unclamped.min()) < -0.01
    assert torch.equal(read_image(tmp_path / "a.png", size=(12, 12)), unclamped.clamp(0, 1))
    assert torch.equal(read_image(tmp_path / "a.exr", size=(12, 12)), unclamped)


def test_same_size_is_not_touched() -> None:
    image = torch.rand(3, 7, 9)
    assert resize_image(image, (9, 7)) is image


# Writing


def test_png_rounds_to_the_nearest_level(tmp_path: Path) -> None:
    image = torch.rand(3, 21, 34) * 1.4 - 0.2
    write_image(tmp_path / "new" / "a.png", image)
    expected = (image.clamp(0, 1).double().permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    assert np.array_equal(cv2.imread(str(tmp_path / "new" / "a.png"))[..., ::-1], expected)


def test_every_8_bit_level_survives(tmp_path: Path) -> None:
    levels = (torch.arange(256).float() / 255).reshape(1, 16, 16).expand(3, 16, 16)
    write_image(tmp_path / "a.png", levels)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png"))[..., 0].ravel(), np.arange(256))
    torch.testing.assert_close(read_image(tmp_path / "a.png"), levels, rtol=0, atol=1e-7)  # 6.0e-8 seen


def test_exr_keeps_float32(tmp_path: Path) -> None:
    image = torch.randn(3, 9, 10) * 5
    write_image(tmp_path / "a.exr", image)
    assert torch.equal(read_image(tmp_path / "a.exr"), image)


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".JPG"])
def test_jpeg_is_close(tmp_path: Path, suffix: str) -> None:
    image = as_tensor(smooth(64, 48))
    write_image(tmp_path / f"a{suffix}", image)
    written = cv2.imread(str(tmp_path / f"a{suffix}"))[..., ::-1].astype(np.float32) / 255
    assert float((as_tensor(written) - image).abs().mean()) < 0.004  # one level; seen 0.0021


def test_unknown_type_is_refused(tmp_path: Path) -> None:
    for name in ("a.gif", "a"):
        refuses(UserInputError, r"expected \.png, \.jpg or \.exr", write_image, tmp_path / name, torch.zeros(3, 4, 4))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on file sizes to imitate a full disk with")
def test_full_disk_leaves_the_old_files(tmp_path: Path) -> None:
    """A limit on file sizes makes writing fail as a full disk does."""
    paths = [tmp_path / name for name in ("a.exr", "a.jpg", "a.png")]
    for path in paths:
        write_image(path, torch.zeros(3, 8, 8))
    before = [path.read_bytes() for path in paths]
    script = (
        "import resource, signal, sys, torch; from pathlib import Path\n"
        "from lapgs_plugin.errors import LapgsError; from lapgs_plugin.scenes.images import write_image\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "for path in sys.argv[1:]:\n"
        "    try: write_image(Path(path), torch.rand(3, 200, 200))\n"
        "    except LapgsError as error: print(error)\n"
    )
    done = subprocess.run(  # a limit cannot be raised again, so it is set in another process
        [sys.executable, "-c", script, *map(str, paths)], capture_output=True, text=True, check=True, timeout=60
    )
    lines = done.stdout.splitlines()
    assert len(lines) == len(paths)
    for line, path in zip(lines, paths, strict=True):
        assert f"{path.name}: the image cannot be written" in line
    assert [path.read_bytes() for path in paths] == before
    assert sorted(tmp_path.iterdir()) == paths


def test_unwritable_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(LapgsError, match=r"a\.png: the image cannot be written"):
        write_image(tmp_path / "file" / "a.png", torch.zeros(3, 4, 4))


def test_names_that_differ_in_the_case_of_their_suffix_are_written_at_once(tmp_path: Path) -> None:
    """Threads write the photos of a folder."""
    with whole_file(tmp_path / "a.exr", "image") as one, whole_file(tmp_path / "a.EXR", "image") as other:
        one.write_bytes(b"one")
        other.write_bytes(b"other")
    assert [(tmp_path / name).read_bytes() for name in ("a.exr", "a.EXR")] == [b"one", b"other"]
    image = torch.from_numpy(noise(3, 6, 5))
    write_image(tmp_path / "a.EXR", image)
    assert torch.equal(read_image(tmp_path / "a.EXR"), image)
