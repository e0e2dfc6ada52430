"""COLMAP and Blender scenes as records that cameras are made from; images are named here and opened later."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from utils.graphics_utils import BasicPointCloud
from utils.scene_files import getNerfppNorm, read_scene_files


class CameraInfo(NamedTuple):
    uid: int
    R: np.ndarray
    T: np.ndarray
    FovY: float
    FovX: float
    depth_params: dict | None
    image_path: str
    image_name: str
    depth_path: str
    width: int
    height: int
    is_test: bool


class SceneInfo(NamedTuple):
    point_cloud: BasicPointCloud
    train_cameras: list
    test_cameras: list
    nerf_normalization: dict
    is_nerf_synthetic: bool


def camera_infos(files, is_test, with_suffix, depths_folder, depths_params):
    found = []
    for uid, (path, R, T, fov_y, fov_x, width, height) in enumerate(files):
        depth_path = str(depths_folder / f"{path.stem}.png") if depths_folder else ""
        params = (depths_params or {}).get(path.stem)
        name = path.name if with_suffix else path.stem
        found.append(CameraInfo(uid, R, T, fov_y, fov_x, params, str(path), name, depth_path, width, height, is_test))
    return found


def read_depth_params(path):
    params = json.loads(Path(path, "sparse/0/depth_params.json").read_text(encoding="utf-8"))
    scales = np.array([entry["scale"] for entry in params.values()])
    median = np.median(scales[scales > 0]) if (scales > 0).any() else 0
    return {name: {**entry, "med_scale": median} for name, entry in params.items()}


def readColmapSceneInfo(path, images, depths, eval, train_test_exp):
    files = read_scene_files(path, images, eval)
    how = True, Path(path, depths) if depths else None, read_depth_params(path) if depths else None
    train, test = camera_infos(files.train, False, *how), camera_infos(files.test, True, *how)
    if train_test_exp:
        train = sorted([*train, *test], key=lambda info: info.image_name)
    return SceneInfo(files.point_cloud, train, test, getNerfppNorm(train), False)


def readNerfSyntheticInfo(path, white_background, depths, eval):
    # The image over its background is thrown away: cameras open the file again, with its alpha.
    files = read_scene_files(path, None, eval)
    how = False, Path(path, depths) if depths else None, None
    train, test = camera_infos(files.train, False, *how), camera_infos(files.test, True, *how)
    return SceneInfo(files.point_cloud, train, test, getNerfppNorm(train), True)


sceneLoadTypeCallbacks = {"Colmap": readColmapSceneInfo, "Blender": readNerfSyntheticInfo}
