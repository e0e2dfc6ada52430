"""Keep rasterizers whose kernels fail if no Gaussian is in any tile from rendering such images.

They write out of bounds or launch a grid of no blocks. One Gaussian more, which changes no pixel, prevents both.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH

SAMPLED = 65536
"""Approximate number of Gaussians in which `surely_blends` searches."""
MARGIN = 0.01
"""Least distance in pixels of a centre from the image border, for `surely_blends`."""
LARGEST_DEVIATION = 100.0
"""Largest standard deviation in pixels on the optical axis, for `surely_blends`."""
VISIBLE_LOGIT = math.log(2.4 / (255 - 2.4))
"""Logit of an opacity above exp(5/6) / 255 and below the 0.01 to which training resets opacities."""
COMPANION_OPACITY = 1.05 / 255


def surely_blends(field: GaussianField, camera: Camera) -> bool:
    """Return whether some Gaussian is certainly in a tile, whatever kernels round. False may mean that none was found.

    A tile includes a Gaussian whose alpha reaches 1/255 between the tile's first and last pixels. A centre in the image
    is at most half a pixel in each direction from such a position, where alpha is, with a variance of 0.3 px^2 or more,
    at least exp(-5/6) of the opacity.
    """
    with torch.no_grad():
        step = len(field) // SAMPLED + 1
        field = field.with_parameters({name: value[::step] for name, value in field.parameters.items()})
        pose = camera.world_to_camera.to(field.means)
        depths = field.means @ pose[2, :3] + pose[2, 3]  # (m,)
        centres = projected_centres(field, camera)  # (m, 2)
        last = centres.new_tensor([camera.width - 1, camera.height - 1])  # (2,)
        inside = ((centres >= MARGIN) & (centres <= last - MARGIN)).all(1)  # (m,)
        # The determinant of a large footprint's covariance could round to 0, which culls.
        moderate = torch.exp(field.log_scales.amax(1)) * max(camera.fx, camera.fy) < LARGEST_DEVIATION * depths  # (m,)
        visible = field.opacity_logits > VISIBLE_LOGIT  # (m,)
        return bool((inside & moderate & visible & (depths > 2 * NEAR_DEPTH)).any())


def companion(camera: Camera, like: Tensor, opacity: float = COMPANION_OPACITY) -> GaussianField:
    """Make a Gaussian of degree 0 that is in a tile but changes no pixel, with the type and device of `like`.

    It is a point between the first four pixels, where its alpha is just over 1/255. At the pixels, which it reaches by
    the 0.3 px^2 that are added to its variance, it is less than half of that.
    """
    pose = camera.world_to_camera.to("cpu", torch.float64)
    # Far enough for float32, whose rounding of the centre grows with the camera's distance from the origin.
    depth = 1 + float(pose[:3, 3].norm())
    point = torch.tensor([(1 - camera.cx) / camera.fx, (1 - camera.cy) / camera.fy, 1.0], dtype=torch.float64) * depth
    return GaussianField(
        means=((point - pose[:3, 3]) @ pose[:3, :3])[None].to(like),
        quaternions=like.new_tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=like.new_full((1, 3), math.log(1e-4 * depth / max(camera.fx, camera.fy))),
        opacity_logits=like.new_full((1,), math.log(opacity / (1 - opacity))),
        sh=like.new_zeros(1, 1, 3),
    )


def projected_centres(field: GaussianField, camera: Camera) -> Tensor:
    """Return projected centres in pixels, (n, 2); meaningless behind the camera."""
    x, y, depth = camera.local(field.means).unbind(-1)  # (n,) each
    centres = torch.stack([camera.fx * x / depth + camera.cx - 0.5, camera.fy * y / depth + camera.cy - 0.5], dim=-1)
    return centres.nan_to_num(0, 0, 0)  # NaN of a depth of 0 would survive the multiplication by 0 that culls it
