"""Pinhole geometry."""

import math
from typing import NamedTuple

import numpy as np
import torch


class BasicPointCloud(NamedTuple):
    points: np.ndarray
    colors: np.ndarray
    normals: np.ndarray


def getWorld2View2(R, t, translate, scale=1.0):
    """World to camera, after the camera has been moved by `translate` and its position scaled."""
    center = (-R @ t + translate) * scale
    matrix = np.eye(4)
    matrix[:3, :3] = R.T
    matrix[:3, 3] = -R.T @ center
    return np.float32(matrix)


def getProjectionMatrix(znear, zfar, fovX, fovY):
    projection = torch.zeros(4, 4)
    projection[0, 0] = 1 / math.tan(fovX / 2)
    projection[1, 1] = 1 / math.tan(fovY / 2)
    projection[2, 2] = zfar / (zfar - znear)
    projection[2, 3] = -zfar * znear / (zfar - znear)
    projection[3, 2] = 1.0
    return projection


def fov2focal(fov, pixels):
    return pixels / (2 * math.tan(fov / 2))


def focal2fov(focal, pixels):
    return 2 * math.atan(pixels / (2 * focal))
