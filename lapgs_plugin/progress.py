"""Show a progress bar with rate and remaining time on stderr."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from datetime import timedelta
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
)
from rich.text import Text

from lapgs_plugin.errors import printable_lines

LEAST_SECONDS = 10.0
"""Shortest time between two lines outside of a terminal, and until the first."""

MOST_SECONDS = 60.0
"""Longest time between two lines outside of a terminal."""

STEP = 0.05
"""Share of the work after which the next line is printed, between these times."""

AVERAGED_SECONDS = 3600.0
"""Time over which the rate of items is averaged. Over shorter times it jumps, because items differ."""


class EscapingConsole(Console):
    """A console that shows control characters of names as escapes, also in tables."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable_lines(text), **options)


class LoggingProgress(Progress):
    """Show a progress bar in a terminal, and print lines elsewhere: count, share, rate, time left, figures.

    A task's field `figures` is a text with the rate and more about the work, shown at the end of its lines.

    Args:
        unit: of the items that are counted.
    """

    def __init__(self, *columns: ProgressColumn, console: Console, unit: str, **options: Any) -> None:
        shown = console.is_terminal
        # Without a bar, rich needs no thread that refreshes it.
        super().__init__(*columns, console=console, disable=not shown, auto_refresh=shown, **options)
        self._unit = unit
        self._printed: dict[TaskID, tuple[float, float]] = {}  # time of the last line and items completed then, or -inf

    def add_task(self, *arguments: Any, **options: Any) -> TaskID:
        """Add a task as rich does."""
        task = super().add_task(*arguments, **options)
        self._printed[task] = time.monotonic(), -math.inf
        return task

    def update(self, task_id: TaskID, **options: Any) -> None:
        """Update a task as rich does, and print a line if one is due."""
        super().update(task_id, **options)
        self._print_if_due(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Advance a task as rich does, and print a line if one is due."""
        super().advance(task_id, advance)
        self._print_if_due(task_id)

    def __exit__(self, kind: type[BaseException] | None, *others: Any) -> None:
        """End as rich does, and print a line about work that ends with items left, unless it failed."""
        super().__exit__(kind, *others)
        for task_id, (_, done) in self._printed.items():
            task = self._tasks[task_id]
            if self.disable and kind is None and task.total and done < task.completed:
                self._print(task_id)

    def _print_if_due(self, task_id: TaskID) -> None:
        if not self.disable:
            return
        task = self._tasks[task_id]
        since, done = self._printed[task_id]
        if task.finished:
            due = done < task.completed
        else:
            passed, moved = time.monotonic() - since, task.completed - done
            due = passed >= MOST_SECONDS or (passed >= LEAST_SECONDS and moved >= STEP * (task.total or 0))
        if due:
            self._print(task_id)

    def _print(self, task_id: TaskID) -> None:
        task = self._tasks[task_id]
        self._printed[task_id] = time.monotonic(), task.completed
        self.console.print(" ".join(self._words(task)), highlight=False, markup=False, soft_wrap=True)

    def _words(self, task: Task) -> Iterable[str]:
        """Yield the parts of a line about a task."""
        yield f"{task.description} {task.completed:.0f}"
        if task.total:
            yield f"of {task.total:.0f} {self._unit} ({task.percentage:.0f} %)"
        figures, rate = str(task.fields.get("figures") or ""), task.finished_speed or task.speed
        if rate and not figures:
            yield f"{rate:.1f} a second" if rate >= 1.0 else f"{1.0 / rate:.1f} s each"
        if left := seconds_left(task):
            yield f"{timedelta(seconds=round(left))} left"
        if figures:
            yield figures


def seconds_left(task: Task) -> float | None:
    """Return the seconds that a task still takes: by its rate, or before rich has one, by its first items."""
    if task.time_remaining is not None or not task.completed or not task.elapsed or task.remaining is None:
        return task.time_remaining
    return task.remaining * task.elapsed / task.completed


class TimeLeftColumn(ProgressColumn):
    """Show the time that is left."""

    def render(self, task: Task) -> Text:
        left = seconds_left(task)
        return Text("-:--:--" if left is None else str(timedelta(seconds=round(left))), style="progress.remaining")


class RateColumn(ProgressColumn):
    """Show items per second, or seconds per item where the rate is below one."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        rate = task.finished_speed or task.speed
        if not rate:
            return Text(f"- {self._unit}/s")
        return Text(f"{rate:.1f} {self._unit}/s" if rate >= 1.0 else f"{1.0 / rate:.1f} s each")


def item_progress(unit: str) -> Progress:
    """Return a bar with count, rate in `unit` and remaining time, for use as a context manager."""
    return LoggingProgress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        RateColumn(unit),
        TimeLeftColumn(),
        console=EscapingConsole(stderr=True),
        unit=unit,
        speed_estimate_period=AVERAGED_SECONDS,
    )
