"""Commands that installed packages add through the entry point group `lapgs.commands`."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lapgs_bench.app import app as bench
from lapgs_plugin.cli.app import INSTALLED, app
from lapgs_plugin.cli.help_texts import module_summary
from lapgs_plugin.errors import UserInputError
from tests.plugin_package import install_package
from tests.refusals import refuses

ENTRIES = """\
[lapgs.commands]
greet = tiny_command:app
train = tiny_command:app
absent = tiny_command:ABSENT
number = tiny_command:NUMBER
empty = tiny_command:EMPTY
told = tiny_command:TOLD
gone = tiny_gone.app:app
"""
SOURCE = '''\
"""Greet [/whom] you name."""
import typer
from lapgs_plugin.errors import UserInputError
app, NUMBER = typer.Typer(), 3
@app.command()
def greet(name: str, loudly: bool = False) -> None:
    """Say hello,
    and no more."""
    if not name.isalpha():
        raise UserInputError(f"NAME {name}: expected letters")
    print("HELLO" if loudly else "hello", name)
EMPTY, TOLD = typer.Typer(), typer.Typer()
TOLD.command(help="Told\\nhere.")(lambda: None)
'''


@pytest.fixture(autouse=True)
def _package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_package(tmp_path, monkeypatch, "tiny_command", ENTRIES, SOURCE)
    monkeypatch.delitem(sys.modules, "tiny_command", raising=False)


def lapgs(*words: str) -> str:
    result = CliRunner(env={"COLUMNS": "100"}).invoke(app, words)
    if isinstance(result.exception, UserInputError):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.stdout


def test_the_list_of_commands_reads_their_sources_and_imports_none() -> None:
    shown = lapgs("--help")
    assert "tiny_command" not in sys.modules
    assert "Greet [/whom] you name." in shown
    assert "Run an experiment, or benchmark one part of the package." in shown
    assert "tiny_gone.app" in shown, "a module that is not there is named"


def test_a_command_is_called_by_its_name() -> None:
    assert lapgs("greet", "Ada", "--loudly") == "HELLO Ada\n"
    shown = lapgs("greet", "--help")
    assert "Say hello, and no more." in shown, "paragraphs flow"
    assert "completion" not in shown
    assert "Told here." in lapgs("told", "--help")
    refuses(UserInputError, "NAME 1: expected letters", lapgs, "greet", "1")
    refuses(UserInputError, "no such option: --loud", lapgs, "greet", "Ada", "--loud")


def test_names_of_this_package_cannot_be_taken() -> None:
    assert "SCENE" in lapgs("train", "--help")
    assert "tiny_command" not in sys.modules


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("absent", "tiny_command:ABSENT cannot be loaded: AttributeError"),
        ("number", "tiny_command:NUMBER is a int, expected an instance of Typer"),
        ("empty", "tiny_command:EMPTY is no command (RuntimeError: Could not get a command"),
        ("gone", "tiny_gone.app:app cannot be loaded: ModuleNotFoundError"),
        ("gret", "no such command 'gret'. Did you mean 'greet'"),
    ],
)
def test_a_command_that_cannot_be_called_is_one_line(name: str, problem: str) -> None:
    with pytest.raises(UserInputError) as caught:
        lapgs(name, "Ada")
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bench_is_such_a_command() -> None:
    assert INSTALLED["bench"] is bench


@pytest.mark.parametrize(
    ("source", "line"),
    [(SOURCE, r"Greet \[/whom] you name."), ("x = 1", "tiny_command"), ("def", "tiny_command"), ("", "tiny_command")],
)
def test_the_summary_of_a_module(source: str, line: str, tmp_path: Path) -> None:
    (tmp_path / "tiny_command.py").write_text(source)
    assert module_summary("tiny_command") == line
