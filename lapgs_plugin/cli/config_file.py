"""Read and write settings files: `lapgs train --config run.toml`."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Annotated, Any

import typer

from lapgs_plugin import __version__
from lapgs_plugin.errors import UserInputError, nearest
from lapgs_plugin.files import write_text
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.runs.layout import RUN_CONFIG
from lapgs_plugin.training.strategies import GRADIENTS, MCMC
from lapgs_plugin.untrusted import read_toml

OF_ONE_CALL = frozenset({"config", "out", "resume", "overwrite", "view", "view_port"})
"""Parameters that say where a run goes and how it is started, not what it is."""


def _load(context: typer.Context, path: Path | None) -> Path | None:
    """Take the values of a settings file as defaults of the command's other parameters."""
    if path is not None:
        context.default_map = {**(context.default_map or {}), **_read(context, path)}
    return path


ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        is_eager=True,
        callback=_load,
        metavar="FILE",
        help="TOML file of options, such as the run.toml of a run folder. Options on the command line override it.",
    ),
]


def _read(context: typer.Context, path: Path) -> dict[str, Any]:
    """Return a settings file's values by the names of the command's parameters.

    Raises:
        UserInputError: the file is not TOML, has a key that is no option, or a value that is not a string, number or
            boolean.
    """
    if not path.is_file():
        raise UserInputError(f"--config {path}: no such file; a run folder has one, {RUN_CONFIG}")
    known = {str(each.name).replace("_", "-"): each for each in context.command.params if each.name not in OF_ONE_CALL}
    values: dict[str, Any] = {}
    for key, value in read_toml(path, dict[str, Any]).items():
        name = key.replace("-", "_")
        if (option := name.replace("_", "-")) not in known:
            all_of_them = f"{context.command_path} --help lists them"
            raise UserInputError(
                f"{path}: {key} is not an option of {context.command_path} that a settings file may have; "
                f"{all_of_them if name in OF_ONE_CALL else nearest(option, known.keys(), all_of_them)}"
            )
        if not isinstance(value, str | int | float):
            raise UserInputError(f"{path}: {key} is {value!r}, expected a string, a number, true or false")
        if isinstance(value, bool) and not getattr(known[option], "is_flag", False):  # Python takes it for a number
            raise UserInputError(f"{path}: {key} is {json.dumps(value)}, expected a value of --{option}")
        values[name] = value
    return _of_this_version(values)


def _of_this_version(values: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a file that may be of an older version, which wrote defaults that have changed since."""
    strategy = values.get("strategy")
    if strategy == "default":  # its name once
        values["strategy"] = GRADIENTS
    if strategy not in (None, AUTO, MCMC) and values.get("cap_max") == 1_000_000:  # written with every strategy
        del values["cap_max"]
    return values


def extend_config(path: Path, iterations: int, extended: int, strategy: str) -> None:
    """Replace what the extension of a run changed in its settings file; older runs have no such file.

    Args:
        path: of the file.
        iterations: of the longer run.
        extended: those after the schedule's end.
        strategy: of the run; "auto" could choose another one for so many iterations.
    """
    if path.is_file():
        line = f"iterations = {iterations}  # the last {extended} extended the finished run"
        text = re.sub(r"(?m)^iterations = .*$", line, path.read_text(encoding="utf-8"))
        text = re.sub(r'(?m)^strategy = "auto"$', f"strategy = {json.dumps(strategy)}", text)
        write_text(path, text)


def write_config(path: Path, context: typer.Context, **replaced: str | int) -> None:
    """Write the parameters of a command that runs as a settings file that makes the same run.

    Parameters that are None and `OF_ONE_CALL` are left out.

    Args:
        path: of the file.
        context: of the command.
        replaced: parameters' values that were chosen or mean the same in every folder, instead of those given.
    """
    lines = [
        f"# Made by lapgs {__version__}. The same again: {context.command_path} --config {path.name} -o NEW_FOLDER"
    ]
    for name in (str(each.name) for each in context.command.params):
        value = replaced.get(name, context.params.get(name))
        if value is None or name in OF_ONE_CALL or (isinstance(value, float) and not math.isfinite(value)):
            continue
        text = json.dumps(str(value.absolute()) if isinstance(value, Path) else value, ensure_ascii=False)
        lines.append(f"{name.replace('_', '-')} = {text}")
    write_text(path, "\n".join(lines) + "\n")
