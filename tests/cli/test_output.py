"""Test how wide the output of commands is on a terminal and in a file."""

from __future__ import annotations

import pytest
from rich.table import Table

from lapgs_plugin.cli.output import make_console

WORDS = "word " * 40 + "end"


@pytest.mark.parametrize(
    ("environment", "lines"),
    [({}, 2), ({"COLUMNS": "60"}, 8), ({"COLUMNS": "60", "FORCE_COLOR": "1"}, 8)],
    ids=["file", "file-with-columns", "terminal"],
)
def test_lines_are_wrapped_for_terminals_alone(
    environment: dict[str, str], lines: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("COLUMNS", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    table = Table.grid()
    table.add_row(WORDS)
    console = make_console()
    console.print(WORDS)
    console.print(table)
    shown = capsys.readouterr().out.splitlines()
    assert " ".join(" ".join(shown).split()) == f"{WORDS} {WORDS}"
    assert len(shown) == lines
