"""Read the project's documents: their fenced blocks, their links, the commands that they show."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCUMENTS = (
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "lapgs_plugin/README.md",
    ROOT / "patches/README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
)
PAGES = tuple(path for path in DOCUMENTS if "notes" not in path.parts and path.name != "CHANGELOG.md")
"""Documents that say how things are now."""


@dataclass(frozen=True)
class Block:
    """A block of code in a document.

    Attributes:
        language: as the fence names it, "" for an indented block.
        title: file that it stands for, "" without.
        text: its lines.
    """

    language: str
    title: str
    text: str


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def blocks(document: Path) -> Iterator[Block]:
    """Yield the fenced and the indented blocks of a document."""
    text = document.read_text(encoding="utf-8")
    fenced = re.compile(r'^```(\w*)(?: title="([^"]*)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)
    for match in fenced.finditer(text):
        yield Block(match[1], match[2] or "", match[3])
    for match in re.finditer(r"(?:(?<=\n\n)|^)((?: {4}[^\n]*\n)+)", fenced.sub("", text)):
        yield Block("", "", re.sub(r"^ {4}", "", match[1], flags=re.MULTILINE))


def prose(document: Path) -> str:
    """Return a document without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", document.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def commands(document: Path) -> list[list[str]]:
    """Return the words of every `lapgs` command in the blocks of a document."""
    lines = []
    for block in blocks(document):
        for line in re.sub(r"\\\n\s*", "", block.text).splitlines():
            words = shlex.split(line, comments=True) if re.match(r"([A-Z_]+=\S+ )*lapgs ", line) else []
            if words:
                lines.append(words[words.index("lapgs") + 1 :])
    return lines
