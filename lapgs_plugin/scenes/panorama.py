"""Describe equirectangular photos as cameras of COLMAP."""

from __future__ import annotations

import pycolmap

from lapgs_plugin.errors import SceneError
from lapgs_plugin.scenes.source import ALL_AROUND

ROUNDED = 2
"""Largest difference in pixels of a panorama's width from twice its height, because programs round either."""
ALMOST = 0.02
"""Largest relative difference of the two that may be that of a panorama which lost rows or was resized."""


def is_panorama(size: tuple[int, int]) -> bool:
    """Return whether a photo of this width and height can show all around."""
    return abs(size[0] - 2 * size[1]) <= ROUNDED


def may_be_panorama(size: tuple[int, int]) -> bool:
    """Return whether a photo of this width and height is about twice as wide as high."""
    return abs(size[0] - 2 * size[1]) <= ALMOST * size[0]


def panorama_lens(size: tuple[int, int], where: str) -> pycolmap.Camera:
    """Return the camera of an equirectangular photo.

    Args:
        size: width and height in pixels.
        where: begins a message.

    Raises:
        SceneError: the photo does not show all around, or pycolmap is too old.
    """
    if not is_panorama(size):
        raise SceneError(
            f"{where}: an equirectangular photo of {size[0]}x{size[1]} pixels, expected twice as wide as high; export "
            "whole panoramas of 360x180 degrees"
        )
    if ALL_AROUND not in pycolmap.CameraModelId.__members__:
        raise SceneError(f"{where}: pycolmap {pycolmap.__version__} has no equirectangular cameras; upgrade it to 4.2")
    return pycolmap.Camera(model=ALL_AROUND, width=size[0], height=size[1], params=list(size))
