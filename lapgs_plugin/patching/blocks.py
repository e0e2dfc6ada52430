"""Mark an edit in a source file as a block that can be reverted to the byte.

A block has one of two forms. An insertion at the start of a line has whole lines with its indentation and line ending:

    // >>> lapgs SET/NAME CHECKSUM
    the text
    // <<< lapgs

Any other insertion, and every replacement, stands between two comments, the first of which has the replaced text:

    /*>>> lapgs SET/NAME CHECKSUM was: the old text*/the text/*<<< lapgs*/

The checksum, which ignores white space, shows whether the block was changed after it was written.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection
from typing import NamedTuple

_HEAD = r">>> lapgs (?P<{0}set>[\w-]+)/(?P<{0}name>[\w-]+) (?P<{0}sum>[0-9a-f]{{8}})"
_BODY = r"(?P<{0}body>(?:(?!>>> lapgs ).)*?)"  # a block that lacks its end must not hide the next one
_BLOCK = re.compile(
    r"^[ \t]*// " + _HEAD.format("l_") + r"[ \t]*\r?\n" + _BODY.format("l_") + r"^[ \t]*// <<< lapgs[ \t]*(?:\r?\n|\Z)"
    r"|/\*" + _HEAD.format("c_") + r"(?: was: (?P<was>.*?))?\*/" + _BODY.format("c_") + r"/\*<<< lapgs\*/",
    re.MULTILINE | re.DOTALL,
)
_MARKER = re.compile(r">>> lapgs |<<< lapgs")
_INDENTATION = re.compile(r"[ \t]*\Z")


class Block(NamedTuple):
    """Locate an edit in a file.

    Attributes:
        set, name: the edit.
        start, end: range of its bytes.
        original: replaced text; empty for an insertion.
        intact: whether it is unchanged since it was written.
    """

    set: str
    name: str
    start: int
    end: int
    original: str
    intact: bool


def find_blocks(source: str) -> list[Block]:
    """Return all blocks in a file, in order."""
    blocks = []
    for match in _BLOCK.finditer(source):
        form = "c_" if match["l_sum"] is None else "l_"
        original = _unescape(match["was"] or "")
        intact = match[form + "sum"] == _checksum(match[form + "body"], original)
        blocks.append(Block(match[form + "set"], match[form + "name"], match.start(), match.end(), original, intact))
    return blocks


def stray_marker(source: str) -> int | None:
    """Return the position of a marker without its counterpart, or None."""
    whole = [range(block.start, block.end) for block in find_blocks(source)]
    for match in _MARKER.finditer(source):
        if not any(match.start() in span for span in whole):
            return match.start()
    return None


def without_blocks(source: str, sets: Collection[str]) -> str:
    """Return the file without the edits of these sets."""
    kept, position = [], 0
    for block in find_blocks(source):
        if block.set in sets:
            kept += [source[position : block.start], block.original]
            position = block.end
    return "".join([*kept, source[position:]])


def insertion(source: str, at: int, label: str, text: str) -> tuple[int, str]:
    """Return the block that inserts `text` at `at`, and its position: `at`, or the start of the line.

    Args:
        source: the file.
        at: position to insert the text at.
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
    """Return the block that replaces `source[start:end]`."""
    newline = _newline(source, start)
    return _inline(label, text.replace("\n", newline), newline, source[start:end])


def _inline(label: str, text: str, newline: str, original: str = "") -> str:
    if newline in text or "//" in text or text.startswith("#"):
        text = newline + text + newline  # directives need their own line, and a comment must not hide the marker
    was = f" was: {_escape(original)}" if original else ""
    return f"/*>>> lapgs {label} {_checksum(text, original)}{was}*/{text}/*<<< lapgs*/"


def _newline(source: str, at: int) -> str:
    """Return the line ending of the line at `at`, or of the line before if it is the last."""
    end = source.find("\n", at)
    end = source.rfind("\n", 0, at) if end < 0 else end
    return "\r\n" if end > 0 and source[end - 1] == "\r" else "\n"


def _checksum(body: str, original: str = "") -> str:
    return hashlib.sha256(("".join(body.split()) + "\0" + "".join(original.split())).encode("latin-1")).hexdigest()[:8]


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace("*/", "*\\/")


def _unescape(text: str) -> str:
    return re.sub(r"\\(.)", r"\1", text, flags=re.DOTALL)
