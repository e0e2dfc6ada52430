"""Draw figures of measured numbers: curves of training, arrows from baselines to hierarchies, bars of memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from lapgs_bench.experiments.aggregate import check_table
from lapgs_bench.experiments.commands import IMPORTED
from lapgs_bench.experiments.exports import Row
from lapgs_bench.experiments.figures.image import draw_bar_image, draw_charts
from lapgs_bench.experiments.results import COUNTS, Results
from lapgs_bench.experiments.schema import Experiment
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import BARE_RECORD, is_file, is_folder
from lapgs_plugin.reports.charts import (
    VARIANT_COLORS,
    Arrow,
    Bar,
    Chart,
    Series,
    draw_arrows,
    draw_bars,
    draw_lines,
)
from lapgs_plugin.reports.report import MINUTES_FROM, START_SHARE, History, run_history
from lapgs_plugin.runs.results import read_bare_record

MEMORY = "peak_memory_without_images_bytes"


class NothingToDrawError(UserInputError):
    """Report that the results lack what a figure shows, and what to do."""


@dataclass(frozen=True)
class Methods:
    """Name the methods of an experiment: its pairs of a backbone and a variant.

    Attributes:
        labels: by pair, in the experiment's order.
    """

    labels: Mapping[tuple[str, str], str]

    @classmethod
    def of(cls, experiment: Experiment, results: Results) -> Methods:
        """Name the methods that have results."""
        measured = {(row["backbone"], row["variant"]) for row in results.rows}
        several = len({backbone for backbone, _ in measured}) > 1
        labels = {
            (name, variant.name): f"{backbone.title or name}: {variant.name}" if several else variant.name
            for name, backbone in experiment.backbones.items()
            for variant in experiment.variants
            if (name, variant.name) in measured
        }
        return cls(labels)

    def style(self, backbone: str, variant: str) -> str:
        """Return the style of a method's lines and arrows."""
        return f"variant-{list(self.labels).index((backbone, variant)) % len(VARIANT_COLORS)}"

    def legend(self, pairs: Sequence[tuple[str, str]]) -> dict[str, str]:
        """Return the styles of these methods by their labels."""
        return {label: self.style(*pair) for pair, label in self.labels.items() if pair in pairs}


def draw_training(
    experiment: Experiment, results: Results, scene: str, *, figure: str, x: str, title: str, advice: str
) -> str:
    """Return the curves of a figure over time or iterations of a scene's runs, with the first seed of each method.

    Args:
        experiment, results, scene: which runs.
        figure: key of the history.
        x: "time" or "iterations".
        title: of the chart.
        advice: what to do if no run has the figure.

    Raises:
        NothingToDrawError: no run has it.
        RunFolderError: a run's folder is missing or damaged.
    """
    methods = Methods.of(experiment, results)
    rows = {pair: found[0] for pair in methods.labels if (found := results.of(scene, *pair))}
    longest = max((row["train_seconds"] for row in rows.values()), default=0.0)
    unit, scale = ("minutes", 60.0) if longest >= MINUTES_FROM else ("seconds", 1.0)
    by_stage = figure == "num_gaussians"  # stages have fields of their own
    series, drawn = [], []
    for pair, row in rows.items():
        lines: dict[int, list[tuple[float, float]]] = {}
        for entry in _history(results, row, scale):
            if figure in entry:
                lines.setdefault(entry["level"] if by_stage else 0, []).append((entry[x], entry[figure]))
        series += [Series(methods.style(*pair), points) for points in lines.values()]
        drawn += [pair] if lines else []
    if not series:
        raise NothingToDrawError(f"no run of {scene} has {title.lower()}; {advice}")
    label = f"{unit} of optimization" if x == "time" else "iterations, all stages"
    start = START_SHARE * longest / scale if x == "time" else None
    chart = draw_lines(title, label, series, from_zero=by_stage, inset_until=start)
    return draw_charts([chart], methods.legend(drawn), f"{title}: {scene}", _titled(results, scene), columns=1)


def _history(results: Results, row: Row, scale: float) -> History:
    """Return a run's history; of a bare run that was not imported the timeline of its record."""
    folder = results.run_folder(row)
    if is_file(folder / BARE_RECORD) and not is_folder(folder / IMPORTED):
        timeline: Sequence[dict[str, Any]] = read_bare_record(folder / BARE_RECORD)["timeline"]
        return [
            {**entry, "level": 0, "time": entry["elapsed"] / scale, "iterations": float(entry["iteration"])}
            for entry in timeline
        ]
    return run_history(results.run(row), scale)


def _titled(results: Results, scene: str) -> str:
    sizes = {row["resolution"] for row in results.rows if row["scene"] == scene and row.get("resolution")}
    return f"{scene}, {' and '.join(sorted(map(str, sizes)))}" if sizes - {"full"} else scene


def draw_time_against_gaussians(experiment: Experiment, results: Results, scenes: Sequence[str]) -> str:
    """Return arrows from the baselines to the hierarchies of these scenes, each backbone's variants in one colour.

    Raises:
        NothingToDrawError: there is no pair of a baseline and another variant.
    """
    chosen = Results(results.folder, [row for row in results.rows if row["scene"] in scenes])
    compared = {backbone for _, backbone in chosen.pairs}
    labels = Methods.of(experiment, results).labels
    # Colours are of arrows alone: with those of baselines, too, many backbones would share them.
    methods = Methods(
        {
            (backbone, variant): label
            for (backbone, variant), label in labels.items()
            if backbone in compared and variant != chosen.baseline(backbone)
        }
    )
    chart = time_arrows(chosen, methods.style) if chosen.rows else None
    if chart is None:
        raise NothingToDrawError("no scene has a baseline and another variant of one backbone; run both")
    legend = methods.legend(list(methods.labels))
    return draw_charts([chart], legend, "Seconds over Gaussians", "Arrows from the baseline to", columns=1)


def time_arrows(results: Results, style: Callable[[str, str], str]) -> Chart | None:
    """Draw time against Gaussians: arrows from every baseline to every other variant, means over the seeds.

    Args:
        results: the runs.
        style: returns the style of a backbone's variant.
    """
    column = next(name for name in COUNTS if all(name in row for row in results.rows))
    arrows = []
    for scene, backbone in results.pairs:
        base = results.baseline(backbone)
        start = _point(results.of(scene, backbone, base), column)
        for variant in results.variants:
            end = _point(results.of(scene, backbone, variant), column)
            if variant != base and start is not None and end is not None:
                label = f"{results.title(scene, backbone)}: {base} to {variant}"
                arrows.append(Arrow(style(backbone, variant), label, start, end))
    if not arrows:
        return None
    return draw_arrows("Optimization (s) against Gaussians", COUNTS[column], arrows)


def _point(rows: Sequence[Row], column: str) -> tuple[float, float] | None:
    if not rows:
        return None
    return fmean(row[column] for row in rows), fmean(row["train_seconds"] for row in rows)


def draw_peak_memory(experiment: Experiment, results: Results, scenes: Sequence[str]) -> str:
    """Return bars of peak GPU memory without images, means over scenes and seeds; labels have the paper's figures.

    Raises:
        NothingToDrawError: no run measured it.
    """
    paper = check_table(experiment)
    bars = []
    for (backbone, variant), label in Methods.of(experiment, results).labels.items():
        values = [
            row[MEMORY]
            for scene in scenes
            for row in results.of(scene, backbone, variant)
            if row.get(MEMORY) is not None
        ]
        if not values:
            continue
        row = next(one for one in experiment.variants if one.name == variant).paper_row(backbone)
        datasets = {one["dataset"] for one in results.rows if one["scene"] in scenes and one.get("dataset")}
        printed = paper and row and len(datasets) == 1 and paper.figure(datasets.pop(), scenes, row, "peak_memory_mb")
        note = f" [paper: {printed.value:,.0f} MB]" if printed else ""
        bars.append(Bar(label + note, [("peak GPU memory", 1e-6 * fmean(values))]))
    if not bars:
        raise NothingToDrawError("no run measured GPU memory; run the experiment on a GPU")
    title = "Peak GPU memory without images (MB)"
    return draw_bar_image(draw_bars(title, bars, lambda value: f"{value:,.0f}"), title)
