"""Progress outside of a terminal: lines at most every ten seconds."""

from __future__ import annotations

import io
import re
import sys
import time

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
    assert len(lines) == 20
    assert lines[0] == "Reading 50 of 1000 images (5 %) 0:15:50 left 7.0 it/s loss 0.1"


@pytest.mark.parametrize(("items", "seconds_each", "apart"), [(300, 0.2, 10.0), (40, 300.0, 300.0), (4000, 5.0, 60.0)])
def test_lines_are_ten_seconds_to_a_minute_apart(
    monkeypatch: pytest.MonkeyPatch, items: int, seconds_each: float, apart: float
) -> None:
    lines = lines_of(monkeypatch, items, seconds_each)
    assert len(lines) == pytest.approx(items * seconds_each / apart, abs=1)  # 0.67 seen


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
