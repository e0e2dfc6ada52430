"""A scene whose photos were taken through a lens that bends rays: solids, seen ray by ray."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pycolmap
import torch

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.lens import Lens
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.scenes.sample import raycast
from lapgs_plugin.scenes.sample.points import sample_points
from lapgs_plugin.scenes.sample.scene import orbit_camera
from lapgs_plugin.scenes.sample.world import build_world

FISHEYE = Lens(True, (0.03, -0.01, 0.0, 0.0))
"""That of `write_bent_scene`."""


def write_bent_scene(
    out: Path, *, size: tuple[int, int] = (64, 48), focal: float = 32.0, views: int = 16, points: int = 1500
) -> None:
    """Write a COLMAP scene of a fisheye lens, OPENCV_FISHEYE."""
    world = build_world(0)
    straight = [orbit_camera(index, size, 0) for index in range(views)]
    bent = [replace(camera, fx=focal, fy=focal, lens=FISHEYE) for camera in straight]
    for index, camera in enumerate(bent):
        image = torch.from_numpy(raycast.render(world, camera)).permute(2, 0, 1)
        write_image(out / "images" / f"{index:02d}.png", image)
    write_model(out, bent, "OPENCV_FISHEYE", FISHEYE.radial)
    cloud = sample_points(world, straight, points, 0)
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    for xyz, rgb in zip(cloud.positions, cloud.colors, strict=True):
        model.add_point3D(xyz, pycolmap.Track(), (255 * rgb).round().astype("uint8"))
    model.write(out / "sparse" / "0")


def write_model(scene: Path, cameras: Sequence[Camera], kind: str, distortion: Sequence[float]) -> None:
    """Write a COLMAP model without points of cameras that differ in their poses alone."""
    first, model = cameras[0], pycolmap.Reconstruction()
    focal = [first.fx] if kind.startswith("SIMPLE") or kind.startswith("RADIAL") else [first.fx, first.fy]
    params = [*focal, first.cx, first.cy, *distortion]
    camera = pycolmap.Camera(model=kind, width=first.width, height=first.height, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for index, posed in enumerate(cameras):
        pose = pycolmap.Rigid3d(posed.world_to_camera[:3].double().numpy())
        model.add_image_with_trivial_frame(pycolmap.Image(f"{index:02d}.png", camera_id=1, image_id=index + 1), pose)
    (scene / "sparse" / "0").mkdir(parents=True, exist_ok=True)
    model.write(scene / "sparse" / "0")
