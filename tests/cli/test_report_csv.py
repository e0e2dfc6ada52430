"""Test `lapgs report --csv`: its rows are those that docs/data/train.csv has, and no file is harmed."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import typer

from lapgs_plugin.cli.evaluate import evaluate
from lapgs_plugin.cli.import_run import import_run
from lapgs_plugin.cli.report import report
from lapgs_plugin.errors import LapgsError
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_run, write_scene
from tests.cli.test_import_run import Foreign
from tests.training_scene import HEIGHT, WIDTH, blob_field

app = typer.Typer()
for command, function in (("report", report), ("eval", evaluate), ("import-run", import_run)):
    app.command(command)(function)
lapgs = succeeding(app, columns=100)

HEADER = (Path(__file__).parents[2] / "docs/data/train.csv").read_text(encoding="utf-8").splitlines()[0]
FIGURES = {
    **{"psnr": 21.23456, "fitted_psnr": 22.5, "ssim": 0.912345, "lpips_alex": 0.25, "lpips_vgg": 0.75, "fps": 1234.5},
    **{"gpu_busy_seconds": 9.5, "peak_memory_bytes": 5_250_000_000},
}


def change(file: Path, **values: Any) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(newline="", encoding="utf-8-sig") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def measured(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of each method, measured without LPIPS."""
    folder = tmp_path_factory.mktemp("runs")
    write_run(folder / "laplacian", scene, seed=3)
    write_run(folder / "nested", scene, nested=True)
    write_run(folder / "one field", scene, levels=1)
    for run in folder.iterdir():
        lapgs("eval", run, "--lpips", "none")
    return folder


@pytest.fixture
def runs(measured: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(measured, tmp_path / "runs"))


def test_a_row_has_the_figures_of_its_run(runs: Path, scene: Path, tmp_path: Path) -> None:
    change(runs / "laplacian/metrics.json", **FIGURES)
    output = lapgs("report", runs / "laplacian", "--csv", tmp_path / "data.csv")
    assert "data.csv has 1 more row" in output
    assert (tmp_path / "data.csv").read_text().splitlines()[0] == HEADER
    assert rows_of(tmp_path / "data.csv") == [
        {
            **{"scene": scene.name, "views": "8", "width": str(WIDTH), "height": str(HEIGHT), "iterations": "300"},
            **{"method": "laplacian", "seed": "0", "seconds": "11.75", "busy_seconds": "9.5", "psnr": "21.2346"},
            **{"psnr_fit": "22.5", "ssim": "0.9123", "lpips": "0.25", "frames_per_second": "1234.5", "peak_gb": "5.25"},
        }
    ]
    assert not (runs / "laplacian/report.html").exists()


def test_rows_are_appended_run_first_and_unknown_values_are_empty(runs: Path, tmp_path: Path) -> None:
    file = tmp_path / "data.csv"
    before = f"{HEADER}\r\nbonsai,255,800,533,30000,FastGS,0,173.1,,31.7,,,,,"  # of a spreadsheet, no line end
    file.write_text(before, encoding="utf-8-sig", newline="")
    for name in ("nested", "laplacian", "one field"):
        change(runs / name / "metrics.json", gpu_busy_seconds=None, peak_memory_bytes=None, lpips_vgg=0.5)
    lapgs("report", runs / "nested", "--baseline", runs / "one field", "--csv", file)
    lapgs("report", runs / "laplacian", "--csv", file)
    rows = rows_of(file)
    assert [row["method"] for row in rows] == ["FastGS", "nested", "one field", "laplacian"]
    assert [row["seconds"] for row in rows] == ["173.1", "11.75", "8.25", "11.75"]
    assert {row[name] for row in rows[1:] for name in ("busy_seconds", "lpips", "peak_gb")} == {""}
    assert file.read_bytes().startswith(before.encode())
    assert not list(tmp_path.glob(".*"))  # no temporary file is left


def test_training_views_give_no_quality(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene, levels=1, hold_out=False)
    lapgs("eval", run, "--lpips", "none")
    assert "of run are empty: no held-out views" in lapgs("report", run, "--csv", tmp_path / "data.csv")
    (row,) = rows_of(tmp_path / "data.csv")
    assert [row[name] for name in ("views", "psnr", "psnr_fit", "ssim", "seconds")] == ["10", "", "", "", "8.25"]


def test_the_views_of_a_scene_that_is_gone_are_unknown_until_it_is_named(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    run = write_run(tmp_path / "run", scene, levels=1)
    lapgs("eval", run, "--lpips", "none")
    scene.rename(tmp_path / "moved")
    lapgs("report", run, "--csv", tmp_path / "data.csv")
    lapgs("report", run, "--csv", tmp_path / "data.csv", "--scene", tmp_path / "moved")
    assert [(row["scene"], row["views"]) for row in rows_of(tmp_path / "data.csv")] == [("scene", ""), ("scene", "8")]


def test_a_bare_script_is_its_own_method_and_has_no_known_seed(scene: Path, tmp_path: Path) -> None:
    foreign = Foreign(tmp_path / "output", scene)
    foreign.options()
    foreign.field("", 700, blob_field())
    lapgs("import-run", foreign.folder, "-o", tmp_path / "run", "--backbone", "fastgs")
    lapgs("eval", tmp_path / "run", "--lpips", "none")
    lapgs("report", tmp_path / "run", "--csv", tmp_path / "data.csv")
    (row,) = rows_of(tmp_path / "data.csv")
    assert [row[name] for name in ("method", "iterations", "seed", "seconds")] == ["own script", "700", "", ""]


def test_a_run_over_a_checkout_is_named_by_its_hierarchy(runs: Path, tmp_path: Path) -> None:
    for name in ("nested", "laplacian", "one field"):
        settings = json.loads((runs / name / "manifest.json").read_text())["settings"]
        backbone = {"name": "fastgs", "checkout": "/code/FastGS", "arguments": ["train.py"]}
        change(runs / name / "manifest.json", settings={**settings, "backbone": backbone}, seed=7)
        lapgs("report", runs / name, "--csv", tmp_path / "data.csv")
    rows = rows_of(tmp_path / "data.csv")
    assert [(row["method"], row["seed"]) for row in rows] == [("nested", "7"), ("laplacian", "7"), ("one field", "7")]


def refused(*arguments: object) -> str:
    with pytest.raises(LapgsError) as caught:
        lapgs("report", *arguments)
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("text", ["scene,psnr\nbonsai,31\n", HEADER.replace(",", ";"), f"{HEADER},gpu\n", "\n", "a\rb"])
def test_a_file_with_other_columns_is_refused(runs: Path, tmp_path: Path, text: str) -> None:
    file = tmp_path / "data.csv"
    file.write_bytes(text.encode())
    message = refused(runs / "nested", "--csv", file)
    assert str(file) in message
    assert f"expected {HEADER}" in message
    assert file.read_bytes() == text.encode()


def test_files_that_cannot_be_appended_to_are_refused(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "latin.csv").write_bytes(b"sc\xe8ne\n")
    (tmp_path / "link.csv").symlink_to(tmp_path / "elsewhere.csv")
    for name, fact in (
        *(("runs", "is a folder"), ("latin.csv", "UTF-8"), ("link.csv", "is a link")),
        ("missing/data.csv", "No such file"),
    ):
        message = refused(runs / "nested", "--csv", tmp_path / name)
        assert str(tmp_path / name.partition("/")[0]) in message
        assert fact in message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["latin.csv", "link.csv", "runs"]


@pytest.mark.parametrize("unmeasured", ["laplacian", "nested"])
def test_a_run_without_metrics_is_refused_and_no_row_written(runs: Path, tmp_path: Path, unmeasured: str) -> None:
    (runs / unmeasured / "metrics.json").unlink()
    message = refused(runs / "laplacian", "--baseline", runs / "nested", "--csv", tmp_path / "data.csv")
    assert f"{runs / unmeasured / 'metrics.json'} does not exist" in message
    assert f"`lapgs eval {runs / unmeasured}`" in message
    assert not (tmp_path / "data.csv").exists()
    assert not (runs / unmeasured / "metrics.json").exists()


def test_an_unfinished_run_is_refused(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene, finished=1)
    assert "only 1 of 2 levels" in refused(run, "--csv", tmp_path / "data.csv")
    assert not (tmp_path / "data.csv").exists()


def test_a_damaged_backbone_is_refused(runs: Path, tmp_path: Path) -> None:
    manifest = runs / "nested/manifest.json"
    change(manifest, settings={**json.loads(manifest.read_text())["settings"], "backbone": 5})
    message = refused(runs / "nested", "--csv", tmp_path / "data.csv")
    assert str(manifest) in message
    assert "backbone" in message
