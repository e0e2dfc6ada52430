"""The runtime breakdown of the built-in trainer: known delays are in their parts, which add up to the whole."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from lapgs_plugin.errors import TrainingStoppedError
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.runs import gpu_busy
from lapgs_plugin.runs.profiling import PARTS
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.settings import Densification, TrainSettings
from tests.training_runs import Said, StopAt, plys, resume, train
from tests.training_scene import ring_scene

SETTINGS = TrainSettings(
    iterations=30, sh_degree=0, joint=0.0, densification=Densification(start=3, until=25, every=5, reset_every=100)
)
DELAYS = {"forward": 0.004, "loss": 0.002, "backward": 0.006, "other": 0.003, "optimizer": 0.005}
"""Seconds that every iteration spends in a part on top of its work, which takes about 1 ms in all."""


class SlowRasterizer(CpuRasterizer):
    def __call__(self, *inputs: Any, **options: Any) -> RenderResult:
        if torch.is_grad_enabled():
            time.sleep(DELAYS["forward"])
        return super().__call__(*inputs, **options)


class SlowHook(StageHook):
    def compose(self, context: StageContext, image: torch.Tensor) -> torch.Tensor:
        time.sleep(DELAYS["loss"])
        image.register_hook(lambda _: time.sleep(DELAYS["backward"]))
        return image

    def after_backward(self, context: StageContext) -> None:
        time.sleep(DELAYS["other"])


def test_delays_are_in_their_parts_and_all_parts_are_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = TrainableField.step

    def slow_step(*inputs: Any, **options: Any) -> None:
        time.sleep(DELAYS["optimizer"])
        step(*inputs, **options)

    monkeypatch.setattr(TrainableField, "step", slow_step)
    monkeypatch.setattr(gpu_busy, "profile_kernels", lambda: lambda: 0.25)  # stands in for a GPU's profile
    options = {"user_hooks": [SlowHook()], "breakdown": True, "gpu_busy": True, "test_every": 3}
    archive = train(tmp_path / "run", ring_scene(), SETTINGS, SlowRasterizer(), **options)
    for record in archive.manifest.records:
        assert record.gpu_busy_seconds == pytest.approx(0.25 * record.iterations / (record.iterations // 5))
        parts = record.breakdown_seconds
        assert tuple(parts) == PARTS
        assert math.fsum(parts.values()) == pytest.approx(record.train_seconds, rel=0.02)  # 0.1 % seen
        for part, delay in DELAYS.items():
            # As they add up to the whole, a delay told of another part would be missing here.
            assert parts[part] >= delay * record.iterations, part
        assert parts["densification"] > 0


def test_means_and_parts_continue_where_a_run_stopped(tmp_path: Path) -> None:
    scene = ring_scene()
    whole = train(tmp_path / "whole", scene, SETTINGS)
    assert [record.breakdown_seconds for record in whole.manifest.records] == [{}, {}]
    for record in whole.manifest.records:
        counts = {e["iteration"]: e["num_gaussians"] for e in whole.history() if e["level"] == record.level}
        starts = [counts[i] for i in range(1, record.iterations)]  # after each iteration; the next is made on them
        first = record.mean_gaussians * record.iterations - sum(starts)
        assert first == pytest.approx(round(first), abs=1e-6)
        assert 0 < first <= record.peak_gaussians
    for measured_before in (True, False):
        folder, said = tmp_path / str(measured_before), Said()
        with pytest.raises(TrainingStoppedError):
            train(folder, scene, SETTINGS, monitor=StopAt(0, 7), breakdown=measured_before)
        record = resume(folder, scene, SETTINGS, monitor=said, breakdown=True).manifest.record(0)
        assert record.mean_gaussians == whole.manifest.record(0).mean_gaussians
        if measured_before:
            assert math.fsum(record.breakdown_seconds.values()) == pytest.approx(record.train_seconds, rel=0.05)
            assert said.lines == []
        else:
            assert record.breakdown_seconds == {}
            assert "level 0 was started without --breakdown" in said.lines[0]


def test_jointly_trained_fields_count(tmp_path: Path) -> None:
    settings = replace(SETTINGS, hierarchy="laplacian", joint=0.5)
    archive = train(tmp_path / "run", ring_scene(), settings)
    base, residual = archive.manifest.records
    counts = [entry["num_gaussians"] for entry in archive.history() if entry["level"] == 0]
    half = residual.iterations // 2
    assert counts[-1] == residual.num_gaussians + base.num_gaussians
    assert residual.peak_gaussians == max(counts)
    assert counts[half] - counts[half - 2] >= base.num_gaussians  # they join in between
    assert max(counts[: half - 1]) < base.num_gaussians + residual.num_gaussians


def test_measuring_changes_no_bit(tmp_path: Path) -> None:
    scene = ring_scene()
    runs = [train(tmp_path / str(flag), scene, SETTINGS, breakdown=flag) for flag in (False, True)]
    assert plys(runs[0]) == plys(runs[1])


def test_writing_a_level_is_timed_by_the_archive(tmp_path: Path) -> None:
    for record in train(tmp_path / "run", ring_scene(), SETTINGS).manifest.records:
        assert 0 < record.overhead_seconds["archive"] < 10
