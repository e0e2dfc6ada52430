"""Read and write scenes: COLMAP and Blender-style folders, their images and image sizes.

Names are imported on first use, because `resolution` must work without the packages that read images.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

_MODULES = {
    "images": ("read_image", "write_image"),
    "resolution": ("Resolution", "parse_resolution"),
    "scene": ("Scene", "View", "load_cameras", "load_scene", "smallest_size"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
