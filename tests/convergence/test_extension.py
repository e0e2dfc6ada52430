"""A finished run is trained further by `lapgs train --resume --iterations MORE`."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import torch

from lapgs_plugin.errors import DeviceMemoryError, TrainingStoppedError, UserInputError
from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.files import MANIFEST
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CHECKPOINT
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training import trainer
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.preparation import extended_settings
from lapgs_plugin.training.saved_settings import settings_from_manifest
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.settings import Densification, TrainSettings
from tests.training_runs import StopAt, plys, resume, train
from tests.training_scene import ring_scene

BEFORE, AFTER = 40, 64
WRITE_JSON = RunArchive._write_json
SETTINGS = TrainSettings(
    iterations=BEFORE,
    hierarchy="laplacian",
    sh_degree=1,
    sh_every=10,
    densification=Densification(start=3, until=1000, every=5, reset_every=50),
    joint=0.25,
)
KINDS = {
    "laplacian": SETTINGS,
    "nested": replace(SETTINGS, hierarchy="nested", joint=None, appearance="bilateral"),
    "one field": replace(SETTINGS, levels=1, joint=None, appearance="affine", keep="best"),
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene(train=12)


@pytest.fixture(scope="module", params=list(KINDS))
def finished(request: pytest.FixtureRequest, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("finished") / "run", scene, KINDS[request.param]).path()


def extend(path: Path, scene: Scene, asked: int | None = AFTER, monitor: Monitor | None = None) -> None:
    archive = RunArchive.open(path)
    settings = extended_settings(archive, settings_from_manifest(archive.manifest), asked)
    resume(path, scene, settings, monitor=monitor or Monitor())


def fails_at_the_manifest(self: RunArchive, path: Path, values: dict[str, Any], training: bool = False) -> None:
    if path.name == MANIFEST:
        raise OSError("no room")
    WRITE_JSON(self, path, values, training)


def contents(path: Path) -> list[bytes]:
    return plys(RunArchive.open(path))


def quality(path: Path, scene: Scene) -> float:
    renderer = HierarchyRenderer.from_archive(RunArchive.open(path), CpuRasterizer())
    return fmean(psnr(renderer.render(view.camera).composed[0], view.image) for view in scene.train)


def test_a_finished_run_is_extended(finished: Path, scene: Scene, tmp_path: Path) -> None:
    path = Path(shutil.copytree(finished, tmp_path / "run"))
    old = RunArchive.open(finished)
    RunArchive.open(path).write_metrics({"psnr": 1.0})
    extend(path, scene)
    new = RunArchive.open(path)
    settings = settings_from_manifest(new.manifest)
    assert (settings.iterations, settings.extended) == (AFTER, AFTER - BEFORE)
    (*coarser, before), (*same, after) = old.manifest.records, new.manifest.records
    assert coarser == same
    assert after.iterations == before.iterations + AFTER - BEFORE
    assert after.num_gaussians == before.num_gaussians
    assert after.train_seconds > before.train_seconds
    assert not new.path(CHECKPOINT).exists()
    assert new.metrics() is None, "they were of the shorter run"
    joint = old.manifest.settings["joint"] > 0
    assert [a != b for a, b in zip(contents(finished), contents(path), strict=True)][:-1] == [joint] * len(coarser)
    assert contents(finished)[-1] != contents(path)[-1]
    # It rose by 0.9 dB at least.
    assert quality(path, scene) >= quality(finished, scene)
    for grids in filter(None, [old.grids(0)]):
        assert any((grids[name] != grid).any() for name, grid in (new.grids(0) or {}).items())
    history = new.history()
    assert history[: len(old.history())] == old.history()
    assert (history[-1]["level"], history[-1]["iteration"]) == (0, after.iterations)
    assert all(a["elapsed"] <= b["elapsed"] for a, b in itertools.pairwise(history))
    unchanged = contents(path)
    extend(path, scene, None)
    assert contents(path) == unchanged, "nothing is left to do"


@pytest.mark.parametrize("finished", ["laplacian", "one field"], indirect=True)
def test_an_interrupted_extension_leaves_the_run_and_continues(finished: Path, scene: Scene, tmp_path: Path) -> None:
    whole, parts = (Path(shutil.copytree(finished, tmp_path / name)) for name in ("whole", "parts"))
    extend(whole, scene)
    stop = RunArchive.open(finished).manifest.records[-1].iterations + 11
    with pytest.raises(TrainingStoppedError):
        extend(parts, scene, monitor=StopAt(0, stop))
    assert contents(parts) == contents(finished)
    assert RunArchive.open(parts).manifest == RunArchive.open(finished).manifest
    with pytest.raises(UserInputError, match=f"--iterations {AFTER + 1}: .* is being extended to {AFTER}; leave"):
        extend(parts, scene, AFTER + 1)
    extend(parts, scene, None)
    assert contents(parts) == contents(whole)


@pytest.mark.parametrize("finished", ["laplacian"], indirect=True)
def test_an_extension_that_cannot_be_written_leaves_the_run(
    finished: Path, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = Path(shutil.copytree(finished, tmp_path / "run"))
    with monkeypatch.context() as patch:
        patch.setattr(RunArchive, "_write_json", fails_at_the_manifest)
        with pytest.raises(OSError, match="no room"):
            extend(path, scene)
    assert list(path.glob("level_0/extended_*")), "written, but they do not count"
    assert contents(path) == contents(finished)
    extend(path, scene)
    assert not list(path.glob("level_*/extended_*"))


@pytest.mark.parametrize("finished", ["one field"], indirect=True)
def test_fewer_iterations_are_refused(finished: Path, scene: Scene) -> None:
    with pytest.raises(UserInputError, match=f"--iterations {BEFORE - 1}: .* is finished with {BEFORE}; give more"):
        extend(finished, scene, BEFORE - 1)


def test_the_schedule_goes_on_as_it_ended() -> None:
    settings = replace(SETTINGS, iterations=4000, levels=1, joint=None, densification=Densification(until=10_000))
    stage = Stage(0, (64, 48), 4000, signed=False)
    longer = StageSchedule.create(replace(settings, iterations=5001, extended=1001), stage)
    schedule = StageSchedule.create(settings, stage)
    assert longer.means_learning_rate(4500) == schedule.means_learning_rate(4000)
    assert longer.densify_until == 4000
    calm = replace(settings, densification=Densification(until=2000))
    longer = StageSchedule.create(replace(calm, iterations=5001, extended=1001), stage)
    done, steps = 0, []
    while done < longer.end:
        steps.append(longer.views_of_step(done))
        done += steps[-1]
    assert done == 5001
    assert set(steps[-100:-1]) == {calm.accumulate_views}
    assert all(4000 < each <= 5001 for each in longer.sampled(4))


def test_a_full_gpu_names_the_finest_level(
    finished: Path, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    path = tmp_path / "run"
    shutil.copytree(finished, path)
    monkeypatch.setattr(trainer, "warm_up", full)
    with pytest.raises(DeviceMemoryError, match="no memory left at level 0; finished levels"):
        extend(path, scene)
