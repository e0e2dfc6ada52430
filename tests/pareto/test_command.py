"""`lapgs bench pareto` as users type it: what it refuses, and a whole comparison."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from typer.testing import CliRunner

from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import LapgsError
from tests.cli.run_folder import write_scene
from tests.contract.stub_runs import STUBS

STUB = STUBS["graphdeco"].script.parent


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--budgets 5,10,10", "--budgets 5,10,10: expected rising seconds"),
        ("--budgets 10,5", "--budgets 10,5: expected rising seconds"),
        ("--budgets 0,5", "--budgets 0,5: expected seconds above 0"),
        ("--budgets=-5,5", "--budgets -5,5: expected seconds above 0"),
        ("--budgets nan", "--budgets nan: expected seconds above 0"),
        ("--budgets 5s", "--budgets 5s: expected seconds separated by commas"),
        ("--seeds 1,1", "--seeds 1,1: expected different numbers"),
        ("--seeds x", "--seeds x: expected whole numbers"),
        ("--lpips-weights none.pth", "--lpips-weights none.pth: no such file"),
        ("--checkout empty", "--checkout empty: has no train.py"),
        ("--checkout other", "other/train.py"),
        ("--checkout fixed", "--checkout fixed: train.py has no option --iterations"),
        ("--checkout-options x", "--checkout-options 'x': there is no --checkout"),
        ("--checkout stub --checkout-options a --checkout-options b", "given 2 times for 1 checkouts"),
        ("--checkout stub --checkout-options --iterations=5", "--checkout-options --iterations=5: scene, folder and"),
        ("--checkout stub --resolution 9/10", "resolution '9/10' for scene scene: the script of a checkout takes 1k"),
        ("--rasterizer cuda", "--rasterizer cuda: expected"),
        ("--checkout stub --device gpu", "--device gpu: expected"),
        ("--seeds=-1", "--seed -1: expected"),
        ("--checkout stub --checkout stub", "two folders make the method 'stub, own script'"),
    ],
)
def test_bad_options_are_one_line(words: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path / "scene")
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/train.py").write_text("print('no splats')\n")
    (tmp_path / "stub").symlink_to(STUB)
    copy_without_iterations(STUB, tmp_path / "fixed")
    _refused(["scene", *words.split(" ")], expected)
    assert not (tmp_path / "runs").exists()


def copy_without_iterations(checkout: Path, copy: Path) -> None:
    """Copy a checkout whose option has another name."""
    for file in checkout.rglob("*.py"):
        target = copy / file.relative_to(checkout)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(file.read_text().replace("iterations", "rounds"))


def test_a_scene_that_is_missing_or_has_no_views_to_hold_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _refused(["nowhere"], "nowhere is not a folder; expected a scene")
    write_scene(tmp_path / "scene", ["only.png"])
    _refused(["scene"], "scene: 0 training views besides 1 held out, expected at least 2")


def _refused(words: list[str], expected: str) -> None:
    result = CliRunner().invoke(app, ["bench", "pareto", *words])
    assert isinstance(result.exception, LapgsError), result.output
    assert result.exception.exit_code == 2
    assert "\n" not in str(result.exception)
    assert expected in str(result.exception)


@pytest.mark.slow  # minutes of starting processes
def test_a_comparison_from_end_to_end(tmp_path: Path) -> None:
    """Of `lapgs train` and a checkout; the second command trains nothing."""
    lapgs = [sys.executable, "-m", "lapgs_plugin"]
    scene = [*lapgs, "sample", "scene", "--size", "96x64", "--views", "9", "--points", "300"]
    compare = [*lapgs, "bench", "pareto", "scene", "--budgets", "6", "-o", "out", "--device", "cpu"]
    compare += ["--checkout", str(STUB), "--checkout-options", "--disable_viewer"]
    outputs = []
    for command in (scene, compare, compare):
        done = subprocess.run(
            command, cwd=tmp_path, env={**os.environ, "COLUMNS": "200"}, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        outputs.append(done.stdout)
    with (tmp_path / "out/pareto.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    methods = ["one field", "nested", "laplacian"]
    methods += [f"{STUB.name}, {kind}" for kind in ("own script", "nested", "laplacian")]
    assert [(row["method"], row["budget"]) for row in rows] == [(method, "6.0") for method in methods]
    assert all(float(row["psnr"]) > 10 and float(row["psnr_fit"]) > 10 and row["gaussians"] for row in rows)
    fastest = min(rows, key=lambda row: float(row["seconds"]))
    assert fastest["front"] == "psnr_fit psnr ssim"
    assert " took " not in outputs[2]
    assert outputs[1].splitlines()[-5:] == outputs[2].splitlines()[-5:]  # readings of three metrics and one budget
    page = (tmp_path / "out/pareto.html").read_text()
    assert all(method in page for method in methods)
    svg = ElementTree.parse(tmp_path / "out/pareto.svg").getroot()
    circles = [node.get("class") for node in svg.iter("{http://www.w3.org/2000/svg}circle")]
    assert circles.count("dot-front") == sum(len(row["front"].split()) for row in rows)
