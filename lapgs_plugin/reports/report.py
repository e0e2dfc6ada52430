"""Write report.html: one page about a run and its baseline that needs no other file and no network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2

from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.evaluation.figures import measured_looks
from lapgs_plugin.evaluation.lpips import lpips_titles
from lapgs_plugin.files import write_text
from lapgs_plugin.hierarchy.plan import Hierarchy
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.progress import item_progress
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.options import RenderOptions
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.reports.charts import (
    INSET_AT,
    PART_COLORS,
    VARIANT_COLORS,
    Arrow,
    Bar,
    BarChart,
    Chart,
    Mark,
    Series,
    draw_arrows,
    draw_bars,
    draw_lines,
    number_text,
    seconds_text,
)
from lapgs_plugin.reports.comparison import Metrics, comparison_rows, setup_differences
from lapgs_plugin.reports.pictures import Strip, make_strip
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import METRICS, REPORT
from lapgs_plugin.runs.manifest import Manifest
from lapgs_plugin.runs.results import MEASURED
from lapgs_plugin.runs.training_figures import (
    VIEW_PSNR,
    finest_gains,
    last_view_psnrs,
    length_lines,
    smaller_gains,
    weak_levels,
)
from lapgs_plugin.untrusted import shortened

TEMPLATE = Path(__file__).with_name("report.html.jinja")
MINUTES_FROM = 300.0
"""Least length of a run, in seconds, whose charts show minutes."""
START_SHARE = 0.15
"""Share of the longest run's time that the inset shows."""
RUN, BASELINE = "run", "baseline"  # styles of lines and arrows


@dataclass(frozen=True)
class MeasuredRun:
    """A complete run with its figures.

    Attributes:
        archive: the run folder.
        metrics: content of its metrics.json.
    """

    archive: RunArchive
    metrics: Metrics

    @property
    def name(self) -> str:
        return self.archive.name


@dataclass(frozen=True)
class ViewTable:
    """The table of all views.

    Attributes:
        columns: headings.
        rows: by view, value and text of every metric of the run, then of the baseline's PSNR and of the gain over it.
    """

    columns: list[str]
    rows: dict[str, list[tuple[float, str]]]


def write_report(run: MeasuredRun, baseline: MeasuredRun | None, options: RenderOptions) -> Path:
    """Write report.html into the folder of a run, compared with its baseline if there is one, and return its path.

    Raises:
        RunFolderError: the scene is missing, or the file cannot be written.
    """
    runs = [run] if baseline is None else [run, baseline]
    kinds = [RUN, BASELINE][: len(runs)]
    renderers = [run_renderer(measured.archive, options.device, options.rasterizer) for measured in runs]
    page = render_page(
        TEMPLATE,
        name=run.name,
        scene=Path(run.archive.manifest.scene.path).name,
        manifest=run.archive.manifest,
        metrics=run.metrics,
        measured=MEASURED[run.metrics["split"]],
        baseline_name=baseline.name if baseline else None,
        differences=setup_differences(run.archive.manifest, baseline.archive.manifest, [one.metrics for one in runs])
        if baseline
        else [],
        rows=comparison_rows([measured.metrics for measured in runs]),
        charts=training_charts(runs, kinds, marked=True),
        arrows=_time_arrows(run, baseline) if baseline else None,
        decided=length_lines(run.archive.manifest.records),
        weak=_weak_levels(run),
        breakdown=breakdown_bars(runs),
        overhead=overhead_bars(runs),
        strips=view_strips(runs, renderers, options.scene),
        views=view_table(runs),
        settings=_settings(run),
        advised=knows_options(run.archive.manifest),
    )
    path = run.archive.path(REPORT)
    write_text(path, page)
    return path


def _weak_levels(run: MeasuredRun) -> list[str]:
    """Return lines about levels that hardly matter; about gains only if views were held out."""
    manifest, metrics = run.archive.manifest, run.metrics
    gains: Sequence[float] = ()
    if metrics["split"] == "test":
        at_end = {int(level): figures[VIEW_PSNR] for level, figures in metrics["levels"].items()}
        logged = last_view_psnrs(run.archive.history(), along=False)
        gains = smaller_gains(finest_gains(at_end), finest_gains(logged))
    return weak_levels(manifest.records, gains, manifest.settings, advised=knows_options(manifest))


def render_page(template: Path, **values: Any) -> str:
    """Render a template, which may import others of its folder and of this one."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, Path(__file__).parent]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template.name).render(
        values, inset_at=INSET_AT, variant_colors=VARIANT_COLORS, part_colors=PART_COLORS
    )


History = list[dict[str, Any]]
"""Entries of a run, each with its time and its iterations since the run's start."""


def training_charts(
    runs: Sequence[MeasuredRun], kinds: Sequence[str], *, marked: bool = False
) -> dict[str, list[Chart]]:
    """Draw loss, held-out PSNR and number of Gaussians over iterations, and over time if it was measured.

    Args:
        runs: the runs to draw, the first on top.
        kinds: line style of each run.
        marked: mark the stages of the first run.
    """
    longest = max(run.metrics["train_seconds"] for run in runs)
    unit, scale = ("minutes", 60.0) if longest >= MINUTES_FROM else ("seconds", 1.0)
    histories = [run_history(run, scale) for run in runs]
    lines = list(zip(kinds, histories, strict=True))[::-1]  # draws the first on top
    return {
        x: _chart_row(lines, x, label, start, _stage_marks(histories[0], x) if marked else [])
        for x, label, start in (
            ("time", f"{unit} of optimization", START_SHARE * longest / scale),
            ("iterations", "iterations, all stages", None),
        )
        if any(entry[x] for history in histories for entry in history)
    }


def run_history(run: MeasuredRun, scale: float) -> History:
    """Return a run's history with "time", in units of `scale` seconds, and "iterations" since the run's start.

    Entries from after a stage have the time of its end. The file counts iterations within a stage.
    """
    records, history = run.archive.manifest.records, []
    for entry in run.archive.history():
        level = entry["level"]
        ended = sum(record.train_seconds for record in records if record.level >= level)
        before = sum(record.iterations for record in records if record.level > level)
        time = float(entry.get("elapsed", ended)) / scale
        history.append({**entry, "time": time, "iterations": float(before + entry["iteration"])})
    return history


def _chart_row(
    lines: Sequence[tuple[str, History]], x: str, x_label: str, start: float | None, marks: Sequence[Mark]
) -> list[Chart]:
    charts = []
    for key, title in (("loss", "Loss"), ("psnr", "Held-out PSNR (dB)"), ("num_gaussians", "Gaussians in training")):
        by_stage = key != "psnr"  # which is of the composed image, so that stages continue each other
        series = []
        for kind, history in lines:
            points: dict[int, list[tuple[float, float]]] = {}
            for entry in history:
                if key in entry:
                    points.setdefault(entry["level"] if by_stage else 0, []).append((entry[x], entry[key]))
            series += [Series(kind, line) for line in points.values()]
        if series:
            inset = None if by_stage else start
            charts.append(draw_lines(title, x_label, series, marks=marks, from_zero=by_stage, inset_until=inset))
    return charts


def _stage_marks(history: History, x: str) -> list[Mark]:
    """Mark the start of each stage of a hierarchy; nothing for a single field."""
    begins: dict[int, float] = {}
    end = 0.0
    for entry in history:
        begins.setdefault(entry["level"], end)
        end = entry[x]
    return [Mark(begin, f"level {level}") for level, begin in begins.items()] if len(begins) > 1 else []


def _time_arrows(run: MeasuredRun, baseline: MeasuredRun) -> Chart | None:
    """Draw time against Gaussians, as an arrow from the baseline to the run, if both have measured their time."""
    if not (run.metrics["train_seconds"] and baseline.metrics["train_seconds"]):
        return None
    ends = [(one.metrics["weighted_gaussians"], one.metrics["train_seconds"]) for one in (baseline, run)]
    label = "Gaussians of levels, weighted by iterations"
    return draw_arrows("Optimization (s) against Gaussians", label, [Arrow(RUN, "", *ends)])


def breakdown_bars(runs: Sequence[MeasuredRun]) -> BarChart | None:
    """Draw the time of iterations by part, a bar for each level of each run that recorded it."""
    bars = []
    for run in runs:
        for record in run.archive.manifest.records:
            if record.breakdown_seconds:
                level = f", level {record.level}" if run.archive.manifest.levels > 1 else ""
                total = sum(record.breakdown_seconds.values())
                label = f"{run.name}{level}: {number_text(1e3 * total / record.iterations)} ms an iteration"
                bars.append(Bar(label, list(record.breakdown_seconds.items())))
    return draw_bars("Optimization", bars, seconds_text) if bars else None


def overhead_bars(runs: Sequence[MeasuredRun]) -> BarChart | None:
    """Draw the time outside the optimization."""
    bars = [Bar(run.name, list(run.metrics["overhead_seconds"].items())) for run in runs]
    return draw_bars("Overhead", bars, seconds_text) if any(b.parts for b in bars) else None


def view_strips(
    runs: Sequence[MeasuredRun], renderers: Sequence[HierarchyRenderer], moved_to: Path | None, most: int = 3
) -> list[Strip]:
    """Render the worst, the median and the best view of the run, with its baseline, as they were measured.

    Args:
        runs: the run whose metrics choose the views, then its baseline.
        renderers: theirs.
        moved_to: the scene's folder now; None when it did not move.
        most: number of these views, from the worst on.

    Raises:
        RunFolderError: the scene is missing.
    """
    run = runs[0]
    shown = dict(list(_select_views(run.metrics).items())[:most])
    figures = {view["name"]: f"{view['psnr']:.2f} dB, SSIM {view['ssim']:.4f}" for view in run.metrics["views"]}
    with one_pool():
        scene = run_scene(run.archive, moved_to)
        views = {view.name: view for view in (*scene.train, *scene.test)}
        if unknown := sorted(shown.keys() - views.keys()):
            raise RunFolderError(
                f"{run.archive.path(METRICS)} measures the view {shortened(unknown[0])}, which {scene.path} does not "
                "have; write it again with `lapgs eval`"
            )
        looks = [measured_looks(one.archive, one.metrics["split"], shown) for one in runs]
        with item_progress("views") as progress:
            return [
                make_strip(views[name], why, figures[name], renderers, [own[name] for own in looks])
                for name, why in progress.track(list(shown.items()), description="Rendering views for the report")
            ]


def _select_views(metrics: Metrics) -> dict[str, str]:
    """Choose the views to show, and the reason of each."""
    ranked = [view["name"] for view in sorted(metrics["views"], key=lambda view: float(view["psnr"]))]
    chosen = {"worst": ranked[0], "median": ranked[(len(ranked) - 1) // 2], "best": ranked[-1]}
    reasons: dict[str, str] = {}
    for why, name in chosen.items():
        reasons.setdefault(name, f"{why} of {len(ranked)} by PSNR")
    return reasons


def view_table(runs: Sequence[MeasuredRun]) -> ViewTable:
    """Make the table of all views of a run, the worst PSNR first, beside those of its baseline if there is one."""
    views = sorted(runs[0].metrics["views"], key=lambda view: float(view["psnr"]))
    keys = {"psnr": "PSNR (dB)", "ssim": "SSIM", **lpips_titles(set.intersection(*map(set, views)))}
    others = [{view["name"]: view["psnr"] for view in baseline.metrics["views"]} for baseline in runs[1:]]
    rows = {}
    for view in views:
        cells = [(view[key], f"{view[key]:.2f}" if key == "psnr" else f"{view[key]:.4f}") for key in keys]
        for other in others:
            # The baseline may have been measured on other views.
            if (theirs := other.get(view["name"])) is not None:
                cells += [(theirs, f"{theirs:.2f}"), (view["psnr"] - theirs, f"{view['psnr'] - theirs:+.2f}")]
        rows[view["name"]] = cells
    return ViewTable([*keys.values(), *(["baseline PSNR", "gain"] if others else [])], rows)


def knows_options(manifest: Manifest) -> bool:
    """Return whether `lapgs train` or `lapgs run` trained a run: no loop of the user's own, no imported run."""
    return "iterations" in manifest.settings and not is_imported(manifest)


def is_imported(manifest: Manifest) -> bool:
    """Return whether `lapgs import-run` made a run folder."""
    return "imported_from" in manifest.settings.get("backbone", {})


def _settings(run: MeasuredRun) -> dict[str, str]:
    """Return the settings that decide a run's result, flat and by name, and the versions of its measurement."""
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
