"""Test `lapgs bench EXPERIMENT` as users run it: to the end, again, with mistakes, and in parallel."""

from __future__ import annotations

import csv
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lapgs_bench.app import app
from lapgs_bench.experiments.expansion import plan_runs
from lapgs_bench.experiments.run import option_names
from lapgs_bench.experiments.schema import load_experiment
from lapgs_bench.experiments.settings import Selection
from lapgs_bench.experiments.store import DONE, FAILED, Job, ResultStore
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.scenes.sample import make_sample_scene
from tests.waiting import wait_for

EXPERIMENT = """
name = "tiny"
title = "Tiny"
iterations = 20
[[scenes]]
name = "mine"
path = "scene"
[backbones.cpu]
rasterizer = "cpu"
[[variants]]
name = "one field"
method = "bare"
[[variants]]
name = "two levels"
options = { levels = 2, sh_degree = 1 }
[table]
columns = ["train_seconds", "psnr"]
"""
LAPGS = [sys.executable, "-m", "lapgs_plugin", "bench"]


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = tmp_path_factory.mktemp("sample") / "scene"
    make_sample_scene(scene, width=48, height=32, views=8, points=100, progress=False)
    return scene


@pytest.fixture
def experiment(sample: Path, tmp_path: Path) -> Path:
    (tmp_path / "scene").symlink_to(sample)
    path = tmp_path / "tiny.toml"
    path.write_text(EXPERIMENT)
    return path


def bench(experiment: Path, *more: str) -> subprocess.CompletedProcess[str]:
    command = [*LAPGS, str(experiment), "--out", "out", *more]
    return subprocess.run(command, cwd=experiment.parent, capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.slow
def test_a_run_that_fails_is_reported_and_a_finished_one_never_repeated(experiment: Path, sample: Path) -> None:
    torn = Path(shutil.copytree(sample, experiment.parent / "torn"))
    whole = (torn / "images" / "0003.png").read_bytes()
    (torn / "images" / "0003.png").write_bytes(whole[: len(whole) // 2])  # with a whole header, so only the run fails
    head, rest = EXPERIMENT.split("[backbones.cpu]")
    text = f'{head}[[scenes]]\nname = "torn"\npath = "torn"\n[backbones.cpu]{rest}'
    experiment.write_text(
        text.replace('[[variants]]\nname = "two levels"\noptions = { levels = 2, sh_degree = 1 }\n', "")
    )
    first = bench(experiment, "--no-eval")
    assert first.returncode == 1
    assert "1 of 2 runs failed" in first.stderr
    assert "0003.png" in first.stderr, "the end of the log says why"
    assert "Traceback" not in first.stderr
    out = experiment.parent / "out"
    with (out / "results.csv").open(newline="") as stream:
        (row,) = csv.DictReader(stream)
    assert (row["variant"], row["scene"], row["method"], row["iterations"]) == ("one field", "mine", "bare", "20")
    assert float(row["psnr"]) > 5.0
    assert row["measured_by"] == "training"
    assert Path(row["folder"], "manifest.json").is_file()
    assert "| one field |" in (out / "tables.md").read_text()
    written = Path(row["folder"], "manifest.json").stat().st_mtime_ns
    outcomes = ResultStore(out / "results.sqlite").outcomes()
    assert [outcome.state for outcome in outcomes] == [DONE, FAILED]

    (torn / "images" / "0003.png").write_bytes(whole)
    second = bench(experiment, "--no-eval")
    assert second.returncode == 0, second.stderr
    assert "1 of 2 runs are done already" in second.stderr
    assert Path(row["folder"], "manifest.json").stat().st_mtime_ns == written
    with (out / "results.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [one["scene"] for one in rows] == ["mine", "torn"]


@pytest.mark.slow
def test_killed_in_the_middle_two_others_go_on_and_share_the_work(experiment: Path) -> None:
    sample = 'sample = { size = "48x32", views = 8, points = 100 }'
    text = EXPERIMENT.replace('path = "scene"', sample)
    experiment.write_text(text.replace("iterations = 20", "iterations = 400"))
    out = experiment.parent / "out"
    command = [*LAPGS, str(experiment), "--out", "out", "--no-eval"]
    doomed = subprocess.Popen(command, cwd=experiment.parent, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    wait_for(lambda: bool(list((out / "runs").glob("*/manifest.json"))))
    doomed.send_signal(signal.SIGKILL)
    doomed.wait()
    both = [
        subprocess.Popen(command, cwd=experiment.parent, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        for _ in range(2)
    ]
    said = [process.communicate(timeout=600)[1].decode() for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    outcomes = ResultStore(out / "results.sqlite").outcomes()
    assert [outcome.state for outcome in outcomes] == [DONE, DONE]
    assert [outcome.record["attempt"] for outcome in outcomes if outcome.record is not None] == [2, 1]
    with (out / "results.csv").open(newline="") as stream:
        assert len(list(csv.DictReader(stream))) == 2


def test_results_of_another_version_are_named(experiment: Path) -> None:
    out = experiment.parent / "out"
    planned = plan_runs(load_experiment(experiment, option_names()), Selection())
    store = ResultStore.create(out / "results.sqlite")
    store.plan([Job(run.spec.run_id, run.spec, "", "", (), True, "{}") for run in planned])
    claim = store.claim([planned[0].spec.run_id])
    assert claim is not None
    store.record(claim, {"psnr": 20.0, "train_seconds": 1.0, "lapgs_version": "0.0.9"})
    words = [str(experiment), "--out", str(out), "--tables-only"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0
    assert "some results were made by lapgs_plugin 0.0.9" in result.stderr
    assert "lapgs_plugin 0.0.9" in (out / "tables.md").read_text()
    assert "| one field |" in result.stdout, "a pipe gets the Markdown"
    assert result.stdout.rstrip().endswith(f"lapgs report {out} writes a page with curves and images")
    shown = CliRunner().invoke(app, words, env={"FORCE_COLOR": "1", "COLUMNS": "150"}).stdout
    assert "one field" in shown
    assert "20.00" in shown
    assert "|" not in shown, "a terminal gets tables, not their source"


def test_tables_of_nothing(experiment: Path) -> None:
    error = (
        CliRunner().invoke(app, [str(experiment), "--out", str(experiment.parent / "out"), "--tables-only"]).exception
    )
    assert isinstance(error, RunFolderError)
    assert "does not exist" in str(error)


def test_a_dry_run_prints_commands_and_writes_nothing(experiment: Path) -> None:
    result = CliRunner().invoke(app, [str(experiment), "--dry-run", "--out", str(experiment.parent / "out")])
    assert result.exit_code == 0
    assert "lapgs_plugin train" in result.output
    assert "lapgs_plugin eval" in result.output
    assert not (experiment.parent / "out").exists()


def test_subcommands_are_still_found() -> None:
    help_of_raster = CliRunner().invoke(app, ["raster", "--help"]).output
    assert "Measure training iterations of the CPU rasterizer" in help_of_raster
    assert "EXPERIMENT" in CliRunner().invoke(app, ["--help"]).output
