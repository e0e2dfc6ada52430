"""`lapgs bench EXPERIMENT.toml`: run what a file describes, keep what comes out, show it as tables."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lapgs_plugin.errors import LapgsError, MissingExtraError, TrainingStoppedError, UserInputError

if TYPE_CHECKING:
    from rich.console import Console

    from lapgs_plugin.experiments.expansion import PlannedRun
    from lapgs_plugin.experiments.launchers import Launcher, WorkOrder
    from lapgs_plugin.experiments.runner import Folder
    from lapgs_plugin.experiments.schema import Experiment
    from lapgs_plugin.experiments.store import Job, Outcome, ResultStore

SELECTION = "What to run"
PLACES = "Where"
ENGINE = "On what"

SET_BY_EXPERIMENTS = {
    *("scene", "out", "iterations", "resolution", "images", "hold_out", "seed", "rasterizer", "resume", "overwrite"),
    *("script", "arguments", "off", "record", "view", "view_port"),
}
"""Parameters of `lapgs train` and `lapgs run` that an experiment says in its own way."""


LONGEST_NAME = 255
"""Bytes of a file's name that file systems take."""


class RunsFailedError(LapgsError):
    """Some runs of an experiment failed; the others are done and shown."""

    exit_code = 1


def bench_experiment(
    experiment: Annotated[Path, typer.Argument(help="Experiment file, such as benchmarks/smoke.toml.")],
    scene: Annotated[
        list[str] | None, typer.Option(rich_help_panel=SELECTION, help="Only this scene; may be given several times.")
    ] = None,
    backbone: Annotated[
        list[str] | None, typer.Option(rich_help_panel=SELECTION, help="Only this backbone; several times as well.")
    ] = None,
    variant: Annotated[
        list[str] | None, typer.Option(rich_help_panel=SELECTION, help="Only this variant; several times as well.")
    ] = None,
    seeds: Annotated[
        str | None, typer.Option(rich_help_panel=SELECTION, help="Instead of the file's, such as 0,1,2.")
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(min=1, rich_help_panel=SELECTION, help="Instead of the file's; a variant's own in proportion."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", rich_help_panel=PLACES, help="Folder for everything. Default: runs/bench/ and its name."
        ),
    ] = None,
    path: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FOLDER",
            rich_help_panel=PLACES,
            help="Where a data set, a scene or a checkout is; several times. Instead, set LAPGS_<NAME>.",
        ),
    ] = None,
    launcher: Annotated[
        str, typer.Option(rich_help_panel=ENGINE, help="local, slurm (through submitit) or ray.")
    ] = "local",
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, max=1024, rich_help_panel=ENGINE, help="Runs at once. Default: one a GPU, or one without GPUs."
        ),
    ] = None,
    gpus: Annotated[
        str | None,
        typer.Option(rich_help_panel=ENGINE, help="Which to use, as for CUDA_VISIBLE_DEVICES: 0,1. Default: all."),
    ] = None,
    launcher_option: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            rich_help_panel=ENGINE,
            help="For Slurm what submitit takes (slurm_partition=gpu, timeout_min=600), for Ray address, num_gpus, "
            "num_cpus; several times.",
        ),
    ] = None,
    evaluate: Annotated[
        bool,
        typer.Option(
            "--eval/--no-eval",
            help="Measure every run with `lapgs eval`; without, what training noted of its images at its end is taken.",
        ),
    ] = True,
    lpips_weights: Annotated[
        list[Path] | None, typer.Option(help="For `lapgs eval`: weights of an LPIPS network; once for each network.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the commands of every run, and run none.")] = False,
    tables_only: Annotated[
        bool, typer.Option("--tables-only", help="Write the tables again from results that are there.")
    ] = False,
) -> None:
    """Run every scene, backbone, variant and seed of EXPERIMENT, and write tables with the paper's figures beside.

    Each run is a process of its own. Stop with Ctrl-C or lose the machine: the same command goes on, and repeats no
    finished run. Several of these commands may work on one folder at a time. Failed runs are reported, and tried again
    by the next command.

    Examples:

        lapgs bench benchmarks/smoke.toml

        lapgs bench benchmarks/split.toml --path mipnerf360=/data/360 --path fastgs=~/FastGS --scene bonsai
    """
    from rich.console import Console

    from lapgs_plugin.cli.bench_check import check_runs
    from lapgs_plugin.experiments.aggregate import check_table
    from lapgs_plugin.experiments.commands import Locations
    from lapgs_plugin.experiments.expansion import Selection, plan_runs, scenes_of
    from lapgs_plugin.experiments.launchers import check_order, launch
    from lapgs_plugin.experiments.mistakes import Mistakes
    from lapgs_plugin.experiments.runner import Folder, execute, make_samples, prepare
    from lapgs_plugin.experiments.schema import load_experiment
    from lapgs_plugin.experiments.store import ResultStore

    console = Console(stderr=True)
    mistakes = Mistakes(experiment)
    loaded = load_experiment(experiment, _option_names())
    with mistakes.at("table"):
        check_table(loaded)
    selection = Selection(scene, backbone, variant, _seeds(seeds), iterations)
    planned, scenes = plan_runs(loaded, selection), scenes_of(loaded, selection)
    folder = Folder(Path("runs", "bench", loaded.name) if out is None else out)
    if tables_only:
        mistakes.refuse()
    else:
        order = _order(workers, gpus, _pairs(launcher_option, "--launcher-option"), folder)
        if not dry_run:
            check_order(launcher, order)
            _require_place(folder.path)
        if evaluate:
            _require_measuring(lpips_weights or ())
        places = Locations(
            {name: _folder(name, value) for name, value in _pairs(path, "--path").items()}, experiment.parent
        )
        weights = [word for file in lpips_weights or () for word in ("--lpips-weights", str(file.absolute()))]
        measuring = weights if evaluate else None
        jobs, found = prepare(planned, scenes, places, folder, measuring, loaded, selection, mistakes)
        here = launcher == "local" and not dry_run
        check_runs(loaded, selection, planned, jobs, found, mistakes, here=here)
        mistakes.refuse()
        if dry_run:
            _print_commands(jobs)
            return
        make_samples(scenes, folder)
        store = ResultStore.create(folder.store)
        store.plan(jobs)
        order = replace(order, run_ids=[job.run_id for job in jobs])
        _follow(execute, store, jobs, lambda: launch(launcher, order), console)
    _write(loaded, planned, ResultStore(folder.store), folder, console)


def _option_names() -> dict[str, set[str]]:
    """By command, what an experiment may set."""
    from lapgs_plugin.cli.run import run
    from lapgs_plugin.cli.train import train

    functions = {"train": train, "run": run}
    return {
        name: {p for p in function.__annotations__ if p not in ("return", "context")} - SET_BY_EXPERIMENTS
        for name, function in functions.items()
    }


def _seeds(text: str | None) -> list[int] | None:
    if text is None:
        return None
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise UserInputError(f"--seeds {text}: expected whole numbers separated by commas, such as 0,1,2") from error
    if len(set(numbers)) < len(numbers):
        raise UserInputError(f"--seeds {text}: expected different numbers, as each run counts once")
    return numbers


def _pairs(texts: Sequence[str] | None, option: str) -> dict[str, str]:
    found = {}
    for text in texts or ():
        name, separator, value = text.partition("=")
        if not (separator and name and value):
            raise UserInputError(f"{option} {text}: expected NAME=VALUE")
        found[name] = value
    return found


def _folder(name: str, text: str) -> Path:
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise UserInputError(f"--path {name}={text}: no such user; expected a folder") from error


def _require_place(folder: Path) -> None:
    """Refuse a folder that cannot be made or written, before anything is.

    Raises:
        UserInputError: it is a file or below one, or it may not be written.
    """
    existing = str(folder.absolute())
    # Not Path.exists, which raises where a name is too long for the file system.
    while not os.path.lexists(existing):
        if len(os.fsencode(os.path.basename(existing))) > LONGEST_NAME:  # noqa: PTH119
            raise UserInputError(f"--out {folder}: a name of more than {LONGEST_NAME} bytes; choose a shorter one")
        existing = os.path.dirname(existing)  # noqa: PTH120
    if not os.path.isdir(existing):  # noqa: PTH112
        raise UserInputError(f"--out {folder}: {existing} is a file; expected a folder, or a name for a new one")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise UserInputError(f"--out {folder}: {existing} may not be written; choose another folder")


def _require_measuring(weights: Sequence[Path]) -> None:
    """Refuse what `lapgs eval` would: not every machine has the packages to read scenes, and weights are files.

    Raises:
        UserInputError: a package is missing, or a file of weights.
    """
    from importlib.util import find_spec

    for file in weights:
        if not os.path.isfile(file):  # noqa: PTH113  # Path.is_file raises where a name is too long
            raise UserInputError(f"--lpips-weights {file}: no such file; expected the weights of an LPIPS network")
    missing = [name for name in ("OpenImageIO", "pycolmap") if find_spec(name) is None]
    if missing:
        raise UserInputError(
            f"{' and '.join(missing)} cannot be imported here, which `lapgs eval` reads scenes with; give --no-eval to "
            "take what training notes of its images"
        )


def _print_commands(jobs: Sequence[Job]) -> None:
    import shlex

    for job in jobs:
        print(f"# {job.run_id}")
        for step in job.steps:
            print(f"cd {shlex.quote(step.cwd)} && {shlex.join(step.command)}")


def _order(workers: int | None, gpus: str | None, options: dict[str, str], folder: Folder) -> WorkOrder:
    """What workers are started for; the runs come later."""
    from lapgs_plugin.experiments.launchers import WorkOrder

    return WorkOrder(
        store=folder.store.absolute(),
        run_ids=(),
        workers=workers,
        gpus=None if gpus is None else gpus.split(","),
        logs=folder.logs("workers").absolute(),
        options={name: int(value) if value.isdecimal() else value for name, value in options.items()},
    )


def _follow(
    execute: Callable[..., list[Outcome]],
    store: ResultStore,
    jobs: Sequence[Job],
    start: Callable[[], Launcher],
    console: Console,
) -> None:
    """Run the jobs with a progress bar and a line for each that ends."""
    from rich.markup import escape

    from lapgs_plugin.experiments.store import DONE, FAILED
    from lapgs_plugin.progress import item_progress

    run_ids = [job.run_id for job in jobs]
    finished = sum(outcome.state == DONE for outcome in store.outcomes(run_ids))
    if finished:
        console.print(f"{finished} of {len(run_ids)} runs are done already")
    with item_progress("runs") as progress:
        task = progress.add_task("Running", total=len(run_ids), completed=finished)

        def say(outcome: Outcome) -> None:
            progress.advance(task)
            if outcome.state == FAILED:
                text = f"[red]failed[/red] {outcome.run_id}\n{escape(outcome.error)}"
            else:
                text = f"[green]done[/green]   {outcome.run_id}: {_summary(outcome.record or {})}"
            progress.console.print(text, soft_wrap=True, highlight=False)

        try:
            execute(store, run_ids, start, say)
        except KeyboardInterrupt:
            raise TrainingStoppedError("stopped; the same command goes on with the runs that are left") from None


def _summary(record: dict[str, Any]) -> str:
    patterns = {"psnr": "{:.2f} dB", "train_seconds": "{:.1f} s", "peak_gaussians": "at most {:,} Gaussians"}
    return ", ".join(pattern.format(record[name]) for name, pattern in patterns.items() if name in record)


def _write(
    experiment: Experiment, planned: Sequence[PlannedRun], store: ResultStore, folder: Folder, messages: Console
) -> None:
    """Write the results of finished runs, print their tables, and report failed runs."""
    import shlex

    from rich.console import Console
    from rich.markdown import Markdown
    from rich.markup import escape

    from lapgs_plugin import __version__
    from lapgs_plugin.experiments import exports
    from lapgs_plugin.experiments.aggregate import baseline_of, make_table
    from lapgs_plugin.experiments.store import FAILED
    from lapgs_plugin.experiments.tables import latex, markdown

    outcomes = {o.run_id: o for o in store.outcomes({run.spec.run_id for run in planned})}
    records = {run_id: o.record for run_id, o in outcomes.items() if o.record is not None}
    names: dict[str, list[str]] = {}
    for run in planned:
        names.setdefault(run.spec.backbone, []).append(run.variant)
    baselines = {backbone: baseline_of(experiment, own) for backbone, own in names.items()}
    rows = [
        {
            "experiment": experiment.name,
            "variant": run.variant,
            "baseline": baselines[run.spec.backbone],
            **records[run.spec.run_id],
        }
        for run in planned
        if run.spec.run_id in records
    ]
    table = make_table(experiment, planned, records)
    text = markdown(table)
    exports.write_csv(folder.path / exports.CSV, rows)
    exports.write_text(folder.path / exports.MARKDOWN, text)
    exports.write_text(folder.path / exports.LATEX, latex(table))
    try:
        exports.write_parquet(folder.path / exports.PARQUET, rows)
    except MissingExtraError as error:
        messages.print(f"[yellow]{escape(str(error))}[/yellow]", highlight=False)
    console = Console()
    console.print(Markdown(text)) if console.is_terminal else print(text)
    others = sorted({str(r["lapgs_version"]) for r in records.values()} - {__version__})
    if others:
        messages.print(
            f"[yellow]some results were made by lapgs_plugin {', '.join(others)}; this is {__version__}[/yellow]"
        )
    print(f"{folder.path} holds {exports.CSV}, {exports.MARKDOWN}, {exports.LATEX} and the runs")
    print(f"next: lapgs report {shlex.quote(str(folder.path))} writes a page with curves and images")
    if failed := [o for o in outcomes.values() if o.state == FAILED]:
        raise RunsFailedError(
            f"{len(failed)} of {len(outcomes)} runs failed, the first is {failed[0].run_id}; its log is in "
            f"{folder.path / 'logs'}"
        )
