"""Test `lapgs report` of experiments: all variants, scenes and backbones are shown, missing ones are named."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from lapgs_bench.experiments.exports import write_csv
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.evaluation.figures import evaluate_run
from lapgs_plugin.files import write_text
from lapgs_plugin.runs.archive import RunArchive
from tests.cli.run_folder import write_run, write_scene
from tests.cli.test_report import Page, lapgs_report

SCENES, BACKBONES, SEEDS = ("garden", "<b>attic</b>"), ("cpu", "fastgs"), (0, 1)
VARIANTS = {"bare": 1, "two levels": 2}


def row(scene: str, backbone: str, variant: str, seed: int) -> dict[str, Any]:
    """Make a line of results.csv whose figures identify it."""
    levels = VARIANTS[variant]
    run = f"{SCENES.index(scene)}-{backbone}-{levels}-{seed}"
    size = 1000.0 * (1 + SCENES.index(scene)) * (1 + BACKBONES.index(backbone)) / levels
    return {
        "experiment": "trial",
        "variant": variant,
        "baseline": "bare",
        "run": run,
        "folder": f"/before/runs/{run}" + "-attempt2" * (run == "1-cpu-2-0"),  # its first worker died
        "scene": scene,
        "backbone": backbone,
        "method": "bare" if levels == 1 else "hierarchy",
        "seed": seed,
        "train_seconds": size / 100 + seed,
        "overhead_seconds": 3.0,
        "overhead_pyramid_seconds": 1.0,
        **({"overhead_cache_seconds": 2.0} if levels > 1 else {}),
        "gaussians": size,
        "weighted_gaussians": size + 10 * seed,
        "forward_ms": 1.0 + seed,
        "backward_ms": 3.0,
        "iteration_ms": 5.0,
        "processor": "AMD",
        "lapgs_version": "0.1.0",
        "torch": "2.13.0",
    }


def write_experiment(folder: Path) -> Path:
    """Write the folder of an experiment with all its runs, one of them without metrics."""
    scene = write_scene(folder / "scenes" / "striped")
    rows = [row(s, b, v, seed) for seed in SEEDS for s in SCENES for b in BACKBONES for v in VARIANTS]
    for one in rows:
        if one["seed"] == 0:
            run = write_run(folder / "runs" / Path(one["folder"]).name, scene, levels=VARIANTS[one["variant"]])
            if one["run"] != "1-fastgs-1-0":
                evaluate_run(RunArchive.open(run))
    write_csv(folder / "results.csv", rows)
    write_text(folder / "tables.md", "# A trial\n\nMeans.\n\n|  | PSNR |\n| --- | --- |\n| <i>bare</i> | 27.0 |\n")
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_experiment(tmp_path_factory.mktemp("trial") / "trial")


@pytest.fixture
def experiment(finished: Path, tmp_path: Path) -> Path:
    """Copy it, so that the paths in its results are outdated."""
    return Path(shutil.copytree(finished, tmp_path / "trial"))


def test_the_page_holds_every_scene_backbone_and_variant(experiment: Path) -> None:
    assert str(experiment / "report.html") in lapgs_report(experiment)
    text = (experiment / "report.html").read_text()
    page = Page(text)
    assert "A trial" in page.text
    assert "<i>bare</i>" in page.text  # from the tables, as text
    assert "16 runs; AMD: lapgs_plugin 0.1.0, PyTorch 2.13.0" in page.text
    assert not re.search(r"https?:", text)
    headings = re.findall(r"<summary><h3>(.*?)</h3>", text)
    assert headings == [f"{s}, {b}" for s in ("garden", "&lt;b&gt;attic&lt;/b&gt;") for b in BACKBONES]
    classes = [line["class"] for line in page.all("polyline")]
    assert set(classes) == {"line-variant-0", "line-variant-1"}
    assert page.text.count("worst of 2 by PSNR") == 4  # a strip for each
    assert page.text.count("The composition of two levels, beside bare.") == 3
    assert page.text.count("The composition of two levels.") == 1  # where bare was not measured


def test_arrows_lead_from_bare_to_the_hierarchy_in_means_over_seeds(experiment: Path) -> None:
    lapgs_report(experiment)
    text = (experiment / "report.html").read_text()
    assert "Optimization (s) against Gaussians over Gaussians of levels, weighted by iterations" in text
    drawn = re.findall(r'<g class="(.*?)"><title>(.*?)</title>\s*<circle cx="(.*?)" cy="(.*?)"', text)
    assert [arrow[:2] for arrow in drawn] == [
        ("line-variant-1 dot-variant-1", f"{s}, {b}: bare to two levels")
        for s in ("garden", "&lt;b&gt;attic&lt;/b&gt;")
        for b in BACKBONES
    ]
    # Starts lie where the means over both seeds are: 1005, 2005, 2005 and 4005 Gaussians; 10.5, 20.5, 20.5, 40.5 s.
    xs, ys = ([float(arrow[i]) for arrow in drawn] for i in (2, 3))
    assert (xs[3] - xs[0]) / (xs[1] - xs[0]) == pytest.approx(3.0, abs=0.01)  # 0.0012 seen
    assert (ys[0] - ys[3]) / (ys[0] - ys[1]) == pytest.approx(3.0, abs=0.01)  # 8.9e-16 seen
    assert (xs[1], ys[1]) == (xs[2], ys[2])


def test_bars_are_means_over_scenes_and_seeds(experiment: Path) -> None:
    lapgs_report(experiment)
    text = (experiment / "report.html").read_text()
    bars = re.findall(r"<title>(\w+): (.*?)</title>", text.partition("<h2>Scenes")[0])
    assert [bar for bar in bars if bar[0] in ("forward", "backward")] == [
        ("forward", "1.5 ms"),
        ("backward", "3 ms"),
    ] * 4
    assert [bar for bar in bars if bar[0] in ("pyramid", "cache")] == [
        *[("pyramid", "1 s"), ("pyramid", "1 s"), ("cache", "2 s")] * 2
    ]


def test_missing_runs_are_named_and_the_rest_is_shown(experiment: Path) -> None:
    shutil.rmtree(experiment / "runs" / "0-cpu-2-0")
    (experiment / "tables.md").unlink()
    lapgs_report(experiment)
    page = Page((experiment / "report.html").read_text())
    assert "two levels is not shown" in page.text
    assert "trial" in page.text
    assert page.text.count("worst of 2 by PSNR") == 4  # of the first pair bare alone


def test_a_missing_scene_leaves_the_charts(experiment: Path) -> None:
    for manifest in experiment.glob("runs/*/manifest.json"):
        values = json.loads(manifest.read_text())
        values["scene"]["path"] = str(experiment / "nowhere")
        manifest.write_text(json.dumps(values))
    lapgs_report(experiment)
    page = Page((experiment / "report.html").read_text())
    assert page.text.count("no pictures: ") == 4
    assert page.all("polyline")
    assert not page.all("img")


def test_the_newest_run_or_experiment_is_reported_on(
    experiment: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunFolderError, match=r"runs holds no run and no experiment; .*lapgs train"):
        lapgs_report()
    run = write_run(tmp_path / "runs" / "mine", finished / "scenes" / "striped")
    bench = tmp_path / "runs" / "bench" / "trial"
    bench.parent.mkdir()
    experiment.rename(bench)
    for newest, older in (
        (run / "manifest.json", bench / "results.csv"),
        (bench / "results.csv", run / "manifest.json"),
    ):
        os.utime(newest, (2e9, 2e9))
        os.utime(older, (1e9, 1e9))
        lapgs_report()
        assert (newest.parent / "report.html").is_file()
        (newest.parent / "report.html").unlink()
        assert not (older.parent / "report.html").exists()


def test_mistakes(experiment: Path) -> None:
    with pytest.raises(UserInputError, match="has baselines and scenes of its own; leave out --baseline"):
        lapgs_report(experiment, "--baseline", experiment / "runs" / "0-cpu-1-0")
    with pytest.raises(UserInputError, match=r"leave out .*--csv"):
        lapgs_report(experiment, "--csv", experiment / "data.csv")
    (experiment / "results.csv").write_text("name,value\na,1\n")
    with pytest.raises(
        RunFolderError, match=r"results.csv lacks backbone, baseline, gaussians, run, .*expected what `lapgs bench`"
    ):
        lapgs_report(experiment)
    (experiment / "results.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RunFolderError, match="cannot be read"):
        lapgs_report(experiment)
    assert not (experiment / "report.html").exists()


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (",1000.0,", ",many,", r"results.csv: '\w+' is 'many', expected a number"),
        (",bare,bare,", ",bare,", r"row 1 has more or fewer cells than the 21 of the first line"),
        (",bare,bare,", ",bare,bare,bare,", r"row 1 has more or fewer cells"),
        (",bare,bare,", ",,bare,", "results.csv lacks variant"),
        ("trial,", "x" * 200_000 + ",", r"results.csv cannot be read \(.*field larger than field limit"),
    ],
)
def test_results_that_were_edited_are_one_line(experiment: Path, before: str, after: str, message: str) -> None:
    table = (experiment / "results.csv").read_text()
    assert before in table
    (experiment / "results.csv").write_text(table.replace(before, after, 1))
    with pytest.raises(RunFolderError, match=message) as caught:
        lapgs_report(experiment)
    assert "\n" not in str(caught.value)


def test_tables_that_are_no_text_are_one_line(experiment: Path) -> None:
    (experiment / "tables.md").write_bytes(b"# A trial\n\xff\xfe")
    with pytest.raises(RunFolderError, match=r"tables.md is not readable: byte 10 .*--tables-only"):
        lapgs_report(experiment)


def test_an_experiment_whose_runs_are_gone_keeps_its_tables(experiment: Path) -> None:
    shutil.rmtree(experiment / "runs")
    lapgs_report(experiment)
    page = (experiment / "report.html").read_text()
    assert "two levels is not shown: " in page
    assert "<td>27.0</td>" in page
