"""`lapgs eval`: the figures of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lapgs_plugin.cli.rendering import DeviceOption, RasterizerOption, show_log

SHOWN_VIEWS = 12
"""How many views the terminal shows; metrics.json and the report hold all."""


def evaluate(
    run: Annotated[
        Path, typer.Argument(help="Complete run folder of `lapgs train`, `lapgs run` or `lapgs import-run`.")
    ],
    scene: Annotated[
        Path | None, typer.Option(help="Where the scene is now, if it moved since the run was trained.")
    ] = None,
    device: DeviceOption = "auto",
    rasterizer: RasterizerOption = "auto",
) -> None:
    """Measure RUN on its held-out views, print the figures and write them to RUN/metrics.json.

    PSNR and SSIM are means over the views, of float images clamped to [0, 1], as 3DGS reports them. Without held-out
    views (`lapgs train --eval`) the training views are measured, which flatters. Times are those of training: the
    optimization, and everything around it beside it.
    """
    from lapgs_plugin.archive import METRICS, RunArchive
    from lapgs_plugin.evaluation.figures import evaluate_run

    archive = RunArchive.open(run)
    show_log()
    metrics = evaluate_run(archive, scene, device=device, rasterizer=rasterizer)
    _print(metrics)
    print(f"{archive.path(METRICS)} holds these figures")


def _print(metrics: dict[str, Any]) -> None:
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console()
    by_view = Table("view", "PSNR (dB)", "SSIM", box=box.SIMPLE_HEAD)
    ranked = sorted(metrics["views"], key=lambda view: float(view["psnr"]))
    for view in ranked[:SHOWN_VIEWS]:
        by_view.add_row(escape(view["name"]), f"{view['psnr']:.2f}", f"{view['ssim']:.4f}")
    more = f", {len(ranked) - SHOWN_VIEWS} better ones are in metrics.json" if len(ranked) > SHOWN_VIEWS else ""
    console.print(f"[bold]Views, worst first[/bold]{more}", by_view, highlight=False)

    by_level = Table("level", "size", "steps", "seconds", "Gaussians", "peak", "PSNR", "upsampled", box=box.SIMPLE_HEAD)
    for level, figures in metrics["levels"].items():
        width, height = figures["image_size"]
        by_level.add_row(
            *(level, f"{width}x{height}", f"{figures['iterations']:,}", f"{figures['train_seconds']:.1f}"),
            *(f"{figures['num_gaussians']:,}", f"{figures['peak_gaussians']:,}"),
            *(f"{figures['psnr']:.2f}", f"{figures['upsampled_psnr']:.2f}"),
        )
    console.print(
        "[bold]Levels as trained[/bold], PSNR in dB at the level's size and upsampled without finer levels",
        by_level,
        highlight=False,
    )
    kind = "held-out" if metrics["split"] == "test" else "TRAINING (nothing was held out)"
    overhead = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in metrics["overhead_seconds"].items())
    console.print(
        f"[bold]{metrics['psnr']:.2f} dB[/bold] PSNR, [bold]{metrics['ssim']:.4f}[/bold] SSIM over "
        f"{metrics['num_views']} {kind} views; optimization [bold]{metrics['train_seconds']:.1f} s[/bold]; "
        f"at most {metrics['peak_gaussians']:,} Gaussians at once",
        highlight=False,
    )
    console.print(f"beside the optimization: {overhead or 'nothing'}", highlight=False)
