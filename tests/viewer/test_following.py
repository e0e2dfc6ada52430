"""Test runs that are viewed while they are written: what is read again, and how damage is reported."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.rasterizers.choice import PlacedRasterizer
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes.scene import load_cameras
from tests.cli.run_folder import write_run, write_scene

pytest.importorskip("viser", reason="needs the extra 'viewer'")

from lapgs_plugin.rendering.options import RenderOptions
from lapgs_plugin.viewer import following
from lapgs_plugin.viewer.following import FollowedRun, RunFollower
from tests.refusals import refuses
from tests.waiting import wait_for


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene")


def finish(run: Path, of: Path) -> None:
    """Add the next level of a complete run to a run."""
    complete = RunArchive.open(of)
    with RunArchive.open(run, resume=True) as archive:
        level = archive.manifest.next_level
        assert level is not None
        archive.finish_level(complete.manifest.record(level), complete.field(level))


def levels(run: FollowedRun) -> list[int]:
    return [] if run.shown is None else list(run.shown.counts)


def test_loading_a_rasterizer_renders_a_hierarchy_and_ignores_errors() -> None:
    class Recording(CpuRasterizer):
        def render_images(self, field: GaussianField, *args: Any, **kwargs: Any) -> torch.Tensor:
            rendered.append(field.signed)
            return super().render_images(field, *args, **kwargs)

    class Broken(CpuRasterizer):
        def render_images(self, *args: Any, **kwargs: Any) -> torch.Tensor:
            raise RuntimeError("no kernel image is available for execution on the device")

    rendered: list[bool] = []
    following.load_rasterizer(PlacedRasterizer(Recording(), torch.device("cpu"), {}))
    assert sorted(rendered) == [False, True]
    following.load_rasterizer(PlacedRasterizer(Broken(), torch.device("cpu"), {}))


def test_new_levels_are_read_and_old_ones_are_not_read_again(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    complete = write_run(tmp_path / "complete", scene)
    folder = write_run(tmp_path / "run", scene, finished=0)
    read: list[str] = []
    load: Callable[[Path], GaussianField] = GaussianField.load_ply
    monkeypatch.setattr(GaussianField, "load_ply", lambda path: read.append(path.parent.name) or load(path))
    run = FollowedRun(folder, RenderOptions(device="cpu"))
    assert levels(run) == []
    assert not run.refresh()
    finish(folder, complete)
    assert run.refresh()
    assert levels(run) == [1]
    finish(folder, complete)
    assert run.refresh()
    assert levels(run) == [1, 0]
    assert [name for name in read if name.startswith("level")][-1:] == ["level_0"]
    assert run.status() == "run: 2 levels"
    before = len(read)
    assert not run.refresh()
    assert len(read) == before
    monkeypatch.chdir(folder)
    assert FollowedRun(Path(), RenderOptions(device="cpu")).status() == "run: 2 levels", "of `lapgs view .`"


def test_a_repaired_level_is_shown_again(scene: Path, tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", scene)
    ply = folder / "level_0" / "point_cloud.ply"
    whole = ply.read_bytes()
    ply.write_bytes(whole[: len(whole) // 2])
    run = FollowedRun(folder, RenderOptions(device="cpu"))
    assert levels(run) == [1]
    assert "cut short" in run.status()
    ply.write_bytes(whole)
    assert run.refresh()
    assert levels(run) == [1, 0]
    assert run.problem is None


def test_nan_in_a_residual_leaves_the_base(scene: Path, tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", scene)
    ply = folder / "level_0" / "point_cloud.ply"
    content = bytearray(ply.read_bytes())
    content[-4:] = np.float32("nan").tobytes()
    ply.write_bytes(content)
    run = FollowedRun(folder, RenderOptions(device="cpu"))
    assert levels(run) == [1]
    assert "NaN" in run.status()


def test_another_run_in_the_same_folder_is_another_field(scene: Path, tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", scene)
    run = FollowedRun(folder, RenderOptions(device="cpu"))
    assert run.shown is not None
    first = run.shown.renderer.fields[1].means.clone()
    other = write_run(tmp_path / "other", scene, seed=9)
    for level in (1, 0):
        new = (other / f"level_{level}" / "point_cloud.ply").read_bytes()
        (folder / f"level_{level}" / "point_cloud.ply").write_bytes(new)
    assert run.refresh()
    assert not torch.equal(run.shown.renderer.fields[1].means, first)


class FakeViewer:
    """Records the content that it should show."""

    def __init__(self) -> None:
        self.shown: list[Any] = []
        self.starts = 0

    def set_initial_view(self, start: Any) -> None:
        self.starts += 1

    def show(self, content: Any) -> None:
        self.shown.append(content)


class FakePage:
    status = ""


def test_the_watching_thread_shows_each_new_level_and_survives_the_end_of_the_folder(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(following, "POLL_SECONDS", 0.02)
    complete = write_run(tmp_path / "complete", scene)
    folder = write_run(tmp_path / "run", scene, finished=1)
    viewer, page, said = FakeViewer(), FakePage(), list[str]()
    follow = RunFollower(viewer, page, FollowedRun(folder, RenderOptions(device="cpu")), None, said.append)  # type: ignore[arg-type]  # fakes
    follow.begin()
    stop = threading.Event()
    thread = threading.Thread(target=follow.watch, args=(stop,))
    thread.start()
    try:
        finish(folder, complete)
        wait_for(lambda: len(viewer.shown) == 2)
        (folder / "manifest.json").rename(tmp_path / "gone.json")
        wait_for(lambda: "not a run" in page.status)
        assert thread.is_alive()
    finally:
        stop.set()
        thread.join()
    assert [list(content.run.counts) for content in viewer.shown[:2]] == [[1], [1, 0]]
    assert len(viewer.shown[0].cameras.by_view) == 10
    assert viewer.starts == 1
    assert said[:2] == ["run is not complete: showing level 1 of 2; others will follow", "run: 2 levels"]


@contextmanager
def watched(follow: RunFollower) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=follow.watch, args=(stop,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_a_new_level_is_shown_though_the_baseline_is_gone(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(following, "POLL_SECONDS", 0.02)
    complete, baseline = write_run(tmp_path / "complete", scene), write_run(tmp_path / "baseline", scene)
    folder = write_run(tmp_path / "run", scene, finished=1)
    runs = [FollowedRun(path, RenderOptions(device="cpu")) for path in (folder, baseline)]
    viewer, page = FakeViewer(), FakePage()
    follow = RunFollower(viewer, page, *runs, report=lambda _: None)  # type: ignore[arg-type]  # fakes
    follow.begin()
    with watched(follow):
        (baseline / "manifest.json").rename(tmp_path / "gone.json")
        wait_for(lambda: "not a run" in page.status)
        finish(folder, complete)
        wait_for(lambda: len(viewer.shown) == 2)
    assert list(viewer.shown[1].run.counts) == [1, 0]
    assert list(viewer.shown[1].other.counts) == [1, 0], "the baseline as it was"
    assert "not a run" in page.status


@pytest.mark.parametrize("same", [True, False])
def test_a_run_that_is_trained_again_is_shown_with_the_cameras_of_its_scene(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, same: bool
) -> None:
    """Clients move to the first camera of another scene, and stay where they are in the same one."""
    monkeypatch.setattr(following, "POLL_SECONDS", 0.02)
    folder = write_run(tmp_path / "run", scene)
    made = json.loads((folder / "manifest.json").read_text())["created"]
    viewer, page = FakeViewer(), FakePage()
    follow = RunFollower(viewer, page, FollowedRun(folder, RenderOptions(device="cpu")), None, lambda _: None)  # type: ignore[arg-type]  # fakes
    follow.begin()
    other = scene if same else write_scene(tmp_path / "other", [f"{i}.png" for i in range(6, 0, -1)])
    wait_for(lambda: datetime.now(timezone.utc).isoformat(timespec="seconds") > made)
    with watched(follow):
        folder.rename(tmp_path / "before")
        wait_for(lambda: "not a run" in page.status)
        write_run(folder, other)
        wait_for(lambda: page.status == "run: 2 levels" and list(viewer.shown[-1].run.counts) == [1, 0])
    expected = load_cameras(other, resolution="full", eval=True)
    assert viewer.shown[-1].cameras.by_view.keys() == {*expected[0], *expected[1]}
    assert viewer.starts == (1 if same else 2)


def test_without_a_level_to_show_damage_is_an_error(scene: Path, tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", scene, finished=1)
    (folder / "level_1" / "point_cloud.ply").unlink()
    refuses(RunFolderError, r"level 1 of .* is missing", FollowedRun, folder, RenderOptions(device="cpu"))
