"""Test the figures of experiments: read back from the SVG files, and compared with the numbers that they show."""

from __future__ import annotations

import base64
import io
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image

from lapgs_bench.experiments.figures.image import draw_charts, png_of
from lapgs_bench.experiments.figures.pictures import edge_error
from lapgs_bench.experiments.figures.write import write_figures
from lapgs_bench.experiments.schema import Experiment
from lapgs_plugin.evaluation.figures import evaluate_run
from lapgs_plugin.files import BARE_RECORD
from lapgs_plugin.reports.charts import Series, draw_lines
from lapgs_plugin.runs.archive import RunArchive
from tests.cli.run_folder import write_run, write_scene

SVG = "{http://www.w3.org/2000/svg}"
KINDS = ("psnr_over_seconds", "gaussians_over_iterations", "seconds_over_gaussians", "peak_memory", "crops", "edges")
HIERARCHY = "residuals"


def experiment(**changes: Any) -> Experiment:
    values = {
        "name": "trial",
        "title": "Trial",
        "scenes": [{"name": "striped", "path": "striped"}],
        "backbones": {"cpu": {"rasterizer": "cpu"}},
        "variants": [{"name": "bare", "method": "bare", "baseline": True}, {"name": HIERARCHY}],
        "figures": [{"kind": kind} for kind in KINDS],
    }
    return Experiment.model_validate({**values, **changes})


def row(variant: str, folder: Path, **more: Any) -> dict[str, Any]:
    metrics = RunArchive.open(folder).metrics() or {}
    return {
        "variant": variant,
        "baseline": "bare",
        "run": folder.name,
        "scene": "striped",
        "dataset": "",
        "resolution": "full",
        "backbone": "cpu",
        "seed": 0,
        "train_seconds": metrics["train_seconds"],
        "gaussians": sum(metrics["num_gaussians"].values()),
        "mean_gaussians": metrics["mean_gaussians"],
        "peak_memory_without_images_bytes": metrics["peak_memory_without_images_bytes"],
        **more,
    }


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """Return the folder of an experiment with a run of each variant, and its rows."""
    folder = tmp_path_factory.mktemp("trial")
    scene = write_scene(folder / "striped")
    rows = []
    for levels, variant in ((1, "bare"), (2, HIERARCHY)):
        run = write_run(folder / "runs" / variant, scene, levels=levels)
        evaluate_run(RunArchive.open(run))
        rows.append(row(variant, run))
    return folder, rows


@pytest.fixture(scope="module")
def drawn(finished: tuple[Path, list[dict[str, Any]]]) -> Path:
    folder, rows = finished
    lines = write_figures(experiment(), rows, folder)
    assert [line for line in lines if "resvg" not in line] == []
    return folder / "figures"


def parsed(path: Path) -> ElementTree.Element:
    return ElementTree.parse(path).getroot()


def texts(image: ElementTree.Element) -> list[str]:
    return [text.text or "" for text in image.iter(f"{SVG}text")]


def polylines(image: ElementTree.Element, style: str) -> Iterator[list[tuple[float, float]]]:
    for line in image.iter(f"{SVG}polyline"):
        if line.get("class") == f"line-{style}":
            yield [(float(x), float(y)) for x, y in (point.split(",") for point in (line.get("points") or "").split())]


def proportional(drawn: list[float], values: list[float], abs_units: float = 0.15) -> None:
    """Check that coordinates are a linear function of values, to the tenth that they are rounded to."""
    slope, offset = np.polyfit(values, drawn, 1)
    np.testing.assert_allclose(slope * np.array(values) + offset, drawn, atol=abs_units)  # 0.1 seen


def test_each_figure_is_an_svg_and_a_png(drawn: Path) -> None:
    pytest.importorskip("resvg_py")
    scene = {"psnr_over_seconds", "gaussians_over_iterations", "crops", "edges"}
    names = {f"{kind}-striped" if kind in scene else kind for kind in KINDS}
    assert {path.stem for path in drawn.glob("*.svg")} == names
    for name in names:
        _, _, width, height = map(float, (parsed(drawn / f"{name}.svg").get("viewBox") or "").split())
        with Image.open(drawn / f"{name}.png") as image:
            assert image.size == pytest.approx((3 * width, 3 * height), abs=1)
            assert len(image.convert("L").getcolors() or ()) > 2, "not blank"


def test_images_need_no_browser(drawn: Path) -> None:
    """Programs that typeset and draw know neither variables of CSS nor :is(), and no image needs the network."""
    for path in drawn.glob("*.svg"):
        text = path.read_text()
        assert not re.search(r"var\(|:is\(|:root", text)
        assert not re.search(r'(?:href|src)="(?!data:|#)', text)


def test_psnr_over_seconds_is_that_of_the_history(drawn: Path, finished: tuple[Path, list[dict[str, Any]]]) -> None:
    image = parsed(drawn / "psnr_over_seconds-striped.svg")
    assert {"striped", "bare", HIERARCHY, "seconds of optimization", "Held-out PSNR (dB)"} <= {*texts(image)}
    for number, variant in enumerate(("bare", HIERARCHY)):
        history = RunArchive.open(finished[0] / "runs" / variant).history()
        points = [entry for entry in history if "psnr" in entry]
        (line,) = polylines(image, f"variant-{number}")
        assert len(line) == len(points) > 1
        proportional([y for _, y in line], [entry["psnr"] for entry in points])
        proportional([x for x, _ in line], [entry["elapsed"] for entry in points])


def test_gaussians_over_iterations_go_on_through_the_stages(
    drawn: Path, finished: tuple[Path, list[dict[str, Any]]]
) -> None:
    image = parsed(drawn / "gaussians_over_iterations-striped.svg")
    history = RunArchive.open(finished[0] / "runs" / HIERARCHY).history()
    coarse, fine = polylines(image, "variant-1")
    counted = [entry for entry in history if "num_gaussians" in entry]
    first = max(entry["iteration"] for entry in history if entry["level"] == 1)
    iterations = [entry["iteration"] + (first if entry["level"] == 0 else 0) for entry in counted]
    proportional([x for x, _ in (*coarse, *fine)], iterations)
    proportional([y for _, y in (*coarse, *fine)], [entry["num_gaussians"] for entry in counted])


def test_arrows_and_bars(drawn: Path) -> None:
    arrows = parsed(drawn / "seconds_over_gaussians.svg")
    assert HIERARCHY in texts(arrows)
    assert "bare" not in texts(arrows), "arrows start there"
    assert [title.text for title in arrows.iter(f"{SVG}title")] == [f"striped: bare to {HIERARCHY}"]
    bars = texts(parsed(drawn / "peak_memory.svg"))
    # Peaks without images are 3 GB for one field, and the same of the larger stage of two.
    assert bars == ["Peak GPU memory without images (MB)", "bare", "3,000", "3,000", HIERARCHY, "3,000", "3,000"]


def test_crops_show_the_photo_and_each_method(drawn: Path, finished: tuple[Path, list[dict[str, Any]]]) -> None:
    image = parsed(drawn / "crops-striped.svg")
    pictures = [one.get("href") or "" for one in image.iter(f"{SVG}image")]
    assert len(pictures) == 3 * 3, "whole, and two parts"
    shown = texts(image)
    assert shown[1::2] == ["Photo", "bare", HIERARCHY]
    metrics = RunArchive.open(finished[0] / "runs" / HIERARCHY).metrics()
    assert metrics is not None
    (expected,) = [view["psnr"] for view in metrics["views"] if view["name"] == shown[2]]
    assert shown[6] == f"{expected:.2f} dB"
    # The enlarged parts of the photo are pixels of the photo.
    with Image.open(finished[0] / "striped" / shown[2]) as photo:
        pixels = np.asarray(photo)
    part = np.asarray(Image.open(io.BytesIO(base64.b64decode(pictures[3].partition(",")[2]))))
    windows = np.lib.stride_tricks.sliding_window_view(pixels, part.shape)[:, :, 0]
    assert (windows == part).all(axis=(2, 3, 4)).any()


def test_edges_have_a_bar_for_each_level(drawn: Path) -> None:
    labels = texts(parsed(drawn / "edges-striped.svg"))
    assert labels[1::3] == ["bare", f"{HIERARCHY}, level 1", f"{HIERARCHY}, level 0"]


def test_the_error_at_edges() -> None:
    """A step of half the contrast has half the gradient; pixels elsewhere do not count."""
    photo = torch.zeros(3, 40, 40)
    photo[:, :, 20:] = 0.8
    assert edge_error(photo, photo) == 0.0
    assert edge_error(photo / 2, photo) == pytest.approx(0.5)
    assert edge_error(torch.full_like(photo, 0.3), photo) == pytest.approx(1.0)
    assert edge_error(1 - photo, photo) == pytest.approx(2.0), "the other direction"
    spoilt = photo.clone()
    spoilt[:, 5:35, 2:12:2] = 0.05
    assert edge_error(spoilt, photo) == 0.0
    assert edge_error(photo, torch.zeros_like(photo)) == 0.0, "a photo without edges"


def test_a_bare_run_that_was_not_imported_is_drawn_from_its_record(tmp_path: Path) -> None:
    timeline = [{"iteration": 10 * i, "elapsed": float(i), "num_gaussians": 100 + i} for i in range(1, 5)]
    timeline += [{"iteration": 40, "elapsed": 4.5, "num_gaussians": 105, "psnr": 20.0}]
    counts = {"num_gaussians": 105, "peak_gaussians": 105, "mean_gaussians": 102.5, "memory_bytes": {}}
    seconds = {"iterations": 40, "train_seconds": 4.5, "saving_seconds": 0.0}
    run = tmp_path / "runs" / "bare"
    run.mkdir(parents=True)
    (run / BARE_RECORD).write_text(json.dumps({**seconds, **counts, "timeline": timeline}))
    only = experiment(figures=[{"kind": "gaussians_over_iterations"}])
    names = {"variant": "bare", "baseline": "bare", "run": "bare", "scene": "striped", "backbone": "cpu"}
    write_figures(only, [{**names, "train_seconds": 4.5, "gaussians": 105}], tmp_path)
    (line,) = polylines(parsed(tmp_path / "figures" / "gaussians_over_iterations-striped.svg"), "variant-0")
    proportional([y for _, y in line], [entry["num_gaussians"] for entry in timeline])


def test_what_cannot_be_drawn_is_a_line_and_the_rest_is_drawn(
    finished: tuple[Path, list[dict[str, Any]]], tmp_path: Path
) -> None:
    folder, rows = finished
    without = [{name: value for name, value in one.items() if "memory" not in name} for one in rows]
    (tmp_path / "runs").symlink_to(folder / "runs")
    figures = [{"kind": kind} for kind in ("peak_memory", "edges")]
    figures += [{"kind": "crops", "scenes": ["striped"], "view": "nothing.png"}]
    lines = [line for line in write_figures(experiment(figures=figures), without, tmp_path) if "resvg" not in line]
    assert [line.partition(" is left out")[0] for line in lines] == ["peak_memory", "crops-striped"]
    assert "run the experiment on a GPU" in lines[0]
    assert "view 'nothing.png' is not held out; expected one such as photos/0" in lines[1]
    assert (tmp_path / "figures" / "edges-striped.svg").is_file()

    alone = write_figures(experiment(figures=[{"kind": "seconds_over_gaussians"}]), rows[:1], tmp_path)
    assert "no scene has a baseline and another variant" in alone[0]


def test_without_resvg_svgs_are_written_and_one_line_says_what_to_install(
    finished: tuple[Path, list[dict[str, Any]]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "resvg_py", None)
    (tmp_path / "runs").symlink_to(finished[0] / "runs")
    figures = [{"kind": "psnr_over_seconds"}, {"kind": "seconds_over_gaussians"}]
    (line,) = write_figures(experiment(figures=figures), finished[1], tmp_path)
    assert line == "a figure as PNG needs resvg-py: pip install 'lapgs_plugin[figures]'"
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "psnr_over_seconds-striped.svg",
        "seconds_over_gaussians.svg",
    }


def test_colours_of_lines_reach_the_png() -> None:
    pytest.importorskip("resvg_py")
    series = [Series("variant-0", [(0.0, 1.0), (1.0, 2.0)]), Series("variant-1", [(0.0, 2.0), (1.0, 1.0)])]
    image = draw_charts([draw_lines("Two", "x", series)], {"a": "variant-0", "b": "variant-1"}, "two", "Two", 1)
    with Image.open(io.BytesIO(png_of(image))) as png:
        colours = {pixel for _, pixel in png.convert("RGB").getcolors(1 << 20)}
    assert {(0xC2, 0x57, 0x1A), (0x17, 0x67, 0xC2)} <= colours
