"""Scenes from disk: COLMAP and Blender-style folders, their images, and the sizes they are trained at."""

from lapgs_plugin.scenes.scene import Scene, View

__all__ = ["Scene", "View"]
