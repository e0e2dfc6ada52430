"""Check JPEG and PNG files before they are decoded.

OpenImageIO allocates the size that a header announces, and libpng prints errors to stderr.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from lapgs_plugin.errors import SceneError
from lapgs_plugin.limits import PHOTO_PIXELS, PHOTO_SIDE

PNG_START, JPEG_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
JPEG_HEADER_BYTES = 2**20
"""Bytes of a JPEG file in which its size is looked for."""
_MARKER = re.compile(rb"\xff([^\x00\xff])")


def check_before_decoding(path: Path, whole: bool) -> None:
    """Check the size that a JPEG file announces, and the chunks of a PNG file, up to its pixels or `whole`.

    Raises:
        SceneError: the image is too large, or damaged.
        OSError: the file cannot be read.
    """
    with path.open("rb") as stream:
        start = stream.read(len(PNG_START))
        if start == PNG_START and (damage := _png_damage(stream, whole)):
            raise damaged(path, damage)
        if start.startswith(JPEG_START):
            header = start + stream.read(JPEG_HEADER_BYTES)
            for code, at in _jpeg_markers(header):
                if 0xC0 <= code <= 0xCF and code not in (0xC4, 0xC8, 0xCC) and len(header) >= at + 7:
                    height, width = struct.unpack(">HH", header[at + 3 : at + 7])
                    check_size(path, width, height)
                    break


def damaged(path: Path, reason: str) -> SceneError:
    """Return the error for an image that cannot be decoded completely."""
    return SceneError(f"{path}: the image is damaged or cut short ({reason}), expected a whole file; copy it again")


def check_size(path: Path, width: int, height: int) -> None:
    """Raise a SceneError if an image has no pixels, or more than the limits allow."""
    subject = f"{path}: the image is {width}x{height} pixels"
    if min(width, height) < 1:
        raise SceneError(f"{subject}, expected at least one; render or export it again")
    PHOTO_PIXELS.check(width * height, subject, "make it smaller", SceneError)
    PHOTO_SIDE.check(max(width, height), subject, "make it smaller", SceneError)


def reaches_its_end(path: Path) -> bool:
    """Return whether a JPEG file has the marker of its end, rather than being cut short."""
    return any(code == 0xD9 for code, _ in _jpeg_markers(path.read_bytes()))


def _jpeg_markers(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield the code of each marker and the position after it. Bytes between segments are skipped, as decoders do."""
    at = len(JPEG_START)
    while marker := _MARKER.search(data, at):
        code, at = marker[1][0], marker.end()
        yield code, at
        if not 0xD0 <= code <= 0xD9:  # these have no data
            at += int.from_bytes(data[at : at + 2], "big")


def _png_damage(stream: BinaryIO, whole: bool) -> str:
    """Describe the damage of the chunks that a decoder needs; "" if there is none."""
    size, kinds = os.fstat(stream.fileno()).st_size, list[bytes]()
    while len(head := stream.read(8)) == 8:
        length, kind = struct.unpack(">I4s", head)
        kinds.append(kind)
        if kinds[0] != b"IHDR":
            return "it has no header"
        if kind == b"IEND" or (kind == b"IDAT" and not whole):
            break
        data, checksum = stream.read(min(length, size)), stream.read(4)
        if len(checksum) < 4:
            return "it ends before its last pixels"
        if not kind[0] & 32 and zlib.crc32(data, zlib.crc32(kind)) != int.from_bytes(checksum, "big"):  # not optional
            return f"the checksum of its {kind.decode('latin-1')} chunk differs"
    return "" if b"IDAT" in kinds else "it has no pixels"
