"""The scene of the 2023 release: cameras by resolution scale, its size, and the Gaussians it starts from."""

import random
from pathlib import Path

from utils.camera_utils import cameraList_from_camInfos
from utils.plain_readers import sceneLoadTypeCallbacks
from utils.scene_files import write_scene_files


class Scene:
    def __init__(self, args, gaussians, shuffle=True, resolution_scales=(1.0,)):
        self.model_path = args.model_path
        self.gaussians = gaussians
        self.train_cameras = {}
        self.test_cameras = {}
        scene_info = sceneLoadTypeCallbacks["Colmap"](args.source_path, args.images, args.eval)
        write_scene_files(self.model_path, scene_info)
        if shuffle:
            random.shuffle(scene_info.train_cameras)
            random.shuffle(scene_info.test_cameras)
        self.cameras_extent = scene_info.nerf_normalization["radius"]
        for scale in resolution_scales:
            self.train_cameras[scale] = cameraList_from_camInfos(scene_info.train_cameras, scale, args)
            self.test_cameras[scale] = cameraList_from_camInfos(scene_info.test_cameras, scale, args)
        self.gaussians.create_from_pcd(scene_info.point_cloud, self.cameras_extent)

    def save(self, iteration):
        path = Path(self.model_path, "point_cloud", f"iteration_{iteration}", "point_cloud.ply")
        self.gaussians.save_ply(path)

    def getTrainCameras(self, scale=1.0):
        return self.train_cameras[scale]

    def getTestCameras(self, scale=1.0):
        return self.test_cameras[scale]
