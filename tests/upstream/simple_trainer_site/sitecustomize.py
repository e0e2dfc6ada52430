"""Let gsplat's examples be imported where packages of theirs are others, or not there.

Python imports this file when it starts with the folder in PYTHONPATH. gsplat 1.5 reads COLMAP models by `SceneManager`
of a fork of pycolmap, its evaluation loads LPIPS networks, and gsplat 1.6 compiles its CUDA code when it is imported
where it finds a toolkit.
"""

from types import SimpleNamespace

import numpy as np
import pycolmap
import torch
import torch.utils.cpp_extension
from torchmetrics.image import lpip

KINDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1}


class SceneManager:
    """Hold a model as gsplat's parser reads it."""

    def __init__(self, folder):
        model = pycolmap.Reconstruction(str(folder))
        poses = {key: model.images[key].cam_from_world().matrix() for key in model.reg_image_ids()}
        self.images = {
            key: SimpleNamespace(
                R=lambda pose=pose: pose[:, :3],
                tvec=pose[:, 3],
                camera_id=model.images[key].camera_id,
                name=model.images[key].name,
            )
            for key, pose in poses.items()
        }
        self.cameras = {key: self._camera(camera) for key, camera in model.cameras.items()}
        keys = sorted(model.points3D)
        points = [model.points3D[key] for key in keys]
        self.points3D = np.array([point.xyz for point in points])
        self.point3D_errors = np.array([point.error for point in points])
        self.point3D_colors = np.array([point.color for point in points])
        self.name_to_image_id = {image.name: key for key, image in self.images.items()}
        self.point3D_id_to_point3D_idx = {key: index for index, key in enumerate(keys)}
        self.point3D_id_to_images = {
            key: [(element.image_id, element.point2D_idx) for element in point.track.elements]
            for key, point in zip(keys, points, strict=True)
        }

    @staticmethod
    def _camera(camera):
        (fx, _, cx), (_, fy, cy), _ = camera.calibration_matrix()
        size = {"width": camera.width, "height": camera.height}
        return SimpleNamespace(fx=fx, fy=fy, cx=cx, cy=cy, camera_type=KINDS[camera.model.name], **size)

    def load_cameras(self):
        """Do nothing: all is read at once."""

    load_images = load_points3D = load_cameras


class NoLpips(torch.nn.Module):
    def __init__(self, **_):
        super().__init__()

    def forward(self, first, second):
        return (first - second).abs().mean()


pycolmap.SceneManager = SceneManager
lpip.LearnedPerceptualImagePatchSimilarity = NoLpips
torch.utils.cpp_extension._find_cuda_home = lambda: None
