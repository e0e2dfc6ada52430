"""Run an experiment file and make tables of its results: `lapgs bench EXPERIMENT.toml`."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lapgs_plugin.cli.output import make_console
from lapgs_plugin.errors import LapgsError, MissingExtraError, RunFolderError, TrainingStoppedError, UserInputError
from lapgs_plugin.limits import LONGEST_NAME

if TYPE_CHECKING:
    from rich.console import Console

    from lapgs_plugin.experiments.expansion import PlannedRun
    from lapgs_plugin.experiments.launchers import Launcher, WorkOrder
    from lapgs_plugin.experiments.runner import Folder
    from lapgs_plugin.experiments.schema import Experiment
    from lapgs_plugin.experiments.store import Job, Outcome, ResultStore

SELECTION = "Selection"
PLACES = "Folders"
ENGINE = "Execution"

SET_BY_EXPERIMENTS = {
    *("scene", "out", "iterations", "resolution", "images", "hold_out", "seed", "rasterizer", "resume", "overwrite"),
    *("script", "arguments", "off", "record", "view", "view_port"),
}
"""Parameters of `lapgs train` and `lapgs run` that an experiment sets by keys of its own."""


class RunsFailedError(LapgsError):
    """Report that some runs of an experiment failed. The others are finished and shown."""

    exit_code = 1


def bench_experiment(
    experiment: Annotated[
        Path, typer.Argument(metavar="EXPERIMENT", help="Experiment file, such as benchmarks/smoke.toml.")
    ],
    scene: Annotated[
        list[str] | None, typer.Option(rich_help_panel=SELECTION, help="Run only this scene. Repeatable.")
    ] = None,
    backbone: Annotated[
        list[str] | None, typer.Option(rich_help_panel=SELECTION, help="Run only this backbone. Repeatable.")
    ] = None,
    variant: Annotated[
        list[str] | None, typer.Option(rich_help_panel=SELECTION, help="Run only this variant. Repeatable.")
    ] = None,
    seeds: Annotated[
        str | None, typer.Option(rich_help_panel=SELECTION, help="Seeds instead of those in the file, such as 0,1,2.")
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(
            min=1,
            rich_help_panel=SELECTION,
            help="Iterations instead of the file's; variants are scaled alike.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", rich_help_panel=PLACES, help="Folder for runs and results. Default: runs/bench/NAME."
        ),
    ] = None,
    path: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FOLDER",
            rich_help_panel=PLACES,
            help="Folder of a data set, scene or checkout that the file names. Repeatable. LAPGS_<NAME> in the "
            "environment does the same.",
        ),
    ] = None,
    launcher: Annotated[
        str, typer.Option(rich_help_panel=ENGINE, help="Where runs are executed: local, slurm (with submitit) or ray.")
    ] = "local",
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, max=1024, rich_help_panel=ENGINE, help="Runs at a time. Default: one per GPU, or one without GPUs."
        ),
    ] = None,
    gpus: Annotated[
        str | None,
        typer.Option(rich_help_panel=ENGINE, help="GPUs to use, as in CUDA_VISIBLE_DEVICES: 0,1. Default: all."),
    ] = None,
    launcher_option: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            rich_help_panel=ENGINE,
            help="Option of the launcher. Slurm: those of submitit (slurm_partition=gpu, timeout_min=600). Ray: "
            "address, num_gpus, num_cpus. Repeatable.",
        ),
    ] = None,
    evaluate: Annotated[
        bool,
        typer.Option(
            "--eval/--no-eval",
            help="Measure every run with `lapgs eval`, or use the metrics that training recorded at its end.",
        ),
    ] = True,
    lpips_weights: Annotated[
        list[Path] | None, typer.Option(help="Weights of an LPIPS network for `lapgs eval`. Repeatable.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the commands of all runs.")] = False,
    tables_only: Annotated[
        bool, typer.Option("--tables-only", help="Only write the tables from existing results.")
    ] = False,
) -> None:
    """Run all scenes, backbones, variants and seeds of EXPERIMENT, and write tables of the results.

    Each run is a process of its own. Repeat the command to continue after Ctrl-C or a crash; finished runs are kept and
    failed ones are tried again. Several commands can work on one folder at the same time.

    Examples:

        lapgs bench benchmarks/smoke.toml

        lapgs bench benchmarks/split.toml --path mipnerf360=/data/360
    """

    from lapgs_plugin.cli.bench_check import check_runs
    from lapgs_plugin.experiments.aggregate import check_table
    from lapgs_plugin.experiments.commands import Locations
    from lapgs_plugin.experiments.expansion import Selection, plan_runs, scenes_of
    from lapgs_plugin.experiments.launchers import check_order, launch
    from lapgs_plugin.experiments.mistakes import Mistakes
    from lapgs_plugin.experiments.runner import Folder, execute, make_samples, prepare
    from lapgs_plugin.experiments.schema import load_experiment
    from lapgs_plugin.experiments.store import ResultStore

    console = make_console(stderr=True)
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
    """Return the options that an experiment may set, by command."""
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
        raise UserInputError(f"--seeds {text}: expected different numbers")
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
    """Refuse a folder that cannot be made or written.

    Raises:
        UserInputError: it is a file or below one, or it is not writable.
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
        raise UserInputError(f"--out {folder}: {existing} is not writable; choose another folder")


def _require_measuring(weights: Sequence[Path]) -> None:
    """Check that `lapgs eval` can run: the packages that read scenes are installed and the weights exist.

    Raises:
        UserInputError: a package or a file of weights is missing.
    """
    from importlib.util import find_spec

    for file in weights:
        if not os.path.isfile(file):  # noqa: PTH113  # Path.is_file raises where a name is too long
            raise UserInputError(f"--lpips-weights {file}: no such file; expected the weights of an LPIPS network")
    missing = [name for name in ("OpenImageIO", "pycolmap") if find_spec(name) is None]
    if missing:
        raise UserInputError(
            f"{' and '.join(missing)} cannot be imported, and `lapgs eval` needs them to read scenes; install them, or "
            "use the metrics that training records with --no-eval"
        )


def _print_commands(jobs: Sequence[Job]) -> None:
    import shlex

    for job in jobs:
        print(f"# {job.run_id}")
        for step in job.steps:
            print(f"cd {shlex.quote(step.cwd)} && {shlex.join(step.command)}")


def _order(workers: int | None, gpus: str | None, options: dict[str, str], folder: Folder) -> WorkOrder:
    """Return the settings of the workers; the runs are filled in later."""
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
    """Run the jobs with a progress bar and a line for each finished run."""
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
            raise TrainingStoppedError("stopped; repeat the command to continue with the remaining runs") from None


def _summary(record: dict[str, Any]) -> str:
    patterns = {"psnr": "{:.2f} dB", "train_seconds": "{:.1f} s", "peak_gaussians": "at most {:,} Gaussians"}
    return ", ".join(pattern.format(record[name]) for name, pattern in patterns.items() if name in record)


def _write(
    experiment: Experiment, planned: Sequence[PlannedRun], store: ResultStore, folder: Folder, messages: Console
) -> None:
    """Write the results, print their table, and report the runs that failed.

    Raises:
        RunsFailedError: some did.
    """
    import shlex

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
    try:
        table = make_table(experiment, planned, records)
    except RunFolderError as error:
        raise RunFolderError(f"{folder.store}: {error}") from None
    text = markdown(table)
    exports.write_csv(folder.path / exports.CSV, rows)
    exports.write_text(folder.path / exports.MARKDOWN, text)
    exports.write_text(folder.path / exports.LATEX, latex(table))
    try:
        exports.write_parquet(folder.path / exports.PARQUET, rows)
    except MissingExtraError as error:
        messages.print(f"[yellow]{escape(str(error))}[/yellow]", highlight=False)
    console = make_console()
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
