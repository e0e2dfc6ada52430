"""Cameras read without their images are those of the scene read whole."""

from __future__ import annotations

from pathlib import Path

import torch

from lapgs_plugin.scenes import load_cameras, load_scene
from tests.cli.run_folder import write_scene


def test_cameras_without_images_are_those_of_the_scene(tmp_path: Path) -> None:
    path = write_scene(tmp_path)
    scene = load_scene(path, resolution="1/2", eval=True, progress=False)
    for cameras, views in zip(load_cameras(path, resolution="1/2", eval=True), (scene.train, scene.test), strict=True):
        assert list(cameras) == [view.name for view in views]
        for view in views:
            camera = cameras[view.name]
            assert (camera.width, camera.height, camera.fx) == (view.camera.width, view.camera.height, view.camera.fx)
            torch.testing.assert_close(camera.world_to_camera, view.camera.world_to_camera)
