"""Progress outside of a terminal: lines at most every ten seconds."""

from __future__ import annotations

import io
import re
import sys
import time
from contextlib import suppress

import pytest
from rich.console import Console
from rich.progress import TextColumn
from tqdm import tqdm

from lapgs_plugin import progress
from lapgs_plugin.jit.notice import say_compiling
from lapgs_plugin.progress import LoggingProgress
from lapgs_plugin.training.monitor import ProgressMonitor


def lines_of(monkeypatch: pytest.MonkeyPatch, items: int, seconds_each: float, figures: str = "") -> list[str]:
    """Return the lines that are printed about work whose items take so long."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    shown = io.StringIO()
    bar = LoggingProgress(TextColumn("{task.description}"), console=Console(file=shown), unit="images")
    bar.get_time = lambda: now[0]
    with bar:
        task = bar.add_task("Reading", total=items, figures=figures)
        for done in range(1, items + 1):
            now[0] += seconds_each
            bar.update(task, completed=done)
    return shown.getvalue().splitlines()


def test_short_work_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    assert lines_of(monkeypatch, 100, 0.05) == ["Reading 100 of 100 images (100 %) 20.0 a second"]


def test_long_work_is_a_line_every_five_per_cent(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = lines_of(monkeypatch, 1000, 1.0, "7.0 it/s loss 0.1")  # 5 % take 50 s
    assert len(lines) == 21
    assert lines[0] == "Reading 10 of 1000 images (1 %) 0:16:30 left 7.0 it/s loss 0.1"  # after ten seconds
    assert lines[1] == "Reading 60 of 1000 images (6 %) 0:15:40 left 7.0 it/s loss 0.1"


@pytest.mark.parametrize(("items", "seconds_each", "apart"), [(300, 0.2, 10.0), (40, 300.0, 300.0), (4000, 5.0, 60.0)])
def test_lines_are_ten_seconds_to_a_minute_apart(
    monkeypatch: pytest.MonkeyPatch, items: int, seconds_each: float, apart: float
) -> None:
    lines = lines_of(monkeypatch, items, seconds_each)
    assert len(lines) == pytest.approx(items * seconds_each / apart, abs=2)  # 1.7 seen


def test_a_terminal_has_a_bar_and_no_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=60)
    with LoggingProgress(TextColumn("{task.description}"), console=console, unit="images") as bar:
        bar.update(bar.add_task("Reading", total=2), completed=2)
    assert "of 2 images" not in shown.getvalue()
    assert "Reading" in shown.getvalue()


def test_what_a_run_says_is_one_line_or_left_out() -> None:
    shown = io.StringIO()
    text = "10 training views are few for 7,000 iterations " * 5 + "[in /runs/a]"
    for advice in (True, False):
        with ProgressMonitor(Console(file=shown, width=80), 1, advice) as monitor:
            monitor.say(text)
    assert shown.getvalue() == f"{text}\n"


def test_tracked_work_without_a_terminal_is_counted_to_its_end() -> None:
    shown = io.StringIO()
    with LoggingProgress(TextColumn("{task.description}"), console=Console(file=shown), unit="views") as bar:
        for _ in bar.track(range(2), description="Rendering"):
            time.sleep(0.15)  # longer than rich waits between two refreshes
    (line,) = shown.getvalue().splitlines()
    assert line.startswith("Rendering 2 of 2 views (100 %) ")


def test_a_scripts_bar_does_not_hide_what_it_waits_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its first iteration compiles our kernels, also with --off: the bar stands at 0 meanwhile."""
    shown = io.StringIO()
    monkeypatch.setattr(sys, "stderr", shown)
    say_compiling.cache_clear()
    with tqdm(total=150, desc="Training progress", file=shown):
        say_compiling("CPU")
        say_compiling("CPU")
    lines = [line for line in re.split(r"[\r\n]", shown.getvalue()) if "compiling" in line]
    assert lines == ["compiling CPU kernels, which may take a minute; later runs load them from a cache ..."]


def test_work_that_is_slow_from_its_start_says_how_long_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """rich knows no rate before the third item."""
    assert lines_of(monkeypatch, 40, 12.0)[0] == "Reading 1 of 40 images (2 %) 0:07:48 left"


def test_work_that_ends_with_items_left_says_how_many(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.StringIO()
    monkeypatch.setattr(progress, "EscapingConsole", lambda **_: Console(file=shown))
    with progress.item_progress("photos") as bar:
        bar.update(bar.add_task("Placing", total=40), completed=16)
    assert shown.getvalue().startswith("Placing 16 of 40 photos (40 %)")
    with suppress(KeyboardInterrupt), progress.item_progress("photos") as bar:
        bar.update(bar.add_task("Reading", total=40), completed=16)
        raise KeyboardInterrupt
    assert "Reading" not in shown.getvalue(), "the reason is enough"


def test_time_left_does_not_jump_with_items_that_come_in_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos are placed one by one, then all are adjusted for a minute."""
    now, left = [0.0], []
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    bar = progress.item_progress("photos")
    bar.get_time = lambda: now[0]
    with bar:
        task = bar.add_task("Placing", total=240)
        for done in range(1, 121):
            now[0] += 60.0 if done % 10 == 0 else 1.0
            bar.update(task, completed=done)
            if done >= 40:
                left.append(progress.seconds_left(bar.tasks[0]) + now[0])
    assert max(left) / min(left) < 1.3  # seen 1.19: the time of the end; 3.5 with a rate of the last 30 seconds
