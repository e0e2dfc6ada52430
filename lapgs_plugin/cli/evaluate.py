"""Measure a run: `lapgs eval`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.cli.output import make_console, make_table, say, show_log
from lapgs_plugin.errors import counted, printable
from lapgs_plugin.options import check_values, option, refuse
from lapgs_plugin.rendering.options import RenderOptions

if TYPE_CHECKING:
    from rich.console import Console

FLICKER_FRAMES = 120
"""Frames of a path along which flicker is measured, unless the user says otherwise."""

SHOWN_VIEWS = 12
"""Views listed on the terminal; metrics.json and the report list all."""


@dataclass(frozen=True)
class EvaluateSettings:
    """Choose the measurement: images of the views, or flicker along a camera path.

    Raises:
        UserInputError: a value is out of range, or an option has no effect with the others.
    """

    lpips: str | None = option(
        None,
        "LPIPS variants to measure, separated by commas: vgg, alex, squeeze, vgg_3dgs (VGG as 3DGS codebases compute "
        "it), or none. Default: those that --lpips-weights names, else vgg and vgg_3dgs.",
        metavar="VARIANTS",
    )
    lpips_weights: list[Path] | None = option(
        None,
        "Weights of an LPIPS network in torchvision's layout, .pth or .safetensors. Repeatable. Default: those in "
        "torchvision's cache. Nothing is downloaded.",
    )
    trajectory: str | None = option(
        None,
        "Measure flicker along a camera path instead of the views: orbit, spline or a JSON file of cameras, as for "
        "`lapgs render`.",
    )
    baseline: Path | None = option(None, "With --trajectory: a run of one field to compare with.")
    frames: int | None = option(
        None, f"Frames of the path. Default: {FLICKER_FRAMES}, or the cameras of the JSON file.", least=2
    )

    def __post_init__(self) -> None:
        check_values(self)
        if self.trajectory is None:
            refuse({"--baseline": self.baseline, "--frames": self.frames}, "needs --trajectory")
        else:
            photo_options = {"--lpips": self.lpips, "--lpips-weights": self.lpips_weights}
            refuse(photo_options, "does not go with --trajectory, which has no photos")


@takes_settings
def evaluate(
    run: Annotated[
        Path,
        typer.Argument(metavar="RUN", help="Complete run folder of `lapgs train`, `lapgs run` or `lapgs import-run`."),
    ],
    settings: EvaluateSettings,
    options: RenderOptions,
) -> None:
    """Measure PSNR, SSIM and LPIPS of RUN on its held-out views, and write RUN/metrics.json.

    The metrics are means over views of float images clamped to [0, 1], as 3DGS reports them. PSNR is also measured on
    the right half of each view after an affine colour fit on its left half, for photos whose exposure changes. LPIPS is
    skipped if the weights of its network are missing. A run without held-out views (`lapgs train --eval`) is measured
    on its training views, where the metrics are higher. If --scene has other photos than the run was trained on, all of
    them are measured. The output also shows training times and frames per second of the composed image.

    With --trajectory the command measures flicker instead: how much each frame differs from the one before after
    warping it by the rendered depth, where both show the same surface. It writes RUN/stability.json.
    """
    if settings.trajectory is not None:
        _stability(run, settings.trajectory, settings, options)
        return
    from lapgs_plugin.evaluation.figures import evaluate_run
    from lapgs_plugin.evaluation.lpips import LpipsRequest
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.runs.layout import METRICS

    wanted = LpipsRequest.parse(settings.lpips, settings.lpips_weights or ())
    archive = RunArchive.open(run)
    show_log()
    metrics = evaluate_run(archive, options, wanted)
    _print(metrics)
    say(f"{archive.path(METRICS)} holds these figures")


def _stability(run: Path, trajectory: str, settings: EvaluateSettings, options: RenderOptions) -> None:
    """Measure flicker along a path and print it."""
    from lapgs_plugin.evaluation.stability import evaluate_stability
    from lapgs_plugin.rendering.run import path_cameras
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.runs.layout import STABILITY

    archive = RunArchive.open(run)
    other = None if settings.baseline is None else RunArchive.open(settings.baseline)
    show_log()
    cameras = path_cameras(archive, trajectory, settings.frames, FLICKER_FRAMES, options.scene)
    figures = evaluate_stability(archive, other, trajectory, cameras, options)
    table = make_table("", "mean difference", "PSNR (dB)")
    for name, difference in figures["flicker"].items():
        table.add_row(name, f"{difference['mean']:.5f}", f"{difference['psnr']:.2f}")
    console = make_console()
    width, height = figures["size"]
    console.print(
        f"[bold]Flicker[/bold] along {trajectory}: {figures['frames']} frames of {width}x{height}, each against the "
        f"one before, where both show the same surface ({100 * figures['compared']:.0f} % of the pixels)",
        table,
    )
    say(f"{archive.path(STABILITY)} holds these figures")


def _print(metrics: dict[str, Any]) -> None:
    console = make_console()
    print_views(console, metrics)
    print_levels(console, metrics)
    if metrics["breakdown_seconds"]:
        _print_breakdown(console, metrics)
    _print_summary(console, metrics)


def print_views(console: Console, metrics: dict[str, Any]) -> None:
    from rich.markup import escape

    from lapgs_plugin.evaluation.lpips import lpips_titles
    from lapgs_plugin.evaluation.metrics import far_worse_below

    measured = lpips_titles(metrics)
    table = make_table("view", "PSNR (dB)", "colour-fitted", "SSIM", *measured.values())
    ranked = sorted(metrics["views"], key=lambda view: float(view["psnr"]))
    for view in ranked[:SHOWN_VIEWS]:
        distances = [f"{view[key]:.4f}" for key in measured]
        figures = f"{view['psnr']:.2f}", f"{view['fitted_psnr']:.2f}", f"{view['ssim']:.4f}"
        table.add_row(escape(printable(view["name"])), *figures, *distances)
    more = f", {len(ranked) - SHOWN_VIEWS} better ones are in metrics.json" if len(ranked) > SHOWN_VIEWS else ""
    console.print(f"[bold]Views, worst first[/bold]{more}", table)
    limit = far_worse_below([float(view["psnr"]) for view in ranked])
    if far := [str(view["name"]) for view in ranked if view["psnr"] < limit]:
        more = f" and {len(far) - SHOWN_VIEWS} more" if len(far) > SHOWN_VIEWS else ""
        console.print(
            f"{len(far)} of {counted(len(ranked), 'view')} are far worse than the rest, below {limit:.1f} dB: "
            f"{printable(', '.join(far[:SHOWN_VIEWS]))}{more}; their cameras may be placed wrongly, or no training "
            "view shows the same",
            markup=False,
            soft_wrap=True,
        )


def print_levels(console: Console, metrics: dict[str, Any]) -> None:
    table = make_table("level", "size", "iterations", "seconds", "Gaussians", "peak", "PSNR", "upsampled")
    for level, figures in metrics["levels"].items():
        width, height = figures["image_size"]
        cells = [f"{width}x{height}", f"{figures['iterations']:,}", f"{figures['train_seconds']:.1f}"]
        cells += [f"{figures['num_gaussians']:,}", f"{figures['peak_gaussians']:,}"]
        table.add_row(level, *cells, f"{figures['psnr']:.2f}", f"{figures['upsampled_psnr']:.2f}")
    console.print(
        "[bold]Levels as trained[/bold], PSNR in dB at the level's size and upsampled without finer levels", table
    )


def _print_breakdown(console: Console, metrics: dict[str, Any]) -> None:
    levels = metrics["levels"].items()
    table = make_table("part", *(f"level {level}" for level, _ in levels), "run")
    total = sum(metrics["breakdown_seconds"].values())
    for part, seconds in metrics["breakdown_seconds"].items():
        cells = [f"{1e3 * f['breakdown_seconds'][part] / f['iterations']:.2f} ms" for _, f in levels]
        table.add_row(part, *cells, f"{seconds:.1f} s, {seconds / total:.1%}")
    console.print("[bold]Where the time of iterations went[/bold], an iteration of each level", table)


def _print_summary(console: Console, metrics: dict[str, Any]) -> None:
    from lapgs_plugin.evaluation.lpips import lpips_titles, missing_lines

    kind, scene = {
        "test": ("held-out view", ""),
        "train": ("TRAINING (nothing was held out) view", ""),
        "other": ("view", " of a scene that it was not trained on"),
    }[metrics["split"]]
    where = " inside their masks" if metrics["masked"] else ""
    if where and lpips_titles(metrics):
        where += " (LPIPS: the photo outside)"
    overhead = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in metrics["overhead_seconds"].items())
    seconds = metrics["train_seconds"]  # 0 where a loop of the user's own has measured none
    optimization = f"optimization [bold]{seconds:.1f} s[/bold]; " if seconds else ""
    console.print(
        f"[bold]{metrics['psnr']:.2f} dB[/bold] PSNR, [bold]{metrics['ssim']:.4f}[/bold] SSIM over "
        f"{counted(metrics['num_views'], kind)}{scene}{where}; {optimization}"
        f"at most {metrics['peak_gaussians']:,} Gaussians at once; {metrics['fps']:,.0f} frames a second"
    )
    console.print(
        f"[bold]{metrics['fitted_psnr']:.2f} dB[/bold] PSNR of the right half of each view after a colour fit on its "
        "left half; compare this one where photos differ in exposure or white balance"
        + (", as they do here" if metrics["exposure_compensated"] else "")
    )
    if metrics["exposure_predicted"]:
        console.print(
            "all other figures give each view the exposure of its neighbours by name among the training photos"
        )
    if (peak := metrics["peak_memory_bytes"]) is not None:
        bare = metrics["peak_memory_without_images_bytes"]
        console.print(f"GPU memory at most {peak / 1e9:.2f} GB, {bare / 1e9:.2f} GB without images")
    if (busy := metrics["gpu_busy_seconds"]) is not None:
        console.print(f"the GPU executed kernels for {busy:.1f} s of the optimization")
    console.print(f"beside the optimization: {overhead or 'nothing'}")
    for line in missing_lines(metrics["lpips_missing"]):
        console.print(line, markup=False, soft_wrap=True)
