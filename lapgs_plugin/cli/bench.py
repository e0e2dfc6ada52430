"""`lapgs bench`: an experiment file, or one of the subcommands."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from lapgs_plugin.cli.bench_experiment import bench_experiment
from lapgs_plugin.cli.bench_raster import raster

EXPERIMENT = "run"
"""The subcommand that is meant when none is named: `lapgs bench smoke.toml`."""


class _ExperimentByDefault(TyperGroup):
    """A group whose first argument is the name of a subcommand, or already belongs to `EXPERIMENT`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, "--help"):
            args = [EXPERIMENT, *args]
        return super().parse_args(ctx, args)


bench_app = typer.Typer(
    name="bench",
    cls=_ExperimentByDefault,
    help="Run an experiment: lapgs bench EXPERIMENT.toml; or measure one part of this program.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
bench_app.command(EXPERIMENT)(bench_experiment)
bench_app.command("raster")(raster)
