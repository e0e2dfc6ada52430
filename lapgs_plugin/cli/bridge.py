"""Make commands from dataclasses whose fields are declared as options, see `lapgs_plugin.options`."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Annotated, Any, TypeVar, get_type_hints

import typer

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.options import CHOSEN, KEY, Option, option_name, parameter_name
from lapgs_plugin.registry import Registry

_F = TypeVar("_F", bound=Callable[..., Any])


def takes_settings(command: _F) -> _F:
    """Replace the parameters of a command that are settings dataclasses by the options that their fields declare.

    `--help` lists them in the order of the command's parameters. The command is called with instances, which check
    their values. Fields without a declaration keep their defaults. Nested settings dataclasses add their options. A
    field declared with `options.options_of` adds the options of all choices, at the end.
    """
    signature = inspect.signature(command, eval_str=True)
    kinds = {name: one.annotation for name, one in signature.parameters.items() if is_dataclass(one.annotation)}
    own: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        own.extend(_parameters(kinds[name]) if name in kinds else [parameter])
    added, clashes = _chosen_parameters(kinds.values(), {parameter.name for parameter in own})

    @functools.wraps(command)
    def call(**arguments: Any) -> Any:
        if clashes:
            raise UserInputError(f"{clashes[0]}; fix or uninstall the package that brings it")
        settings = {name: _build(kind, arguments) for name, kind in kinds.items()}
        return command(**arguments, **settings)

    keyword_only = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in (*own, *added)]
    call.__signature__ = signature.replace(parameters=keyword_only)  # type: ignore[attr-defined]  # typer reads it
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in keyword_only}
    result: Any = call
    return result  # type: ignore[no-any-return]  # another signature


def _declared(kind: Any) -> Iterator[tuple[Field[Any], Any, Option | None]]:
    """Yield the fields of a dataclass with their types and declarations."""
    hints = get_type_hints(kind)
    for field in fields(kind):
        yield field, hints[field.name], field.metadata.get(KEY)


def _parameters(kind: Any) -> Iterator[inspect.Parameter]:
    """Make the parameters of a settings dataclass and those inside it."""
    for field, hint, declared in _declared(kind):
        if declared is not None:
            default = field.default_factory() if field.default_factory is not MISSING else field.default
            yield _parameter(field, hint, declared, default)
        elif is_dataclass(hint) and CHOSEN not in field.metadata:
            yield from _parameters(hint)


def _parameter(field: Field[Any], hint: Any, declared: Option, default: Any) -> inspect.Parameter:
    name = parameter_name(field.name, declared)
    names = declared.names or ((f"--{name.replace('_', '-')}",) if hint is bool else ())
    asked = typer.Option(
        *names,
        help=declared.help,
        rich_help_panel=declared.panel or None,
        min=declared.least,
        max=declared.most,
        metavar=declared.metavar or None,
    )
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[hint, asked])


def _chosen_parameters(kinds: Iterable[Any], taken: set[str]) -> tuple[list[inspect.Parameter], list[str]]:
    """Return the parameters of all choices of options, and a line for each that has the name of another.

    An option that one choice inherits from another is the same for both.
    """
    chosen: dict[str, tuple[Option, inspect.Parameter]] = {}
    clashes = []
    for registry, by in (pair for kind in kinds for pair in _registries(kind)):
        for choice, settings in _choices(registry).items():
            for field, hint, declared in _declared(type(settings)):
                if declared is None:
                    continue
                name = parameter_name(field.name, declared)
                if name in taken or (name in chosen and chosen[name][0] is not declared):
                    clashes.append(f"--{by} {choice}: {option_name(field)} is also an option of something else")
                chosen.setdefault(name, (declared, _parameter(field, hint, declared, getattr(settings, field.name))))
    return [parameter for name, (_, parameter) in chosen.items() if name not in taken], clashes


def _registries(kind: Any) -> Iterator[tuple[Registry[Any], str]]:
    """Yield the declarations by `options.options_of` in a settings dataclass and those inside it."""
    for field, hint, declared in _declared(kind):
        if CHOSEN in field.metadata:
            yield field.metadata[CHOSEN]
        elif declared is None and is_dataclass(hint):
            yield from _registries(hint)


def _choices(registry: Registry[Any]) -> dict[str, Any]:
    """Return the settings objects of a registry. One that cannot be loaded is an error only where it is chosen."""
    choices = {}
    for name in registry:
        with suppress(UserInputError):
            choices[name] = registry[name]
    return choices


def _build(kind: Any, arguments: dict[str, Any]) -> Any:
    """Make an instance from a command's arguments, and remove these from `arguments`."""
    values: dict[str, Any] = {}
    for field, hint, declared in _declared(kind):
        if declared is not None:
            values[field.name] = arguments.pop(parameter_name(field.name, declared))
        elif CHOSEN in field.metadata:
            registry, by = field.metadata[CHOSEN]
            values[field.name] = _build_chosen(registry, by, values[by], arguments)
        elif is_dataclass(hint):
            values[field.name] = _build(hint, arguments)
    return kind(**values)


def _build_chosen(registry: Registry[Any], by: str, name: str, arguments: dict[str, Any]) -> Any:
    """Make the settings object of a choice, and remove the arguments of all choices.

    Raises:
        UserInputError: an unknown choice, or an option of another one.
    """
    kind, values = type(registry[name]), {}
    owners: dict[str, list[str]] = {}
    defaults: dict[str, Any] = {}
    for choice, settings in _choices(registry).items():
        for field, _, declared in _declared(type(settings)):
            if declared is not None:
                parameter = parameter_name(field.name, declared)
                owners.setdefault(parameter, []).append(choice)
                defaults.setdefault(parameter, getattr(settings, field.name))
                if choice == name:
                    values[field.name] = arguments[parameter]
    for parameter, choices in owners.items():
        value, shown = arguments.pop(parameter), parameter.replace("_", "-")
        if name not in choices and value != defaults[parameter]:
            raise UserInputError(
                f"--{shown} {value} with --{by} {name}: an option of --{by} {' and '.join(choices)}; leave it out"
            )
    return kind(**values)


def chosen_options(context: typer.Context) -> set[str]:
    """Return the names of the parameters that the command line or a settings file sets."""
    sources: Mapping[str, Any] = {name: context.get_parameter_source(name) for name in context.params}
    return {name for name, source in sources.items() if getattr(source, "name", "") in ("COMMANDLINE", "DEFAULT_MAP")}
