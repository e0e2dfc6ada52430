"""COLMAP and Blender scenes as records that cameras are made from."""

from utils.plain_readers import CameraInfo, SceneInfo, sceneLoadTypeCallbacks

__all__ = ["CameraInfo", "SceneInfo", "sceneLoadTypeCallbacks"]
