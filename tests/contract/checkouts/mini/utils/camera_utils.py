"""Cameras from what the readers found."""

from scene.cameras import Camera

from utils.plain_cameras import load_camera


def loadCam(args, id, cam_info, resolution_scale):
    return load_camera(Camera, args, id, cam_info, resolution_scale)


def cameraList_from_camInfos(cam_infos, resolution_scale, args):
    return [loadCam(args, index, info, resolution_scale) for index, info in enumerate(cam_infos)]
