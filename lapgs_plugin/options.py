"""Declare an option of a command where it is used: as a field of a settings dataclass.

`cli/bridge.py` makes command lines from these declarations. Nothing here imports a command-line library.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from lapgs_plugin.errors import UserInputError

KEY = "option"


@dataclass(frozen=True)
class Option:
    """How a field is asked for on a command line.

    Attributes:
        help: what it does, one or two sentences.
        panel: title of the group that `--help` shows it in.
        names: of the option; empty makes one from the field's name. The first is shown, the others are old names.
        least, most: bounds of a number.
    """

    help: str
    panel: str = ""
    names: tuple[str, ...] = ()
    least: float | None = None
    most: float | None = None


def option(
    default: Any,
    help: str,
    *,
    panel: str = "",
    names: tuple[str, ...] = (),
    least: float | None = None,
    most: float | None = None,
) -> Any:
    """Declare a dataclass field that is also an option of every command that takes the dataclass."""
    return field(default=default, metadata={KEY: Option(help, panel, names, least, most)})


def parameter_name(name: str, declared: Option) -> str:
    """Return the name that a command's parameter has for a field: the option's, as an identifier."""
    shown = declared.names[0].split("/")[0] if declared.names else name
    return shown.lstrip("-").replace("-", "_")


def option_values(settings: Any) -> Mapping[str, Any]:
    """Return the values of all options of a settings object, those of dataclasses inside it too, by parameter name."""
    values: dict[str, Any] = {}
    for each in fields(settings):
        value = getattr(settings, each.name)
        if (declared := each.metadata.get(KEY)) is not None:
            values[parameter_name(each.name, declared)] = value
        elif is_dataclass(value):
            values.update(option_values(value))
    return values


def check_bounds(settings: Any) -> None:
    """Check the numbers of a settings object against the bounds that its fields declare.

    Raises:
        UserInputError: one is outside.
    """
    for each in fields(settings):
        declared, value = each.metadata.get(KEY), getattr(settings, each.name)
        if declared is None or value is None or isinstance(value, str):
            continue
        name = "--" + parameter_name(each.name, declared).replace("_", "-")
        if declared.least is not None and not value >= declared.least:
            raise UserInputError(f"{name} {value}: expected at least {declared.least:g}")
        if declared.most is not None and not value <= declared.most:
            raise UserInputError(f"{name} {value}: expected at most {declared.most:g}")
