"""Test that `lapgs run --off --record` measures a script's own run and does not change it."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor
from typer.testing import CliRunner

from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.evaluation.figures import evaluate_run
from lapgs_plugin.fields.gaussian_field import count_gaussians
from lapgs_plugin.files import BARE_RECORD
from lapgs_plugin.runner.imported import import_run, read_foreign_run
from lapgs_plugin.runner.recording import BareRunRecorder
from lapgs_plugin.runs import gpu_busy
from lapgs_plugin.runs.options import MeasuringOptions
from tests.contract.stub_runs import (
    CHECKOUTS,
    ITERATIONS,
    NAMES,
    SAVING,
    SHORT,
    STUBS,
    Result,
    arguments,
    captured,
    files,
    loaded,
    run_hierarchy,
    without,
)

EVERY = ITERATIONS // 3
"""Iterations between two measurements of held-out views."""
PROFILED = 0.5
"""Seconds of kernels that the stand-in of a GPU's profile finds each time."""


@pytest.fixture(autouse=True)
def _profile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_busy, "profile_kernels", lambda: lambda: PROFILED)


def record(name: str, scene: Path, folder: Path, test_every: int | None = None) -> Result:
    results: list[Result] = []
    measuring = MeasuringOptions(gpu_busy=True, test_every=test_every)
    with captured(folder, results), loaded(STUBS[name], scene, folder, *SAVING) as adapter:
        BareRunRecorder(adapter, "cpu", measuring).run()
    return results[0]


@pytest.mark.parametrize("name", NAMES)
def test_a_recorded_run_is_the_bare_run_to_the_bit(
    name: str, bare_run: Callable[[str], tuple[Result, Tensor]], scene: Path, tmp_path: Path
) -> None:
    bare, _ = bare_run(name)
    start = time.perf_counter()
    recorded = record(name, scene, tmp_path / "recorded")
    wall = time.perf_counter() - start
    assert recorded.losses == bare.losses
    assert files(recorded.folder) == files(bare.folder)

    values = json.loads((recorded.folder / BARE_RECORD).read_text())
    last = recorded.folder / f"point_cloud/iteration_{ITERATIONS}/point_cloud.ply"
    assert values["backbone"] == name
    assert values["num_gaussians"] == count_gaussians(last)
    assert values["iterations"] == ITERATIONS
    assert [entry["iteration"] for entry in values["timeline"]] == list(range(1, ITERATIONS + 1))
    counts = [entry["num_gaussians"] for entry in values["timeline"]]
    assert values["mean_gaussians"] == pytest.approx(sum(counts) / ITERATIONS)
    assert values["peak_gaussians"] >= max(*counts, values["num_gaussians"])
    assert values["saving_seconds"] > 0
    profiled_iterations = PROFILED / (ITERATIONS // gpu_busy.WINDOWS)
    assert values["gpu_busy_seconds"] == pytest.approx(profiled_iterations * ITERATIONS)
    assert values["train_seconds"] + values["saving_seconds"] < wall
    assert values["timeline"][-1]["elapsed"] <= values["train_seconds"]


@pytest.mark.parametrize("name", NAMES)
def test_held_out_quality_along_a_run_changes_nothing(
    name: str, bare_run: Callable[[str], tuple[Result, Tensor]], scene: Path, tmp_path: Path
) -> None:
    bare, _ = bare_run(name)
    recorded = record(name, scene, tmp_path / "recorded", test_every=EVERY)
    assert recorded.losses == bare.losses
    assert files(recorded.folder) == files(bare.folder)

    values = json.loads((recorded.folder / BARE_RECORD).read_text())
    measured = [entry for entry in values["timeline"] if "psnr" in entry]
    assert [entry["iteration"] for entry in measured] == [*range(EVERY, ITERATIONS, EVERY), ITERATIONS]
    assert measured[-1]["psnr"] == values["psnr"]
    assert measured[-1]["elapsed"] == values["train_seconds"]
    times = [entry["elapsed"] for entry in values["timeline"]]
    assert times == sorted(times)


def test_quality_along_a_bare_run_is_in_the_history_of_the_imported_run(scene: Path, tmp_path: Path) -> None:
    recorded = record("graphdeco", scene, tmp_path / "recorded", test_every=EVERY)
    values = json.loads((recorded.folder / BARE_RECORD).read_text())
    archive = import_run(read_foreign_run(recorded.folder), tmp_path / "imported", codebase="graphdeco")
    psnrs = [entry["psnr"] for entry in archive.history() if "psnr" in entry]
    assert psnrs == [entry["psnr"] for entry in values["timeline"] if "psnr" in entry]


def test_iterations_are_steps_where_nothing_says_when_they_begin(scene: Path, tmp_path: Path) -> None:
    script = tmp_path / "checkouts" / "graphdeco" / "train.py"
    shutil.copytree(CHECKOUTS, tmp_path / "checkouts", ignore=shutil.ignore_patterns("__pycache__"))
    text = script.read_text(encoding="utf-8")
    script.write_text(text.replace("gaussians.update_learning_rate(iteration)", "pass"), encoding="utf-8")
    folder, more = tmp_path / "out", ("--iterations", 20)
    with captured(folder, []), loaded(STUBS["graphdeco"], scene, folder, *more, script=script) as adapter:
        without(adapter.profile.model, "update_learning_rate")
        BareRunRecorder(adapter, "cpu", MeasuringOptions()).run()
    values = json.loads((folder / BARE_RECORD).read_text())
    assert values["iterations"] == 20, "the loop leaves out the last step"
    assert [entry["iteration"] for entry in values["timeline"]] == list(range(1, 21))


@pytest.mark.parametrize(("end", "is_recorded"), [("sys.exit()", True), ("sys.exit(0)", True), ("sys.exit(3)", False)])
def test_a_script_that_exits_is_recorded_if_it_succeeded(
    end: str, is_recorded: bool, scene: Path, tmp_path: Path
) -> None:
    script = tmp_path / "checkouts" / "graphdeco" / "train.py"
    shutil.copytree(CHECKOUTS, tmp_path / "checkouts", ignore=shutil.ignore_patterns("__pycache__"))
    ended = 'print("\\nTraining complete.")'
    text = script.read_text(encoding="utf-8")
    assert ended in text
    script.write_text(text.replace(ended, f"import sys; {end}"), encoding="utf-8")
    folder, more = tmp_path / "out", ("--iterations", 20)
    with loaded(STUBS["graphdeco"], scene, folder, *more, script=script) as adapter, pytest.raises(SystemExit):
        BareRunRecorder(adapter, "cpu", MeasuringOptions()).run()
    assert (folder / BARE_RECORD).is_file() == is_recorded


def test_import_run_takes_over_what_was_recorded(scene: Path, tmp_path: Path) -> None:
    recorded = record("graphdeco", scene, tmp_path / "recorded")
    values = json.loads((recorded.folder / BARE_RECORD).read_text())
    foreign = read_foreign_run(recorded.folder)
    assert foreign.times_are_known
    archive = import_run(foreign, tmp_path / "imported", codebase="graphdeco")
    (level,) = archive.manifest.records
    assert (level.train_seconds, level.mean_gaussians) == (values["train_seconds"], values["mean_gaussians"])
    assert level.gpu_busy_seconds == values["gpu_busy_seconds"]
    assert level.overhead_seconds["saving"] == values["saving_seconds"]
    assert len(archive.history()) == ITERATIONS
    # The script's own render against our rasterizer on the saved field: rounding, worst seen 7e-8 dB; where
    # a pixel at 1/255 differs on another processor, 5e-5.
    measured = evaluate_run(archive)
    assert measured["psnr"] == pytest.approx(values["psnr"], abs=1e-3)
    assert measured["ssim"] == pytest.approx(values["ssim"], abs=1e-4)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (("--breakdown",), "--breakdown"),
        (("--test-every", 5), "--test-every"),
        (("--resume", "--prune", 0.0, "--levels", 2), "--levels, --prune, --resume"),
        (("--no-fused-adam",), "--fused-adam"),
        (("--gpu-busy",), "--gpu-busy"),
    ],
)
def test_options_that_off_has_no_use_for(scene: Path, tmp_path: Path, given: tuple[Any, ...], named: str) -> None:
    stub = STUBS["fastgs"]
    words = ["run", "--off", *map(str, given), "--device", "cpu", str(stub.script)]
    error = CliRunner().invoke(app, [*words, *arguments(stub, scene, tmp_path / "out")]).exception
    assert isinstance(error, UserInputError)
    assert str(error).startswith(f"{named} has no effect with --off")
    assert not (tmp_path / "out").exists()


def test_a_bare_run_is_not_recorded_into_a_run_in_levels(scene: Path, tmp_path: Path) -> None:
    stub, folder = STUBS["fastgs"], tmp_path / "run"
    run_hierarchy(stub, scene, folder, *SHORT)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    words = ["run", "--off", "--record", "--device", "cpu", str(stub.script)]
    error = CliRunner().invoke(app, [*words, *arguments(stub, scene, folder, SHORT)]).exception
    assert isinstance(error, RunFolderError)
    assert str(error) == f"-m {folder}: it holds a run in levels; give a bare run another folder"
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_record_without_off(scene: Path, tmp_path: Path) -> None:
    stub = STUBS["fastgs"]
    words = ["run", "--record", "--device", "cpu", str(stub.script), *arguments(stub, scene, tmp_path / "out")]
    error = CliRunner().invoke(app, words).exception
    assert isinstance(error, UserInputError)
    assert "--record needs --off" in str(error)
