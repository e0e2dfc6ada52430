"""The table of a run and its baseline."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from lapgs_plugin.archive import Manifest, SceneReference
from lapgs_plugin.evaluation.comparison import Cell, comparison_rows, unlike


def metrics(**changes: Any) -> dict[str, Any]:
    values = {
        "psnr": 27.39,
        "ssim": 0.812,
        "split": "test",
        "train_seconds": 300.0,
        "overhead_seconds": {"pyramid": 1.5, "cache": 2.0},
        "num_gaussians": {"1": 1_130_000, "0": 1_470_000},
        "peak_gaussians": 1_500_000,
    }
    return {**values, **changes}


BASELINE = metrics(
    psnr=27.73,
    ssim=0.8,
    train_seconds=525.0,
    overhead_seconds={"pyramid": 0.5},
    num_gaussians={"0": 2_290_000},
    peak_gaussians=3_000_000,
)


def test_rows_of_a_run_and_its_baseline() -> None:
    rows = {row.key: row for row in comparison_rows([metrics(), BASELINE])}
    assert {key: row.change for key, row in rows.items()} == {
        "psnr": "-0.34 dB",
        "ssim": "+0.0120",
        "train_seconds": "1.75x as fast",
        "overhead_seconds": "+3.0 s",
        "num_gaussians": "1.14x",
        "peak_gaussians": "0.50x",
    }
    assert rows["num_gaussians"].cells == (
        Cell(2_600_000, "2,600,000", ("level 1 1,130,000", "level 0 1,470,000")),
        Cell(2_290_000, "2,290,000"),
    )
    assert [cell.value for cell in rows["train_seconds"].cells] == [300.0, 525.0]
    assert rows["overhead_seconds"].cells[0] == Cell(3.5, "3.5", ("pyramid 1.5", "cache 2.0"))
    assert rows["psnr"].label == "PSNR, held-out views (dB)"


def test_a_run_alone_has_one_cell_and_no_change() -> None:
    for row in comparison_rows([metrics(split="train", overhead_seconds={})]):
        assert len(row.cells) == 1
        assert row.change == ""
    assert "training views" in comparison_rows([metrics(split="train")])[0].label


def test_unlike_runs_are_told_apart() -> None:
    scene = SceneReference("/data/fox", "1/4", True, (0.0, 0.0, 0.0), "colmap")
    run = Manifest(scene, 2, "camera", "reconstructed", "xyz", 3, "cpu", 0, {"iterations": 3000})
    assert unlike(run, replace(run, levels=1, seed=3)) == []
    other = replace(run, scene=replace(scene, resolution="1/8"), settings={"iterations": 1000})
    assert unlike(run, other) == ["resolution 1/4 against 1/8", "iterations 3000 against 1000"]
