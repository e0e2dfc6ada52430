"""Report on a run and its baseline: `lapgs report`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.cli.output import make_console, make_table, say, show_log
from lapgs_plugin.errors import RunFolderError, UserInputError, counted
from lapgs_plugin.rendering.options import RenderOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lapgs_plugin.reports.report import MeasuredRun


@takes_settings
def report(
    run: Annotated[
        Path | None,
        typer.Argument(
            metavar="RUN",
            help="Complete run folder of `lapgs train`, `lapgs run` or `lapgs import-run`, or folder of `lapgs bench`. "
            "Default: the newest one in runs/.",
        ),
    ] = None,
    *,
    baseline: Annotated[
        Path | None, typer.Option(help="Another run to compare with, such as one trained with --levels 1.")
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Instead of writing the page, append a row for each run to this CSV file. It is made if it is not "
            "there. Runs have to be measured before, with `lapgs eval`.",
        ),
    ] = None,
    options: RenderOptions,
) -> None:
    """Print the metrics of RUN and write RUN/report.html with curves and images.

    The page is a single file that needs no network. With --baseline, table and page show both runs and their ratio. A
    run without metrics is measured first, as by `lapgs eval`. For a folder of `lapgs bench`, the page shows its tables
    and the scenes whose runs still exist.
    """
    from lapgs_plugin.evaluation.figures import run_metrics
    from lapgs_plugin.reports.data_file import append_rows, data_row
    from lapgs_plugin.reports.folders import FOLDER_REPORTS
    from lapgs_plugin.reports.report import MeasuredRun, write_report
    from lapgs_plugin.runs.archive import RunArchive

    run = run or _newest(Path("runs"))
    for name in FOLDER_REPORTS:
        if (run / FOLDER_REPORTS[name].marker).is_file():
            if baseline or options.scene or csv:
                raise UserInputError(
                    f"{run} ({name}) has baselines and scenes of its own; leave out --baseline, --scene and --csv"
                )
            show_log()
            say(f"{FOLDER_REPORTS[name]().write(run, options)} shows the {name}")
            return
    archives = [RunArchive.open(path) for path in (run, baseline) if path is not None]
    show_log()
    runs = [MeasuredRun(archive, run_metrics(archive, None if csv else options)) for archive in archives]
    if csv is None:
        page = write_report(runs[0], runs[1] if len(runs) > 1 else None, options)
        last_line = f"{page} shows this with curves and images"
    else:
        append_rows(csv, [data_row(run, options.scene) for run in runs])
        last_line = f"{csv} has {counted(len(runs), 'more row')}"
        if names := ", ".join(run.name for run in runs if run.metrics["split"] != "test"):
            last_line += f"; psnr, psnr_fit, ssim and lpips of {names} are empty: no held-out views were measured"
    _print(runs)
    say(last_line)


def _newest(folder: Path) -> Path:
    """Return the run, or other folder with a report, in a folder that was written to last.

    Raises:
        RunFolderError: there is none.
    """
    from lapgs_plugin.files import MANIFEST
    from lapgs_plugin.reports.folders import FOLDER_REPORTS

    markers = MANIFEST, *(FOLDER_REPORTS[name].marker for name in FOLDER_REPORTS)
    files = [path for marker in markers for depth in ("*", "*/*") for path in folder.glob(f"{depth}/{marker}")]
    if not files:
        raise RunFolderError(
            f"{folder.absolute()} holds no {' and no '.join(('run', *FOLDER_REPORTS))}; name one, or train one with "
            "`lapgs train SCENE -o runs/NAME`"
        )
    return max(files, key=lambda path: path.stat().st_mtime).parent


def _print(runs: Sequence[MeasuredRun]) -> None:
    from rich.markup import escape

    from lapgs_plugin.evaluation.lpips import missing_lines
    from lapgs_plugin.reports.comparison import comparison_rows, setup_differences

    names = [escape(run.archive.name) for run in runs]
    table = make_table("", *names, *(["change"] if len(runs) > 1 else []))
    for row in comparison_rows([run.metrics for run in runs]):
        cells = ["\n".join([cell.text, *(f"[dim]{part}[/dim]" for part in cell.parts)]) for cell in row.cells]
        table.add_row(row.label, *cells, *([row.change] if len(runs) > 1 else []))
    console = make_console()
    console.print(table)
    for line in missing_lines({name: why for run in runs for name, why in run.metrics["lpips_missing"].items()}):
        console.print(f"{line}; then repeat lapgs eval", markup=False, soft_wrap=True)
    if len(runs) < 2:
        return
    ours, theirs = (run.archive.manifest for run in runs)
    if differences := setup_differences(ours, theirs, [run.metrics for run in runs]):
        console.print(f"[yellow]not trained and measured alike:[/yellow] {escape('; '.join(differences))}")
