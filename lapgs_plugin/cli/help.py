"""Show the documentation that comes with the package: `lapgs help`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lapgs_plugin.cli.output import make_console
from lapgs_plugin.errors import UserInputError, nearest
from lapgs_plugin.files import shipped


def topics() -> dict[str, Path]:
    """Return the pages of the documentation by name."""
    pages = {path.stem: path for path in sorted(shipped("docs").glob("*.md"))}
    return {**pages, "patches": shipped("patches") / "README.md"}


def show_topic(
    topic: Annotated[str | None, typer.Argument(metavar="TOPIC", help="Page to show. Default: list all.")] = None,
) -> None:
    """Show a page of the documentation, such as `lapgs help training`, or list all pages.

    `lapgs COMMAND --help` shows the options of a command.
    """
    from rich.markdown import Markdown

    pages = topics()
    if topic is None:
        for name, path in pages.items():
            print(f"lapgs help {name:12} {_title(path)}")
        return
    if topic not in pages:
        raise UserInputError(f"lapgs help {topic}: no such page; {nearest(topic, pages.keys())}")
    text, console = pages[topic].read_text(encoding="utf-8"), make_console()
    console.print(Markdown(text)) if console.is_terminal else print(text)


def _title(path: Path) -> str:
    with path.open(encoding="utf-8") as stream:
        return stream.readline().strip("# \n")
