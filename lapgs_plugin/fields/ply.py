"""Read PLY files of unknown origin with plyfile, after comparing their header with their size."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyElementParseError, PlyListProperty

from lapgs_plugin.errors import joined
from lapgs_plugin.untrusted import require_regular, shortened

HEADER_BYTES = 2**18
"""Longest header that is read; the header of a Gaussian field is far shorter unless it has many comments."""

_END = re.compile(rb"(?:^|[\r\n])end_header(\r\n|\r|\n)")
_ELEMENT = re.compile(rb"(?m)^(element[ \t]+)(\S+)([ \t]+)(\S+)[ \t]*$")
_FORMAT = re.compile(rb"(?m)^format[ \t]+(\S+)")


def read_ply(path: Path | str) -> PlyData:
    """Read a PLY file.

    Raises:
        ValueError: it is not a PLY file, truncated or otherwise damaged; says how in one line.
        OSError: it cannot be read.
    """
    _check_header(Path(path))
    try:
        return PlyData.read(str(path))
    except OSError:
        raise
    except PlyElementParseError as error:
        at = "" if error.row is None else f" after {error.row} of {error.element.count} ({error.element.name})"
        raise ValueError(f"it is cut short or damaged{at} ({error.message})") from error
    except Exception as error:  # damage raises ValueError, OverflowError, MemoryError, ... in plyfile and numpy
        raise ValueError(f"it is not a PLY file ({_line(error)})") from error


def scalar_names(element: PlyElement) -> set[str]:
    """Return the properties of an element that hold one number each."""
    return {prop.name for prop in element.properties if not isinstance(prop, PlyListProperty)}


def _check_header(path: Path) -> None:
    """Check that the file is as large as its header says: plyfile allocates memory for that before it reads.

    Raises:
        ValueError: it is smaller, or has no valid header.
        OSError: the file cannot be read.
    """
    require_regular(path)
    with path.open("rb") as stream:
        start = stream.read(HEADER_BYTES)
        size = stream.seek(0, 2)
    if not re.match(rb"ply[ \t]*[\r\n]", start):
        raise ValueError(f"it is not a PLY file (it begins with {shortened(start[:8])}, expected ply)")
    if (end := _END.search(start)) is None:
        raise ValueError(f"it is not a PLY file (no end_header in its first {min(size, HEADER_BYTES):,} bytes)")
    header = start[: end.end()].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    counts = [element.group(4) for element in _ELEMENT.finditer(header)]
    for count in counts:
        if not re.fullmatch(rb"[0-9]{1,15}", count):
            raise ValueError(f"its header counts {shortened(count.decode('latin-1'))}, expected a number from 0")
    try:
        # With all counts 0 plyfile reads the header alone.
        empty = PlyData.read(io.BytesIO(_ELEMENT.sub(rb"\1\2\g<3>0", header)))
    except Exception as error:  # as in `read_ply`
        raise ValueError(f"it is not a PLY file ({_line(error)})") from error
    if len(empty.elements) != len(counts):
        raise ValueError(f"it is not a PLY file ({len(counts)} elements with counts of {len(empty.elements)})")
    is_text = (kind := _FORMAT.search(header)) is not None and kind.group(1) == b"ascii"
    rows = [_row_bytes(element, is_text) for element in empty.elements]
    held = size - end.end()
    for element, row, count in zip(empty.elements, rows, map(int, counts), strict=True):
        if count and not element.properties:
            raise ValueError(f"its header counts {count} of {element.name} without any property")
        # The last line of an ASCII file may lack its line break.
        if row * count > held + is_text:
            fitting = held // row
            raise ValueError(
                f"it is cut short or damaged after {fitting} of {count} ({element.name}): these take {row * count:,} "
                f"bytes at least, the file has {held:,}"
            )
        held -= row * count


def _row_bytes(element: PlyElement, is_text: bool) -> int:
    """Return the least number of bytes of one row of an element."""
    if is_text:
        return 2 * len(element.properties)  # a digit, and a space or a line break
    return sum(
        np.dtype(prop.list_dtype()[0] if isinstance(prop, PlyListProperty) else prop.dtype()).itemsize
        for prop in element.properties
    )


def _line(error: Exception) -> str:
    """Return an error's message, which may quote a long header, as one short line; its type's name if it has none."""
    text = joined(str(error) or type(error).__name__)
    return text if len(text) <= 300 else f"{text[:297]}..."
