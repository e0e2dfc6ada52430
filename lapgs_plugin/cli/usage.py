"""Turn click's usage errors into one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer

from lapgs_plugin.errors import UserInputError

USAGE_ERROR: type[Exception] = typer.BadParameter.__mro__[1]
"""click's UsageError, which some versions of typer bring themselves."""
PLAIN = {
    "Input should be greater than or equal to": "expected at least",
    "Input should be less than or equal to": "expected at most",
    "Input should be": "expected",
}
"""Our words for pydantic's."""
REPLACED = {"exposure": "--appearance (none, affine or bilateral; before: off, on)"}
"""Options that other ones took the place of, which files and scripts of users may still have."""
WITH_BASELINE = ("report", "view")
"""Commands that show one run, and a second one by --baseline."""


def usage_message(error: Any) -> str:
    """Return the message of a usage error, with the refused value if there is one."""
    refused: Any = getattr(error.__cause__, "errors", list)()  # pydantic's, whose message leaves out the value
    if refused and getattr(error, "param", None) is not None:
        expected = refused[0]["msg"]
        for said, plain in PLAIN.items():
            expected = expected.replace(said, plain)
        return f"{error.param.opts[0]} {refused[0]['input']}: {expected}"
    message: str = error.format_message().rstrip(".")
    return message[:1].lower() + message[1:]


@contextmanager
def one_line_usage_errors(context: Any = None) -> Iterator[None]:
    """Turn usage errors into one line that names the help of the command.

    Raises:
        UserInputError: click refused a command line. A group without arguments still shows its help.
    """
    try:
        yield
    except USAGE_ERROR as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            raise
        where = getattr(error, "ctx", None)
        words = ["lapgs", context and context.invoked_subcommand] if where is None else [where.command_path]
        command = " ".join(filter(None, words))
        if getattr(where, "info_name", "") in WITH_BASELINE and "extra argument" in usage_message(error):
            raise UserInputError(
                f"{usage_message(error)}; expected one run, to compare it with another: {command} RUN --baseline OTHER"
            ) from error
        said = usage_message(error)
        if (name := str(getattr(error, "option_name", "")).lstrip("-")) in REPLACED:
            raise UserInputError(f"no such option: --{name}; give {REPLACED[name]}") from error
        if command == "lapgs run" and said.startswith("no such option"):
            raise UserInputError(f"{said}; options of the script go after it, see `{command} --help`") from error
        raise UserInputError(f"{said}{' See' if said.endswith('?') else '; see'} `{command} --help`") from error
