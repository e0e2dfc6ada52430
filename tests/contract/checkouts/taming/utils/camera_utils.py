"""Cameras from what the readers found, at the size that `--resolution` asks for."""

from scene.cameras import Camera

from utils.general_utils import PILtoTorch
from utils.scene_files import size_for


def loadCam(args, id, cam_info, resolution_scale):
    resolution = size_for(*cam_info.image.size, args.resolution, resolution_scale)
    return Camera(
        colmap_id=cam_info.uid,
        R=cam_info.R,
        T=cam_info.T,
        FoVx=cam_info.FovX,
        FoVy=cam_info.FovY,
        image=PILtoTorch(cam_info.image, resolution)[:3],
        gt_alpha_mask=None,  # the code that this stands for looks for an alpha channel in the wrong dimension
        image_name=cam_info.image_name,
        uid=id,
        data_device=args.data_device,
    )


def cameraList_from_camInfos(cam_infos, resolution_scale, args):
    return [loadCam(args, index, info, resolution_scale) for index, info in enumerate(cam_infos)]
