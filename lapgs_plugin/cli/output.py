"""Print tables and logs, and name the command that comes next."""

from __future__ import annotations

import logging
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from lapgs_plugin.errors import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

UNLIMITED = 10_000
"""Width in columns without a terminal, more than that of any table."""


def make_console(*, stderr: bool = False) -> Console:
    """Return a console that fits its lines to a terminal, and neither wraps nor cuts them in files and pipes.

    The environment variable COLUMNS sets the width of either.
    """
    from lapgs_plugin.progress import EscapingConsole

    console = EscapingConsole(stderr=stderr, highlight=False)
    if not console.is_terminal and not os.environ.get("COLUMNS", "").isdecimal():
        console.width = UNLIMITED
    return console


def say(text: str, *, stderr: bool = False) -> None:
    """Print one line at once, with control characters and line breaks of names as escapes."""
    print(printable(text), file=sys.stderr if stderr else sys.stdout, flush=True)


class _EscapingFormatter(logging.Formatter):
    """Show messages of this program as one line each, with control characters of names as escapes."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return printable(text) if record.name.startswith("lapgs_") else text


def log_to_stderr(pattern: str = "lapgs: %(message)s") -> None:
    """Print log records on stderr, unless the program set up logging before."""
    handler = logging.StreamHandler()
    handler.setFormatter(_EscapingFormatter(pattern))
    logging.basicConfig(handlers=[handler])


def make_table(*headings: str) -> Table:
    """Return a table with a line under its headings and no other lines."""
    from rich import box
    from rich.table import Table

    return Table(*headings, box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)


def show_log() -> None:
    """Print on stderr which rasterizer renders a run, and why."""
    log_to_stderr()
    logging.getLogger("lapgs_plugin.rasterizers.choice").setLevel(logging.INFO)


def train_command(scene: Path, options: str = "") -> str:
    """Return the command that trains a scene with further options, as a user can paste it."""
    run = Path("runs") / scene.absolute().name
    return f"lapgs train {shlex.quote(str(scene))} -o {shlex.quote(str(run))} --eval {options}".rstrip()
