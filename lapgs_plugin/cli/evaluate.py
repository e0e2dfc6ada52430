"""`lapgs eval`: the figures of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def evaluate(
    run: Annotated[Path, typer.Argument(help="Complete run folder that `lapgs train` wrote.")],
    scene: Annotated[
        Path | None, typer.Option(help="Where the scene is now, if it moved since the run was trained.")
    ] = None,
) -> None:
    """Measure RUN on its held-out views, print the figures and write them to RUN/metrics.json.

    PSNR and SSIM are means over the views, of float images clamped to [0, 1], as 3DGS reports them. Without held-out
    views (`lapgs train --eval`) the training views are measured, which flatters. Times are those of training: the
    optimization, and everything around it beside it.
    """
    from lapgs_plugin.archive import METRICS, RunArchive
    from lapgs_plugin.evaluation.figures import evaluate_run

    archive = RunArchive.open(run)
    metrics = evaluate_run(archive, scene)
    _print(metrics)
    print(f"{archive.path(METRICS)} holds these figures")


def _print(metrics: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    by_view = Table("view", "PSNR dB", "SSIM", title="Views, worst first", title_justify="left")
    for view in sorted(metrics["views"], key=lambda view: float(view["psnr"])):
        by_view.add_row(view["name"], f"{view['psnr']:.2f}", f"{view['ssim']:.4f}")
    console.print(by_view)

    by_level = Table(
        *("level", "size", "iterations", "seconds", "Gaussians", "peak", "PSNR dB", "upsampled dB"),
        title="Levels, in training order",
        title_justify="left",
        caption="PSNR at the level's own size, and upsampled to full resolution without finer levels",
        caption_justify="left",
    )
    for level, figures in metrics["levels"].items():
        width, height = figures["image_size"]
        by_level.add_row(
            *(level, f"{width}x{height}", f"{figures['iterations']:,}", f"{figures['train_seconds']:.1f}"),
            *(f"{figures['num_gaussians']:,}", f"{figures['peak_gaussians']:,}"),
            *(f"{figures['psnr']:.2f}", f"{figures['upsampled_psnr']:.2f}"),
        )
    console.print(by_level)
    kind = "held-out" if metrics["split"] == "test" else "TRAINING (nothing was held out)"
    overhead = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in metrics["overhead_seconds"].items())
    console.print(
        f"[bold]{metrics['psnr']:.2f} dB[/bold] PSNR, [bold]{metrics['ssim']:.4f}[/bold] SSIM over "
        f"{metrics['num_views']} {kind} views; optimization [bold]{metrics['train_seconds']:.1f} s[/bold]; "
        f"at most {metrics['peak_gaussians']:,} Gaussians at once",
        highlight=False,
    )
    console.print(f"beside the optimization: {overhead or 'nothing'}", highlight=False)
