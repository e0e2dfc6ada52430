"""Show a progress bar with rate and remaining time on stderr."""

from __future__ import annotations

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text


class RateColumn(ProgressColumn):
    """Show items per second, or seconds per item if that is below one."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        rate = task.finished_speed or task.speed
        if not rate:
            return Text(f"- {self._unit}/s")
        return Text(f"{rate:.1f} {self._unit}/s" if rate >= 1.0 else f"{1.0 / rate:.1f} s/{self._unit}")


def item_progress(unit: str) -> Progress:
    """Return a bar with count, rate in `unit` and remaining time, for use as a context manager."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        RateColumn(unit),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
