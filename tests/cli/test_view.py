"""Test `lapgs view` until it serves: its messages and refusals."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from lapgs_plugin.cli.view import view
from lapgs_plugin.errors import LapgsError, MissingExtraError, RunFolderError, UserInputError
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_run, write_scene
from tests.refusals import refuses
from tests.viewer.pages import statuses

viser = pytest.importorskip("viser", reason="needs the extra 'viewer'")

from lapgs_plugin.viewer.page import free_port  # noqa: E402  # needs viser
from lapgs_plugin.viewer.viewer import Viewer  # noqa: E402

app = typer.Typer()
app.command("view")(view)
lapgs_view = succeeding(app, columns=200)


@pytest.fixture(autouse=True)
def _ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop the viewer as soon as it serves."""
    monkeypatch.setattr(Viewer, "serve", lambda self, **_: None)


def test_it_says_how_to_reach_it_and_takes_the_next_port(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        output = lapgs_view(run, "--port", port)
    assert f"port {port} is taken, using {port + 1}" in output
    assert f"open http://localhost:{port + 1} in a browser" in output
    assert free_port("127.0.0.1", port) == port  # nothing listens any more


def test_a_run_still_being_written_shows_what_is_finished(scene: Path, tmp_path: Path) -> None:
    output = lapgs_view(write_run(tmp_path / "run", scene, finished=1))
    assert "run is not complete: showing level 1 of 2" in output
    assert "showing level nothing of 2" in lapgs_view(write_run(tmp_path / "none", scene, finished=0))


def test_a_run_without_its_scene_is_shown_without_cameras(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    run = write_run(tmp_path / "run", scene)
    shutil.rmtree(scene)
    assert "without the scene's cameras" in lapgs_view(run)
    refuses(LapgsError, "no such scene folder", lapgs_view, run, "--scene", tmp_path / "nowhere")


def test_a_missing_or_truncated_level_is_said_and_the_coarser_ones_are_shown(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene)
    ply = run / "level_0" / "point_cloud.ply"
    ply.write_bytes(ply.read_bytes()[:-1000])
    output = lapgs_view(run)
    assert re.search(r"level 0 of .* is damaged: .* cut short .*; showing level 1 of 2", output), output
    ply.unlink()
    assert re.search(r"level 0 of .* is missing: .*; showing level 1 of 2", lapgs_view(run))
    (run / "level_1" / "point_cloud.ply").unlink()
    refuses(RunFolderError, r"level 1 of .* is missing", lapgs_view, run)


def test_a_foreign_page_may_not_look(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = []

    def ask(self: Viewer, **_: object) -> None:
        answers.extend(statuses(self._page.address))

    monkeypatch.setattr(Viewer, "serve", ask)
    lapgs_view(write_run(tmp_path / "run", scene))
    lapgs_view(write_run(tmp_path / "other", scene), "--host", "0.0.0.0")
    assert answers == [200, 403, 403] * 2


def test_an_address_of_another_machine_is_refused(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match=r"--host 192\.0\.2\.1: cannot listen there"):
        lapgs_view(write_run(tmp_path / "run", scene), "--host", "192.0.2.1")


def test_without_viser_it_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lapgs_plugin.errors.find_spec", lambda name: None)
    refuses(MissingExtraError, r"lapgs_plugin\[viewer\]", lapgs_view, tmp_path)


def test_a_folder_that_is_no_run_is_refused_before_anything_is_served(tmp_path: Path) -> None:
    refuses(RunFolderError, r"nowhere does not exist, so it is not a run", lapgs_view, tmp_path / "nowhere")


def test_the_page_is_served_without_torch() -> None:
    """Browsers load the page while the process still imports the renderer."""
    code = "import sys; import lapgs_plugin.viewer.page, lapgs_plugin.cli.view; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_crop_is_shown_by_its_edges(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[object] = []
    monkeypatch.setattr(
        viser.SceneApi, "add_line_segments", lambda _, name, points, *__, **___: shown.append(points.shape)
    )
    run = write_run(tmp_path / "run", scene)
    lapgs_view(run)
    assert shown == []
    lapgs_view(run, "--crop", "-1,-1,-1,1,1,1")
    assert shown == [(12, 2, 3)]
    refuses(UserInputError, "--crop 1: expected six numbers", lapgs_view, run, "--crop", "1")
