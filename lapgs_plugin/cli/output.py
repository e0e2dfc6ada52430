"""Make the console on which a command prints its tables."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

UNLIMITED = 10_000
"""Width in columns where there is no terminal: more than any table has."""


def make_console(*, stderr: bool = False) -> Console:
    """Return a console that fits its lines to a terminal, and neither wraps nor cuts them in files and pipes.

    The environment variable COLUMNS sets the width of either.
    """
    from rich.console import Console

    made = Console(stderr=stderr)
    if not made.is_terminal and not os.environ.get("COLUMNS", "").isdigit():
        made.width = UNLIMITED
    return made
