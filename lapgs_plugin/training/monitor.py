"""Show the progress of a run."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Column

from lapgs_plugin.errors import printable
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.progress import LoggingProgress


@dataclass(frozen=True)
class Tick:
    """Hold the state of training at one moment.

    Attributes:
        level, iteration: the iteration counts from 1 within the stage of the level.
        elapsed: optimization seconds since the start of the run, over all stages.
        loss: smoothed photometric loss.
        num_gaussians: Gaussians being optimized.
        rate: iterations a second since the last tick.
        psnr: mean PSNR in dB of all held-out views, composed at full resolution; None if it was not measured now.
        sampled_psnr, sampled_fitted_psnr: of some held-out views, always the same ones; the latter after a colour fit.
    """

    level: int
    iteration: int
    elapsed: float
    loss: float
    num_gaussians: int
    rate: float
    psnr: float | None = None
    sampled_psnr: float | None = None
    sampled_fitted_psnr: float | None = None


class Monitor:
    """Receive a run's progress. Every method is a no-op to override."""

    def stage_started(self, stage: Stage, first_iteration: int) -> None:
        """Receive a stage whose training begins, or is resumed, at an iteration."""

    def tick(self, stage: Stage, tick: Tick) -> None:
        """Receive the state after some more iterations."""

    def say(self, text: str) -> None:
        """Receive one line of text."""


class ProgressMonitor(Monitor):
    """Show a progress bar for each stage: rate, time left, loss, Gaussians, held-out PSNR. Use as a context manager.

    Args:
        console: to print to.
        levels: of the run.
        advice: print lines of text too, which name options of `lapgs train`.
    """

    def __init__(self, console: Console, levels: int, advice: bool = True) -> None:
        self._levels, self._advice = levels, advice
        self._progress = LoggingProgress(
            TextColumn("{task.description}", table_column=Column(no_wrap=True)),
            BarColumn(bar_width=None, table_column=Column(ratio=1)),
            MofNCompleteColumn(table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[figures]}", table_column=Column(no_wrap=True)),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True, table_column=Column(no_wrap=True)),
            console=console,
            expand=True,
            unit="iterations",
        )
        self._task: TaskID | None = None
        self._psnr: float | None = None

    def __enter__(self) -> ProgressMonitor:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def stage_started(self, stage: Stage, first_iteration: int) -> None:
        width, height = stage.image_size
        base = self._levels > 1 and stage.level == self._levels - 1
        name = "base" if base else "residual" if stage.signed else "field"
        self._psnr = None
        self._task = self._progress.add_task(
            f"{name} {width}x{height}",
            total=stage.iterations,
            completed=first_iteration - 1,
            figures="",
        )

    def tick(self, stage: Stage, tick: Tick) -> None:
        assert self._task is not None
        psnr = tick.sampled_psnr if tick.psnr is None else tick.psnr
        self._psnr = self._psnr if psnr is None else psnr  # measured rarely: the last one stays visible
        held_out = "" if self._psnr is None else f" PSNR {self._psnr:.2f} dB"
        figures = f"{tick.rate:.1f} it/s loss {tick.loss:.4f} {tick.num_gaussians / 1000:.1f}k Gaussians{held_out}"
        self._progress.update(self._task, completed=tick.iteration, total=stage.iterations, figures=figures)

    def say(self, text: str) -> None:
        if self._advice:
            self._progress.console.print(printable(text), highlight=False, markup=False, soft_wrap=True)
