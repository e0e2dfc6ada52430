"""Find and read maps of the normals that photos show, in the axes of their cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lapgs_plugin.errors import SceneError, first_line, printable
from lapgs_plugin.scenes.depth import INSIDE_SHARE, depth_size, find_maps, open_npy, read_maps
from lapgs_plugin.scenes.image_files import check_size
from lapgs_plugin.scenes.images import read_image, same_shape
from lapgs_plugin.scenes.masks import NONE, resolve_folder, stem_of
from lapgs_plugin.scenes.scene import Scene, View

ENDS = ("", "_normal", "_normals")
"""What the name of a map may have after that of its photo."""
UNIT = (0.7, 1.3)
"""Lengths between which a value is a normal; others, such as those of black pixels, are unknown."""
FACING = 0.9
"""Least share of the normals that look to the camera, or all away from it, in maps in the axes of cameras."""
ADVICE = "correct them, or train without (--normals none)"

Say = Callable[[str], None]


def resolve_normals(scene: Path, setting: str) -> str:
    """Resolve a value of --normals for a scene: "none", or a folder, relative to the scene or absolute.

    Raises:
        UserInputError: there is no such folder.
    """
    return NONE if setting == NONE else resolve_folder(scene, setting, "--normals", "a folder of normal maps, or none")


def load_normals(scene: Scene, setting: str, say: Say) -> dict[str, Tensor]:
    """Return unit normals (3, h, w) of the training views that have a map, NaN where they are not known.

    Axes are those of the camera: x right, y down, z forward. Maps whose y is up and z backward are turned.

    Args:
        scene: its masks apply to maps, too.
        setting: result of `resolve_normals`.
        say: receives how many views have a map, and a line if some cannot be used.

    Raises:
        SceneError: none can be used, or normals are not in the axes of cameras.
    """
    if setting == NONE:
        return {}
    folder, names = scene.path / setting, [view.name for view in scene.train]
    files = find_maps(folder, names, ENDS)
    if not files:
        raise SceneError(
            f"{folder}: no normal map of any of the {len(names)} training photos, expected the names of photos with "
            f"or without _normal, such as {printable(stem_of(names[0]))}.png; {ADVICE}"
        )
    maps = read_maps(scene.train, files, _read_normals, "normals", say)
    backward = _are_backward(maps, str(folder))
    axes = "y up, z backward (OpenGL)" if backward else "y down, z forward (OpenCV)"
    say(f"normals ({folder}): {len(maps)} of {len(names)} training photos have a map, read as x right, {axes}")
    turn = torch.tensor([1.0, -1.0, -1.0])[:, None, None]
    return {name: values * turn for name, values in maps.items()} if backward else maps


def _are_backward(maps: Mapping[str, Tensor], where: str) -> bool:
    """Return whether z of the normals points backward: what a camera sees looks towards it.

    Raises:
        SceneError: some do and others do not.
    """
    z = torch.cat([values[2].flatten() for values in maps.values()])
    share = float((z[~z.isnan()] > 0).float().mean())
    if 1.0 - FACING < share < FACING:
        raise SceneError(
            f"{where}: {share:.0%} of the normals have a positive z, expected nearly all or none, because what a photo "
            f"shows looks towards its camera; write them in the axes of cameras, not of the world; {ADVICE}"
        )
    return share > FACING


def _read_normals(file: Path, view: View) -> Tensor:
    """Return unit normals (3, h, w) as a map has them, at the size of depths; NaN where unknown or masked.

    Raises:
        SceneError: it cannot be used.
    """
    values = _read_values(file)
    height, width = values.shape[1:]
    size = view.camera.size
    if not same_shape((width, height), size):
        raise SceneError(
            f"{file}: the normal map is {width}x{height} pixels, its photo {size[0]}x{size[1]}; expected the same "
            "aspect ratio"
        )
    if bool((values >= 0.0).all()):
        values = 2.0 * values - 1.0  # a picture of them
    length = values.norm(dim=0)
    known = (length > UNIT[0]) & (length < UNIT[1])
    values = torch.where(known, values / length, 0.0)
    width, height = depth_size(size)
    if values.shape[1:] != (height, width):
        known = F.interpolate(known[None, None].float(), (height, width), mode="area")[0, 0] > INSIDE_SHARE
        values = F.normalize(F.interpolate(values[None], (height, width), mode="area")[0], dim=0)
    if view.mask is not None:
        known &= F.interpolate(view.mask[None].float(), (height, width), mode="area")[0, 0] > INSIDE_SHARE
    if not bool(known.any()):
        raise SceneError(f"{file}: no pixel holds a normal, expected vectors of length 1, or (n + 1) / 2 as colours")
    return torch.where(known, values, torch.nan)


def _read_values(file: Path) -> Tensor:
    """Return the values (3, h, w) of a file: of integers from 0 to 1, others as they are.

    Raises:
        SceneError: it cannot be read, or has no three channels.
    """
    if file.suffix.lower() != ".npy":
        return read_image(file, clamp=False)
    try:
        array = open_npy(file)
        if array.dtype.kind != "f":
            raise ValueError(f"it holds {array.dtype}, expected floating-point numbers")
        if array.ndim != 3 or 3 not in (array.shape[0], array.shape[2]):
            raise ValueError(f"its shape is {array.shape}, expected height, width and 3, or 3, height and width")
        first = array.shape[2] != 3
        check_size(file, array.shape[2 if first else 1], array.shape[1 if first else 0])
        values = torch.from_numpy(np.array(array, np.float32))
        return values if first else values.permute(2, 0, 1)
    except (OSError, ValueError) as error:
        raise SceneError(f"{file}: the normal map cannot be read ({first_line(error)})") from error
