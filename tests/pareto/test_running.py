"""Runs of methods in a store: whose they are, and what is shared with other commands."""

from __future__ import annotations

import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from lapgs_bench.experiments import execution
from lapgs_bench.experiments.commands import Step
from lapgs_bench.experiments.store import Job, ResultStore
from lapgs_bench.pareto import running
from lapgs_bench.pareto.methods import Method, job_of, run_spec
from lapgs_bench.pareto.running import WARM_UP, Bench
from lapgs_bench.pareto.settings import ParetoSettings
from lapgs_plugin.errors import RunFolderError
from tests.experiments.examples import COPY, starts, tiny_run

METHOD = Method("one field", None)


@pytest.fixture(autouse=True)
def copied_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the commands of runs copy a folder instead of training."""
    tiny_run(tmp_path / "source")

    def copying(*words: object) -> Job:
        job = job_of(*words)  # type: ignore[arg-type]
        paths = job.folder, str(tmp_path / "started"), str(tmp_path / "source"), "0"
        return replace(job, steps=(Step((sys.executable, "-c", COPY, *paths), str(tmp_path)),), evaluate=True)

    monkeypatch.setattr(running, "job_of", copying)


def make_bench(tmp_path: Path, scene: str, budgets: str = "5") -> Bench:
    """Return a comparison of a scene, all in one folder."""
    folder = tmp_path / scene
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "images/photo.jpg").write_bytes(scene.encode())
    return Bench(ParetoSettings(budgets_text=budgets), folder, tmp_path / "out", lambda _: None)


def test_another_scene_of_the_same_name_is_refused(tmp_path: Path) -> None:
    """Programs call their folders alike, such as COLMAP's dense, and the default of --out has the scene's name."""
    bench = make_bench(tmp_path, "kitchen/dense")
    bench.rows(METHOD)
    trained = starts(tmp_path)
    with pytest.raises(RunFolderError, match=r"kitchen/dense, whose files differ from those of .*hall/dense; choose"):
        make_bench(tmp_path, "hall/dense").rows(METHOD)
    shutil.copytree(tmp_path / "kitchen", tmp_path / "copy")
    (tmp_path / "copy/dense/sparse/0").mkdir(parents=True)
    (tmp_path / "copy/dense/sparse/0/points3D.ply").write_text("as a training script adds it")
    assert len(replace(bench, scene=tmp_path / "copy/dense").rows(METHOD)) == 1
    (tmp_path / "kitchen").rename(tmp_path / "moved")
    assert len(replace(bench, scene=tmp_path / "moved/dense").rows(METHOD)) == 1
    assert starts(tmp_path) == trained, "a scene that was moved or copied keeps its runs"


def test_a_run_of_another_command_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = make_bench(tmp_path, "scene")
    job = running.job_of(run_spec(METHOD, bench.settings, bench.scene, WARM_UP, 0), bench.scene, bench.folder, None)
    store = ResultStore.create(bench.folder / "results.sqlite")
    store.plan([job])
    claim = store.claim([job.run_id])
    assert claim is not None
    sleep = time.sleep

    def end_the_other(seconds: float) -> None:
        store.record(claim, {"iterations": WARM_UP, "train_seconds": 10.0})
        sleep(seconds)

    monkeypatch.setattr(execution.time, "sleep", end_the_other)
    assert len(bench.rows(METHOD)) == 1
    assert job.run_id not in starts(tmp_path)


def test_runs_of_other_defaults_are_not_mixed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_bench(tmp_path, "scene").rows(METHOD)
    monkeypatch.setattr("lapgs_plugin.training.strategies.LONG_RUN", 10)  # what "auto" means for these runs
    assert len(make_bench(tmp_path, "scene").rows(METHOD)) == 1  # nothing remains to be run
    with pytest.raises(RunFolderError, match=r"have other defaults than the 1 that remain \(absgrad was"):
        make_bench(tmp_path, "scene", "5,50").rows(METHOD)
