"""Cameras from what the readers found, at the size that `--resolution` asks for."""

import cv2
import numpy as np
from PIL import Image
from scene.cameras import Camera

from utils.scene_files import size_for


def loadCam(args, id, cam_info, resolution_scale, is_nerf_synthetic, is_test_dataset):
    image = Image.open(cam_info.image_path)
    invdepthmap = None
    if cam_info.depth_path:
        stored = cv2.imread(cam_info.depth_path, cv2.IMREAD_UNCHANGED)
        invdepthmap = stored.astype(np.float32) / (512 if is_nerf_synthetic else 2**16)
    return Camera(
        size_for(*image.size, args.resolution, resolution_scale),
        colmap_id=cam_info.uid,
        R=cam_info.R,
        T=cam_info.T,
        FoVx=cam_info.FovX,
        FoVy=cam_info.FovY,
        depth_params=cam_info.depth_params,
        image=image,
        invdepthmap=invdepthmap,
        image_name=cam_info.image_name,
        uid=id,
        data_device=args.data_device,
        train_test_exp=args.train_test_exp,
        is_test_dataset=is_test_dataset,
        is_test_view=cam_info.is_test,
    )


def cameraList_from_camInfos(cam_infos, resolution_scale, args, is_nerf_synthetic, is_test_dataset):
    return [
        loadCam(args, index, info, resolution_scale, is_nerf_synthetic, is_test_dataset)
        for index, info in enumerate(cam_infos)
    ]
