"""Run an experiment, or benchmark one part of the package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from lapgs_bench.experiments.settings import BenchSettings, WorkerSettings
from lapgs_bench.kernels.commands import blend, ops, raster
from lapgs_bench.pareto.settings import ParetoSettings
from lapgs_plugin.cli.bridge import takes_settings
from lapgs_plugin.training.settings import TrainingControl

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
    from lapgs_bench.experiments.run import run_experiment

    run_experiment(experiment, settings)


@takes_settings
def pareto(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene folder.")],
    settings: ParetoSettings,
) -> None:
    """Compare methods at equal time: train SCENE for several budgets of seconds, and draw quality over seconds.

    One field, nested levels and residuals of `lapgs train`; with --checkout also a checkout's script, by itself and
    under `lapgs run`. Repeat the command to continue after Ctrl-C; finished runs are kept.

    Examples:

        lapgs bench pareto data/garden --budgets 5,10,20,40

        lapgs bench pareto data/garden --checkout FastGS --seeds 0,1
    """
    from lapgs_bench.pareto.command import draw_pareto

    draw_pareto(scene, settings)


@takes_settings
def tiles(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN", help="Run of `lapgs train --tiles` whose coarser levels are finished, as by --only-base."
        ),
    ],
    scene: Annotated[Path | None, typer.Option(help="Scene folder, if it was moved after training.")] = None,
    *,
    engine: WorkerSettings,
    control: TrainingControl,
) -> None:
    """Train the tiles of RUN on this machine, Slurm or Ray, and merge them.

    Each worker takes the next tile that is not finished. Repeat the command to continue after Ctrl-C or a crash, with
    any launcher; each tile goes on from its last checkpoint.

    Examples:

        lapgs bench tiles runs/town --launcher slurm --workers 6

        lapgs bench tiles runs/town --launcher ray --launcher-option address=auto
    """
    from lapgs_bench.tiles import train_tiles

    train_tiles(run, scene, engine, control)


app = typer.Typer(
    name="bench",
    cls=_ExperimentByDefault,
    help="Run an experiment (lapgs bench EXPERIMENT), or benchmark one part of this package.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command(EXPERIMENT)(experiment)
app.command("raster")(raster)
app.command("ops")(ops)
app.command("blend")(blend)
app.command("pareto")(pareto)
app.command("tiles")(tiles)
