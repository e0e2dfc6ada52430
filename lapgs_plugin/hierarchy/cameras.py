"""Make cameras of pyramid levels."""

from __future__ import annotations

from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.hierarchy.plan import level_size


def level_camera(camera: Camera, level: int) -> Camera:
    """Return the camera of a pyramid level, from the camera of the full-resolution view.

    Raises:
        UserInputError: a negative level.
    """
    return camera.resized(*level_size(camera.size, level))


def level_intrinsics(intrinsics: Tensor, size: tuple[int, int], level: int) -> Tensor:
    """Return the intrinsics of a pyramid level's camera, for loops that keep cameras as matrices.

    Odd sizes are rounded up and the field of view is kept, so focal lengths are not exactly halved.

    Args:
        intrinsics: (..., 3, 3) matrices K of the full-resolution camera.
        size: (width, height) of the full-resolution image.
        level: 0 is full resolution.

    Returns:
        (..., 3, 3) with the type and device of `intrinsics`; float32 of integers.

    Raises:
        UserInputError: another shape, or a negative level.
    """
    if tuple(intrinsics.shape[-2:]) != (3, 3):
        raise UserInputError(f"intrinsics of shape {tuple(intrinsics.shape)}: expected (..., 3, 3), matrices K")
    intrinsics = intrinsics if intrinsics.is_floating_point() else intrinsics.float()
    width, height = level_size(size, level)
    factors = intrinsics.new_tensor([width / size[0], height / size[1], 1.0])
    return intrinsics * factors[:, None]
