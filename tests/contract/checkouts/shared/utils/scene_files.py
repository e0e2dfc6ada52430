"""Scenes as posed image files, the images not yet read; and what is written of a scene beside a model."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from plyfile import PlyData, PlyElement
from utils.graphics_utils import BasicPointCloud, focal2fov, fov2focal

from lapgs_plugin.scenes.blender import read_transforms
from lapgs_plugin.scenes.colmap import find_model, read_colmap


class PosedFile(NamedTuple):
    """R is camera to world, T the translation from world to camera, as the family has it."""

    path: Path
    R: np.ndarray
    T: np.ndarray
    FovY: float
    FovX: float
    width: int
    height: int


class SceneFiles(NamedTuple):
    point_cloud: BasicPointCloud
    train: list
    test: list


def read_scene_files(path, images, eval):
    model = find_model(Path(path))
    if model is not None:
        source = read_colmap(Path(path), model, images or "images", eval)
    else:
        source = read_transforms(Path(path), "images", eval)
    points = BasicPointCloud(source.points, source.colors, np.zeros_like(source.points))
    if model is not None and Path(model, "points3D.ply").is_file():
        points = fetchPly(Path(model, "points3D.ply"))
    train, test = ([posed_file(frame) for frame in frames] for frames in (source.train, source.test))
    return SceneFiles(points, train, test)


def fetchPly(path):
    vertices = PlyData.read(str(path))["vertex"]
    columns = (np.stack([vertices[name] for name in names], 1) for names in ("xyz", ("red", "green", "blue")))
    points, colors = columns
    return BasicPointCloud(points, colors / 255.0, np.zeros_like(points))


def posed_file(frame):
    camera = frame.camera
    pose = camera.world_to_camera.numpy()
    fov_x, fov_y = focal2fov(camera.fx, camera.width), focal2fov(camera.fy, camera.height)
    return PosedFile(frame.path, pose[:3, :3].T, pose[:3, 3], fov_y, fov_x, camera.width, camera.height)


def getNerfppNorm(cam_info):
    centers = np.stack([-cam.R @ cam.T for cam in cam_info])
    middle = centers.mean(axis=0)
    return {"translate": -middle, "radius": 1.1 * np.linalg.norm(centers - middle, axis=1).max()}


def size_for(width, height, resolution, resolution_scale):
    """The size that `--resolution` asks for: a divisor of 1, 2, 4 or 8, or a width; -1 for at most 1600."""
    if resolution in (1, 2, 4, 8):
        return round(width / (resolution_scale * resolution)), round(height / (resolution_scale * resolution))
    wanted = min(width, 1600) if resolution == -1 else resolution
    divisor = float(width / wanted) * float(resolution_scale)
    return int(width / divisor), int(height / divisor)


def storePly(path, xyz, rgb):
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    vertices = np.zeros(len(xyz), dtype=[(name, "u1" if len(name) > 2 else "f4") for name in names])
    for name, column in zip((*names[:3], *names[6:]), np.hstack([xyz, rgb]).T, strict=True):
        vertices[name] = column
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))


def camera_to_JSON(id, camera):
    return {
        "id": id,
        "img_name": camera.image_name,
        "width": camera.width,
        "height": camera.height,
        "position": (-camera.R @ camera.T).tolist(),
        "rotation": camera.R.tolist(),
        "fy": fov2focal(camera.FovY, camera.height),
        "fx": fov2focal(camera.FovX, camera.width),
    }


def write_scene_files(model_path, scene_info):
    storePly(Path(model_path, "input.ply"), scene_info.point_cloud.points, scene_info.point_cloud.colors * 255)
    infos = [*scene_info.test_cameras, *scene_info.train_cameras]
    entries = [camera_to_JSON(index, info) for index, info in enumerate(infos)]
    Path(model_path, "cameras.json").write_text(json.dumps(entries), encoding="utf-8")
