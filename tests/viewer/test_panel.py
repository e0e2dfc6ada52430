"""Test a client's panel that is built again because the run has another level or other cameras."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.run_folder import write_run, write_scene

pytest.importorskip("viser", reason="needs the extra 'viewer'")

from lapgs_plugin.rendering.options import RenderOptions
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.viewer.following import FollowedRun
from lapgs_plugin.viewer.page import Page
from lapgs_plugin.viewer.poses import SceneCameras
from lapgs_plugin.viewer.session import Session, ViewerContent
from lapgs_plugin.viewer.viewer import Viewer
from tests.viewer.wire import wire_client
from tests.waiting import wait_for


def shown(viewer: Viewer, run: Path, cameras: SceneCameras) -> Session:
    """Show a run to the only client, and return its session after the last picture."""
    followed = FollowedRun(run, RenderOptions(device="cpu"))
    followed.set_cameras(cameras.rig)
    assert followed.shown is not None
    viewer.show(ViewerContent(followed.shown, None, cameras))
    while viewer.draw_next(0.3):
        pass
    (session,) = viewer._sessions.values()
    return session


@pytest.mark.parametrize("same_scene", [True, False])
def test_choices_stay_when_the_panel_is_built_again(tmp_path: Path, same_scene: bool) -> None:
    scene = write_scene(tmp_path / "scene")
    first = write_run(tmp_path / "first", scene, finished=1)
    other = scene if same_scene else write_scene(tmp_path / "other", [f"photos/{i:02d}.png" for i in range(2, 6)])
    second = write_run(tmp_path / "second", other)
    cameras = SceneCameras.of(RunArchive.open(first))
    then = cameras if same_scene else SceneCameras.of(RunArchive.open(second))
    with Page("127.0.0.1", 8870, "run") as page, wire_client(page.address) as client:
        viewer = Viewer(page)
        wait_for(lambda: viewer.watched)
        session = shown(viewer, first, cameras)
        panel = session._controls
        assert panel is not None
        panel._frustums.value, panel._view.value = True, "photos/03.png"
        wait_for(lambda: len(session._frustums) == 10)
        place = [1.0, 2.0, -5.0]
        panel._kept.content = f"{session._keep()} views kept"
        client.look_from(*place)
        wait_for(lambda: session._pose().position.tolist() == place)

        assert shown(viewer, second, then) is session
        panel = session._controls
        assert panel is not None
        assert panel.settings.gains == {1: 1.0, 0: 1.0}
        assert (panel._frustums.value, panel._view.value) == (True, "photos/03.png")
        assert panel._kept.content == "1 views kept"
        assert session._pose().position.tolist() == place
        names = sorted(frustum.name for frustum in session._frustums)
        assert names == [f"/cameras/photos/{i:02d}.png" for i in (range(10) if same_scene else range(2, 6))]
        assert all(frustum.visible for frustum in session._frustums)
        there = {name for name in session._client.scene._handle_from_node_name if name.startswith("/cameras/photos/")}
        assert there == set(names), "frustums of other cameras are gone"
        panel._frustums.value = False
        wait_for(lambda: not any(frustum.visible for frustum in session._frustums))
