"""What an edit looks like in a source file: a marked block that can be taken out again to the byte.

Two forms. Where the place begins a line, whole lines with its indentation and its line ending:

    // >>> lapgs SET/NAME CHECKSUM
    the text
    // <<< lapgs

Elsewhere, and wherever text is replaced, between two comments; what was replaced is kept in the first:

    /*>>> lapgs SET/NAME CHECKSUM was: the old text*/the text/*<<< lapgs*/

The checksum tells a block that is as it was written (reformatting aside) from one that somebody changed since.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection
from typing import NamedTuple

_HEAD = r">>> lapgs (?P<{0}set>[\w-]+)/(?P<{0}name>[\w-]+) (?P<{0}sum>[0-9a-f]{{8}})"
_BLOCK = re.compile(
    r"^[ \t]*// " + _HEAD.format("l_") + r"[ \t]*\r?\n(?P<l_body>.*?)^[ \t]*// <<< lapgs[ \t]*(?:\r?\n|\Z)"
    r"|/\*" + _HEAD.format("c_") + r"(?: was: (?P<was>.*?))?\*/(?P<c_body>.*?)/\*<<< lapgs\*/",
    re.MULTILINE | re.DOTALL,
)
_MARKER = re.compile(r">>> lapgs |<<< lapgs")
_INDENTATION = re.compile(r"[ \t]*\Z")


class Block(NamedTuple):
    """An edit found in a file.

    Attributes:
        set, name: which edit it is.
        start, end: the bytes it takes up.
        original: what stood there before; empty for an insertion.
        intact: whether it is still as it was written.
    """

    set: str
    name: str
    start: int
    end: int
    original: str
    intact: bool


def find_blocks(source: str) -> list[Block]:
    """All blocks in a file, in order."""
    found = []
    for match in _BLOCK.finditer(source):
        form = "c_" if match["l_sum"] is None else "l_"
        original = _unescape(match["was"] or "")
        intact = match[form + "sum"] == _checksum(match[form + "body"], original)
        found.append(Block(match[form + "set"], match[form + "name"], match.start(), match.end(), original, intact))
    return found


def stray_marker(source: str) -> int | None:
    """Where half a block stands (one of its two markers is gone), or None."""
    whole = [range(block.start, block.end) for block in find_blocks(source)]
    for match in _MARKER.finditer(source):
        if not any(match.start() in span for span in whole):
            return match.start()
    return None


def without_blocks(source: str, sets: Collection[str]) -> str:
    """The file as it was before the edits of these sets were made."""
    kept, position = [], 0
    for block in find_blocks(source):
        if block.set in sets:
            kept += [source[position : block.start], block.original]
            position = block.end
    return "".join([*kept, source[position:]])


def insertion(source: str, at: int, label: str, text: str) -> tuple[int, str]:
    """The block that puts `text` in front of `at`, and where it goes: there, or at the start of the line.

    Args:
        label: SET/NAME of the edit.
        text: one or more lines joined by "\\n".
    """
    line_start = source.rfind("\n", 0, at) + 1
    newline = _newline(source, at)
    if not _INDENTATION.match(source, line_start, at):
        return at, _inline(label, text.replace("\n", newline), newline)
    indent = source[line_start:at]
    body = "".join((indent + line if line else "") + newline for line in text.split("\n"))
    head = f"{indent}// >>> lapgs {label} {_checksum(body)}{newline}"
    return line_start, f"{head}{body}{indent}// <<< lapgs{newline}"


def replacement(source: str, start: int, end: int, label: str, text: str) -> str:
    """The block that stands for `source[start:end]`."""
    newline = _newline(source, start)
    return _inline(label, text.replace("\n", newline), newline, source[start:end])


def _inline(label: str, text: str, newline: str, original: str = "") -> str:
    if newline in text or "//" in text or text.startswith("#"):
        text = newline + text + newline  # directives need a line of their own, a comment must not reach the marker
    was = f" was: {_escape(original)}" if original else ""
    return f"/*>>> lapgs {label} {_checksum(text, original)}{was}*/{text}/*<<< lapgs*/"


def _newline(source: str, at: int) -> str:
    """The line ending of the line at `at`, or of the one before if it is the file's last."""
    end = source.find("\n", at)
    end = source.rfind("\n", 0, at) if end < 0 else end
    return "\r\n" if end > 0 and source[end - 1] == "\r" else "\n"


def _checksum(body: str, original: str = "") -> str:
    return hashlib.sha256(("".join(body.split()) + "\0" + "".join(original.split())).encode("latin-1")).hexdigest()[:8]


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace("*/", "*\\/")


def _unescape(text: str) -> str:
    return re.sub(r"\\(.)", r"\1", text, flags=re.DOTALL)
