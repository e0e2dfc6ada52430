"""The typer application: every command registered in one place, errors turned into one line and an exit code."""

from __future__ import annotations

import sys

import typer

from lapgs_plugin.cli.train import train
from lapgs_plugin.errors import LapgsError

app = typer.Typer(
    name="lapgs",
    help="Train 3D Gaussian Splatting as a Laplacian frequency hierarchy.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)

app.command("train")(train)


def run() -> None:
    """Run the command line; a `LapgsError` becomes one line on stderr and its exit code."""
    try:
        app()
    except LapgsError as error:
        print(f"lapgs: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
