"""Declare command-line options as fields of settings dataclasses.

`cli/bridge.py` makes command lines from the declarations. This module imports no command-line library.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields, is_dataclass
from typing import TYPE_CHECKING, Any

from lapgs_plugin.errors import UserInputError

if TYPE_CHECKING:
    from lapgs_plugin.registry import Registry

KEY = "option"
"""Key of a field's metadata for its `Option`."""

CHOSEN = "chosen"
"""Key of a field's metadata for a registry, and for the name of the field that chooses an object of it."""


@dataclass(frozen=True)
class Option:
    """How a field appears on the command line.

    Attributes:
        help: text of one or two sentences.
        panel: title of its group in `--help`.
        names: of the option, the longest first; empty for a name made from the field's.
        least, most: bounds of a number.
        choices: accepted texts; empty for any.
        metavar: name of its value in `--help`; empty for its type.
    """

    help: str
    panel: str = ""
    names: tuple[str, ...] = ()
    least: float | None = None
    most: float | None = None
    choices: tuple[str, ...] = ()
    metavar: str = ""


def option(
    default: Any,
    help: str,
    *,
    panel: str = "",
    names: tuple[str, ...] = (),
    least: float | None = None,
    most: float | None = None,
    choices: tuple[str, ...] = (),
    metavar: str = "",
) -> Any:
    """Declare a dataclass field that is an option of every command that takes the dataclass."""
    return field(default=default, metadata={KEY: Option(help, panel, names, least, most, choices, metavar)})


def options_of(registry: Registry[Any], by: str) -> Any:
    """Declare a dataclass field for the settings object of a registry that the field `by` names.

    Every object of the registry is a settings dataclass, and commands have the options of all of them; those of an
    object that is not chosen are refused.
    """
    return field(default=None, metadata={CHOSEN: (registry, by)})


def parameter_name(name: str, declared: Option) -> str:
    """Return the name of a field's command parameter: the option's name as an identifier."""
    shown = declared.names[0].split("/")[0] if declared.names else name
    return shown.lstrip("-").replace("-", "_")


def option_name(declared: Field[Any]) -> str:
    """Return the option of a field as a user writes it."""
    return "--" + parameter_name(declared.name, declared.metadata[KEY]).replace("_", "-")


def option_values(settings: Any) -> Mapping[str, Any]:
    """Return the option values of a settings object, including nested dataclasses, by parameter name."""
    values: dict[str, Any] = {}
    for setting in fields(settings):
        value = getattr(settings, setting.name)
        if (declared := setting.metadata.get(KEY)) is not None:
            values[parameter_name(setting.name, declared)] = value
        elif is_dataclass(value):
            values.update(option_values(value))
    return values


def check_values(settings: Any) -> None:
    """Check the values of a settings object against their declared bounds and choices.

    Raises:
        UserInputError: a number is out of bounds, or a text is not among the choices.
    """
    for setting in fields(settings):
        declared, value = setting.metadata.get(KEY), getattr(settings, setting.name)
        if declared is None or value is None:
            continue
        name = option_name(setting)
        if declared.choices and value not in declared.choices:
            *others, last = declared.choices
            raise UserInputError(f"{name} {value}: expected {', '.join(others)} or {last}")
        if isinstance(value, str):
            continue
        if declared.least is not None and not value >= declared.least:
            raise UserInputError(f"{name} {value}: expected at least {declared.least:g}")
        if declared.most is not None and not value <= declared.most:
            raise UserInputError(f"{name} {value}: expected at most {declared.most:g}")


LARGEST = 1e30
"""Largest factor or rate that is accepted; kernels compute in float32."""


def require_positive(name: str, value: float, kind: str) -> None:
    """Raise a UserInputError about a number that is not positive and finite in float32."""
    if not 0.0 < value <= LARGEST:
        raise UserInputError(f"{name} {value}: expected a positive {kind} of at most {LARGEST:g}")


def refuse(options: Mapping[str, object], why: str) -> None:
    """Refuse options that would have no effect.

    Args:
        options: values by name; None or False for an option that was not given.
        why: the reason, as it follows the option's name.

    Raises:
        UserInputError: one was given.
    """
    for name, value in options.items():
        if value is not None and value is not False:
            raise UserInputError(f"{name} {why}; leave it out")
