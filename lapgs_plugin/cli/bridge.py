"""Make commands from dataclasses whose fields are declared as options (`lapgs_plugin.options`)."""

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

    `--help` lists them in the order of the command's parameters. The command is called with an instance, which checks
    its values when it is made. Fields without a declaration keep their defaults, unless they are settings dataclasses
    themselves: these add their options. A field declared with `options.options_of` adds the options of everything that
    can be chosen there, at the end.
    """
    signature = inspect.signature(command, eval_str=True)
    settings = {name: each.annotation for name, each in signature.parameters.items() if is_dataclass(each.annotation)}
    own: list[inspect.Parameter] = []
    for name, each in signature.parameters.items():
        own.extend(_parameters(settings[name]) if name in settings else [each])
    added, clashes = _chosen_parameters(settings.values(), {each.name for each in own})

    @functools.wraps(command)
    def call(**given: Any) -> Any:
        if clashes:
            raise UserInputError(f"{clashes[0]}; fix or uninstall the package that brings it")
        made = {name: _build(kind, given) for name, kind in settings.items()}
        return command(**given, **made)

    keyword_only = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in (*own, *added)]
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
    """Make the parameters of a settings dataclass and those inside it."""
    for each, hint, declared in _declared(kind):
        if declared is not None:
            default = each.default_factory() if each.default_factory is not MISSING else each.default
            yield _parameter(each, hint, declared, default)
        elif is_dataclass(hint) and CHOSEN not in each.metadata:
            yield from _parameters(hint)


def _parameter(each: Field[Any], hint: Any, declared: Option, default: Any) -> inspect.Parameter:
    name = parameter_name(each.name, declared)
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
    """Make the parameters of everything that an option can choose, and say which have the name of another.

    An option that one choice inherits from another is the same for both.
    """
    found: dict[str, tuple[Option, inspect.Parameter]] = {}
    clashes = []
    for registry, by in (chosen for kind in kinds for chosen in _registries(kind)):
        for choice, settings in _choices(registry).items():
            for each, hint, declared in _declared(type(settings)):
                if declared is None:
                    continue
                name = parameter_name(each.name, declared)
                if name in taken or (name in found and found[name][0] is not declared):
                    clashes.append(f"--{by} {choice}: {option_name(each)} is also an option of something else")
                found.setdefault(name, (declared, _parameter(each, hint, declared, getattr(settings, each.name))))
    return [parameter for name, (_, parameter) in found.items() if name not in taken], clashes


def _registries(kind: Any) -> Iterator[tuple[Registry[Any], str]]:
    """Find what `options.options_of` declares in a settings dataclass and those inside it."""
    for each, hint, declared in _declared(kind):
        if CHOSEN in each.metadata:
            yield each.metadata[CHOSEN]
        elif declared is None and is_dataclass(hint):
            yield from _registries(hint)


def _choices(registry: Registry[Any]) -> dict[str, Any]:
    """Return the settings objects of a registry. One that cannot be loaded is an error only where it is chosen."""
    found = {}
    for name in registry:
        with suppress(UserInputError):
            found[name] = registry[name]
    return found


def _build(kind: Any, given: dict[str, Any]) -> Any:
    """Make an instance from a command's arguments, and remove these from `given`."""
    values: dict[str, Any] = {}
    for each, hint, declared in _declared(kind):
        if declared is not None:
            values[each.name] = given.pop(parameter_name(each.name, declared))
        elif CHOSEN in each.metadata:
            registry, by = each.metadata[CHOSEN]
            values[each.name] = _build_chosen(registry, by, values[by], given)
        elif is_dataclass(hint):
            values[each.name] = _build(hint, given)
    return kind(**values)


def _build_chosen(registry: Registry[Any], by: str, name: str, given: dict[str, Any]) -> Any:
    """Make the settings object of a choice, and take the arguments of all choices out.

    Raises:
        UserInputError: an unknown choice, or an option of another one.
    """
    kind, values = type(registry[name]), {}
    owners: dict[str, list[str]] = {}
    defaults: dict[str, Any] = {}
    for choice, settings in _choices(registry).items():
        for each, _, declared in _declared(type(settings)):
            if declared is not None:
                parameter = parameter_name(each.name, declared)
                owners.setdefault(parameter, []).append(choice)
                defaults.setdefault(parameter, getattr(settings, each.name))
                if choice == name:
                    values[each.name] = given[parameter]
    for parameter, choices in owners.items():
        value, shown = given.pop(parameter), parameter.replace("_", "-")
        if name not in choices and value != defaults[parameter]:
            raise UserInputError(
                f"--{shown} {value} with --{by} {name}: an option of --{by} {' and '.join(choices)}; leave it out"
            )
    return kind(**values)


def given_options(context: typer.Context) -> set[str]:
    """Return the parameters that were given on the command line or in a settings file."""
    sources: Mapping[str, Any] = {name: context.get_parameter_source(name) for name in context.params}
    given = {"COMMANDLINE", "DEFAULT_MAP"}
    return {name for name, source in sources.items() if source is not None and source.name in given}
