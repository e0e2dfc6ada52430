"""Measure a stage of a checkout's training: seconds, Gaussians, GPU memory and held-out quality."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

from lapgs_plugin.checkouts.training_call import StageWindow
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.runner.context import RunContext, StageResult
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.gpu_busy import GpuBusy
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.runs.profiling import Overhead, PeakMemory

HISTORY_ENTRIES = 200
"""About how many entries a run adds to its history."""


class StageRecord:
    """Measure one stage and write the measurements into the run folder.

    Attributes:
        overhead: seconds beside optimization, by purpose.
        iteration: running iteration, from 1; 0 before the first.
        peak: most Gaussians at the start of an iteration.
    """

    def __init__(self, context: RunContext, archive: RunArchive, window: StageWindow) -> None:
        self._context, self._archive, self._window = context, archive, window
        self.overhead = Overhead(settle=self._synchronize)
        self.iteration = self.peak = 0
        self._gaussian_steps = 0  # Gaussians, summed over the iterations
        self._began: float | None = None
        self._busy = GpuBusy(window.stage.iterations if context.gpu_busy else 0)
        self._excluded = 0.0  # seconds since `_began` that are not optimization
        self._memory: PeakMemory  # set by `start`
        self._memory_bytes: dict[str, int] = {}

    def start(self) -> None:
        """Start measuring GPU memory, and drop history entries of an interrupted run of this stage."""
        self._archive.rewind_history(self._window.stage.level, 0)
        self._memory = PeakMemory(self._context.device)
        self._context.parts.stage_begins()

    def start_clock(self) -> None:
        """Start the clock of optimization, unless it runs already."""
        if self._began is None:
            self._synchronize()
            self._began = time.perf_counter()

    def count(self, iteration: int, gaussians: int) -> None:
        """Note the number of Gaussians of an iteration that is about to begin."""
        self._profile(iteration - 1)
        self.iteration = iteration
        self.peak = max(self.peak, gaussians)
        self._gaussian_steps += gaussians

    def write_progress(self, gaussians: int) -> bool:
        """Add the running iteration to the history if it is one of about `HISTORY_ENTRIES`; return whether it is."""
        due = self.iteration % max(1, self._window.total // HISTORY_ENTRIES) == 0
        if due:
            self._write_history(self.iteration, {"elapsed": self.elapsed(), "num_gaussians": gaussians})
        return due

    def write_quality(self, iteration: int, quality: Mapping[str, float], elapsed: float | None = None) -> None:
        """Add the quality of held-out views after an iteration to the history."""
        self._write_history(iteration, {**({} if elapsed is None else {"elapsed": elapsed}), **quality})

    def note_memory(self, image_bytes: int) -> None:
        """Note the GPU memory in use and the bytes of images in it."""
        self._memory_bytes = self._memory.note(image_bytes)

    @contextmanager
    def outside(self, purpose: str) -> Iterator[None]:
        """Stop the clock of optimization inside, and count the time as overhead."""
        self._synchronize()
        start = time.perf_counter()
        self._context.parts.breakdown.pause()
        with self.overhead.timed(purpose):
            yield
        self._excluded += time.perf_counter() - start
        self._context.parts.breakdown.mark("other")

    def elapsed(self) -> float:
        """Return the seconds of optimization since the start of the run."""
        return sum(record.train_seconds for record in self._archive.manifest.records) + self._seconds()

    def stop(self, image_bytes: int) -> None:
        """Stop the clock of optimization and measure the memory."""
        self._profile(self.iteration)
        self._context.parts.breakdown.pause()
        self._synchronize()
        self._train_seconds = self._seconds()
        self.note_memory(image_bytes)

    def archive(self, result: StageResult, joint_fields: Mapping[int, GaussianField] | None) -> None:
        """Write the stage's field and measurements, and the coarser fields that were trained jointly, by level."""
        stage, field = self._window.stage, result.field
        inherited: dict[str, Any] = {"carried": dict(result.carried), "moments": dict(result.moments)}
        self._archive.finish_level(
            LevelRecord(
                level=stage.level,
                signed=stage.signed,
                iterations=stage.iterations,
                num_gaussians=len(field),
                peak_gaussians=max(self.peak, len(field)),
                train_seconds=self._train_seconds,
                overhead_seconds=dict(self.overhead),
                image_size=stage.image_size,
                memory_bytes=self._memory_bytes,
                mean_gaussians=self._gaussian_steps / stage.iterations,
                breakdown_seconds=self._context.parts.breakdown.seconds(),
                gpu_busy_seconds=self._busy.seconds(),
            ),
            field,
            inherited if stage.level > 0 and any(inherited.values()) else None,
            joint_fields,
        )

    def _profile(self, done: int) -> None:
        """Start or end a profile if it is due after so many iterations."""
        if self._busy.due(done):
            with self.outside("profile"):
                self._busy.step(done)

    @contextmanager
    def after_archive(self, purpose: str) -> Iterator[None]:
        """Count the time inside as overhead of the archived level."""
        overhead = Overhead(settle=self._synchronize)
        with overhead.timed(purpose):
            yield
        self._archive.add_overhead(overhead)

    def _write_history(self, iteration: int, values: Mapping[str, Any]) -> None:
        self._archive.append_history({"level": self._window.stage.level, "iteration": iteration, **values})

    def _seconds(self) -> float:
        """Return the stage's seconds of optimization so far."""
        assert self._began is not None, "training() without an iteration"
        return time.perf_counter() - self._began - self._excluded

    def _synchronize(self) -> None:
        if self._context.device.type == "cuda":
            torch.cuda.synchronize()
