"""Measure a stage of a checkout's training, and write the measurements into the run folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from lapgs_plugin.checkouts.training_call import StageWindow
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.runner.context import StageResult, TrainingRun
from lapgs_plugin.runner.loop_record import LoopRecord
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.runs.profiling import Overhead

HISTORY_ENTRIES = 200
"""About how many entries a run adds to its history."""


class StageRecord(LoopRecord):
    """Measure one stage and write the measurements into the run folder."""

    def __init__(self, run: TrainingRun, window: StageWindow) -> None:
        super().__init__(run.context.device, window.stage.iterations if run.context.measuring.gpu_busy else 0)
        self._parts, self._archive, self._window = run.context.parts, run.archive, window

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
