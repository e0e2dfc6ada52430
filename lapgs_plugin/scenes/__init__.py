"""Scenes from disk: COLMAP and Blender-style folders, their images, and the sizes they are trained at."""

from lapgs_plugin.scenes.images import read_image, write_image
from lapgs_plugin.scenes.resolution import Resolution, parse_resolution
from lapgs_plugin.scenes.scene import Scene, View, load_cameras, load_scene, smallest_size

__all__ = [
    "Resolution",
    "Scene",
    "View",
    "load_cameras",
    "load_scene",
    "parse_resolution",
    "read_image",
    "smallest_size",
    "write_image",
]
