"""`lapgs train --view`: its messages, its refusals before anything is written, and the port that it frees."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import pytest
import typer

from lapgs_plugin.cli.run import CONTEXT, run
from lapgs_plugin.cli.train import train
from lapgs_plugin.errors import MissingExtraError, UserInputError
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_scene
from tests.contract.stub_runs import STUBS

pytest.importorskip("viser", reason="needs the extra 'viewer'")

app = typer.Typer()
app.command("train")(train)
app.command("run", context_settings=CONTEXT)(run)
lapgs = succeeding(app, columns=200)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"), size=(128, 96))


def test_training_without_a_browser(scene: Path, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        output = lapgs("train", scene, "-o", tmp_path / "run", "--iterations", 6, "--view", "--view-port", port)
    assert f"port {port} is taken, using {port + 1}" in output
    assert f"open http://localhost:{port + 1} in a browser; it shows the run while it is trained" in output
    records = json.loads((tmp_path / "run" / "manifest.json").read_text())["records"]
    assert len(records) == 2
    assert not any("view" in record["overhead_seconds"] for record in records)
    with socket.create_server(("127.0.0.1", port + 1)):
        pass  # nothing listens any more


def test_mistakes_come_before_the_run_folder(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserInputError, match="--view-port 8123 needs --view"):
        lapgs("train", scene, "-o", tmp_path / "run", "--view-port", 8123)
    with pytest.raises(UserInputError, match="--view has no effect with --off"):
        lapgs("run", "--off", "--view", "--device", "cpu", STUBS["graphdeco"].script)
    monkeypatch.setattr("lapgs_plugin.errors.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"--view needs viser.*lapgs_plugin\[viewer\]"):
        lapgs("train", scene, "-o", tmp_path / "run", "--view")
    assert not (tmp_path / "run").exists()
