"""Shape the help texts of commands."""

from __future__ import annotations

import ast
import inspect
from importlib.machinery import PathFinder
from importlib.util import find_spec
from typing import Any

import typer


def join_lines(group: typer.Typer) -> None:
    """Join the lines of each paragraph of the help texts, because typer keeps the line breaks of the source."""
    for command in [*group.registered_commands, group.registered_callback]:
        if command is not None and command.callback is not None:
            text = command.help if isinstance(command.help, str) else command.callback.__doc__
            paragraphs = inspect.cleandoc(text or "").split("\n\n")
            command.help = "\n\n".join(text.replace("\n", " ") for text in paragraphs)
    for inner in group.registered_groups:
        if inner.typer_instance is not None:
            join_lines(inner.typer_instance)


def show_flags_without_type(command: Any) -> None:
    """Leave out `<bool>` behind flags in help texts, which take no value."""
    for parameter in command.get_params(typer.Context(command)):
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
    for below in getattr(command, "commands", {}).values():
        show_flags_without_type(below)


def module_summary(module: str) -> str:
    """Return the first line of a module's docstring from its source, or the module's name; nothing is imported."""
    package, *below = module.split(".")
    try:
        spec: Any = find_spec(package)
        for name in below:
            spec = PathFinder.find_spec(f"{spec.name}.{name}", spec.submodule_search_locations)
        text = ast.get_docstring(ast.parse(spec.loader.get_source(spec.name))) or module
    except (ImportError, AttributeError, SyntaxError, TypeError, ValueError):  # calling the command explains the error
        text = module
    return text.split("\n")[0].replace("[", r"\[")  # no markup
