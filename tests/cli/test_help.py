"""`--help` of every command: fast to load, and readable."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from itertools import pairwise
from typing import Any

import pytest
from typer.testing import CliRunner

from lapgs_plugin.cli.app import all_commands, app

HEAVY = ("torch", "numba", "numpy", "pycolmap", "OpenImageIO", "gsplat", "cv2", "viser")


def _commands() -> list[list[str]]:
    """Words of every command, groups included."""
    names: list[list[str]] = [[]]

    def visit(command: Any, words: list[str]) -> None:
        for name, below in getattr(command, "commands", {}).items():
            names.append([*words, name])
            visit(below, [*words, name])

    visit(all_commands(), [])
    return names


COMMANDS = _commands()

SCRIPT = """
import json, sys
from typer.testing import CliRunner
from lapgs_plugin.cli.app import all_commands, app
codes = [CliRunner().invoke(app, [*words, "--help"]).exit_code for words in json.loads(sys.argv[1])]
print(json.dumps({"codes": codes, "modules": sorted(sys.modules)}))
"""


def test_help_of_all_commands_imports_nothing_heavy() -> None:
    arguments = [sys.executable, "-c", SCRIPT, json.dumps(COMMANDS)]
    shown = json.loads(subprocess.run(arguments, capture_output=True, text=True, check=True).stdout)
    assert len(COMMANDS) >= 20
    assert shown["codes"] == [0] * len(COMMANDS)
    assert "typer" in shown["modules"]
    assert not set(HEAVY) & set(shown["modules"])


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_first_line_is_a_sentence_and_every_option_is_described(words: list[str]) -> None:
    command: Any = all_commands()
    for word in words:
        command = command.commands[word]
    first = command.help.split("\n\n")[0].replace("\n", " ")
    assert first[0].isupper()
    assert first.endswith(".")
    assert len(first) <= 110
    described = [parameter for parameter in command.params if parameter.name not in ("help", "install_completion")]
    assert [parameter.name for parameter in described if not parameter.help] == []
    shown = CliRunner(env={"COLUMNS": "200"}).invoke(app, [*words, "--help"]).output
    assert first in " ".join(shown.split())


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_paragraphs_fill_the_lines_of_a_terminal_and_examples_take_one_each(words: list[str]) -> None:
    shown = CliRunner(env={"COLUMNS": "80"}).invoke(app, [*words, "--help"]).output
    paragraphs = re.split(r"\n *\n", shown.split("╭")[0])
    assert len(paragraphs) > 2  # usage, help text
    for paragraph in paragraphs:
        lines = [line.strip() for line in paragraph.splitlines() if line.strip()]
        for line, following in pairwise(lines):
            assert "lapgs " not in line[:6], f"an example that does not fit: {line} {following}"
            assert len(line) + 1 + len(following.split()[0]) > 78, line


def test_options_that_train_and_run_share_come_in_the_same_order() -> None:
    commands = all_commands()
    train, run = ([option.name for option in commands.commands[name].params] for name in ("train", "run"))
    shared = [name for name in train if name in run and name != "rasterizer"]  # which asks each command something else
    assert "resume" in shared
    assert [name for name in run if name in shared] == shared
