"""Run an experiment file and make tables of its results. Imports more than `lapgs --help` has time for."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.markdown import Markdown
from rich.markup import escape

from lapgs_bench.experiments import exports
from lapgs_bench.experiments.aggregate import baseline_of, check_table, make_table
from lapgs_bench.experiments.checks import check_runs
from lapgs_bench.experiments.commands import Locations
from lapgs_bench.experiments.execution import LOGS, STORE, follow, make_samples, prepare
from lapgs_bench.experiments.expansion import PlannedRun, plan_runs, scenes_of
from lapgs_bench.experiments.figures.write import FOLDER, write_figures
from lapgs_bench.experiments.launchers import check_launcher
from lapgs_bench.experiments.mistakes import Mistakes
from lapgs_bench.experiments.schema import Experiment, load_experiment
from lapgs_bench.experiments.settings import BenchSettings
from lapgs_bench.experiments.standard import experiment_file
from lapgs_bench.experiments.store import FAILED, ResultStore
from lapgs_bench.experiments.tables import latex, markdown
from lapgs_plugin import __version__
from lapgs_plugin.cli.output import make_console, say
from lapgs_plugin.cli.run import run as run_script
from lapgs_plugin.cli.train import train
from lapgs_plugin.errors import (
    LapgsError,
    MissingExtraError,
    RunFolderError,
    UserInputError,
    printable_lines,
)
from lapgs_plugin.files import is_file, is_folder, write_text
from lapgs_plugin.runs.layout import require_place, require_utf8

SET_BY_EXPERIMENTS = {
    *("scene", "out", "iterations", "resolution", "images", "eval", "seed", "rasterizer", "resume", "overwrite"),
    *("script", "arguments", "off", "record", "view", "view_port", "config"),
}
"""Parameters of `lapgs train` and `lapgs run` that an experiment sets by keys of its own.

A settings file would hide settings that decide a run's result from its name."""


class RunsFailedError(LapgsError):
    """Report that some runs of an experiment failed. The others are finished and shown."""

    exit_code = 1


def run_experiment(file: Path, settings: BenchSettings) -> None:
    """Run an experiment as the help of `lapgs bench EXPERIMENT` says."""
    file = experiment_file(file)
    experiment = load_experiment(file, option_names())
    mistakes = Mistakes(file, experiment, settings.selection)
    with mistakes.at("table"):
        check_table(experiment)
    planned = plan_runs(experiment, settings.selection)
    folder = Path("runs", "bench", experiment.name) if settings.out is None else settings.out
    if settings.tables_only:
        mistakes.refuse()
        _write(experiment, planned, folder)
        return
    if not settings.dry_run:
        require_utf8(folder, "--out")
        check_launcher(settings.engine)
        require_place(folder)
    scenes, places = scenes_of(experiment, settings.selection), Locations(settings.folders, file.parent)
    jobs, scene_folders = prepare(planned, scenes, places, folder, _measuring(settings), mistakes)
    here = settings.engine.launcher == "local" and not settings.dry_run
    check_runs(planned, jobs, scene_folders, mistakes, here=here)
    mistakes.refuse()
    if settings.dry_run:
        for job in jobs:
            commands = [f"cd {shlex.quote(step.cwd)} && {shlex.join(step.command)}" for step in job.steps]
            say("\n".join([f"# {job.run_id}", *commands]))
        return
    make_samples(scenes, folder)
    follow(jobs, folder, settings.engine, "runs", _summary)
    _write(experiment, planned, folder)


def option_names() -> dict[str, set[str]]:
    """Return the options that an experiment may set, by command."""
    return {
        name: {p for p in function.__annotations__ if p not in ("return", "context")} - SET_BY_EXPERIMENTS
        for name, function in (("train", train), ("run", run_script))
    }


def _measuring(settings: BenchSettings) -> list[str] | None:
    """Return the options of `lapgs eval`, None without it."""
    if not settings.evaluate:
        return None
    weights = settings.lpips_weights or []
    for file in weights:
        if not is_file(file):
            raise UserInputError(f"--lpips-weights {file}: no such file; expected the weights of an LPIPS network")
    return [word for file in weights for word in ("--lpips-weights", str(file.absolute()))]


def _summary(record: dict[str, Any]) -> str:
    patterns = {"psnr": "{:.2f} dB", "train_seconds": "{:.1f} s", "peak_gaussians": "at most {:,} Gaussians"}
    return ", ".join(pattern.format(record[name]) for name, pattern in patterns.items() if name in record)


def _write(experiment: Experiment, planned: Sequence[PlannedRun], folder: Path) -> None:
    """Write the results, print their table, and report the runs that failed."""
    path = folder / STORE
    outcomes = {o.run_id: o for o in ResultStore(path).outcomes({run.spec.run_id for run in planned})}
    records = {run_id: o.record for run_id, o in outcomes.items() if o.record is not None}
    try:
        table = make_table(experiment, planned, records)
    except RunFolderError as error:
        raise RunFolderError(f"{path}: {error}") from None
    text = markdown(table)
    write_text(folder / exports.MARKDOWN, text)
    write_text(folder / exports.LATEX, latex(table))
    rows = _rows(experiment, planned, records)
    _write_rows(rows, folder)
    for problem in write_figures(experiment, rows, folder):
        make_console(stderr=True).print(f"[yellow]{escape(problem)}[/yellow]")
    console = make_console()
    console.print(Markdown(printable_lines(text))) if console.is_terminal else print(printable_lines(text))
    _name_versions(records)
    drawn = f", {FOLDER}/" if is_folder(folder / FOLDER) else ""
    say(f"{folder} holds {exports.CSV}, {exports.MARKDOWN}, {exports.LATEX}{drawn} and the runs")
    say(f"next: lapgs report {shlex.quote(str(folder))} writes a page with curves and images")
    if failed := [o for o in outcomes.values() if o.state == FAILED]:
        raise RunsFailedError(
            f"{len(failed)} of {len(outcomes)} runs failed, the first is {failed[0].run_id}; its log is in "
            f"{folder / LOGS}"
        )


def _rows(
    experiment: Experiment, planned: Sequence[PlannedRun], records: Mapping[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return the row of each run that is done."""
    names: dict[str, list[str]] = {}
    for run in planned:
        names.setdefault(run.spec.backbone, []).append(run.variant)
    baselines = {backbone: baseline_of(experiment, own) for backbone, own in names.items()}
    return [
        {
            "experiment": experiment.name,
            "variant": run.variant,
            "baseline": baselines[run.spec.backbone],
            **records[run.spec.run_id],
        }
        for run in planned
        if run.spec.run_id in records
    ]


def _write_rows(rows: Sequence[exports.Row], folder: Path) -> None:
    """Write the figures of each run, as CSV and, where pyarrow is installed, as Parquet."""
    exports.write_csv(folder / exports.CSV, rows)
    try:
        exports.write_parquet(folder / exports.PARQUET, rows)
    except MissingExtraError as error:
        make_console(stderr=True).print(f"[yellow]{escape(str(error))}[/yellow]")


def _name_versions(records: Mapping[str, dict[str, Any]]) -> None:
    """Say on stderr if results were made by other versions of this package."""
    others = sorted({str(r["lapgs_version"]) for r in records.values()} - {__version__})
    if others:
        make_console(stderr=True).print(
            f"[yellow]some results were made by lapgs_plugin {', '.join(others)}; this is {__version__}[/yellow]"
        )
