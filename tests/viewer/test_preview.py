"""Test the preview: its content, who receives it, and when it ends."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from lapgs_plugin.files import PREVIEW
from lapgs_plugin.rendering.run import run_cameras, run_renderer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.viewer.preview import SIZE, crop_to_aspect, read_preview, save_run_preview
from tests.cli.run_folder import write_run, write_scene

pytest.importorskip("viser", reason="needs the extra 'viewer'")

from lapgs_plugin.rendering.options import RenderOptions
from lapgs_plugin.viewer.following import FollowedRun, RunFollower
from lapgs_plugin.viewer.page import Page
from lapgs_plugin.viewer.viewer import Viewer
from tests.viewer.wire import WireClient, wire_client
from tests.waiting import wait_for as wait_so_long

PATIENCE = 20.0
wait_for = partial(wait_so_long, seconds=PATIENCE)
WINDOW = (320, 240)

# Blocks the import of torch until a file exists.
COMMAND = """
import builtins, sys, time
from pathlib import Path
gate, plain = Path(sys.argv.pop()), builtins.__import__
def gated(name, *rest, **named):
    while name.split(".")[0] == "torch" and not gate.exists():
        time.sleep(0.01)
    return plain(name, *rest, **named)
builtins.__import__ = gated
from lapgs_plugin.cli import main
main()
"""


def decoded(jpeg: bytes) -> NDArray[np.float64]:
    return np.asarray(Image.open(io.BytesIO(jpeg)), np.float64)


def test_the_preview_shows_the_first_camera_of_the_scene(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene, hold_out=False)  # all around, so that up is up in every image
    save_run_preview(run, "cpu")
    archive = RunArchive.open(run)
    preview = read_preview(run)
    assert preview is not None
    camera = run_cameras(archive)[0]["photos/00.png"]
    width, height = round(SIZE[1] * camera.width / camera.height), SIZE[1]
    seen = run_renderer(archive, "cpu").images([camera.resized(width, height)])[0].clamp(0, 1)
    shown = np.asarray(crop_to_aspect(preview, width / height), np.float64)
    # Mean over the picture, 8 bits, for a JPEG; worst seen 0.74.
    assert np.abs(255 * seen.permute(1, 2, 0).numpy() - shown).mean() < 1.5


def test_the_preview_is_cropped_to_the_window() -> None:
    columns = np.tile(np.arange(200, dtype=np.uint8)[None, :, None], (100, 1, 3))
    image = Image.fromarray(columns)
    np.testing.assert_array_equal(np.asarray(crop_to_aspect(image, 1.5)), columns[:, 25:175])
    wider = np.asarray(crop_to_aspect(image, 3.0))
    np.testing.assert_array_equal(wider[:, 50:250], columns)
    assert wider.shape == (100, 300, 3)
    assert not wider[:, :50].any()


def test_an_outdated_or_damaged_preview_is_not_read(run: Path, scene: Path, tmp_path: Path) -> None:
    save_run_preview(run, "cpu")
    kept, manifest = (run / PREVIEW).read_bytes(), json.loads((run / "manifest.json").read_text())
    assert read_preview(run) is not None
    (run / "manifest.json").write_text(json.dumps({**manifest, "created": "2001-01-01T00:00:00+00:00"}))
    assert read_preview(run) is None
    (run / "manifest.json").write_text(json.dumps({**manifest, "records": manifest["records"][:1]}))
    assert read_preview(run) is None
    (run / "manifest.json").write_text(json.dumps(manifest))
    for damaged in (kept[: len(kept) // 2], b"", b"\x89PNG", kept[:300]):
        (run / PREVIEW).write_bytes(damaged)
        assert read_preview(run) is None
    (run / "manifest.json").write_text("{")
    (run / PREVIEW).write_bytes(kept)
    assert read_preview(run) is None
    assert read_preview(tmp_path / "nowhere") is None


def test_a_preview_that_cannot_be_saved_is_logged(
    run: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (run / PREVIEW).mkdir()
    save_run_preview(run, "cpu")
    assert [record.levelname for record in caplog.records if "no preview of" in record.message] == ["WARNING"]
    assert not list(run.glob("*.tmp")) + list(run.glob(".*.tmp"))
    (run / "level_0" / "point_cloud.ply").unlink()
    save_run_preview(run, "cpu")
    assert "level 0 of" in caplog.messages[-1]
    monkeypatch.setitem(sys.modules, "lapgs_plugin.rendering.run", None)  # importing it fails
    save_run_preview(run, "cpu")
    assert "rendering.run" in caplog.messages[-1]


def test_a_viewer_saves_a_preview_after_drawing(run: Path) -> None:
    stop = threading.Event()
    with Page("127.0.0.1", 8960, "run") as page:
        viewer = Viewer(page)
        following = RunFollower(viewer, page, FollowedRun(run, RenderOptions(device="cpu")), None, lambda _: None)
        following.begin()
        serving = threading.Thread(target=viewer.serve, args=(stop, following.save_preview))
        serving.start()
        try:
            time.sleep(0.6)  # twice the patience of the thread that draws
            assert read_preview(run) is None
            with wire_client(page.address, WINDOW) as client:
                assert client.listen(PATIENCE, pictures=1) == 1
                wait_for(lambda: read_preview(run) is not None)
        finally:
            stop.set()
            serving.join()
    kept = (run / PREVIEW).read_bytes()
    save_run_preview(run, "cpu")
    assert (run / PREVIEW).read_bytes() == kept


def test_a_run_whose_scene_was_moved_has_a_preview(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    run, moved = write_run(tmp_path / "run", scene), tmp_path / "moved"
    scene.rename(moved)
    save_run_preview(run, "cpu", moved)
    assert read_preview(run) is not None


def test_a_damaged_run_has_no_preview(run: Path) -> None:
    ply = run / "level_0" / "point_cloud.ply"
    ply.write_bytes(ply.read_bytes()[:-1000])
    with Page("127.0.0.1", 8965, "run") as page:
        following = RunFollower(Viewer(page), page, FollowedRun(run, RenderOptions(device="cpu")), None, lambda _: None)
        following.begin()
        following.save_preview()
    assert not (run / PREVIEW).exists()


@pytest.fixture
def gated(run: Path, tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """Start `lapgs view` without torch; return its address and the file that lets torch be imported."""
    gate = tmp_path / "gate"
    command = [sys.executable, "-c", COMMAND, "view", str(run), "--device", "cpu", "--port", "8970", str(gate)]
    save_run_preview(run, "cpu")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        yield process.stdout.readline().split()[1], gate
    finally:
        process.kill()
        process.communicate()


def test_the_preview_precedes_torch_and_ends_with_the_first_picture(run: Path, gated: tuple[str, Path]) -> None:
    address, gate = gated
    with Image.open(run / PREVIEW) as stored:
        middle = np.asarray(stored, np.float64)[:, 200:1000]  # 4:3 of 1200x600

    def gets_it(client: WireClient) -> None:
        assert client.listen(PATIENCE, pictures=1) == 1
        # Mean over the picture, 8 bits, for a JPEG of a JPEG; worst seen 0.51.
        assert np.abs(decoded(client.pictures[0][1]) - middle).mean() < 1.0
        assert "Preview of the run; loading." in client.words

    with wire_client(address, WINDOW) as first, wire_client(address, WINDOW) as second:
        gets_it(first)
        gets_it(second)
        gate.touch()
        for client in (first, second):
            wait_for(lambda client=client: client.listen(0.5) == 0 and len(client.pictures) > 1)  # type: ignore[misc]
            sizes = [decoded(jpeg).shape[:2] for _, jpeg in client.pictures]
            assert sizes.count(middle.shape[:2]) == 1
            assert sizes[-1] == WINDOW[::-1]
    with wire_client(address, WINDOW) as later:
        assert later.listen(PATIENCE, pictures=1) == 1
        assert decoded(later.pictures[0][1]).shape[0] <= WINDOW[1]
