"""Measure the optimization in a training loop, and write that of a stage into the run folder."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from typing_extensions import Self

from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.gpu_busy import GpuBusy
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.runs.profiling import Breakdown, Overhead, PeakMemory
from lapgs_plugin.runs.training_figures import (
    COARSER_VIEW_PSNR,
    VIEW_PSNR,
    finest_gains,
    last_view_psnrs,
    smaller_gains,
    weak_levels,
)

HISTORY_ENTRIES = 200
"""Approximate number of history entries of a run, without those of held-out views."""


@dataclass
class LoopCounts:
    """Count the iterations of a loop, its seconds and its Gaussians.

    Attributes:
        iteration: of a checkout's loop the running one, of the built-in trainer the last finished one; 0 before the
            first.
        seconds: of optimization until the clock was last stopped.
        peak_gaussians: most Gaussians optimized at once.
        gaussian_steps: Gaussians optimized, summed over the iterations.
        start_gaussians: number of Gaussians before the first iteration; None if it was not recorded.
    """

    iteration: int = 0
    seconds: float = 0.0
    peak_gaussians: int = 0
    gaussian_steps: int = 0
    start_gaussians: int | None = None

    @classmethod
    def of(cls, record: LevelRecord) -> Self:
        """Return the counts at the end of a finished stage."""
        mean = record.num_gaussians if record.mean_gaussians is None else record.mean_gaussians
        return cls(
            iteration=record.iterations,
            seconds=record.train_seconds,
            peak_gaussians=record.peak_gaussians,
            gaussian_steps=round(mean * record.iterations),
            start_gaussians=record.start_gaussians,
        )

    @property
    def mean_gaussians(self) -> float:
        """Mean number of Gaussians over the iterations."""
        return self.gaussian_steps / self.iteration


@dataclass
class LoopRecord:
    """Measure a training loop; the time of anything but optimization is counted apart.

    Attributes:
        device: of training.
        profiled: number of iterations of which some are profiled; 0 profiles none.
        counts: iterations, seconds and Gaussians so far.
        overhead: seconds beside optimization so far, by purpose.
        breakdown: measures the seconds of optimization by part of an iteration.
        busy: estimates the seconds in which the GPU executes kernels.
        memory_bytes: see `PeakMemory.note`.
    """

    device: torch.device
    profiled: int = 0
    counts: LoopCounts = field(default_factory=LoopCounts)
    overhead: Overhead = field(default_factory=Overhead)
    breakdown: Breakdown = field(default_factory=Breakdown)
    memory_bytes: dict[str, int] = field(default_factory=dict)
    _memory: PeakMemory = field(init=False, repr=False)  # set by `start`
    _began: float | None = field(default=None, init=False)  # when the clock was last started; None while it stands

    def __post_init__(self) -> None:
        self.overhead = Overhead(self.overhead, settle=self.wait_for_device)
        self.busy = GpuBusy(self.profiled)

    def start(self) -> None:
        """Start measuring GPU memory."""
        self._memory = PeakMemory(self.device)

    def start_clock(self) -> None:
        """Start the clock of optimization, unless it runs, after the device has finished its work."""
        if self._began is None:
            self.wait_for_device()
            self.resume_clock()

    def resume_clock(self) -> None:
        """Start the clock of optimization without waiting for the device; the time is of the part "other"."""
        self._began = time.perf_counter()
        self.breakdown.mark("other")

    def pause_clock(self) -> None:
        """Stop the clock of optimization without waiting for the device."""
        self.breakdown.pause()
        self.counts.seconds = self.elapsed()
        self._began = None

    @contextmanager
    def outside(self, purpose: str) -> Iterator[None]:
        """Stop the clock of optimization inside, and count the time as overhead."""
        runs = self._began is not None
        self.wait_for_device()
        self.pause_clock()
        try:
            with self.overhead.timed(purpose):
                yield
        finally:
            if runs:
                self.resume_clock()

    def elapsed(self) -> float:
        """Return the seconds of optimization so far."""
        running = 0.0 if self._began is None else time.perf_counter() - self._began
        return self.counts.seconds + running

    def count(self, iteration: int, gaussians: int) -> None:
        """Count an iteration that is about to begin, with the number of its Gaussians."""
        self.profile(iteration - 1)
        counts = self.counts
        counts.iteration = iteration
        counts.start_gaussians = counts.start_gaussians or gaussians
        counts.peak_gaussians = max(counts.peak_gaussians, gaussians)
        counts.gaussian_steps += gaussians

    def profile(self, done: int) -> None:
        """Start or end a profile if it is due after so many iterations."""
        if self.busy.due(done):
            with self.outside("profile"):
                self.busy.step(done)

    def note_memory(self, image_bytes: int) -> None:
        """Note the GPU memory in use and the bytes of images in it, before images are added or removed."""
        self.memory_bytes = self._memory.note(image_bytes)

    def stop(self, image_bytes: int) -> None:
        """Stop the clock of optimization after the last iteration, and measure the memory."""
        self.profile(self.counts.iteration)
        self.wait_for_device()
        self.pause_clock()
        self.note_memory(image_bytes)

    def wait_for_device(self) -> None:
        """Wait until a GPU has finished its work."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


@dataclass(kw_only=True)
class StageRecord(LoopRecord):
    """Measure one stage and write the measurements into the run folder.

    Attributes:
        archive: the run folder, open for writing.
        stage: the stage.
        iterations: of the whole run.
        memory_before: the "peak" and the "images" of a finished stage that is extended.
    """

    archive: RunArchive
    stage: Stage
    iterations: int
    memory_before: Mapping[str, int] = field(default_factory=dict)

    @property
    def history_every(self) -> int:
        """Iterations between two entries of the history."""
        return max(1, self.iterations // HISTORY_ENTRIES)

    def rewind_history(self) -> None:
        """Drop history entries of iterations that an interrupted run of this stage trained and this one repeats."""
        self.archive.rewind_history(self.stage.level, self.counts.iteration)

    def write_history(self, iteration: int, values: Mapping[str, Any]) -> None:
        """Add figures of an iteration to the history."""
        self.archive.append_history({"level": self.stage.level, "iteration": iteration, **values})

    def write_view_psnrs(self, psnrs: Sequence[float], coarser: Sequence[float] = ()) -> None:
        """Add the PSNR in dB of the held-out views at the stage's end to its last entry in the history.

        Args:
            psnrs: of whole images at full size, one for each view.
            coarser: the same of the coarser levels' images alone, if the level is added to them.
        """
        figures = {VIEW_PSNR: list(psnrs), **({COARSER_VIEW_PSNR: list(coarser)} if coarser else {})}
        self.archive.complete_history({"level": self.stage.level, "iteration": self.stage.iterations, **figures})

    def elapsed_in_run(self) -> float:
        """Return the seconds of optimization since the start of the run."""
        records = self.archive.manifest.records
        return sum(record.train_seconds for record in records if record.level != self.stage.level) + self.elapsed()

    def of_level(self, num_gaussians: int) -> LevelRecord:
        """Return the manifest's record of the finished level, whose field has `num_gaussians`."""
        stage, counts, before = self.stage, self.counts, self.memory_before
        return LevelRecord(
            level=stage.level,
            signed=stage.signed,
            iterations=stage.iterations,
            num_gaussians=num_gaussians,
            peak_gaussians=max(counts.peak_gaussians, num_gaussians),
            train_seconds=counts.seconds,
            overhead_seconds=dict(self.overhead),
            image_size=stage.image_size,
            memory_bytes={name: max(n, before.get(name, 0)) for name, n in self.memory_bytes.items()},
            mean_gaussians=counts.mean_gaussians,
            breakdown_seconds=self.breakdown.seconds(),
            gpu_busy_seconds=self.busy.seconds(),
            start_gaussians=counts.start_gaussians,
        )

    def weak_lines(self) -> list[str]:
        """Return a line for the user for each sign that the level that was archived last hardly matters."""
        manifest, history = self.archive.manifest, self.archive.history()
        gains = [finest_gains(last_view_psnrs(history, along=along)) for along in (True, False)]
        return weak_levels(manifest.records[-1:], smaller_gains(*gains), manifest.settings)

    @contextmanager
    def after_archive(self, purpose: str) -> Iterator[None]:
        """Count the time inside as overhead of the archived level."""
        overhead = Overhead(settle=self.wait_for_device)
        with overhead.timed(purpose):
            yield
        self.archive.add_overhead(overhead)
