"""Test the table of a run and its baseline."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from lapgs_plugin.hierarchy.plan import Hierarchy, StagePlan
from lapgs_plugin.reports.comparison import Cell, comparison_rows, setup_differences
from lapgs_plugin.runs.manifest import LevelRecord, Manifest, SceneReference
from lapgs_plugin.runs.training_figures import training_figures
from tests.training_scene import blob_field


def metrics(**changes: Any) -> dict[str, Any]:
    values = {
        "psnr": 27.39,
        "ssim": 0.812,
        "split": "test",
        "train_seconds": 300.0,
        "overhead_seconds": {"pyramid": 1.5, "cache": 2.0},
        "num_gaussians": {"1": 1_130_000, "0": 1_470_000},
        "weighted_gaussians": 1_356_666.7,
        "mean_gaussians": 1_200_000.0,
        "peak_gaussians": 1_500_000,
        "gpu_busy_seconds": None,
        "peak_memory_bytes": None,
        "peak_memory_without_images_bytes": None,
        "lpips_missing": {},
        "fps": 90.0,
    }
    return {**values, **changes}


BASELINE = metrics(
    psnr=27.73,
    ssim=0.8,
    train_seconds=525.0,
    overhead_seconds={"pyramid": 0.5},
    num_gaussians={"0": 2_290_000},
    weighted_gaussians=2_290_000.0,
    mean_gaussians=2_000_000.0,
    peak_gaussians=3_000_000,
    fps=120.0,
)


@pytest.mark.parametrize(
    ("hierarchy", "rendered"),
    [(Hierarchy.LAPLACIAN, {"2": 12, "1": 11, "0": 10}), (Hierarchy.NESTED, {"0": 10})],
)
def test_gaussians_are_those_that_an_image_takes(hierarchy: Hierarchy, rendered: dict[str, int]) -> None:
    plan = StagePlan.create((320, 240), 60, 3, hierarchy=hierarchy)
    records = [LevelRecord.of(stage, blob_field(10 + stage.level)) for stage in plan]
    assert training_figures(records)["num_gaussians"] == rendered


def test_rows_of_a_run_and_its_baseline() -> None:
    rows = {row.key: row for row in comparison_rows([metrics(), BASELINE])}
    assert {key: row.change for key, row in rows.items()} == {
        "psnr": "-0.34 dB",
        "ssim": "+0.0120",
        "train_seconds": "1.75x as fast",
        "overhead_seconds": "+3.0 s",
        "num_gaussians": "1.14x",
        "weighted_gaussians": "0.59x",
        "mean_gaussians": "0.60x",
        "peak_gaussians": "0.50x",
        "fps": "0.75x",
    }
    assert rows["num_gaussians"].cells == (
        Cell(2_600_000, "2,600,000", ("level 1 1,130,000", "level 0 1,470,000")),
        Cell(2_290_000, "2,290,000"),
    )
    assert [cell.value for cell in rows["train_seconds"].cells] == [300.0, 525.0]
    assert rows["overhead_seconds"].cells[0] == Cell(3.5, "3.5", ("pyramid 1.5", "cache 2.0"))
    assert rows["psnr"].label == "PSNR, held-out views (dB)"


def test_figures_of_only_one_run_are_shown_and_not_compared() -> None:
    ours = metrics(lpips_alex=0.2, peak_memory_bytes=3_500_000_000, lpips_missing={"vgg_3dgs": "no weights"})
    rows = {row.key: row for row in comparison_rows([ours, BASELINE])}
    assert rows["lpips_alex"].label == "LPIPS (AlexNet), held-out views"
    assert rows["lpips_alex"].cells == (Cell(0.2, "0.2000"), Cell(None, "not measured"))
    assert "lpips_vgg_3dgs" not in rows
    assert [cell.text for cell in rows["peak_memory_bytes"].cells] == ["3.50", "not measured"]
    assert [rows[key].change for key in ("lpips_alex", "peak_memory_bytes")] == [""] * 2
    both = comparison_rows([metrics(lpips_alex=0.2), metrics(lpips_alex=0.25)])
    assert {row.key: row.change for row in both}["lpips_alex"] == "-0.0500"


def test_a_run_alone_has_one_cell_and_no_change() -> None:
    for row in comparison_rows([metrics(split="train", overhead_seconds={})]):
        assert len(row.cells) == 1
        assert row.change == ""
    assert "training views" in comparison_rows([metrics(split="train")])[0].label


def test_differences_of_setup_are_listed() -> None:
    scene = SceneReference("/data/fox", "1/4", True, (0.0, 0.0, 0.0), "colmap")
    run = Manifest(scene, 2, "camera", "reconstructed", "xyz", 3, "cpu", 0, {"iterations": 3000})
    both = [metrics(), BASELINE]
    assert setup_differences(run, replace(run, levels=1, seed=3), both) == []
    other = replace(run, scene=replace(scene, resolution="1/8"), settings={"iterations": 1000})
    assert setup_differences(run, other, both) == ["resolution 1/4 against 1/8", "iterations 3000 against 1000"]
    masked = replace(run, scene=replace(scene, masks="masks"))
    assert setup_differences(masked, run, both) == [f"masks masks against {scene.masks}"]


@pytest.mark.parametrize(("split", "views"), [("train", "training"), ("other", "another scene's")])
def test_quality_of_other_views_is_not_compared(split: str, views: str) -> None:
    both = [metrics(), {**BASELINE, "split": split}]
    rows = {row.key: row for row in comparison_rows(both)}
    assert (rows["psnr"].change, rows["ssim"].change) == ("", "")
    assert rows["psnr"].cells[1].text == f"{BASELINE['psnr']:.2f} ({views})"
    assert rows["train_seconds"].change == "1.75x as fast"
    scene = SceneReference("/data/fox", "1/4", True, (0.0, 0.0, 0.0), "colmap")
    run = Manifest(scene, 2, "camera", "reconstructed", "xyz", 3, "cpu", 0, {"iterations": 3000})
    assert setup_differences(run, run, both) == [f"measured views held-out against {views}"]
