"""Scenes: cameras, images and points, from COLMAP or Blender layouts or made up."""
