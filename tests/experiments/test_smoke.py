"""Run the smoke experiment as users do: a scene, training, evaluation and tables, each in processes of their own."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest

from lapgs_bench.experiments.standard import EXPERIMENTS

SMOKE = EXPERIMENTS["smoke"]


SAMPLE = 'size = "240x160", views = 24, points = 2000'
SMALLER = 'size = "96x64", views = 9, points = 300'


@pytest.mark.slow  # half a minute of starting processes; `make smoke` runs all of it
def test_the_smoke_experiment_runs_from_end_to_end(tmp_path: Path) -> None:
    """With its first and last variant, on a smaller scene."""
    text, out = SMOKE.read_text(), tmp_path / "smoke"
    assert SAMPLE in text
    (tmp_path / "smoke.toml").write_text(text.replace(SAMPLE, SMALLER))
    variants = ["one field", "three levels of residuals"]
    words = ["bench", str(tmp_path / "smoke.toml"), "--seeds", "0", "--iterations", "100", "--out", str(out)]
    words += [word for variant in variants for word in ("--variant", variant)]
    done = subprocess.run([sys.executable, "-m", "lapgs_plugin", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with (out / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["variant"] for row in rows] == variants
    assert all(float(row["psnr"]) > 14 for row in rows)  # seen 14.69 and 14.74
    pictures = {"crops-sample", "edges-sample", "psnr_over_seconds-sample", "gaussians_over_iterations-sample"}
    assert {path.stem for path in (out / "figures").glob("*.svg")} == pictures | {"seconds_over_gaussians"}
    tables = (out / "tables.md").read_text()
    assert all(f"| {variant} |" in tables for variant in variants)
