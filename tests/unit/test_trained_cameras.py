"""Test the cameras that a run folder keeps beside its scene's."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CAMERAS
from lapgs_plugin.runs.manifest import Manifest, SceneReference
from lapgs_plugin.runs.trained_cameras import TrainedCameras

ROW: list[float] = [8, 6, 9.0, 9.5, 4.0, 3.25, *torch.eye(4).flatten().tolist()]


@pytest.fixture
def archive(tmp_path: Path) -> Iterator[RunArchive]:
    scene = SceneReference(str(tmp_path), "full", eval=True, background=(0.0, 0.0, 0.0), kind="colmap")
    with RunArchive.create(tmp_path / "run", Manifest.of_loop(scene, 2, "cpu")) as made:
        yield made


def test_cameras_are_read_as_they_were_written(archive: RunArchive) -> None:
    assert archive.cameras() is None
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.1, -2.0, 1e-3])
    archive.write_cameras(TrainedCameras({"a": Camera(8, 6, 9.1, 9.5, 4.25, 3.0, pose)}, {}))
    cameras = archive.cameras()
    assert cameras is not None
    assert (*cameras.train,) == ("a",)
    assert cameras.test == {}
    assert (cameras.train["a"].size, cameras.train["a"].fx, cameras.train["a"].cx) == ((8, 6), 9.1, 4.25)
    assert torch.equal(cameras.train["a"].world_to_camera, pose)


DAMAGED: dict[str, tuple[Any, str]] = {
    "no table": ([], "view_cameras.json"),
    "a part": ({"train": {}}, "expected train and test"),
    "a number": ({"train": {"a": ROW[:-1]}, "test": {}}, "view_cameras.json"),
    "a size": ({"train": {"a": [0.5, *ROW[1:]]}, "test": {}}, "the camera of a has no size"),
    "a lens": ({"train": {"a": [8, 6, 0, *ROW[3:]]}, "test": {}}, "the camera of a has no size or focal length"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_file_is_one_line(case: str, archive: RunArchive) -> None:
    values, line = DAMAGED[case]
    archive.path(CAMERAS).write_text(json.dumps(values))
    with pytest.raises(RunFolderError, match=line) as caught:
        archive.cameras()
    assert "\n" not in str(caught.value)
