"""Run experiments and benchmarks: `lapgs bench`."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from lapgs_plugin.cli.bench_experiment import bench_experiment
from lapgs_plugin.cli.bench_raster import raster

EXPERIMENT = "run"
"""The default subcommand: `lapgs bench smoke.toml`."""


class _ExperimentByDefault(TyperGroup):
    """Run `EXPERIMENT` if the first argument is not the name of a subcommand."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, "--help"):
            args = [EXPERIMENT, *args]
        return super().parse_args(ctx, args)


bench_app = typer.Typer(
    name="bench",
    cls=_ExperimentByDefault,
    help="Run an experiment file (lapgs bench EXPERIMENT.toml), or benchmark one part of this package.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
bench_app.command(EXPERIMENT)(bench_experiment)
bench_app.command("raster")(raster)
