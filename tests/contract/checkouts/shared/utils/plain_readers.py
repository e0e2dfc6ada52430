"""COLMAP and Blender scenes as records that cameras are made from; images are opened here."""

from typing import NamedTuple

import numpy as np
from PIL import Image
from utils.graphics_utils import BasicPointCloud
from utils.scene_files import getNerfppNorm, read_scene_files


class CameraInfo(NamedTuple):
    uid: int
    R: np.ndarray
    T: np.ndarray
    FovY: float
    FovX: float
    image: Image.Image
    image_path: str
    image_name: str
    width: int
    height: int


class SceneInfo(NamedTuple):
    point_cloud: BasicPointCloud
    train_cameras: list
    test_cameras: list
    nerf_normalization: dict


def camera_info(uid, file, background=None):
    image = Image.open(file.path)
    if background is not None:
        rgba = np.asarray(image.convert("RGBA")) / 255.0
        blended = rgba[..., :3] * rgba[..., 3:] + background * (1 - rgba[..., 3:])
        image = Image.fromarray((blended * 255.0).astype(np.uint8))
    path, R, T, fov_y, fov_x, width, height = file
    return CameraInfo(uid, R, T, fov_y, fov_x, image, str(path), path.name.split(".")[0], width, height)


def read_scene_info(path, images, eval, background=None):
    files = read_scene_files(path, images, eval)
    train, test = (
        [camera_info(uid, file, background) for uid, file in enumerate(found)] for found in (files.train, files.test)
    )
    return SceneInfo(files.point_cloud, train, test, getNerfppNorm(train))


def readColmapSceneInfo(path, images, eval):
    return read_scene_info(path, images, eval)


def readNerfSyntheticInfo(path, white_background, eval):
    return read_scene_info(path, None, eval, float(white_background))


sceneLoadTypeCallbacks = {"Colmap": readColmapSceneInfo, "Blender": readNerfSyntheticInfo}
