"""Runs of `lapgs train --stop auto`: views that are set aside decide the lengths of levels."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from lapgs_plugin.errors import RunFolderError, TrainingStoppedError, UserInputError
from lapgs_plugin.hooks import StageContext, StageHook
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CHECKPOINT
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training import gains
from lapgs_plugin.training.preparation import TrainRequest
from lapgs_plugin.training.quality import set_aside_to_stop
from lapgs_plugin.training.settings import Densification, TrainSettings
from tests.training_runs import Said, plys, resume, train
from tests.training_scene import ring_scene

MOST = 400
KINDS: dict[str, dict[str, Any]] = {
    "laplacian": {"joint": 0.25, "appearance": "affine"},
    "nested": {"hierarchy": "nested", "views_per_step": "2"},
    "one field": {"levels": 1, "refine_poses": True},
}


def of_kind(kind: str) -> TrainSettings:
    return TrainSettings(**{"iterations": MOST, "stop": "auto", "sh_degree": 1, "appearance": "none", **KINDS[kind]})


class Trained(StageHook):
    """Note which views are trained, by level."""

    def __init__(self) -> None:
        self.names: dict[int, list[str]] = {}

    def before_render(self, context: StageContext) -> None:
        self.names.setdefault(context.stage.level, []).append(context.view)


class Stops(StageHook):
    """Stop the run, as Ctrl-C does, when a level reaches an iteration."""

    def __init__(self, level: int, iteration: int) -> None:
        self._level, self._iteration = level, iteration

    def after_backward(self, context: StageContext) -> None:
        if context.stage.level == self._level and context.iteration >= self._iteration:
            signal.raise_signal(signal.SIGINT)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene(train=12)


@pytest.fixture(scope="module", autouse=True)
def easily_content() -> Any:
    """End stages when views promise less than 3 dB: this scene gains in all its iterations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gains, "LEAST_GAIN", 3.0)
        yield


@pytest.fixture(scope="module", params=list(KINDS))
def whole(request: pytest.FixtureRequest, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return the kind of an uninterrupted run, the run, its views and its lines."""
    said, views = Said(), Trained()
    folder = tmp_path_factory.mktemp("whole") / "run"
    archive = train(folder, scene, of_kind(request.param), monitor=said, user_hooks=[views])
    return request.param, archive, views.names, said.lines


def aside(scene: Scene) -> set[str]:
    return {view.name for view in set_aside_to_stop(scene.train)}


def test_levels_end_when_views_stop_gaining(whole: Any) -> None:
    kind, archive, _, lines = whole
    records: Sequence[Any] = archive.manifest.records
    assert archive.manifest.complete
    for record in records:
        decided = record.decided
        if record.level < len(records) - 1:
            assert decided is None
            assert record.iterations == records[0].iterations, "in proportion to the coarsest's"
            continue
        assert decided.most == MOST // len(records)
        assert decided.views == 3
        assert record.iterations < decided.most
        assert record.iterations == pytest.approx(decided.after / 0.6, abs=1)
        assert -10.0 < decided.gain < 3.0
        assert any(
            f"level {record.level}: {record.iterations:,} iterations, of at most {decided.most:,}; after "
            f"{decided.after}, 3 views set aside promised {decided.gain:+.2f} dB" in line
            for line in lines
        )
    assert any("3 of 12 training views are set aside" in line for line in lines)
    last = [entry for entry in archive.history() if entry["level"] == 0][-1]
    assert last["iteration"] == records[-1].iterations
    assert last["psnr"] > 13.0, kind


def test_views_set_aside_are_trained_on_when_lengths_are_decided(whole: Any, scene: Scene) -> None:
    _, archive, names, _ = whole
    for record in archive.manifest.records:
        views = names[record.level]
        if record.level < archive.manifest.levels - 1:
            assert set(views) == {view.name for view in scene.train}
            continue
        after = record.decided.after
        assert len(views) == record.iterations
        assert not aside(scene) & set(views[:after])
        assert set(views[:after]) == {view.name for view in scene.train} - aside(scene)
        assert aside(scene) & set(views[after:])


@pytest.mark.parametrize("where", ["before", "after"])
@pytest.mark.parametrize("level", [1, 0])
def test_a_stopped_run_decides_alike(whole: Any, scene: Scene, tmp_path: Path, level: int, where: str) -> None:
    kind, archive, *_ = whole
    if level >= archive.manifest.levels:
        pytest.skip("one level")
    decided = archive.manifest.record(level).decided
    after = 30 if decided is None else decided.after
    stop = after - 7 if where == "before" else after + 5
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "parts", scene, of_kind(kind), user_hooks=[Stops(level, stop)])
    parts = resume(tmp_path / "parts", scene, of_kind(kind), user_hooks=[Trained()])
    assert [r.decided for r in parts.manifest.records] == [r.decided for r in archive.manifest.records]
    assert plys(parts) == plys(archive)


def test_statistics_of_density_control_go_on_when_a_level_becomes_shorter(scene: Scene, tmp_path: Path) -> None:
    settings = replace(of_kind("one field"), refine_poses=False)
    decided = train(tmp_path / "whole", scene, settings).manifest.record(0).decided
    assert decided is not None
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "parts", scene, settings, user_hooks=[Stops(0, decided.after)])
    checkpoint = RunArchive.open(tmp_path / "parts").load_checkpoint()
    assert checkpoint is not None
    assert checkpoint["gains"]["decided"] == checkpoint["counts"]["iteration"] == decided.after
    assert checkpoint["densifier"]["count"].max() > 10  # views that showed a Gaussian


def test_a_level_that_becomes_shorter_is_pruned_although_its_densification_is_over_by_then(
    scene: Scene, tmp_path: Path
) -> None:
    densification = Densification(strategy="3dgs", start=2)
    settings = replace(of_kind("one field"), refine_poses=False, densification=densification)
    counts = {}
    for share in (0.0, 0.05):
        archive = train(tmp_path / str(share), scene, replace(settings, prune=share), test_every=1)
        record = archive.manifest.record(0)
        counts[share] = {entry["iteration"]: entry["num_gaussians"] for entry in archive.history()}
        assert record.decided is not None
        until = record.iterations / 2
        assert until < record.decided.after < MOST / 2, "no densification ends at an iteration of the stage"
        after = record.decided.after
    assert counts[0.0][after - 1] == counts[0.05][after - 1]
    assert 0.05 < 1 - counts[0.05][after] / counts[0.0][after] < 0.5


def test_a_damaged_decision_is_one_line(scene: Scene, tmp_path: Path) -> None:
    settings = of_kind("one field")
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "run", scene, settings, user_hooks=[Stops(0, 40)])
    path = tmp_path / "run" / CHECKPOINT
    saved = torch.load(path, weights_only=True)
    with pytest.raises(RunFolderError, match="gains has measurements, expected none without --stop auto"):
        resume(tmp_path / "run", scene, replace(settings, stop="planned"))
    saved["state"]["gains"]["looks"] = [(0, ["x"])]
    torch.save(saved, path)
    with pytest.raises(RunFolderError, match=r"gains\.looks"):
        resume(tmp_path / "run", scene, settings)
    saved["state"]["gains"] = None
    torch.save(saved, path)
    with pytest.raises(RunFolderError, match="gains is None, expected measurements with --stop auto"):
        resume(tmp_path / "run", scene, settings)


def test_a_stopped_run_that_gets_a_time_ends_with_it(scene: Scene, tmp_path: Path) -> None:
    settings = replace(of_kind("one field"), iterations=100_000)
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "run", scene, settings, user_hooks=[Stops(0, 500)])
    archive = resume(tmp_path / "run", scene, replace(settings, time="2s"))
    assert archive.manifest.complete
    assert 500 < archive.manifest.record(0).iterations < 50_000
    assert archive.manifest.record(0).decided is None


def test_a_time_and_views_do_not_both_decide(tmp_path: Path) -> None:
    chosen = frozenset({"time", "stop"})
    with pytest.raises(UserInputError, match="--time 9s with --stop auto: both say when to end"):
        TrainRequest("scene", tmp_path, TrainSettings(time="9s", stop="auto"), chosen=chosen)


def test_archives_of_other_runs_have_no_decision(scene: Scene, tmp_path: Path) -> None:
    archive = train(tmp_path / "run", scene, TrainSettings(iterations=20, levels=1, sh_degree=0, appearance="none"))
    assert RunArchive.open(archive.path()).manifest.record(0).decided is None
