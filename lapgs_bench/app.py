"""Run experiments and benchmarks: `lapgs bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from lapgs_plugin.cli.bench_blend import blend
from lapgs_plugin.cli.bench_raster import raster
from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.cli.output import make_console
from lapgs_plugin.experiments.settings import BenchSettings

EXPERIMENT = "run"
"""The default subcommand: `lapgs bench smoke`."""


class _ExperimentByDefault(TyperGroup):
    """Run `EXPERIMENT` if the first argument is not the name of a subcommand."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, "--help"):
            args = [EXPERIMENT, *args]
        return super().parse_args(ctx, args)


@takes_settings
def experiment(
    experiment: Annotated[
        Path,
        typer.Argument(
            metavar="EXPERIMENT", help="TOML file, or the name of an experiment that comes with lapgs, such as smoke."
        ),
    ],
    settings: BenchSettings,
) -> None:
    """Run all scenes, backbones, variants and seeds of EXPERIMENT, and write tables of the results.

    Each run is a process of its own. Repeat the command to continue after Ctrl-C or a crash; finished runs are kept and
    failed ones are tried again. Several commands can work on one folder at the same time.

    Examples:

        lapgs bench smoke

        lapgs bench split --path mipnerf360=/data/360
    """
    from lapgs_plugin.cli.bench_experiment import run_experiment

    run_experiment(experiment, settings)


def ops(
    width: Annotated[int, typer.Option(min=3, max=16384, help="Width of the images in pixels.")] = 800,
    height: Annotated[int, typer.Option(min=3, max=16384, help="Height of the images in pixels.")] = 532,
    gaussians: Annotated[int, typer.Option(min=1, max=10_000_000, help="Number of Gaussians in the field.")] = 100_000,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Turns; the table has medians over them.")] = 7,
    device: Annotated[
        str, typer.Option(metavar="auto|cpu|cuda", help="Where to run; auto takes a GPU if there is one.")
    ] = "auto",
) -> None:
    """Time each operation of a training iteration in every version that this machine has.

    Speed-ups and differences are against PyTorch's operations. Other libraries have their own names.
    """
    import torch
    from rich import box
    from rich.table import Table

    from lapgs_plugin.environment.device import chosen_device
    from lapgs_plugin.ops.benchmark import benchmark

    where = torch.device(chosen_device(device))
    table = Table(title=f"Operations at {width}x{height} with {gaussians} Gaussians on {where}", box=box.SIMPLE)
    for heading in ("operation", "version"):
        table.add_column(heading)
    for heading in ("ms", "speed-up", "difference"):
        table.add_column(heading, justify="right", no_wrap=True)
    shown = ""
    for found in benchmark(where, width, height, gaussians, repeats):
        name = "" if found.op == shown else found.op
        table.add_row(name, found.version, f"{found.milliseconds:.2f}", f"{found.ratio:.2f}", f"{found.difference:.0e}")
        shown = found.op
    make_console().print(table)


bench_app = typer.Typer(
    name="bench",
    cls=_ExperimentByDefault,
    help="Run an experiment (lapgs bench EXPERIMENT), or benchmark one part of this package.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
bench_app.command(EXPERIMENT)(experiment)
bench_app.command("raster")(raster)
bench_app.command("ops")(ops)
bench_app.command("blend")(blend)
