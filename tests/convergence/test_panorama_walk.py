"""A walk of panoramas trains as the pinhole images that the faces stand for."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

from lapgs_plugin.cli.app import app
from lapgs_plugin.scenes import load_scene
from tests.cli.commands import succeeding
from tests.panoramas import Array, Renderer, cloud_view, panorama, psnr, room_view, save, walk

WIDTH, PLACES = 512, 10
call = succeeding(app, 200)


def write_walk(folder: Path, view: Renderer) -> None:
    """Write panoramas with nerfstudio's file and points at random places of the room."""
    frames = []
    for index, pose in enumerate(walk(PLACES)):
        save(folder / "images" / f"{index:02d}.png", panorama(view, pose, WIDTH))
        camera_to_world = np.linalg.inv(pose) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"images/{index:02d}.png", "transform_matrix": camera_to_world.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "EQUIRECTANGULAR", "frames": frames}))
    places = np.random.default_rng(0).uniform((-3, -3, -0.2), (3, 3, 3.4), (3000, 3))
    kinds = [(axis, "f8") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
    rows = np.array([(*place, 128, 128, 128) for place in places], dtype=kinds)
    PlyData([PlyElement.describe(rows, "vertex")]).write(folder / "points3d.ply")


def held_out_psnr(scene: Path, run: Path, exact: Path) -> float:
    """Train, render the held-out views, and return their mean PSNR against the images of another folder."""
    call("train", scene, "-o", run, "--eval", "--iterations", 1500)
    call("render", run)
    renders = sorted((run / "renders/test").glob("*_composed.png"))
    assert len(renders) == 13

    def pixels(file: Path) -> Array:
        with Image.open(file) as image:
            return np.asarray(image.convert("RGB"), np.float64) / 255

    return float(np.mean([psnr(pixels(file), pixels(exact / file.name.replace("_composed", ""))) for file in renders]))


# Seen: 0.22 dB less for Gaussians, 0.07 dB more for the room.
@pytest.mark.slow
@pytest.mark.parametrize("view", [room_view, cloud_view])
def test_faces_train_as_the_pinhole_images_that_they_stand_for(view: Renderer, tmp_path: Path) -> None:
    write_walk(tmp_path / "walk", view)
    call("prepare", tmp_path / "walk", tmp_path / "faces")
    shutil.copytree(tmp_path / "faces", tmp_path / "pinhole")
    exact = tmp_path / "pinhole/images"
    for face in load_scene(tmp_path / "faces", progress=False).train:
        save(exact / face.name, view(face.camera.to(dtype=torch.float64)))
    faces, pinhole = (held_out_psnr(tmp_path / name, tmp_path / f"run_{name}", exact) for name in ("faces", "pinhole"))
    assert faces > pinhole - 0.3
