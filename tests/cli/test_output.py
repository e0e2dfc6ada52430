"""Test how wide the output of commands is on a terminal and in a file, and which command comes next."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from PIL import Image
from rich.table import Table
from typer.testing import CliRunner

from lapgs_plugin.cli import prepare
from lapgs_plugin.cli.app import app
from lapgs_plugin.cli.output import make_console
from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.training import backend
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_run, write_scene
from tests.refusals import refuses

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


@pytest.mark.parametrize(
    ("size", "rasterizer", "options"),
    [
        ((1600, 1200), "cpu", " --resolution 1/4 --iterations 3000"),
        ((160, 120), "cpu", ""),
        ((1600, 1200), "gsplat", ""),
        ((1600, 1200), MissingExtraError("a GPU without gsplat"), ""),
    ],
    ids=["cpu", "small-photos", "gpu", "gpu-that-needs-a-package"],
)
def test_prepare_proposes_a_training_that_this_machine_can_do(
    size: tuple[int, int],
    rasterizer: str | MissingExtraError,
    options: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def choose(name: str) -> str:
        if isinstance(rasterizer, MissingExtraError):
            raise rasterizer
        return rasterizer

    monkeypatch.setattr(backend, "choose_rasterizer", choose)
    monkeypatch.chdir(tmp_path)
    Path("desk/images/left").mkdir(parents=True)
    for index in range(25):
        Image.new("L", size).save(f"desk/images/left/{index}.png")
    command = prepare.next_command(Path("desk"))
    assert command == f"lapgs train desk -o runs/desk --eval{options}"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("train desk -o runs/desk", "desk: no such scene folder; "),
        ("train empty -o runs/desk", "empty: neither a COLMAP model "),
        ("train run -o runs/desk", "run is a run, expected a scene; "),
        ("train desk -o full", "full is not empty and not a run "),
        ("train desk -o full/train.py/x", "--out full/train.py/x: full/train.py is a file; "),
        ("train desk -o /proc/run", "--out /proc/run"),
        ("run --device cpu full/train.py", "full/train.py is not the training script "),
        ("eval runs/desk", "runs/desk does not exist, "),
        ("render empty", "empty has no manifest.json, .* `lapgs run`; .* `lapgs import-run` "),
        ("view empty", "empty has no manifest.json, "),
    ],
)
def test_messages_name_folders_as_they_were_typed(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("empty", "full", "run"):
        Path(folder).mkdir()
    Path("run/manifest.json").write_text("{}")
    Path("full/train.py").write_text("import json\n")
    refuses(UserInputError, f"^{message}", succeeding(app, 120), *words.split())


ODD = "r\x1b]0;title\n\x07\udcff[b]"
"""A name with a control sequence, a line break, a byte that is no UTF-8, and markup of rich."""


@pytest.mark.parametrize(
    "command",
    [
        "eval",
        "export",
        "export --html",
        "render",
        "report",
        "report --baseline {run}",
        "train {scene} --iterations 2 --levels 1 --overwrite -o",
    ],
)
def test_names_reach_the_terminal_as_escapes_on_success_too(command: str, tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "s\x1b[31m")
    run = write_run(tmp_path / ODD, scene, levels=1)
    name, *options = (word.format(run=run, scene=scene) for word in command.split(" "))
    words = [name, str(run), *options] if name != "train" else [name, *options, str(run)]
    result = CliRunner(charset="utf-8").invoke(app, words)
    assert result.exit_code == 0, result.output
    assert r"r\x1b]0;title\n\x07\udcff[b]" in result.output.replace("\n", "")
    assert RunArchive.open(run).name == r"r\x1b]0;title\n\x07\udcff[b]"  # on pages, too
    assert not re.search("[\x00-\x09\x0b-\x1f\udcff]", result.output)
