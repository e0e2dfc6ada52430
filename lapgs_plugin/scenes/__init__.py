"""Read and write scenes: COLMAP and Blender-style folders, their images and image sizes.

Functions that load scenes are imported on first use: `resolution` must work without the packages that read images.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lapgs_plugin.scenes.scene import Scene, View, load_cameras, load_scene, smallest_size

__all__ = ["Scene", "View", "load_cameras", "load_scene", "smallest_size"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.scene"), name)
