"""Numbers and paths that make no sense: one line, exit code 2, and nothing written."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import LapgsError

LONG = "n" * 300
HUGE = "1000000000000000000"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("bench raster --sizes 0x0", "--sizes '0x0': expected one of"),
        ("bench raster --sizes=-1x5/3", "--sizes '-1x5/3': expected one of"),
        ("bench raster --sizes nan", "--sizes 'nan': expected one of"),
        ("bench raster --sizes 1000000x1000000/5", "expected at most 8192x8192 pixels"),
        (f"bench raster --sizes 64x48/{HUGE}", "10000000 Gaussians"),
        (f"bench raster --sizes {HUGE}{HUGE}x1/1", "expected one of"),
        ("bench raster --repeats 0", "Invalid value for '--repeats'"),
        (f"bench raster --repeats {HUGE}", "Invalid value for '--repeats'"),
        ("bench raster --repeats inf", "Invalid value for '--repeats'"),
        ("bench raster --json file/x", "--json file/x: expected a file in a folder that exists"),
        ("bench raster --json folder", "--json folder: expected a file in a folder that exists"),
        ("bench raster --json nowhere/x", "--json nowhere/x: expected a file in a folder that exists"),
        (f"bench raster --json {LONG}", "expected a file in a folder that exists"),
        (f"bench raster --json {LONG}/x", "expected a file in a folder that exists"),
        ("bench raster --dtype float16", "--dtype float16: expected float32 or float64"),
        ("conformance --rasterizer nothing", "--rasterizer nothing: expected one that this machine can run"),
        ("doctor 5", "unexpected extra argument"),
        ("sample s --size 0x0", "--size 0x0: expected at least 16x16"),
        ("sample s --size=-1x4", "--size '-1x4': expected WIDTHxHEIGHT"),
        ("sample s --size 99999x99999", "--size 99999x99999: expected at most 8192x8192"),
        ("sample s --views 0", "--views 0: expected 2 to 9999"),
        (f"sample s --views {HUGE}", "expected 2 to 9999"),
        ("sample s --views nan", "Invalid value for '--views'"),
        ("sample s --points -5", "--points -5: expected at least 1"),
        (f"sample s --points {HUGE}", "expected at most 1000000"),
        ("sample s --points inf", "Invalid value for '--points'"),
        ("sample s --seed -1", "--seed -1: expected 0 or more"),
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
    result = CliRunner(env={"COLUMNS": "300"}).invoke(app, words.split(" "))
    if isinstance(result.exception, LapgsError):
        assert result.exception.exit_code == 2
        assert "\n" not in str(result.exception)
        assert expected in str(result.exception)
    else:  # what typer says of a word that is no such number
        assert result.exit_code == 2, result.exception
        assert expected in result.output
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "folder"]
