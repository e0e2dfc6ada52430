"""report.html: one page about a run, beside its baseline if there is one, that needs no other file and no network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2

from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.evaluation.lpips import LPIPS_KEY, VARIANTS, title_of
from lapgs_plugin.files import atomic_write, one_line_errors
from lapgs_plugin.hierarchy.plan import Hierarchy
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.progress import item_progress
from lapgs_plugin.rendering.compose import HierarchyRenderer
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.reports.charts import (
    INSET_AT,
    Bar,
    BarChart,
    Chart,
    Mark,
    Move,
    Series,
    draw,
    draw_bars,
    draw_moves,
)
from lapgs_plugin.reports.comparison import Metrics, comparison_rows, unlike
from lapgs_plugin.reports.pictures import Strip, make_strip
from lapgs_plugin.runs.archive import METRICS, REPORT, RunArchive
from lapgs_plugin.untrusted import shortened

TEMPLATE = "report.html.jinja"
MINUTES_FROM = 300.0
"""Runs at least this many seconds long are charted in minutes."""
START_SHARE = 0.15
"""Of the longest run's time, drawn once more as an inset."""
RUN, BASELINE = "run", "baseline"
"""Styles of lines and arrows."""


@dataclass(frozen=True)
class MeasuredRun:
    """A complete run with its figures.

    Attributes:
        archive: the run folder.
        metrics: what its metrics.json holds.
    """

    archive: RunArchive
    metrics: Metrics

    @property
    def name(self) -> str:
        return self.archive.path().name


@dataclass(frozen=True)
class ViewRow:
    """One view in the table of all.

    Attributes:
        name: of the view.
        cells: value and text of every metric of the run, then of the baseline's PSNR and how much the run gains on it.
    """

    name: str
    cells: tuple[tuple[float, str], ...]


def write_report(
    run: MeasuredRun,
    baseline: MeasuredRun | None = None,
    moved_to: Path | None = None,
    *,
    device: str = "auto",
    rasterizer: str = "auto",
) -> Path:
    """Write RUN/report.html.

    Args:
        run: what the page is about.
        baseline: what it is compared with.
        moved_to: where the run's scene is now; None when it did not move.
        device, rasterizer: what renders the pictures, see `rendering.run.run_renderer`.

    Returns:
        The file.

    Raises:
        RunFolderError: the scene is not where it was, or the file cannot be written.
    """
    runs = [run] if baseline is None else [run, baseline]
    kinds = [RUN, BASELINE][: len(runs)]
    renderers = [run_renderer(each.archive, device, rasterizer) for each in runs]
    view_columns, view_rows = view_table(runs)
    page = render_page(
        TEMPLATE,
        name=run.name,
        scene=Path(run.archive.manifest.scene.path).name,
        manifest=run.archive.manifest,
        metrics=run.metrics,
        baseline_name=baseline.name if baseline else None,
        unlike=unlike(run.archive.manifest, baseline.archive.manifest) if baseline else [],
        rows=comparison_rows([each.metrics for each in runs]),
        charts=training_charts(runs, kinds, marked=run),
        moves=_moves(run, baseline) if baseline else None,
        breakdown=breakdown_bars(runs),
        overhead=overhead_bars(runs),
        strips=view_strips(run, renderers, moved_to),
        view_columns=view_columns,
        view_rows=view_rows,
        settings=_settings(run),
    )
    return write_page(run.archive.path(REPORT), page)


def render_page(template: str, **values: Any) -> str:
    """A template of this folder, filled in."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(values, inset_at=INSET_AT)


def write_page(path: Path, page: str) -> Path:
    """Write a whole page or none.

    Raises:
        RunFolderError: it cannot be written.
    """
    with one_line_errors(path), atomic_write(path) as stream:
        stream.write(page.encode())
    return path


# What was recorded during training.


def training_charts(
    runs: Sequence[MeasuredRun], kinds: Sequence[str], marked: MeasuredRun | None = None
) -> dict[str, list[Chart]]:
    """Loss, held-out PSNR and number of Gaussians, over seconds and over iterations; without what was not recorded.

    Args:
        runs: whose lines are drawn, the first on top.
        kinds: style of each one's lines.
        marked: whose stages are marked; None marks nothing.
    """
    longest = max(run.metrics["train_seconds"] for run in runs)
    unit, scale = ("minutes", 60.0) if longest >= MINUTES_FROM else ("seconds", 1.0)

    def elapsed(run: MeasuredRun, entry: dict[str, Any]) -> float:
        return _elapsed(run, entry) / scale

    start = START_SHARE * longest / scale
    return {
        "time": _chart_row(runs, kinds, marked, f"{unit} of optimization", elapsed, start),
        "iterations": _chart_row(runs, kinds, marked, "iterations, all stages", _iteration, None),
    }


def _elapsed(run: MeasuredRun, entry: dict[str, Any]) -> float:
    """Seconds of optimization since the start of the run; what is noted after a stage has no time of its own."""
    if "elapsed" in entry:
        return float(entry["elapsed"])
    return sum(record.train_seconds for record in run.archive.manifest.records if record.level >= entry["level"])


def _iteration(run: MeasuredRun, entry: dict[str, Any]) -> float:
    """Iterations since the start of the run; the history counts within a stage."""
    before = sum(record.iterations for record in run.archive.manifest.records if record.level > entry["level"])
    return float(before + entry["iteration"])


Position = Callable[[MeasuredRun, dict[str, Any]], float]


def _chart_row(
    runs: Sequence[MeasuredRun],
    kinds: Sequence[str],
    marked: MeasuredRun | None,
    x_label: str,
    x_of: Position,
    start: float | None,
) -> list[Chart]:
    marks = [] if marked is None else _stage_marks(marked, x_of)
    charts = []
    for key, title, from_zero, by_stage, format_y in (
        ("loss", "Loss", True, True, "{:g}".format),
        ("psnr", "Held-out PSNR (dB)", False, False, "{:g}".format),
        ("num_gaussians", "Gaussians in training", True, True, count_text),
    ):
        series = [
            Series(kind, points)
            for run, kind in reversed(list(zip(runs, kinds, strict=True)))  # the first on top
            for points in _lines(run, key, by_stage, x_of)
        ]
        if series:
            charts.append(
                draw(
                    title,
                    x_label,
                    series,
                    marks=marks,
                    from_zero=from_zero,
                    format_x=count_text,
                    format_y=format_y,
                    inset_until=start if key == "psnr" else None,
                )
            )
    return charts


def _lines(run: MeasuredRun, key: str, by_stage: bool, x_of: Position) -> list[list[tuple[float, float]]]:
    """What the history says about `key`: one line, or one a stage where stages do not continue each other."""
    lines: dict[int, list[tuple[float, float]]] = {}
    for entry in run.archive.history():
        if key in entry:
            lines.setdefault(entry["level"] if by_stage else 0, []).append((x_of(run, entry), entry[key]))
    return list(lines.values())


def _stage_marks(run: MeasuredRun, x_of: Position) -> list[Mark]:
    """Where each stage of a hierarchy begins; nothing for a single field."""
    begins: dict[int, float] = {}
    end = 0.0
    for entry in run.archive.history():
        begins.setdefault(entry["level"], end)
        end = x_of(run, entry)
    return [Mark(x, f"level {level}") for level, x in begins.items()] if len(begins) > 1 else []


def count_text(value: float) -> str:
    """A number short enough for an axis: 1.5k, 20k, 1.2M."""
    for size, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{suffix}"
    return f"{value:g}"


# What it took.


def seconds_text(value: float) -> str:
    """Seconds with three digits."""
    return f"{value:.3g} s" if value < 1e3 else f"{value:,.0f} s"


def _moves(run: MeasuredRun, baseline: MeasuredRun) -> Chart:
    """Time against Gaussians, an arrow from the baseline to the run."""
    ends = [(each.metrics["weighted_gaussians"], each.metrics["train_seconds"]) for each in (baseline, run)]
    return draw_moves(
        "Optimization (s) against Gaussians",
        "Gaussians, mean of levels by iterations",
        [Move(RUN, "", *ends)],
        format_x=count_text,
        format_y=count_text,
    )


def breakdown_bars(runs: Sequence[MeasuredRun]) -> BarChart | None:
    """Where the time of iterations went, a bar for each level of each run that was broken down."""
    bars = []
    for run in runs:
        for record in run.archive.manifest.records:
            if record.breakdown_seconds:
                what = f", level {record.level}" if run.archive.manifest.levels > 1 else ""
                total = sum(record.breakdown_seconds.values())
                label = f"{run.name}{what}: {1e3 * total / record.iterations:.3g} ms an iteration"
                bars.append(Bar(label, list(record.breakdown_seconds.items())))
    return draw_bars("Optimization", bars, format_value=seconds_text) if bars else None


def overhead_bars(runs: Sequence[MeasuredRun]) -> BarChart | None:
    """What was spent beside the optimization."""
    bars = [Bar(run.name, list(run.metrics["overhead_seconds"].items())) for run in runs]
    return draw_bars("Beside the optimization", bars, format_value=seconds_text) if any(b.parts for b in bars) else None


# Views.


def view_strips(
    run: MeasuredRun, renderers: Sequence[HierarchyRenderer], moved_to: Path | None, most: int = 3
) -> list[Strip]:
    """The worst, the median and the best view of the run, in pictures of it and of its baseline.

    Args:
        run: by whose metrics views are chosen.
        renderers: of the run, and of its baseline.
        moved_to: where the scene is now; None when it did not move.
        most: of these views, from the worst on.

    Raises:
        RunFolderError: the scene is not where it was.
    """
    shown = dict(list(_shown_views(run.metrics).items())[:most])
    figures = {view["name"]: f"{view['psnr']:.2f} dB, SSIM {view['ssim']:.4f}" for view in run.metrics["views"]}
    with one_pool():
        scene = run_scene(run.archive, moved_to)
        views = {view.name: view for view in (*scene.train, *scene.test)}
        if unknown := sorted(shown.keys() - views.keys()):
            raise RunFolderError(
                f"{run.archive.path(METRICS)} measures the view {shortened(unknown[0])}, which {scene.path} does not "
                "have; write it again with `lapgs eval`"
            )
        with item_progress("views") as progress:
            return [
                make_strip(views[name], why, figures[name], renderers)
                for name, why in progress.track(list(shown.items()), description="Rendering views for the report")
            ]


def _shown_views(metrics: Metrics) -> dict[str, str]:
    """Names of the views to show, with the reason."""
    ranked = [view["name"] for view in sorted(metrics["views"], key=lambda view: float(view["psnr"]))]
    chosen = {"worst": ranked[0], "median": ranked[(len(ranked) - 1) // 2], "best": ranked[-1]}
    reasons: dict[str, str] = {}
    for why, name in chosen.items():
        reasons.setdefault(name, f"{why} of {len(ranked)} by PSNR")
    return reasons


def view_table(runs: Sequence[MeasuredRun]) -> tuple[list[str], list[ViewRow]]:
    """All views by the run's PSNR, the worst first; the columns' headings, and the rows.

    Args:
        runs: the run, and its baseline if there is one.
    """
    views = sorted(runs[0].metrics["views"], key=lambda view: float(view["psnr"]))
    keys = {"psnr": "PSNR (dB)", "ssim": "SSIM"}
    keys |= {
        LPIPS_KEY.format(name): f"LPIPS ({title_of(name)})"
        for name in VARIANTS
        if all(LPIPS_KEY.format(name) in view for view in views)
    }
    others = [{view["name"]: view["psnr"] for view in each.metrics["views"]} for each in runs[1:]]
    rows = []
    for view in views:
        cells = [(view[key], f"{view[key]:.2f}" if key == "psnr" else f"{view[key]:.4f}") for key in keys]
        for other in others:
            # The baseline may have been measured on other views.
            if (theirs := other.get(view["name"])) is not None:
                cells += [(theirs, f"{theirs:.2f}"), (view["psnr"] - theirs, f"{view['psnr'] - theirs:+.2f}")]
        rows.append(ViewRow(view["name"], tuple(cells)))
    return [*keys.values(), *(["baseline PSNR", "gain"] if others else [])], rows


def _settings(run: MeasuredRun) -> dict[str, str]:
    """What decides a run's result, by name, flat; and the versions it was measured with."""
    manifest = run.archive.manifest
    nested = manifest.settings.get("hierarchy") == Hierarchy.NESTED.value
    values: dict[str, Any] = {
        "scene": manifest.scene.path,
        "resolution": manifest.scene.resolution,
        "every eighth view held out": manifest.scene.eval,
        "background": ", ".join(f"{value:g}" for value in manifest.scene.background),
        "levels": manifest.levels,
        "grid": manifest.grid,
        "supervision": manifest.supervision,
        "inherit": "everything" if nested else manifest.inherit,
        "SH degree": manifest.sh_degree,
        "seed": manifest.seed,
        "rasterizer": manifest.rasterizer,
        "measured with rasterizer": run.metrics["rasterizer"],
        **_flat(manifest.settings),
        "trained": f"{manifest.created} by {manifest.created_by}",
        **{f"measured with {name}": version for name, version in run.metrics["versions"].items()},
    }
    return {name: "default" if value is None else str(value) for name, value in values.items()}


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        label = prefix + name.replace("_", " ")
        flat.update(_flat(value, f"{label}: ") if isinstance(value, dict) else {label: value})
    return flat
