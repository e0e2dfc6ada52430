"""The scene: cameras by resolution scale, its size, and the Gaussians it starts from."""

import json
import random
from pathlib import Path

from arguments import ModelParams
from utils.camera_utils import cameraList_from_camInfos
from utils.scene_files import write_scene_files

from scene.dataset_readers import sceneLoadTypeCallbacks
from scene.gaussian_model import GaussianModel


class Scene:
    gaussians: GaussianModel

    def __init__(self, args: ModelParams, gaussians: GaussianModel, shuffle=True, resolution_scales=(1.0,)):
        self.model_path = args.model_path
        self.gaussians = gaussians
        self.train_cameras = {}
        self.test_cameras = {}
        path = args.source_path
        if Path(path, "sparse").exists():
            read = sceneLoadTypeCallbacks["Colmap"]
            scene_info = read(path, args.images, args.depths, args.eval, args.train_test_exp)
        elif Path(path, "transforms_train.json").exists():
            scene_info = sceneLoadTypeCallbacks["Blender"](path, args.white_background, args.depths, args.eval)
        else:
            raise AssertionError("Could not recognize scene type!")
        write_scene_files(self.model_path, scene_info)
        if shuffle:
            random.shuffle(scene_info.train_cameras)
            random.shuffle(scene_info.test_cameras)
        self.cameras_extent = scene_info.nerf_normalization["radius"]
        synthetic = scene_info.is_nerf_synthetic
        for scale in resolution_scales:
            self.train_cameras[scale] = cameraList_from_camInfos(
                scene_info.train_cameras, scale, args, synthetic, False
            )
            self.test_cameras[scale] = cameraList_from_camInfos(scene_info.test_cameras, scale, args, synthetic, True)
        self.gaussians.create_from_pcd(scene_info.point_cloud, scene_info.train_cameras, self.cameras_extent)

    def save(self, iteration):
        path = Path(self.model_path, "point_cloud", f"iteration_{iteration}", "point_cloud.ply")
        self.gaussians.save_ply(path)
        exposures = {
            name: self.gaussians.get_exposure_from_name(name).detach().cpu().numpy().tolist()
            for name in self.gaussians.exposure_mapping
        }
        Path(self.model_path, "exposure.json").write_text(json.dumps(exposures, indent=2), encoding="utf-8")

    def getTrainCameras(self, scale=1.0):
        return self.train_cameras[scale]

    def getTestCameras(self, scale=1.0):
        return self.test_cameras[scale]
