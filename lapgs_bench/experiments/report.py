"""Write report.html of an experiment: tables, time and views, as one page that needs no network.

Reads the files that `lapgs bench` writes: results.csv, tables.md and run folders. Missing run folders are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from markdown_it import MarkdownIt

from lapgs_bench.experiments.exports import CSV, MARKDOWN, columns_of
from lapgs_bench.experiments.figures.curves import time_arrows
from lapgs_bench.experiments.results import Results
from lapgs_plugin.errors import LapgsError, RunFolderError
from lapgs_plugin.files import write_text
from lapgs_plugin.rendering.options import RenderOptions
from lapgs_plugin.rendering.run import run_renderer
from lapgs_plugin.reports.charts import Bar, BarChart, draw_bars, number_text, seconds_text
from lapgs_plugin.reports.folders import FolderReport
from lapgs_plugin.reports.pictures import Strip
from lapgs_plugin.reports.report import MeasuredRun, render_page, training_charts, view_strips, view_table
from lapgs_plugin.runs.layout import REPORT
from lapgs_plugin.runs.profiling import PARTS
from lapgs_plugin.untrusted import read_text

TEMPLATE = Path(__file__).with_name("experiment.html.jinja")
PARTS_MS = {f"{part}_ms": part for part in PARTS}
"""Columns with the milliseconds of parts of an iteration."""


class ExperimentReport(FolderReport):
    """Report on a folder of `lapgs bench`."""

    marker = CSV

    def write(self, folder: Path, options: RenderOptions) -> Path:
        results = Results.read(folder)
        title, tables = _tables(folder / MARKDOWN)
        overheads = {
            column: column.removeprefix("overhead_").removesuffix("_seconds")
            for column in columns_of(results.rows)
            if column.startswith("overhead_") and column != "overhead_seconds"
        }
        page = render_page(
            TEMPLATE,
            title=title or str(results.rows[0].get("experiment", folder.name)),
            tables=tables,
            variants={name: results.style(name) for name in results.variants},
            num_runs=len({row["run"] for row in results.rows}),
            arrows=time_arrows(results, lambda _, variant: results.style(variant)),
            breakdown=_bars(results, "An iteration", PARTS_MS, lambda value: f"{number_text(value)} ms"),
            overhead=_bars(results, "Overhead", overheads, seconds_text),
            parts=[_part(results, scene, backbone, options) for scene, backbone in results.pairs],
            machines=_machines(results),
        )
        write_text(folder / REPORT, page)
        return folder / REPORT


def _tables(path: Path) -> tuple[str, str]:
    """Return the experiment's title, and its tables as HTML."""
    if not path.is_file():
        return "", ""
    advice = "write it again with `lapgs bench` and --tables-only"
    first, _, rest = read_text(path, error=RunFolderError, advice=advice).partition("\n")
    html = MarkdownIt("commonmark", {"html": False}).enable("table").render(rest)
    return first.removeprefix("# "), html.replace("<table>", '<div class="scroll"><table>').replace(
        "</table>", "</table></div>"
    )


def _machines(results: Results) -> list[str]:
    """Describe machines and versions."""
    lines = {
        ", ".join(str(row[name]) for name in ("gpu", "processor") if row.get(name))
        + f": lapgs_plugin {row.get('lapgs_version', '?')}, PyTorch {row.get('torch', '?')}"
        for row in results.rows
    }
    return sorted(lines)


# All scenes and backbones together.


def _bars(results: Results, title: str, names: Mapping[str, str], text: Callable[[float], str]) -> BarChart | None:
    """Draw a bar for each variant on each backbone that has any of these columns, of means over scenes and seeds."""
    bars = []
    for backbone in dict.fromkeys(row["backbone"] for row in results.rows):
        for variant in results.variants:
            rows = [row for row in results.rows if (row["backbone"], row["variant"]) == (backbone, variant)]
            parts = [
                (name, fmean(row.get(column, 0.0) for row in rows))
                for column, name in names.items()
                if any(column in row for row in rows)
            ]
            if parts:
                bars.append(Bar(results.title(variant, backbone), parts))
    return draw_bars(title, bars, text) if bars else None


# One scene on one backbone.


def _part(results: Results, scene: str, backbone: str, options: RenderOptions) -> dict[str, Any]:
    """Return the page's part about a scene on a backbone, with the first seed of every variant.

    Keys: title; charts of training, and variants by the style of their lines; views of a variant beside the baseline
    as pictures and as a table, and the variants that these compare, in words; notes on missing runs.
    """
    runs: dict[str, MeasuredRun] = {}
    notes = []
    for variant in results.variants:
        for row in results.of(scene, backbone, variant)[:1]:
            try:
                runs[variant] = results.run(row)
            except LapgsError as error:
                notes.append(f"{variant} is not shown: {error}")
    base = results.baseline(backbone)
    measured = [name for name in runs if runs[name].metrics.get("views")]
    shown = next((name for name in measured if name != base), base)
    pair = [runs[name] for name in dict.fromkeys((shown, base)) if name in measured]
    strips: list[Strip] = []
    if pair:
        try:
            renderers = [run_renderer(run.archive, options.device, options.rasterizer) for run in pair]
            strips = view_strips(pair, renderers, None, most=1)
        except LapgsError as error:
            notes.append(f"no pictures: {error}")
    return {
        "title": results.title(scene, backbone),
        "charts": training_charts(list(runs.values()), [results.style(name) for name in runs]) if runs else {},
        "styles": {results.style(name): name for name in runs},
        "strips": strips,
        "views": view_table(pair) if pair else None,
        "compared": shown if len(pair) == 1 else f"{shown}, beside {base}",
        "notes": notes,
    }
