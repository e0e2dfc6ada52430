"""A checkout's PLY files, which other processes may look for at any time."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from lapgs_plugin.checkouts.attachment import Attachment
from lapgs_plugin.checkouts.whole_ply import writing_whole_files
from lapgs_plugin.errors import LapgsError


def points(count: int) -> PlyData:
    return PlyData([PlyElement.describe(np.zeros(count, [("x", "f4"), ("y", "f4")]), "vertex")])


def test_it_is_there_when_it_is_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, seen, header = tmp_path / "points3D.ply", [], PlyData.header

    def looked_for(ply: PlyData) -> Any:  # asked for when the file is open
        seen.append(path.exists())
        return header.fget(ply)

    monkeypatch.setattr(PlyData, "header", property(looked_for))
    before = vars(PlyData)["write"]
    with Attachment([writing_whole_files()]):
        points(3).write(str(path))
        assert PlyData.read(path)["vertex"].count == 3
        points(5).write(path)
        points(7).write(stream := io.BytesIO())
    assert vars(PlyData)["write"] is before
    assert seen == [False, True, True], "written beside the file that is there, and then put in its place"
    assert PlyData.read(path)["vertex"].count == 5
    assert PlyData.read(io.BytesIO(stream.getvalue()))["vertex"].count == 7
    assert [each.name for each in tmp_path.iterdir()] == ["points3D.ply"]


def test_a_file_that_cannot_be_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "points3D.ply"
    points(3).write(path)

    def broken(*_: Any) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(PlyElement, "_write", broken)
    with Attachment([writing_whole_files()]), pytest.raises(LapgsError, match="the PLY file cannot be written"):
        points(5).write(path)
    assert PlyData.read(path)["vertex"].count == 3
    assert [each.name for each in tmp_path.iterdir()] == ["points3D.ply"]
