"""Commands in this process, as the tests of them call them."""

from __future__ import annotations

from collections.abc import Callable

import typer
from typer.testing import CliRunner

from lapgs_plugin.errors import LapgsError


def succeeding(app: typer.Typer, columns: int) -> Callable[..., str]:
    """What calls an app with arguments and returns its standard output.

    The command has to succeed; a LapgsError comes through as it is.

    Args:
        app: of one command or several.
        columns: of the terminal it writes to.
    """

    def call(*arguments: object) -> str:
        result = CliRunner(env={"COLUMNS": str(columns)}).invoke(app, [str(argument) for argument in arguments])
        if isinstance(result.exception, LapgsError):
            raise result.exception
        assert result.exit_code == 0, result.output
        return result.stdout

    return call
