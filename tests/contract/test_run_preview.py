"""Test that `lapgs run` leaves the picture that `lapgs view` shows first."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from lapgs_plugin.viewer.preview import read_preview
from tests.contract.stub_runs import STUBS, arguments


def test_a_finished_run_has_a_picture(scene: Path, tmp_path: Path) -> None:
    stub = STUBS["graphdeco"]
    words = ["run", "--device", "cpu", stub.script, *arguments(stub, scene, tmp_path / "run")]
    command = [sys.executable, "-c", "from lapgs_plugin.cli import main; main()", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert read_preview(tmp_path / "run") is not None
