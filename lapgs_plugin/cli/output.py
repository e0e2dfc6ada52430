"""Print tables and logs, and name the command that comes next."""

from __future__ import annotations

import logging
import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

UNLIMITED = 10_000
"""Width in columns where there is no terminal: more than any table has."""


def make_console(*, stderr: bool = False) -> Console:
    """Return a console that fits its lines to a terminal, and neither wraps nor cuts them in files and pipes.

    The environment variable COLUMNS sets the width of either.
    """
    from rich.console import Console

    made = Console(stderr=stderr, highlight=False)
    if not made.is_terminal and not os.environ.get("COLUMNS", "").isdecimal():
        made.width = UNLIMITED
    return made


def make_table(*headings: str) -> Table:
    """Return a table with a line under its headings and no other lines."""
    from rich import box
    from rich.table import Table

    return Table(*headings, box=box.SIMPLE_HEAD)


def show_log() -> None:
    """Print on stderr which rasterizer renders a run, and why."""
    logging.basicConfig(format="lapgs: %(message)s")
    logging.getLogger("lapgs_plugin.rasterizers.choice").setLevel(logging.INFO)


def train_command(scene: Path, options: str = "") -> str:
    """Return the command that trains a scene with further options, as a user can paste it."""
    run = Path("runs") / scene.absolute().name
    return f"lapgs train {shlex.quote(str(scene))} -o {shlex.quote(str(run))} --eval {options}".rstrip()
