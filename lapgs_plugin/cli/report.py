"""`lapgs report`: a run, and its baseline beside it, as a table and as a page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.rendering import DeviceOption, RasterizerOption, show_log
from lapgs_plugin.errors import RunFolderError, UserInputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lapgs_plugin.reports.report import MeasuredRun


def report(
    run: Annotated[
        Path | None,
        typer.Argument(
            help="Complete run folder of `lapgs train`, `lapgs run` or `lapgs import-run`, or folder of `lapgs bench`. "
            "Default: whichever of them in runs/ is the newest."
        ),
    ] = None,
    baseline: Annotated[
        Path | None, typer.Option(help="Another run to compare it with, such as one trained with --levels 1.")
    ] = None,
    scene: Annotated[
        Path | None, typer.Option(help="Where the scene is now, if it moved since the runs were trained.")
    ] = None,
    device: DeviceOption = "auto",
    rasterizer: RasterizerOption = "auto",
) -> None:
    """Print the figures of RUN as a table and write RUN/report.html, with curves and images.

    The page is one file that needs no network. With --baseline both show the two runs side by side and the ratio
    between them. Runs that were not measured yet are measured first, as `lapgs eval` does. Of an experiment the page
    holds the tables and every scene, as far as its runs are still there.
    """
    from lapgs_plugin.evaluation.figures import run_metrics
    from lapgs_plugin.experiments.exports import CSV
    from lapgs_plugin.reports.report import MeasuredRun, write_report
    from lapgs_plugin.runs.archive import RunArchive

    run = run or _newest(Path("runs"))
    if (run / CSV).is_file():
        if baseline or scene:
            raise UserInputError(
                f"{run} is an experiment, which has its own baselines and scenes; leave out --baseline and --scene"
            )
        from lapgs_plugin.experiments.report import write_experiment_report

        show_log()
        page = write_experiment_report(run, device=device, rasterizer=rasterizer)
        print(f"{page} shows the experiment")
        return
    archives = [RunArchive.open(path) for path in (run, baseline) if path is not None]
    show_log()
    runs = [
        MeasuredRun(archive, run_metrics(archive, scene, device=device, rasterizer=rasterizer)) for archive in archives
    ]
    page = write_report(runs[0], runs[1] if len(runs) > 1 else None, scene, device=device, rasterizer=rasterizer)
    _print(runs)
    print(f"{page} shows this with curves and images")


def _newest(folder: Path) -> Path:
    """The run or experiment in a folder of such that was written to last.

    Raises:
        RunFolderError: there is none.
    """
    from lapgs_plugin.experiments.exports import CSV
    from lapgs_plugin.files import MANIFEST

    patterns = [f"*/{MANIFEST}", f"*/*/{MANIFEST}", f"*/{CSV}", f"*/*/{CSV}"]
    found = [path for pattern in patterns for path in folder.glob(pattern)]
    if not found:
        raise RunFolderError(
            f"{folder.absolute()} holds no run and no experiment; say which to report on, or train one with "
            "`lapgs train SCENE -o runs/NAME`"
        )
    return max(found, key=lambda path: path.stat().st_mtime).parent


def _print(runs: Sequence[MeasuredRun]) -> None:
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from lapgs_plugin.reports.comparison import comparison_rows, setup_differences

    names = [escape(each.archive.path().name) for each in runs]
    table = Table("", *names, *(["change"] if len(runs) > 1 else []), box=box.SIMPLE_HEAD)
    for row in comparison_rows([each.metrics for each in runs]):
        cells = ["\n".join([cell.text, *(f"[dim]{part}[/dim]" for part in cell.parts)]) for cell in row.cells]
        table.add_row(row.label, *cells, *([row.change] if len(runs) > 1 else []))
    console = Console()
    console.print(table)
    if len(runs) > 1 and (differences := setup_differences(runs[0].archive.manifest, runs[1].archive.manifest)):
        console.print(f"[yellow]not trained alike:[/yellow] {escape('; '.join(differences))}", highlight=False)
