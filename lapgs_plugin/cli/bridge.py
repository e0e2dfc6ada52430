"""Make commands from dataclasses whose fields are declared as options (`lapgs_plugin.options`)."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Annotated, Any, TypeVar, get_type_hints

import typer

from lapgs_plugin.options import KEY, Option, parameter_name

_F = TypeVar("_F", bound=Callable[..., Any])


def takes_settings(command: _F) -> _F:
    """Replace the parameters of a command that are settings dataclasses by the options that their fields declare.

    The command receives an instance, which checks its values in `__post_init__`. A field without a declaration keeps
    its default; if it is a dataclass itself, its options are added too.
    """
    signature = inspect.signature(command, eval_str=True)
    settings = {name: each.annotation for name, each in signature.parameters.items() if is_dataclass(each.annotation)}
    parameters = [each for name, each in signature.parameters.items() if name not in settings]
    for kind in settings.values():
        parameters += _parameters(kind)

    @functools.wraps(command)
    def call(**given: Any) -> Any:
        made = {name: _build(kind, given) for name, kind in settings.items()}
        return command(**given, **made)

    keyword_only = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]
    call.__signature__ = signature.replace(parameters=keyword_only)  # type: ignore[attr-defined]  # typer reads it
    call.__annotations__ = {each.name: each.annotation for each in keyword_only}
    result: Any = call
    return result  # type: ignore[no-any-return]  # another signature


def _declared(kind: Any) -> Iterator[tuple[Field[Any], Any, Option | None]]:
    """Yield the fields of a dataclass with their types and declarations."""
    hints = get_type_hints(kind)
    for each in fields(kind):
        yield each, hints[each.name], each.metadata.get(KEY)


def _parameters(kind: Any) -> Iterator[inspect.Parameter]:
    """Yield a keyword parameter for each option of a dataclass."""
    for each, hint, declared in _declared(kind):
        if declared is None:
            if is_dataclass(hint):
                yield from _parameters(hint)
            continue
        name = parameter_name(each.name, declared)
        default = each.default_factory() if each.default_factory is not MISSING else each.default
        numeric: dict[str, Any] = {"min": declared.least, "max": declared.most}
        names = declared.names or ((f"--{name.replace('_', '-')}",) if hint is bool else ())
        asked = typer.Option(*names, help=declared.help, rich_help_panel=declared.panel or None, **numeric)
        yield inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[hint, asked]
        )


def _build(kind: Any, given: dict[str, Any]) -> Any:
    """Make an instance from a command's arguments, and remove these from `given`."""
    values: dict[str, Any] = {}
    for each, hint, declared in _declared(kind):
        if declared is not None:
            values[each.name] = given.pop(parameter_name(each.name, declared))
        elif is_dataclass(hint):
            values[each.name] = _build(hint, given)
    return kind(**values)


def given_options(context: typer.Context) -> set[str]:
    """Return the parameters that were given on the command line."""
    sources: Mapping[str, Any] = {name: context.get_parameter_source(name) for name in context.params}
    return {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}
