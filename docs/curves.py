"""Draw quality over seconds from docs/data/curves.csv into docs/images/curves.svg.

Run `python docs/curves.py` after changing the data; a test compares the image with it. A row of the data is one run of
`lapgs train --strategy mcmc --iterations N`. A point is the mean over seeds.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

from lapgs_bench.experiments.figures.image import draw_charts
from lapgs_plugin.reports.charts import Chart, Frame, Series, count_text, draw_lines

ROOT = Path(__file__).resolve().parents[1]
DATA, IMAGE = ROOT / "docs/data/curves.csv", ROOT / "docs/images/curves.svg"
TITLE = "Quality over seconds of optimization, by scene and method"
STYLES = {"one field": "variant-0", "nested": "variant-1", "laplacian": "variant-2"}
METRICS = {"psnr_fit": "PSNR after fit", "lpips": "LPIPS"}
COLUMNS = 3
SMALL = Frame(290, 190, left=50, right=14, top=16, bottom=36)
"""Frame of a chart, of which three stand beside each other."""

Run = Mapping[str, str]
Point = Mapping[str, float]
"""Means of the seconds and figures of runs of one method and length."""
FIGURES = ("seconds", "psnr", "psnr_fit", "ssim", "lpips")


def drawn(runs: Sequence[Run]) -> str:
    """Return the image: each metric's charts, one for each scene, in the order of the runs."""
    scenes = list(dict.fromkeys(run["scene"] for run in runs))
    charts = [_chart([run for run in runs if run["scene"] == scene], metric) for metric in METRICS for scene in scenes]
    return draw_charts(charts, STYLES, TITLE, TITLE, COLUMNS)


def runs_of_data() -> Sequence[Run]:
    """Return the measured runs."""
    with DATA.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def points_of(runs: Sequence[Run], method: str) -> list[Point]:
    """Return the points of a method in runs of one scene, shortest first."""
    of_length: dict[int, list[Run]] = {}
    for run in runs:
        if run["method"] == method:
            of_length.setdefault(int(run["iterations"]), []).append(run)
    means = [{name: fmean(float(run[name]) for run in same) for name in FIGURES} for same in of_length.values()]
    return sorted(means, key=lambda point: point["seconds"])


def at_time(points: Sequence[Point], seconds: float) -> Point:
    """Return a curve's figures after so many seconds: between its points, or beyond them, straight over log seconds."""
    after = next((i for i, point in enumerate(points[1:], 1) if point["seconds"] >= seconds), len(points) - 1)
    one, other = points[after - 1], points[after]
    part = math.log(seconds / one["seconds"]) / math.log(other["seconds"] / one["seconds"])
    return {name: one[name] + part * (other[name] - one[name]) for name in FIGURES}


def _chart(runs: Sequence[Run], metric: str) -> Chart:
    lines = [
        Series(style, [(point["seconds"], point[metric]) for point in points_of(runs, method)])
        for method, style in STYLES.items()
    ]
    megapixels = float(runs[0]["width"]) * float(runs[0]["height"]) / 1e6
    title = f"{runs[0]['scene']}, {megapixels:.1f} MP: {METRICS[metric]}"
    return draw_lines(title, "seconds", lines, from_zero=False, text=count_text, frame=SMALL)


if __name__ == "__main__":
    IMAGE.write_text(drawn(runs_of_data()), encoding="utf-8")
