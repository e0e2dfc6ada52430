"""Numbers and paths that make no sense: one line, exit code 2, and nothing written."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lapgs_plugin.cli.app import app, run
from lapgs_plugin.errors import LapgsError

LONG = "n" * 300
HUGE = "1000000000000000000"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("bench raster --sizes 0x0", "--sizes '0x0': expected one of"),
        ("bench raster --sizes 1000000x1000000/5", "expected at most 8192x8192 pixels"),
        (f"bench raster --sizes 64x48/{HUGE}", "10000000 Gaussians"),
        (f"bench raster --sizes {HUGE}{HUGE}x1/1", "expected one of"),
        ("bench ops --width 2", "--width 2: expected at least 3"),
        (f"bench raster --repeats {HUGE}", f"--repeats {HUGE}: expected at most 1000"),
        ("bench raster --repeats inf", "--repeats inf: expected a valid integer"),
        ("bench raster --json folder", "--json folder: expected a file in a folder that exists"),
        ("bench raster --json nowhere/x", "--json nowhere/x: expected a file in a folder that exists"),
        (f"bench raster --json {LONG}", "expected a file in a folder that exists"),
        ("bench raster --dtype float16", "--dtype float16: expected float32 or float64"),
        ("conformance --rasterizer nothing", "--rasterizer nothing: expected one that this machine can run"),
        ("doctor 5", "expected the root of a 3DGS checkout"),
        ("sample s --size=-1x4", "--size '-1x4': expected WIDTHxHEIGHT"),
        (f"sample s --views {HUGE}", "expected 2 to 9999"),
        ("sample s --views nan", "--views nan: expected a valid integer"),
        (f"sample s --points {HUGE}", "expected at most 1000000"),
        ("sample s --points inf", "--points inf: expected a valid integer"),
        ("sample file", "file: a file, expected a folder or a new name"),
        ("sample file/x", "the scene cannot be written"),
        (f"sample {LONG}", "the scene cannot be written"),
        ("patch status nowhere", "nowhere: no such folder"),
        ("patch apply file", "file: no such folder"),
        (f"patch revert {LONG}", "no such folder"),
        ("patch apply folder", "no rasterizer that is known in this folder"),
    ],
)
def test_one_line_and_nothing_written(
    words: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(app, words.split(" "))
    assert isinstance(result.exception, LapgsError), result.output
    assert result.exception.exit_code == 2
    assert "\n" not in str(result.exception)
    assert expected in str(result.exception)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder"]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("train", "lapgs: missing argument 'SCENE'; see `lapgs train --help`"),
        ("train scene", "lapgs: missing option '--out' / '-o'; see `lapgs train --help`"),
        ("train scene --out", "lapgs: option '--out' requires an argument; see `lapgs train --help`"),
        ("bench raster --repeats 0", "lapgs: --repeats 0: expected at least 1; see `lapgs bench raster --help`"),
        ("view run --nothing 1", "lapgs: no such option: --nothing; see `lapgs view --help`"),
        ("nothing", "lapgs: no such command 'nothing'; see `lapgs --help`"),
        ("trian", "lapgs: no such command 'trian'. Did you mean 'train'? See `lapgs --help`"),
        ("--nothing", "lapgs: no such option: --nothing; see `lapgs --help`"),
        (
            "train s -o r --exposure on",
            "lapgs: no such option: --exposure; give --appearance (none, affine or bilateral; before: off, on)",
        ),
        (
            "run --iterations 60 train.py -s scene",
            "lapgs: no such option: --iterations; options of the script go after it, see `lapgs run --help`",
        ),
        ("patch nothing", "lapgs: no such command 'nothing'; see `lapgs patch --help`"),
    ],
)
def test_usage_errors_are_one_line_with_exit_code_2(
    words: str, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["lapgs", *words.split(" ")])
    with pytest.raises(SystemExit) as ended:
        run()
    assert ended.value.code == 2
    assert tuple(capsys.readouterr()) == ("", f"{line}\n")


@pytest.mark.parametrize("command", ["report", "view", "render"])
def test_a_second_run_is_told_its_option(command: str) -> None:
    error = CliRunner().invoke(app, [command, "one", "other"]).exception
    assert isinstance(error, LapgsError)
    assert ("(other); expected one run" in str(error)) == (command != "render")
    assert f"lapgs {command} {'--help' if command == 'render' else 'RUN --baseline OTHER'}" in str(error)


@pytest.mark.parametrize("words", [[], ["bench"], ["patch"]])
def test_a_group_without_arguments_shows_its_help(words: list[str]) -> None:
    result = CliRunner().invoke(app, words)
    assert "Usage:" in result.output
    assert "Commands" in result.output
