"""Measure the optimization in a checkout's training loop, and write that of a stage into the run folder."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

from lapgs_plugin.checkouts.training_call import StageWindow
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.runner.iteration_parts import IterationParts
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.gpu_busy import GpuBusy
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.runs.profiling import Overhead, PeakMemory

HISTORY_ENTRIES = 200
"""About how many entries a run adds to its history."""


class LoopRecord:
    """Measure a loop from its first iteration to its end, without what is beside optimization.

    Args:
        device: device that the checkout renders on.
        profiled: number of iterations of which some are profiled; 0 profiles none.

    Attributes:
        overhead: seconds beside optimization, by purpose.
        iteration: running iteration, from 1; 0 before the first.
        first, peak: Gaussians at the start of the first iteration, and most at that of any.
        seconds: of optimization, once the loop has ended.
        memory_bytes: see `PeakMemory.note`.
    """

    def __init__(self, device: torch.device, profiled: int = 0) -> None:
        self._device, self._busy = device, GpuBusy(profiled)
        self.overhead = Overhead(settle=self._synchronize)
        self.iteration = self.first = self.peak = 0
        self.seconds = 0.0
        self.memory_bytes: dict[str, int] = {}
        self._gaussian_steps = 0  # Gaussians, summed over the iterations
        self._began: float | None = None
        self._excluded = 0.0  # seconds since `_began` that are not optimization
        self._memory: PeakMemory  # set by `start`

    def start(self) -> None:
        """Start measuring GPU memory."""
        self._memory = PeakMemory(self._device)

    def start_clock(self) -> None:
        """Start the clock of optimization, unless it runs already."""
        if self._began is None:
            self._synchronize()
            self._began = time.perf_counter()

    def count(self, iteration: int, gaussians: int) -> None:
        """Note the number of Gaussians of an iteration that is about to begin."""
        self._profile(iteration - 1)
        self.first = self.first or gaussians
        self.iteration = iteration
        self.peak = max(self.peak, gaussians)
        self._gaussian_steps += gaussians

    @contextmanager
    def outside(self, purpose: str) -> Iterator[None]:
        """Stop the clock of optimization inside, and count the time as overhead."""
        self._synchronize()
        start = time.perf_counter()
        with self.overhead.timed(purpose):
            yield
        self._excluded += time.perf_counter() - start

    def note_memory(self, image_bytes: int) -> None:
        """Note the GPU memory in use and the bytes of images in it."""
        self.memory_bytes = self._memory.note(image_bytes)

    def elapsed(self) -> float:
        """Return the seconds of optimization so far."""
        assert self._began is not None, "training() without an iteration"
        return time.perf_counter() - self._began - self._excluded

    def stop(self, image_bytes: int) -> None:
        """Stop the clock of optimization and measure the memory."""
        self._profile(self.iteration)
        self._synchronize()
        self.seconds = self.elapsed()
        self.note_memory(image_bytes)

    @property
    def mean_gaussians(self) -> float:
        """Mean number of Gaussians over the iterations."""
        return self._gaussian_steps / self.iteration

    @property
    def gpu_busy_seconds(self) -> float | None:
        """Estimated seconds in which the GPU executed kernels; None if nothing was profiled."""
        return self._busy.seconds()

    def _profile(self, done: int) -> None:
        """Start or end a profile if it is due after so many iterations."""
        if self._busy.due(done):
            with self.outside("profile"):
                self._busy.step(done)

    def _synchronize(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize()


class StageRecord(LoopRecord):
    """Measure one stage and write the measurements into the run folder.

    Args:
        archive: the run folder, open for writing.
        window: the stage.
        parts: parts of the run's iterations.
        gpu_busy: whether some iterations are profiled.
    """

    def __init__(self, archive: RunArchive, window: StageWindow, parts: IterationParts, gpu_busy: bool) -> None:
        super().__init__(parts.device, window.stage.iterations if gpu_busy else 0)
        self._archive, self._window, self._parts = archive, window, parts

    def start(self) -> None:
        """Start measuring GPU memory, and drop history entries of an interrupted run of this stage."""
        self._archive.rewind_history(self._window.stage.level, 0)
        super().start()
        self._parts.stage_begins()

    def write_progress(self, gaussians: int) -> bool:
        """Add the running iteration to the history if it is one of about `HISTORY_ENTRIES`; return whether it is."""
        due = self.iteration % max(1, self._window.total // HISTORY_ENTRIES) == 0
        if due:
            self._write_history(self.iteration, {"elapsed": self.elapsed_in_run(), "num_gaussians": gaussians})
        return due

    def write_quality(self, iteration: int, quality: Mapping[str, float], elapsed: float | None = None) -> None:
        """Add the quality of held-out views after an iteration to the history."""
        self._write_history(iteration, {**({} if elapsed is None else {"elapsed": elapsed}), **quality})

    @contextmanager
    def outside(self, purpose: str) -> Iterator[None]:
        self._parts.breakdown.pause()
        with super().outside(purpose):
            yield
        self._parts.breakdown.mark("other")

    def elapsed_in_run(self) -> float:
        """Return the seconds of optimization since the start of the run."""
        return sum(record.train_seconds for record in self._archive.manifest.records) + self.elapsed()

    def stop(self, image_bytes: int) -> None:
        super().stop(image_bytes)  # may end a profile, after which parts are measured again
        self._parts.breakdown.pause()

    def archive(
        self, field: GaussianField, inherited: dict[str, Any], joint_fields: Mapping[int, GaussianField] | None
    ) -> None:
        """Write the stage's field, measurements, what the next stage inherits, and jointly trained coarser fields."""
        stage = self._window.stage
        self._archive.finish_level(
            LevelRecord(
                level=stage.level,
                signed=stage.signed,
                iterations=stage.iterations,
                num_gaussians=len(field),
                peak_gaussians=max(self.peak, len(field)),
                train_seconds=self.seconds,
                overhead_seconds=dict(self.overhead),
                image_size=stage.image_size,
                memory_bytes=self.memory_bytes,
                mean_gaussians=self.mean_gaussians,
                breakdown_seconds=self._parts.breakdown.seconds(),
                gpu_busy_seconds=self.gpu_busy_seconds,
                start_gaussians=self.first,
            ),
            field,
            inherited if stage.level > 0 and any(inherited.values()) else None,
            joint_fields,
        )

    @contextmanager
    def after_archive(self, purpose: str) -> Iterator[None]:
        """Count the time inside as overhead of the archived level."""
        overhead = Overhead(settle=self._synchronize)
        with overhead.timed(purpose):
            yield
        self._archive.add_overhead(overhead)

    def _write_history(self, iteration: int, values: Mapping[str, Any]) -> None:
        self._archive.append_history({"level": self._window.stage.level, "iteration": iteration, **values})
