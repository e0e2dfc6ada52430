"""Write what was measured: a page, its curves as SVG, and a CSV file with one run a line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lapgs_bench.experiments.exports import write_csv
from lapgs_bench.experiments.figures.image import draw_charts
from lapgs_bench.pareto.curves import (
    METRICS,
    Metric,
    Point,
    best_within,
    mean_points,
    measured,
    pareto_front,
    time_ratios,
)
from lapgs_bench.pareto.methods import ONE_FIELD
from lapgs_plugin.files import write_text
from lapgs_plugin.reports.charts import VARIANT_COLORS, Chart, Series, count_text, draw_lines, seconds_text
from lapgs_plugin.reports.report import render_page

HTML, SVG, CSV = "pareto.html", "pareto.svg", "pareto.csv"
PAGE_TEMPLATE = Path(__file__).with_name("pareto.html.jinja")
LPIPS = ("lpips_alex", "lpips_vgg", "lpips_squeeze")
"""Columns of an evaluation that can be the LPIPS of a page: the first that all of its runs have."""
LATE = 0.1
"""Share by which a run may exceed a budget and still count for it."""
FRONT = "front"

Row = Mapping[str, Any]


def figures(row: Row, lpips: str | None) -> dict[str, Any]:
    """Return the columns of the CSV file of a run's row; a figure that was not measured is missing."""
    peak = row.get("peak_memory_bytes")
    values = {
        "scene": row["scene"],
        "method": row["curve"],
        "budget": row["budget"],
        "seed": row["seed"],
        "iterations": row["iterations"],
        "seconds": row["train_seconds"],
        "psnr_fit": row.get("fitted_psnr"),
        "psnr": row.get("psnr"),
        "ssim": row.get("ssim"),
        "lpips": None if lpips is None else row[lpips],
        "gaussians": row.get("gaussians"),
        "peak_gaussians": row.get("peak_gaussians"),
        "peak_gb": None if peak is None else 1e-9 * peak,
        "gpu": row.get("gpu") or None,
        "processor": row.get("processor"),
    }
    return {
        name: round(value, 4) if isinstance(value, float) else value
        for name, value in values.items()
        if value is not None
    }


def lpips_column(rows: Sequence[Row]) -> str | None:
    """Return the column of LPIPS that all rows have; None without one."""
    return next((name for name in LPIPS if all(name in row for row in rows)), None)


@dataclass(frozen=True)
class Curves:
    """Hold the measured runs of a scene.

    Attributes:
        scene: its name.
        budgets: in seconds.
        rows: `figures` of each run.
        lpips: column of LPIPS; None without one.
        failures: a line for each method that failed.
    """

    scene: str
    budgets: Sequence[float]
    rows: Sequence[Mapping[str, Any]]
    lpips: str | None
    failures: Sequence[str]

    @property
    def points(self) -> list[Point]:
        """Means over seeds."""
        return mean_points(self.rows)

    @property
    def styles(self) -> dict[str, str]:
        """Styles of lines by method."""
        methods = dict.fromkeys(row["method"] for row in self.rows)
        return {method: f"variant-{number % len(VARIANT_COLORS)}" for number, method in enumerate(methods)}

    @property
    def metrics(self) -> list[Metric]:
        """Metrics that any run has."""
        return [metric for metric in METRICS if measured(self.points, metric)]

    def chart(self, metric: Metric) -> Chart:
        """Draw quality over seconds, the front's points first."""
        front = Series(FRONT, _places(pareto_front(self.points, metric), metric))
        lines = [
            Series(style, _places([p for p in measured(self.points, metric) if p.method == method], metric))
            for method, style in self.styles.items()
            if any(p.method == method for p in measured(self.points, metric))
        ]
        return draw_lines(metric.title, "seconds of optimization", [front, *lines], from_zero=False, text=count_text)

    def fronts_of(self, point: Point) -> list[str]:
        """Return the metrics on whose front a point is."""
        return [metric.key for metric in self.metrics if point in pareto_front(self.points, metric)]

    def ratio_lines(self) -> list[str]:
        """Say when each method reaches what one field reaches at best."""
        lines = []
        for metric in self.metrics:
            reading = time_ratios(self.points, metric, ONE_FIELD)
            if reading is None:
                continue
            best, ratios = reading
            words = [
                f"{one.method} not within these budgets"
                if one.seconds is None
                else f"{one.method} in {one.ratio:.2f} of its time ({seconds_text(one.seconds)})"
                for one in ratios
            ]
            value = metric.text(best.values[metric.key])
            lines.append(
                f"{metric.title}: {ONE_FIELD} reaches {value} at best, after {seconds_text(best.seconds)}"
                + (f": {'; '.join(words)}" if words else "")
            )
        return lines

    def best_lines(self) -> list[tuple[float, list[str]]]:
        """Return, by budget, the best method of each metric as words; "-" where no run was so short."""
        return [(budget, [self._best(metric, budget) for metric in self.metrics]) for budget in self.budgets]

    def _best(self, metric: Metric, budget: float) -> str:
        best = best_within(self.points, metric, budget * (1 + LATE))
        return "-" if best is None else f"{best.method}: {metric.text(best.values[metric.key])}"


def _places(points: Sequence[Point], metric: Metric) -> list[tuple[float, float]]:
    return sorted((point.seconds, point.values[metric.key]) for point in points)


def write_results(curves: Curves, folder: Path) -> None:
    """Write the page, the SVG and the CSV file.

    Raises:
        RunFolderError: one of them cannot be written.
    """
    points = {(point.method, point.budget): point for point in curves.points}
    fronts = {key: " ".join(curves.fronts_of(point)) for key, point in points.items()}
    rows = [{**row, "front": fronts[row["method"], row["budget"]]} for row in curves.rows]
    write_csv(folder / CSV, rows)
    charts = [curves.chart(metric) for metric in curves.metrics]
    label = f"Quality over seconds: {curves.scene}"
    title = f"{label}; rings: the Pareto front"
    write_text(folder / SVG, draw_charts(charts, curves.styles, label, title, columns=2))
    page = render_page(
        PAGE_TEMPLATE,
        scene=curves.scene,
        charts=charts,
        styles=curves.styles,
        ratios=curves.ratio_lines(),
        metrics=curves.metrics,
        best=curves.best_lines(),
        late=f"{100 * LATE:g} %",
        rows=rows,
        lpips=curves.lpips,
        failures=curves.failures,
        machines=sorted({row.get("gpu") or row.get("processor", "") for row in rows}),
    )
    write_text(folder / HTML, page)
