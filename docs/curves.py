"""Draw quality over seconds from docs/data/curves.csv into docs/images/curves.svg.

Run `python docs/curves.py` after changing the data; a test compares the image with it. A row of the data is one run of
`lapgs train --strategy mcmc --iterations N`.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

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


def drawn(runs: Sequence[Run]) -> str:
    """Return the image: each metric's charts, one for each scene, in the order of the runs."""
    scenes = list(dict.fromkeys(run["scene"] for run in runs))
    charts = [_chart([run for run in runs if run["scene"] == scene], metric) for metric in METRICS for scene in scenes]
    return draw_charts(charts, STYLES, TITLE, TITLE, COLUMNS)


def runs_of_data() -> Sequence[Run]:
    """Return the measured runs."""
    with DATA.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def _chart(runs: Sequence[Run], metric: str) -> Chart:
    lines = [
        Series(style, sorted((float(run["seconds"]), float(run[metric])) for run in runs if run["method"] == method))
        for method, style in STYLES.items()
    ]
    megapixels = float(runs[0]["width"]) * float(runs[0]["height"]) / 1e6
    title = f"{runs[0]['scene']}, {megapixels:.1f} MP: {METRICS[metric]}"
    return draw_lines(title, "seconds", lines, from_zero=False, text=count_text, frame=SMALL)


if __name__ == "__main__":
    IMAGE.write_text(drawn(runs_of_data()), encoding="utf-8")
