"""Exports of other programs, written from known cameras by writers of our own; OpenCV projects, and COLMAP's lenses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lapgs_plugin.scenes.exports.registry import find_export
from tests.export_writers import WRITERS, Capture, from_colmap, synthetic

WITH_POINTS = ("metashape", "realitycapture", "bundler", "opensfm", "arkitscenes")
"""Exports whose points come from a file."""


def centred(capture: Capture) -> Capture:
    """Return the capture with its principal point in the middle, and two radial terms, which is all Bundler knows."""
    width, height = capture.size
    return replace(capture, center=(width / 2, height / 2), radial=(*capture.radial[:2], 0.0), tangential=(0.0, 0.0))


def check(name: str, folder: Path, capture: Capture) -> None:
    """Compare what is read with what was written."""
    WRITERS[name](folder, capture)
    found = find_export(folder)
    assert found is not None
    assert found.name == name
    model, source = found.read(folder)
    frames = list(model.images.values())
    assert len(frames) == len(capture.names) == len(source.train)
    assert all(frame.path.is_file() for frame in source.train)
    for view, image in enumerate(frames):
        pose = image.pose.matrix()
        np.testing.assert_allclose(pose[:, :3], capture.turns[view], rtol=0, atol=1e-6)
        np.testing.assert_allclose(pose[:, 3], capture.shifts[view], rtol=1e-6, atol=1e-6)
        camera, seen = model.cameras[image.camera_id], capture.in_front(view)
        local = capture.xyz[seen] @ pose[:, :3].T + pose[:, 3]
        np.testing.assert_allclose(camera.img_from_cam(local), capture.pixels(view), rtol=0, atol=1e-6)
    if name in WITH_POINTS:
        np.testing.assert_allclose(source.points, capture.xyz, rtol=0, atol=1e-6)
        np.testing.assert_allclose(source.colors * 255, capture.rgb, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["metashape", "realitycapture", "opensfm"])
def test_distorted_cameras_are_those_that_were_written(name: str, tmp_path: Path) -> None:
    check(name, tmp_path, synthetic(distorted=True))


def test_bundlers_cameras_are_those_that_were_written(tmp_path: Path) -> None:
    check("bundler", tmp_path, centred(synthetic(distorted=True)))


@pytest.mark.parametrize("name", ["metashape", "realitycapture", "opensfm", "record3d", "polycam", "arkitscenes"])
def test_pinhole_cameras_are_those_that_were_written(name: str, tmp_path: Path) -> None:
    check(name, tmp_path, synthetic())


@pytest.mark.shared
@pytest.mark.parametrize("name", ["metashape", "realitycapture", "bundler", "opensfm"])
def test_cameras_of_south_building_are_colmaps(name: str, tmp_path: Path, shared_data: Path) -> None:
    check(name, tmp_path, from_colmap(shared_data / "south-building/distorted"))


@pytest.mark.shared
@pytest.mark.parametrize("name", ["metashape", "opensfm", "record3d", "polycam", "arkitscenes"])
def test_cameras_of_fox_are_colmaps(name: str, tmp_path: Path, shared_data: Path) -> None:
    check(name, tmp_path, from_colmap(shared_data / "fox/sparse/0"))
