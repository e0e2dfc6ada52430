"""`lapgs prepare --camera-per rig` on photos of a rig whose cameras are known exactly."""

from __future__ import annotations

import logging
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lapgs_plugin.errors import SceneError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.prepare.pipeline import PrepareResult, prepare_scene
from lapgs_plugin.scenes.prepare.settings import PrepareSettings
from lapgs_plugin.scenes.sample.raycast import render
from tests.refusals import refuses
from tests.unit.test_prepare import COUNT, FOCAL, SIZE, WORLD, _align, _arc, _save

TURN = Rotation.from_euler("yxz", [9.0, 4.0, 2.0], degrees=True).as_matrix()
SHIFT = np.array([-0.35, 0.12, 0.05])
"""Pose of the right camera against the left one, `right = TURN @ left + SHIFT`."""
FLAT = "right/05.png"
"""A photo that shows hardly anything: only the rig says where it was taken."""


def poses() -> dict[str, NDArray[np.float64]]:
    """The exact poses (3, 4) of all photos by name."""
    exact = {}
    for index, camera in enumerate(_arc(SIZE, FOCAL)):
        left = camera.world_to_camera.numpy()[:3]
        exact[f"left/{index:02d}.png"] = left
        exact[f"right/{index:02d}.png"] = np.concatenate([TURN @ left[:, :3], (TURN @ left[:, 3] + SHIFT)[:, None]], 1)
    return exact


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rig")
    for name, pose in poses().items():
        whole = np.eye(4)
        whole[:3] = pose
        image = render(WORLD, Camera(*SIZE, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, torch.from_numpy(whole)))
        if name == FLAT:
            image = np.float32(0.5) + np.float32(0.02) * image
        (folder / name).parent.mkdir(exist_ok=True)
        _save(folder / name, image)
    return folder


def run(photos: Path, out: Path, **options: object) -> PrepareResult:
    settings = PrepareSettings(camera_per="rig", camera_model="SIMPLE_PINHOLE", **options)  # type: ignore[arg-type]
    return prepare_scene(photos, out, settings, overwrite=True, progress=False)


def test_a_rig_is_found_and_places_photos_that_show_nothing(
    photos: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        result = run(photos, tmp_path / "out")
    assert "rig of 2 cameras (left, right), 8 moments of two or more" in caplog.messages
    assert "the rig places 16 photos, 15 without it" in caplog.messages
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    images, exact = {image.name: image for image in model.images.values()}, poses()
    names = sorted(exact)
    assert [*sorted(images)] == [*result.registered] == names
    centers = np.array([images[name].projection_center() for name in names])
    target = np.array([-exact[name][:, :3].T @ exact[name][:, 3] for name in names])
    errors = np.linalg.norm(_align(centers, target) - target, axis=1) / 4.6
    assert errors.max() < 4e-3  # worst seen 4.2e-4
    for index in range(COUNT):
        left, right = (images[f"{side}/{index:02d}.png"].cam_from_world() for side in ("left", "right"))
        relative = (right * left.inverse()).matrix()
        assert np.degrees(Rotation.from_matrix(relative[:, :3] @ TURN.T).magnitude()) < 0.1  # worst seen 0.007
    assert len(model.cameras) == 2
    for point in model.points3D.values():  # observations are those of the images
        for element in point.track.elements:
            seen = model.images[element.image_id].points2D[element.point2D_idx]
            assert model.points3D[seen.point3D_id].xyz is not None
    assert len(load_scene(tmp_path / "out", progress=False).train) == 2 * COUNT


def test_cameras_that_are_not_fixed_to_each_other_keep_their_poses(
    photos: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Photos of one name are of different moments."""
    for index in range(5):
        for side, moment in (("left", index), ("right", 4 - index)):
            (tmp_path / "in" / side).mkdir(parents=True, exist_ok=True)
            shutil.copy(photos / side / f"{moment:02d}.png", tmp_path / "in" / side / f"{index:02d}.png")
    result = run(tmp_path / "in", tmp_path / "out")
    assert len(result.registered) == 10
    assert result.reprojection_error < 1.0
    assert any(
        re.search(r"the cameras do not fit a rig \(\d+% of the features", message) for message in caplog.messages
    )


@pytest.mark.parametrize(
    ("names", "options", "kind", "facts"),
    [
        (("a.png", "b.png"), {}, SceneError, "has photos without subfolders, expected a subfolder for each"),
        (("l/a.png", "l/b.png"), {}, SceneError, "has only l, expected a subfolder for each"),
        (("l/a.png", "r/a.png", "b.png"), {}, SceneError, r"has photos beside them \(b.png\)"),
        (("l/a.png", "l/r/a.png"), {}, SceneError, "has photos in l and in l/r, expected folders of cameras beside"),
        (("l/a.png", "r/b.png"), {}, SceneError, "no photo of l and r has the same name, such as l/a.png"),
        (("l/a.png", "r/a.png"), {"matcher": "sequential"}, UserInputError, "--matcher sequential with"),
    ],
)
def test_folders_that_are_no_rig_are_one_line(
    names: tuple[str, ...], options: dict[str, str], kind: type[SceneError], facts: str, tmp_path: Path
) -> None:
    random = np.random.default_rng(0)
    for name in names:
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "in" / name), random.integers(0, 256, (64, 64, 3)))
    assert "--camera-per rig" in refuses(kind, facts, run, tmp_path / "in", tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_sizes_within_a_folder_are_one(tmp_path: Path) -> None:
    for name, size in (("l/a.png", 64), ("r/a.png", 80), ("l/b.png", 72)):
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "in" / name), np.zeros((size, 96, 3), np.uint8))
    refuses(UserInputError, "--camera-per rig: .* expected one size", run, tmp_path / "in", tmp_path / "out")
