"""`lapgs report`: a run, and its baseline beside it, as a table and as a page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lapgs_plugin.cli.rendering import DeviceOption, RasterizerOption, show_log

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lapgs_plugin.evaluation.report import MeasuredRun


def report(
    run: Annotated[
        Path, typer.Argument(help="Complete run folder of `lapgs train`, `lapgs run` or `lapgs import-run`.")
    ],
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
    between them. Runs that were not measured yet are measured first, as `lapgs eval` does.
    """
    from lapgs_plugin.archive import RunArchive
    from lapgs_plugin.evaluation.figures import run_metrics
    from lapgs_plugin.evaluation.report import MeasuredRun, write_report

    archives = [RunArchive.open(path) for path in (run, baseline) if path is not None]
    show_log()
    runs = [
        MeasuredRun(archive, run_metrics(archive, scene, device=device, rasterizer=rasterizer)) for archive in archives
    ]
    page = write_report(runs[0], runs[1] if len(runs) > 1 else None, scene, device=device, rasterizer=rasterizer)
    _print(runs)
    print(f"{page} shows this with curves and images")


def _print(runs: Sequence[MeasuredRun]) -> None:
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from lapgs_plugin.evaluation.comparison import comparison_rows, unlike

    names = [escape(each.archive.path().name) for each in runs]
    table = Table("", *names, *(["change"] if len(runs) > 1 else []), box=box.SIMPLE_HEAD)
    for row in comparison_rows([each.metrics for each in runs]):
        cells = ["\n".join([cell.text, *(f"[dim]{part}[/dim]" for part in cell.parts)]) for cell in row.cells]
        table.add_row(row.label, *cells, *([row.change] if len(runs) > 1 else []))
    console = Console()
    console.print(table)
    if len(runs) > 1 and (differences := unlike(runs[0].archive.manifest, runs[1].archive.manifest)):
        console.print(f"[yellow]not trained alike:[/yellow] {escape('; '.join(differences))}", highlight=False)
