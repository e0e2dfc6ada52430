"""Test `lapgs run --breakdown`: delays in a checkout's loop appear in their parts, which add up to the optimization."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.optim.optimizer import register_optimizer_step_pre_hook

from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.runs import gpu_busy
from lapgs_plugin.runs.profiling import PARTS
from tests.contract.stub_runs import NAMES, STUBS, run_hierarchy, run_residuals

TINY = ("--iterations", 18, "--densify_from_iter", 0, "--densification_interval", 2, "--densify_until_iter", 18)
LOSS, BACKWARD, DENSIFY, STEP = 0.05, 0.03, 0.06, 0.02
"""Seconds of each sleep, far longer than any operation at 64x48 pixels."""


class Slow(StageHook):
    """Sleep, and count the calls."""

    def __init__(self) -> None:
        self.densified = {1: 0, 0: 0}

    def compose(self, context: StageContext, image: Tensor) -> Tensor:
        time.sleep(LOSS)
        image.register_hook(lambda _: time.sleep(BACKWARD))
        return image

    def on_densify(self, context: StageContext) -> None:
        self.densified[context.stage.level] += 1
        time.sleep(DENSIFY)


@pytest.mark.parametrize("name", [NAMES[0], *(pytest.param(name, marks=pytest.mark.slow) for name in NAMES[1:])])
def test_delays_land_in_their_parts(scene: Path, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_busy, "profile_kernels", lambda: lambda: 0.25)  # stands in for a GPU's profile
    hook = Slow()
    backward = torch.Tensor.backward
    archive, _ = run_hierarchy(
        STUBS[name], scene, tmp_path / "run", *TINY, hooks=(hook,), breakdown=True, gpu_busy=True
    )
    assert torch.Tensor.backward is backward
    assert hook.densified[0] > 0 or name == "taming"  # in so few iterations no Gaussian qualifies there
    for record in archive.manifest.records:
        assert record.gpu_busy_seconds == pytest.approx(0.25 * record.iterations / (record.iterations // 5))
        parts = record.breakdown_seconds
        assert tuple(parts) == PARTS
        assert math.fsum(parts.values()) == pytest.approx(record.train_seconds, rel=0.03)  # 0.2 % seen
        slept = {
            "loss": record.iterations * LOSS,
            "backward": record.iterations * BACKWARD,
            "densification": hook.densified[record.level] * DENSIFY,
        }
        for part in PARTS:
            own = parts[part] - slept.get(part, 0.0)
            # The parts add up to the whole, so a sleep counted in another part would be missing here.
            assert own > 0 or (part, slept.get(part)) == ("densification", 0.0), part


def test_optimizers_are_told_by_their_steps(scene: Path, tmp_path: Path) -> None:
    taken: list[str] = []

    def slow(optimizer: torch.optim.Optimizer, *_: Any) -> None:
        taken.append(type(optimizer).__name__)
        time.sleep(STEP)

    class SlowSteps(StageHook):
        """Register a hook of the optimizer after the stage has begun, so that the sleep is inside the marked part."""

        def on_stage_start(self, stage: Any) -> None:
            if not handles:
                handles.append(register_optimizer_step_pre_hook(slow))

    handles: list[Any] = []
    try:
        archive, _ = run_hierarchy(
            STUBS["taming"], scene, tmp_path / "run", *TINY, "--sh_lower", hooks=(SlowSteps(),), breakdown=True
        )
    finally:
        handles[0].remove()
    assert len(taken) >= 16, "with every iteration but the last one of a stage"
    optimizer = sum(record.breakdown_seconds["optimizer"] for record in archive.manifest.records)
    assert optimizer >= STEP * len(taken)
    whole = sum(record.train_seconds for record in archive.manifest.records)
    assert sum(sum(r.breakdown_seconds.values()) for r in archive.manifest.records) == pytest.approx(whole, rel=0.03)


def test_fields_that_are_trained_along_count(scene: Path, tmp_path: Path) -> None:
    archive, _ = run_residuals(STUBS["graphdeco"], scene, tmp_path / "run", *TINY, joint=0.5)
    base, residual = archive.manifest.records
    assert residual.peak_gaussians >= base.num_gaussians + residual.num_gaussians
    apart, _ = run_residuals(STUBS["graphdeco"], scene, tmp_path / "apart", *TINY, joint=0.0)
    assert apart.manifest.record(0).peak_gaussians < base.num_gaussians + residual.num_gaussians


def test_without_the_option_nothing_of_it_is_there(scene: Path, tmp_path: Path) -> None:
    class Looking(StageHook):
        seen: Any = None

        def before_render(self, context: StageContext) -> None:
            Looking.seen = torch.Tensor.backward

    backward = torch.Tensor.backward
    archive, _ = run_hierarchy(STUBS["graphdeco"], scene, tmp_path / "run", *TINY, hooks=(Looking(),))
    assert Looking.seen is backward
    assert [record.breakdown_seconds for record in archive.manifest.records] == [{}, {}]
    assert all(0 < record.mean_gaussians <= record.peak_gaussians for record in archive.manifest.records)
