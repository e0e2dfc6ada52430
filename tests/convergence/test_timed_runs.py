"""Runs of `lapgs train --time`: the clock decides the lengths of levels, and a stopped run keeps its decisions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from lapgs_plugin.errors import TrainingDivergedError, TrainingStoppedError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training.settings import TrainSettings
from lapgs_plugin.training.time_budget import COARSER_COST, END_SECONDS
from tests.training_runs import StopAt, plys, resume, train
from tests.training_scene import ring_scene

TIMED = TrainSettings(iterations=400, time="7s", sh_degree=1, appearance="affine", split="1/2,1/2", joint=0.25)
"""Of `Ticks` that is 889 iterations and a second to end; 400 are what was expected."""


class Ticks(StageHook):
    """A clock that goes on by a hundredth of a second with each view that is trained, by less at a coarser level."""

    def __init__(self) -> None:
        self.seconds = 1000.0

    def __call__(self) -> float:
        return self.seconds

    def after_backward(self, context: StageContext) -> None:
        self.seconds += 0.01 * COARSER_COST**context.stage.level


def timed() -> dict[str, Any]:
    """Return options of a trainer whose clock ticks."""
    ticks = Ticks()
    return {"clock": ticks, "user_hooks": [ticks]}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene()


@pytest.fixture(scope="module", params=["laplacian", "nested"])
def whole(request: pytest.FixtureRequest, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> RunArchive:
    """Return an uninterrupted run."""
    return train(tmp_path_factory.mktemp("whole") / "run", scene, of_kind(request.param), **timed())


def of_kind(hierarchy: str) -> TrainSettings:
    return replace(TIMED, hierarchy=hierarchy, joint=0.25 if hierarchy == "laplacian" else None)


def test_each_level_gets_its_share_of_the_seconds(whole: RunArchive) -> None:
    base, finest = whole.manifest.records
    assert base.iterations == pytest.approx(444, rel=0.05)
    assert finest.iterations == pytest.approx(444, rel=0.05)
    assert whole.manifest.complete
    last = [entry for entry in whole.history() if entry["level"] == 0][-1]
    assert last["iteration"] == finest.iterations
    assert last["psnr"] > 15.0  # 17.2 dB seen


@pytest.mark.parametrize(("level", "iteration"), [(1, 40), (1, 420), (0, 100), (0, 420)])
def test_a_stopped_run_keeps_what_the_clock_decided(
    scene: Scene, tmp_path: Path, whole: RunArchive, level: int, iteration: int
) -> None:
    settings = of_kind(whole.manifest.settings["hierarchy"])
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "parts", scene, settings, monitor=StopAt(level, iteration), **timed())
    archive = resume(tmp_path / "parts", scene, settings, **timed())
    lengths = [record.iterations for record in archive.manifest.records]
    assert lengths == [record.iterations for record in whole.manifest.records]
    assert plys(archive) == plys(whole)


def test_a_run_killed_before_it_saved_anything_of_its_time_has_all_of_it(scene: Scene, tmp_path: Path) -> None:
    """The seconds of its base were over before it got a time."""
    planned = replace(TIMED, time=None)
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "run", scene, planned, monitor=StopAt(0, 20))
    base = RunArchive.open(tmp_path / "run").manifest.record(1)
    seconds = base.train_seconds + sum(base.overhead_seconds.values())
    for_training = min(0.5, seconds / 2)
    timed_run = replace(planned, time=f"{END_SECONDS + for_training:.3f}s")
    archive = resume(tmp_path / "run", scene, timed_run, **timed())
    assert archive.manifest.record(0).iterations == pytest.approx(20 + 100 * for_training, rel=0.2)


def test_divergence_is_named_where_the_clock_ends_a_level_at_once(scene: Scene, tmp_path: Path) -> None:
    class Steep(Ticks):
        def loss(self, context: StageContext, image: torch.Tensor) -> torch.Tensor | None:
            if context.iteration != 40:
                return None
            self.seconds += 60.0
            return (0.0 * image.mean()).sqrt()  # 0, with a gradient of infinity times 0

    ticks = Steep()
    settings = TrainSettings(iterations=400, levels=1, time="6s", sh_degree=0, appearance="none")
    with pytest.raises(TrainingDivergedError, match=r"level 0, iteration 40: .*NaN"):
        train(tmp_path / "run", scene, settings, clock=ticks, user_hooks=[ticks])


class Degrees(CpuRasterizer):
    """Note the SH degrees of renders."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[int] = []

    def __call__(self, field: GaussianField, *values: Any, sh_degree: int | None = None, **more: Any) -> RenderResult:
        if sh_degree is not None:
            self.seen.append(sh_degree)
        return super().__call__(field, *values, sh_degree=sh_degree, **more)


def test_no_level_falls_back_to_a_lower_sh_degree_when_it_gets_longer(scene: Scene, tmp_path: Path) -> None:
    """60 iterations are expected: degree 2 from the fourth on. The clock allows 1000, of which it would be the 66th."""
    settings = TrainSettings(iterations=60, levels=1, time="10s", sh_degree=2, appearance="none")
    whole = Degrees()
    ended = train(tmp_path / "whole", scene, settings, whole, **timed())
    assert ended.manifest.record(0).iterations > 500
    degrees = whole.seen[1:]  # the first render looks whether anything is visible
    assert degrees[:10] == sorted(degrees[:10])
    assert set(degrees[4:]) == {2}
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "parts", scene, settings, monitor=StopAt(0, 40), **timed())
    assert plys(resume(tmp_path / "parts", scene, settings, **timed())) == plys(ended)
