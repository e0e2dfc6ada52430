"""Cameras of the 2023 release from what the readers found, at the size that `--resolution` asks for."""

from utils.general_utils import PILtoTorch
from utils.scene_files import size_for


def load_camera(kind, args, id, cam_info, resolution_scale):
    resolution = size_for(*cam_info.image.size, args.resolution, resolution_scale)
    return kind(
        colmap_id=cam_info.uid,
        R=cam_info.R,
        T=cam_info.T,
        FoVx=cam_info.FovX,
        FoVy=cam_info.FovY,
        image=PILtoTorch(cam_info.image, resolution)[:3],
        gt_alpha_mask=None,
        image_name=cam_info.image_name,
        uid=id,
        data_device=args.data_device,
    )
