"""Read and write settings files: `lapgs train --config run.toml`."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lapgs_plugin import __version__
from lapgs_plugin.cli.usage import REPLACED
from lapgs_plugin.errors import LapgsError, RunFolderError, UserInputError, nearest, printable
from lapgs_plugin.files import write_text
from lapgs_plugin.runs.layout import RUN_CONFIG
from lapgs_plugin.untrusted import read_text, read_toml

if TYPE_CHECKING:
    from lapgs_plugin.training.settings import TrainSettings

OF_ONE_CALL = frozenset(
    {
        "config",
        "out",
        "resume",
        "overwrite",
        "view",
        "view_port",
        "gpus",
        "processes",
        "shard",
        "tile",
        "base",
        "only_base",
    }
)
"""Parameters of a call that do not change the trained run."""

META_KEY = "lapgs_plugin.config"
"""Key of click's `Context.meta` for the command's context and the settings file that it reads."""


def _load(context: typer.Context, path: Path | None) -> Path | None:
    """Set defaults of the command's other parameters to the values of a settings file."""
    if path is not None:
        context.default_map = {**(context.default_map or {}), **_read(context, path)}
        context.meta[META_KEY] = context, path
    return path


@contextmanager
def naming_the_config(meta: Mapping[str, Any]) -> Iterator[None]:
    """Begin errors about an option or a scene with the settings file that gave it.

    Args:
        meta: of the command's context, or of one above it.

    Raises:
        LapgsError: the block raised it, or a kind of it.
    """
    try:
        yield
    except LapgsError as error:
        context, path = meta.get(META_KEY, (None, None))
        if context is None:
            raise
        option = re.match("(?:invalid value for ')?--([a-z-]+)", str(error))
        name = option[1].replace("-", "_") if option else "scene"
        source = context.get_parameter_source(name)
        scene = printable(str(context.params.get(name)))  # messages have it so
        about = option is not None or str(error).startswith((scene, "scene "))
        if source is None or source.name != "DEFAULT_MAP" or not about:
            raise
        raise type(error)(f"{path}: {error}") from error


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
    if not os.path.lexists(path):
        raise UserInputError(f"--config {path}: no such file; a run folder has one, {RUN_CONFIG}")
    known = {str(one.name).replace("_", "-"): one for one in context.command.params if one.name not in OF_ONE_CALL}
    values: dict[str, Any] = {}
    for key, value in read_toml(path, dict[str, Any]).items():
        name = key.replace("-", "_")
        if (option := name.replace("_", "-")) not in known:
            if option in REPLACED:
                raise UserInputError(f"{path}: {key} is no option any more; give {REPLACED[option]}")
            all_of_them = f"{context.command_path} --help lists them"
            raise UserInputError(
                f"{path}: {key} is not an option of {context.command_path} that a settings file may have; "
                f"{all_of_them if name in OF_ONE_CALL else nearest(option, known.keys(), all_of_them)}"
            )
        if not isinstance(value, str | int | float):
            raise UserInputError(f"{path}: {key} is {value!r}, expected a string, a number, true or false")
        if isinstance(value, bool) and not getattr(known[option], "is_flag", False):  # a bool is an int in Python
            raise UserInputError(f"{path}: {key} is {json.dumps(value)}, expected a value of --{option}")
        values[name] = value
    return values


def extended_config(path: Path, settings: TrainSettings) -> str | None:
    """Return the text of a run's settings file, changed by the extension of the run; None if the run has none.

    Args:
        path: of the file.
        settings: of the longer run. Its strategy replaces "auto", which could choose another one for that length.

    Raises:
        RunFolderError: the file cannot be read.
    """
    if not path.is_file():
        return None
    text = read_text(path, error=RunFolderError, advice="restore it, or delete it: the run does not need it")
    line = f"iterations = {settings.iterations}  # the last {settings.extended} extended the finished run"
    text = re.sub(r"(?m)^iterations = .*$", line, text)
    strategy = json.dumps(settings.densification.strategy)
    return re.sub(r'(?m)^strategy = "auto"$', f"strategy = {strategy}", text)


def write_config(path: Path, context: typer.Context, **replaced: str | int | None) -> None:
    """Write the parameters of a command that runs as a settings file that makes the same run.

    Parameters that are None and `OF_ONE_CALL` are left out.

    Args:
        path: of the file.
        context: of the command.
        replaced: values to write instead of parameters' own, such as absolute paths.
    """
    lines = [
        f"# Made by lapgs {__version__}. The same again: {context.command_path} --config {path.name} -o NEW_FOLDER"
    ]
    for name in (str(parameter.name) for parameter in context.command.params):
        value = replaced.get(name, context.params.get(name))
        if value is None or name in OF_ONE_CALL or (isinstance(value, float) and not math.isfinite(value)):
            continue
        text = json.dumps(str(value.absolute()) if isinstance(value, Path) else value, ensure_ascii=False)
        lines.append(f"{name.replace('_', '-')} = {text}")
    write_text(path, "\n".join(lines) + "\n")
