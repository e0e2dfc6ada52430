"""Run the smoke experiment as users do: a scene, training, evaluation and tables, each in processes of their own."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

SMOKE = Path(__file__).parents[2] / "benchmarks" / "smoke.toml"


def test_the_smoke_experiment_runs_from_end_to_end(tmp_path: Path) -> None:
    out = tmp_path / "smoke"
    command = [sys.executable, "-m", "lapgs_plugin", "bench", str(SMOKE), "--seeds", "0", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with (out / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    variants = ["one field", "two nested levels", "two levels of residuals", "three levels of residuals"]
    assert [row["variant"] for row in rows] == variants
    assert all(float(row["psnr"]) > 14 for row in rows)  # seen 14.95 to 15.44
    tables = (out / "tables.md").read_text()
    assert all(f"| {variant} |" in tables for variant in variants)
