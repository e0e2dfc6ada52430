"""The measurements of a loop: which seconds are optimization, which iterations count, what the run folder gets."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

import pytest
import torch

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.runs.profiling import Overhead, breakdown_on
from lapgs_plugin.stages.record import LoopCounts, LoopRecord, StageRecord
from lapgs_plugin.training.settings import TrainSettings
from tests.training_runs import make_archive

CPU = torch.device("cpu")
STAGE = Stage(1, (8, 6), 4, signed=False)


class Time:
    """Let time pass when a test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)

    def passes(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Time:
    return Time(monkeypatch)


def test_seconds_beside_optimization_are_overhead_alone(clock: Time) -> None:
    record = LoopRecord(CPU)
    record.start()
    with record.outside("saving"):  # before the first iteration
        clock.passes(1)
    assert record.elapsed() == 0
    record.start_clock()
    for _ in range(2):
        clock.passes(10)
        record.start_clock()  # of the next iteration
        with record.outside("saving"):
            clock.passes(2)
    with suppress(OSError), record.outside("view"):
        clock.passes(4)
        raise OSError("full")
    clock.passes(10)
    assert record.elapsed() == 30
    record.stop(0)
    clock.passes(50)
    assert record.counts.seconds == record.elapsed() == 30
    assert record.overhead == {"saving": 5, "view": 4}
    assert record.memory_bytes == {}, "a CPU's are not measured"


def test_a_clock_that_stops_between_steps_adds_up_the_steps(clock: Time) -> None:
    record = LoopRecord(CPU, counts=LoopCounts(iteration=2, seconds=5.0), breakdown=breakdown_on(CPU))
    for _ in range(3):
        record.resume_clock()
        clock.passes(1)
        record.breakdown.mark("forward")
        clock.passes(2)
        record.pause_clock()
        clock.passes(40)
    assert record.counts.seconds == 14
    parts = record.breakdown.seconds()
    assert (parts["other"], parts["forward"], sum(parts.values())) == (3, 6, 9)


def test_a_profile_that_ends_with_the_loop_leaves_no_part_running(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lapgs_plugin.runs.gpu_busy.profile_kernels", lambda: lambda: 0.5)
    record = LoopRecord(CPU, 5, breakdown=breakdown_on(CPU))
    record.start()
    record.start_clock()
    for iteration in range(1, 6):
        record.count(iteration, 10)
    record.stop(0)
    before = record.breakdown.seconds()
    record.breakdown.pause()  # as what follows training does
    assert record.breakdown.seconds() == before
    assert record.busy.seconds() == pytest.approx(2.5)


def field_of(count: int) -> GaussianField:
    return GaussianField(
        torch.zeros(count, 3), torch.ones(count, 4), torch.zeros(count, 3), torch.zeros(count), torch.zeros(count, 1, 3)
    )


def test_a_stage_is_archived_with_its_counts(tmp_path: Path, clock: Time) -> None:
    settings = TrainSettings(iterations=8, sh_degree=0)
    with make_archive(tmp_path / "run", settings) as archive:
        record = StageRecord(
            archive=archive, stage=STAGE, iterations=8, device=CPU, overhead=Overhead({"pyramid": 1.5})
        )
        record.start()
        record.start_clock()
        for iteration, gaussians in enumerate((20, 10, 40, 10), start=1):
            record.count(iteration, gaussians)
            clock.passes(3)
        record.write_history(4, {"elapsed": record.elapsed_in_run(), "psnr": 20.0})
        record.stop(0)
        archive.finish_level(record.of_level(1), field_of(1))
        with record.after_archive("evaluation"):
            clock.passes(7)
        assert [line[:41] for line in record.weak_lines()] == ["level 1 ended with 1 of the 20 Gaussians "]
        later = StageRecord(archive=archive, stage=Stage(0, (16, 12), 4, signed=True), iterations=8, device=CPU)
        assert later.elapsed_in_run() == 12
    run = RunArchive.open(tmp_path / "run")
    (level,) = run.manifest.records
    assert (level.iterations, level.num_gaussians, level.train_seconds) == (4, 1, 12)
    assert (level.start_gaussians, level.peak_gaussians, level.mean_gaussians) == (20, 40, 20)
    assert level.overhead_seconds == {"pyramid": 1.5, "archive": 0, "evaluation": 7}
    assert run.history() == [{"level": 1, "iteration": 4, "elapsed": 12.0, "psnr": 20.0}]


def test_a_stage_that_is_extended_counts_on(tmp_path: Path, clock: Time) -> None:
    before = LevelRecord(1, False, 4, 30, 40, 12.0, {"pyramid": 1.5}, (8, 6), {"peak": 9, "images": 2}, 20.0)
    with make_archive(tmp_path / "run", TrainSettings(iterations=8, sh_degree=0)) as archive:
        counts = LoopCounts.of(before)
        record = StageRecord(
            archive=archive, stage=STAGE, iterations=8, device=CPU, counts=counts, memory_before=before.memory_bytes
        )
        assert (counts.iteration, counts.gaussian_steps, counts.peak_gaussians) == (4, 80, 40)
        record.memory_bytes = {"peak": 5, "images": 3}
        record.resume_clock()
        clock.passes(1)
        record.pause_clock()
        level = record.of_level(50)
    assert (level.train_seconds, level.peak_gaussians) == (13, 50)
    assert level.memory_bytes == {"peak": 9, "images": 3}
