"""Commands made from settings dataclasses, on dataclasses of the test's own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

import pytest
import typer
from typer.testing import CliRunner, Result

from lapgs_plugin.cli.bridge import chosen_options, takes_settings
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.options import option, option_values, parameter_name


@dataclass(frozen=True)
class Schedule:
    """Nested in `Settings`."""

    max_steps: int = option(100, "Steps to take.", least=1, most=1000)
    rates: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Settings:
    """Take all kinds of options."""

    accumulate: int = option(2, "Views a step.", names=("--accumulate-views", "--gather"))
    half: bool = option(False, "Use half precision.")
    fast: bool = option(True, "Be fast.", names=("--fast/--slow",))
    decay: float | None = option(None, "Decay rate.", panel="Optimizer", least=0.0)
    schedule: Schedule = field(default_factory=Schedule)
    secret: int = 7

    def __post_init__(self) -> None:
        if self.accumulate == 13:
            raise UserInputError(f"--accumulate-views {self.accumulate}: expected another number")


@dataclass(frozen=True)
class Extra:
    """A second settings object of the same command."""

    name: str = option("none", "A name.")


CALLS: list[dict[str, Any]] = []
APP = typer.Typer()


@APP.command()
@takes_settings
def work(
    context: typer.Context,
    target: Annotated[str, typer.Argument(help="What to work on.")],
    settings: Settings,
    extra: Extra,
    plain: Annotated[int, typer.Option(help="Declared in the signature.")] = 3,
) -> None:
    """Work on TARGET."""
    names = chosen_options(context)
    CALLS.append({"target": target, "settings": settings, "extra": extra, "plain": plain, "given": names})


def _run(*words: str) -> Result:
    CALLS.clear()
    return CliRunner(env={"COLUMNS": "200"}).invoke(APP, list(words))


def _called(*words: str) -> dict[str, Any]:
    result = _run(*words)
    assert result.exit_code == 0, result.output
    (call,) = CALLS
    return call


def test_defaults_are_those_of_the_dataclasses() -> None:
    assert _called("it") == {"target": "it", "settings": Settings(), "extra": Extra(), "plain": 3, "given": {"target"}}


def test_options_reach_their_fields_in_nested_dataclasses_too() -> None:
    words = "it --accumulate-views 5 --half --slow --decay 0.5 --max-steps 7 --name x --plain 4"
    call = _called(*words.split())
    assert call["settings"] == Settings(accumulate=5, half=True, fast=False, decay=0.5, schedule=Schedule(max_steps=7))
    assert (call["extra"], call["plain"]) == (Extra("x"), 4)
    assert call["given"] == {"target", "accumulate_views", "half", "fast", "decay", "max_steps", "name", "plain"}


def test_old_names_set_the_same_field() -> None:
    call = _called("it", "--gather", "6")
    assert call["settings"].accumulate == 6
    assert call["given"] == {"target", "accumulate_views"}


@pytest.mark.parametrize("word", ["--no-half", "--secret", "--schedule", "--rates", "--accumulate"])
def test_only_declared_options_exist(word: str) -> None:
    result = _run("it", word, "1")
    assert result.exit_code == 2
    assert "No such option" in result.output
    assert CALLS == []


@pytest.mark.parametrize("words", [("--max-steps", "0"), ("--max-steps", "1001"), ("--decay", "-0.1")])
def test_bounds_are_checked(words: tuple[str, str]) -> None:
    result = _run("it", *words)
    assert result.exit_code == 2
    assert words[0] in result.output
    assert CALLS == []


def test_bounds_are_accepted() -> None:
    assert _called("it", "--max-steps", "1", "--decay", "0")["settings"].schedule.max_steps == 1
    assert _called("it", "--max-steps", "1000")["settings"].schedule.max_steps == 1000


def test_errors_of_a_dataclass_come_through() -> None:
    result = _run("it", "--accumulate-views", "13")
    assert isinstance(result.exception, UserInputError)
    assert str(result.exception) == "--accumulate-views 13: expected another number"


def test_help_shows_names_defaults_bounds_and_panels() -> None:
    lines = [line.strip("│ ") for line in _run("--help").output.splitlines()]

    def line(name: str) -> str:
        (row,) = (line for line in lines if line.startswith(name))
        return row

    assert "Work on TARGET." in lines
    assert "--gather" in line("--accumulate-views")
    assert "Views a step. [default: 2]" in line("--accumulate-views")
    assert "Steps to take." in line("--max-steps")
    assert "[default: 100]" in line("--max-steps")
    assert "1<=x<=1000" in line("--max-steps")
    assert "--slow" in line("--fast")
    assert "default" not in line("--decay")
    assert any("Optimizer" in line for line in lines)


def test_the_command_keeps_its_name_and_documentation() -> None:
    assert (work.__name__, work.__doc__) == ("work", "Work on TARGET.")
    assert "accumulate_views" in work.__annotations__


def test_values_and_names_of_options_match_the_command_line() -> None:
    assert option_values(Settings(accumulate=4)) == {
        "accumulate_views": 4,
        "half": False,
        "fast": True,
        "decay": None,
        "max_steps": 100,
    }
    declared = Settings.__dataclass_fields__["fast"].metadata["option"]
    assert parameter_name("fast", declared) == "fast"
