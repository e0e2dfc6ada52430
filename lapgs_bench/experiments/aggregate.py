"""Aggregate rows of results to a table: means over scenes, deviations over seeds, ratios, the paper's figures.

Cells use the scenes that every row of the table has, so that rows stay comparable while runs are missing: first the
mean over these scenes for each seed, then mean and sample deviation over the seeds.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

from lapgs_bench.experiments.expansion import PlannedRun
from lapgs_bench.experiments.exports import Row
from lapgs_bench.experiments.schema import Experiment
from lapgs_bench.experiments.standard import DATASETS, PaperFigure, PaperTable
from lapgs_plugin.errors import RunFolderError, UserInputError, nearest
from lapgs_plugin.untrusted import shortened

PRINTED = "As printed"
"""Section of rows that are only printed, in tables with sections."""
LEVELS = "_level_"
"""End of a source that stands for one column for each level."""
TIMES = ("minutes", "train_seconds", "iteration_ms")
"""Columns for the speed-up; the first one in the table is used."""


@dataclass(frozen=True)
class Column:
    """Describe a column of a table.

    Attributes:
        heading: as in the paper, without arrow.
        better: "lower", "higher" or "".
        sources: columns of the rows; the first that a row has is used. A source that ends with "_level_" stands for one
            column for each level.
        scale: factor on the value.
    """

    heading: str
    better: str
    sources: tuple[str, ...]
    scale: float = 1.0
    decimals: int = 2


def _milliseconds(heading: str, name: str) -> Column:
    return Column(f"{heading} (ms)", "lower", (f"{name}_ms",), decimals=3)


def _seconds(heading: str, name: str) -> Column:
    return Column(f"{heading} (s)", "lower", (f"overhead_{name}_seconds",))


COLUMNS: Mapping[str, Column] = {
    "minutes": Column("Time (min)", "lower", ("train_seconds",), 1 / 60),
    "train_seconds": Column("Time (s)", "lower", ("train_seconds",), decimals=1),
    "gpu_busy_seconds": Column("GPU busy (s)", "lower", ("gpu_busy_seconds",), decimals=1),
    "overhead_seconds": Column("Overhead (s)", "lower", ("overhead_seconds",), decimals=1),
    "psnr": Column("PSNR", "higher", ("psnr",)),
    "ssim": Column("SSIM", "higher", ("ssim",), decimals=3),
    "lpips": Column("LPIPS", "lower", ("lpips_vgg_3dgs", "lpips_vgg"), decimals=3),
    "gaussians_millions": Column("N_GS (M)", "lower", ("gaussians_level_", "gaussians"), 1e-6),
    "gaussians_thousands": Column("N_GS (k)", "lower", ("gaussians_level_", "gaussians"), 1e-3, 1),
    "mean_gaussians": Column("Mean N_GS", "lower", ("mean_gaussians",), decimals=0),
    "peak_gaussians": Column("Peak N_GS", "lower", ("peak_gaussians",), decimals=0),
    "peak_memory_mb": Column("Peak GPU (MB)", "lower", ("peak_memory_without_images_bytes",), 1e-6, 0),
    "peak_memory_with_images_mb": Column("with images (MB)", "lower", ("peak_memory_bytes",), 1e-6, 0),
    "fps": Column("FPS", "higher", ("fps",), decimals=0),
    "forward_ms": _milliseconds("Forward rendering", "forward"),
    "loss_ms": _milliseconds("Composition + loss", "loss"),
    "backward_ms": _milliseconds("Backward propagation", "backward"),
    "densification_ms": _milliseconds("Densification + pruning", "densification"),
    "optimizer_ms": _milliseconds("Optimizer step", "optimizer"),
    "other_ms": _milliseconds("Other", "other"),
    "iteration_ms": _milliseconds("Total", "iteration"),
    "pyramid_seconds": _seconds("Pyramid", "pyramid"),
    "cache_seconds": _seconds("Stage cache", "cache"),
    "inheritance_seconds": _seconds("Inheritance", "inheritance"),
    "archive_seconds": _seconds("Archive I/O", "archive"),
}
"""All columns of tables, by their names in experiment files."""


@dataclass(frozen=True)
class Cell:
    """Hold a figure of a row, and that of the paper.

    Attributes:
        values: the mean, or one for each level, coarsest first; empty without measurements.
        deviation: over seeds, of the sum over levels; None with one seed.
    """

    values: tuple[float, ...] = ()
    deviation: float | None = None
    seeds: int = 0
    paper: PaperFigure | None = None

    @property
    def value(self) -> float | None:
        """Sum over the levels."""
        return math.fsum(self.values) if self.values else None


@dataclass(frozen=True)
class Ratio:
    """Compare a row with its baseline, as measured and in the paper; None without a comparison."""

    measured: float | None
    paper: float | None


@dataclass(frozen=True)
class TableRow:
    """Hold the figures of a variant on a backbone.

    Attributes:
        section: heading above it, "" without one.
        cells: by column.
        speedup: time of the baseline divided by its own.
        psnr_gain: its PSNR minus the baseline's, in dB.
    """

    label: str
    section: str
    cells: Mapping[str, Cell]
    speedup: Ratio
    psnr_gain: Ratio
    is_baseline: bool


@dataclass(frozen=True)
class Group:
    """Hold the part of a table for one data set or one scene: rows in the experiment's order, remarks as sentences."""

    title: str
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class ResultTable:
    """Hold a table of results, to be written as Markdown and LaTeX.

    Attributes:
        measured: machines, versions and numbers of iterations.
        groups: data sets in the experiment's order.
        scenes: single scenes, if the experiment asks for them.
    """

    experiment: Experiment
    measured: str
    groups: tuple[Group, ...]
    scenes: tuple[Group, ...]


RowKey = tuple[str, str]
"""Backbone and variant."""


def check_table(experiment: Experiment) -> PaperTable | None:
    """Check the experiment's `[table]`, and return the paper's table.

    Raises:
        UserInputError: a column, or a row of the paper's table, is not known.
    """
    for column in experiment.table.columns:
        if column not in COLUMNS:
            raise UserInputError(f"table.columns: {column!r} is not known; {nearest(column, COLUMNS.keys())}")
    if experiment.table.paper is None:
        if experiment.table.printed:
            raise UserInputError("table.printed: there is no table.paper whose rows these are; give it")
        return None
    paper = PaperTable(experiment.table.paper)
    for variant in experiment.variants:
        for backbone in experiment.backbones:
            name = variant.paper_row(backbone)
            if name and name not in paper.rows:
                raise UserInputError(
                    f"variant {variant.name!r}: the paper's table {paper.name} has no row {name!r}; "
                    f"{nearest(name, paper.rows)}"
                )
    for name in experiment.table.printed:
        if name not in paper.rows:
            raise UserInputError(
                f"table.printed: the paper's table {paper.name} has no row {name!r}; {nearest(name, paper.rows)}"
            )
    return paper


def baseline_of(experiment: Experiment, names: Sequence[str]) -> str:
    """Return the variant that others on the same backbone are compared with: the marked one, or the first."""
    marked = {variant.name for variant in experiment.variants if variant.baseline}
    return next((name for name in names if name in marked), names[0])


def make_table(experiment: Experiment, planned: Sequence[PlannedRun], records: Mapping[str, Row]) -> ResultTable:
    """Make the table of an experiment from its runs and, by the names of runs, the rows of those that are finished."""
    paper = check_table(experiment)
    by_dataset: dict[str, list[PlannedRun]] = defaultdict(list)
    by_scene: dict[tuple[str, str], list[PlannedRun]] = defaultdict(list)
    for run in planned:
        by_dataset[run.spec.dataset].append(run)
        by_scene[run.spec.dataset, run.spec.scene].append(run)
    groups = tuple(_GroupBuilder(experiment, paper, runs, records).group() for runs in by_dataset.values())
    scenes: tuple[Group, ...] = ()
    if experiment.table.by_scene and len(by_scene) > len(groups):
        scenes = tuple(
            _GroupBuilder(experiment, paper, runs, records).group(scene) for (_, scene), runs in by_scene.items()
        )
    return ResultTable(experiment, _measured(planned, records), groups, scenes)


def _measured(planned: Sequence[PlannedRun], records: Mapping[str, Row]) -> str:
    """Describe where the runs were measured."""
    finished = [(run.spec, records[run.spec.run_id]) for run in planned if run.spec.run_id in records]
    if not finished:
        return "nothing yet"
    iterations = sorted({spec.iterations for spec, _ in finished})
    parts = [f"{' and '.join(f'{count:,}' for count in iterations)} iterations"]
    machines = sorted({str(row.get("gpu") or row.get("processor") or "an unknown machine") for _, row in finished})
    parts.append(" and ".join(machines))
    for words, name in (("torch", "torch"), ("lapgs_plugin", "lapgs_version"), ("images measured by", "measured_by")):
        if values := sorted({str(row[name]) for _, row in finished if row.get(name)}):
            parts.append(f"{words} {' and '.join(values)}")
    return ", ".join(parts)


class _GroupBuilder:
    """Build one group of a table, of runs that share their data set, from the rows of all finished runs."""

    def __init__(
        self, experiment: Experiment, paper: PaperTable | None, runs: Sequence[PlannedRun], records: Mapping[str, Row]
    ) -> None:
        self._experiment, self._paper, self._dataset = experiment, paper, runs[0].spec.dataset
        self._variants = {variant.name: variant for variant in experiment.variants}
        asked = {(run.spec.backbone, run.variant) for run in runs}
        pairs = [(backbone, variant) for variant in self._variants for backbone in experiment.backbones]
        self._keys: list[RowKey] = [pair for pair in pairs if pair in asked]
        self._scenes = list(dict.fromkeys(run.spec.scene for run in runs))
        self._rows: dict[RowKey, dict[int, dict[str, Row]]] = {key: defaultdict(dict) for key in self._keys}
        for run in runs:
            if (record := records.get(run.spec.run_id)) is not None:
                self._rows[run.spec.backbone, run.variant][run.spec.seed][run.spec.scene] = record
        self._missing = sum(run.spec.run_id not in records for run in runs)
        self._total = len(runs)
        measured = [by_seed for by_seed in self._rows.values() if by_seed]
        self._common = [
            scene
            for scene in self._scenes
            if all(any(scene in rows for rows in by_seed.values()) for by_seed in measured)
        ]

    def group(self, title: str | None = None) -> Group:
        cells = {key: self._cells(key) for key in self._keys}
        rows = *(self._row(key, cells) for key in self._keys), *map(self._printed_row, self._experiment.table.printed)
        return Group(title or self._title(), rows, tuple(self._notes(rows)))

    def _title(self) -> str:
        if not self._dataset:
            return ", ".join(self._scenes)
        known = DATASETS[self._dataset]
        some = f" ({', '.join(self._scenes)})" if len(self._scenes) < len(known.scenes) else ""
        return known.title + some

    def _cells(self, key: RowKey) -> dict[str, Cell]:
        # Only seeds that have all compared scenes.
        complete = [[one[s] for s in self._common] for one in self._rows[key].values() if {*self._common} <= one.keys()]
        rows = complete if self._common else []
        printed = self._variants[key[1]].paper_row(key[0])
        return {
            name: _cell(rows, COLUMNS[name], self._paper_figure(printed, name))
            for name in self._experiment.table.columns
        }

    def _paper_figure(self, row: str, column: str) -> PaperFigure | None:
        if self._paper is None or not row:
            return None
        return self._paper.figure(self._dataset, self._common or self._scenes, row, column)

    def _row(self, key: RowKey, cells: Mapping[RowKey, Mapping[str, Cell]]) -> TableRow:
        backbone, variant = key
        base = backbone, baseline_of(self._experiment, [name for own, name in self._keys if own == backbone])
        time = next((name for name in TIMES if name in cells[key]), None)
        title = self._experiment.backbones[backbone].title or backbone
        return TableRow(
            label=variant if len({b for b, _ in self._keys}) == 1 else f"{variant} ({title})",
            section=self._variants[variant].section,
            cells=cells[key],
            speedup=_compare(cells[base].get(time or ""), cells[key].get(time or ""), lambda base, own: base / own),
            psnr_gain=_compare(cells[base].get("psnr"), cells[key].get("psnr"), lambda base, own: own - base),
            is_baseline=key == base,
        )

    def _printed_row(self, name: str) -> TableRow:
        """Return a row of the paper's figures alone."""
        cells = {column: Cell(paper=self._paper_figure(name, column)) for column in self._experiment.table.columns}
        return TableRow(
            label=f"{name} (printed only)",
            section=PRINTED if any(variant.section for variant in self._experiment.variants) else "",
            cells=cells,
            speedup=Ratio(None, None),
            psnr_gain=Ratio(None, None),
            is_baseline=False,
        )

    def _notes(self, rows: Sequence[TableRow]) -> list[str]:
        notes = []
        if self._missing:
            notes.append(f"{self._missing} of {self._total} runs are missing.")
        if self._common and len(self._common) < len(self._scenes):
            notes.append(f"Means over {', '.join(self._common)}: the scenes that every row has.")
        printed = [cell.paper for row in rows for cell in row.cells.values() if cell.paper is not None]
        if any(not figure.exact for figure in printed):
            whole = len(DATASETS[self._dataset].scenes)
            notes.append(f"The paper's figures are means over all {whole} scenes of {DATASETS[self._dataset].title}.")
        return notes


def _cell(seeds: Sequence[Sequence[Row]], column: Column, paper: PaperFigure | None) -> Cell:
    """Compute a figure from the rows of all scenes, for each seed."""
    figures = [[_value(row, column) for row in scenes] for scenes in seeds]
    if not figures or any(not value for scenes in figures for value in scenes):
        return Cell(paper=paper)
    if len({len(value) for scenes in figures for value in scenes}) > 1:
        figures = [[(math.fsum(value),) for value in scenes] for scenes in figures]
    means = [tuple(fmean(level) for level in zip(*scenes, strict=True)) for scenes in figures]  # by seed, by level
    sums = [math.fsum(levels) for levels in means]
    deviation = stdev(sums) if len(sums) > 1 else None
    return Cell(tuple(fmean(level) for level in zip(*means, strict=True)), deviation, len(sums), paper)


def _value(row: Row, column: Column) -> tuple[float, ...]:
    """Return a row's figure, or one for each level, coarsest first; empty without one."""
    for source in column.sources:
        if not source.endswith(LEVELS):
            if row.get(source) is not None:
                return (column.scale * _number(row, source),)
            continue
        levels = sorted((int(name.removeprefix(source)) for name in row if name.startswith(source)), reverse=True)
        if levels:
            return tuple(column.scale * _number(row, f"{source}{level}") for level in levels)
    return ()


def _number(row: Row, name: str) -> float:
    value = row[name]
    if not isinstance(value, int | float):
        raise RunFolderError(
            f"the results of {row.get('run', 'a run')} have {name} {shortened(value)}, expected a number; run the "
            "experiment again in another folder"
        )
    return value


def _compare(base: Cell | None, own: Cell | None, how: Callable[[float, float], float]) -> Ratio:
    if base is None or own is None:
        return Ratio(None, None)
    measured = how(base.value, own.value) if base.value and own.value else None
    printed = how(base.paper.value, own.paper.value) if base.paper and own.paper else None
    return Ratio(measured, printed)
