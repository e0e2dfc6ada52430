"""Write a page that shows a field in any browser with WebGL 2: one file, which needs no network."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from markupsafe import Markup

from lapgs_plugin.errors import FieldError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import SH_C0
from lapgs_plugin.files import write_text
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH
from lapgs_plugin.rendering.rig import Rig, forward
from lapgs_plugin.reports.report import render_page

TEMPLATE = Path(__file__).with_name("splats.html.jinja")
NEAREST_TARGET = 0.05
"""Least distance of the point that the view turns around, in distances of the cameras from their focus."""
INVISIBLE = 1.0 / 255.0
"""Opacity below which no rasterizer draws a Gaussian."""

LAYOUT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quaternion", "u1", 4)])


def write_splat_page(
    field: GaussianField,
    path: Path,
    title: str,
    cameras: Sequence[Camera],
    background: tuple[float, float, float],
    near: float = NEAR_DEPTH,
) -> None:
    """Write the page.

    Args:
        field: an ordinary field, of which the page shows SH degree 0.
        path: of the page.
        title: of the page.
        cameras: of the training views; the page starts at the first and turns around the point that all look at.
        background: RGB in [0, 1] behind the Gaussians.
        near: least depth of Gaussians that are drawn, in world units.

    Raises:
        FieldError: the field is a residual, or holds NaN or inf.
        RunFolderError: the page cannot be written.
    """
    splats = base64.b64encode(splat_bytes(field)).decode()
    start = json.dumps({**_start(cameras), "background": background, "near": near})
    # Base64 and our own JSON of numbers hold nothing to escape.
    write_text(path, render_page(TEMPLATE, title=title, start=Markup(start), splats=Markup(splats)))


def splat_bytes(field: GaussianField) -> bytes:
    """Return the visible Gaussians of a field as ".splat", the most important first, without SH of degree 1 and higher.

    This compact form of web viewers has 32 bytes a Gaussian: mean and standard deviations as float32, colour and
    opacity as 8 bits, and a normalised quaternion, wxyz, whose components q are stored as 128 q + 128.

    Raises:
        FieldError: the field is a residual, or holds NaN or inf.
    """
    if field.signed:
        raise FieldError("a residual has signed colours, which no viewer shows by themselves; merge the run first")
    field = field.detach().to("cpu", torch.float32)
    field.require_finite()
    opacities = torch.sigmoid(field.opacity_logits)
    importance = opacities.log() + field.log_scales.sum(dim=1)
    order = importance.argsort(descending=True)
    order = order[opacities[order] >= INVISIBLE]
    colors = (0.5 + SH_C0 * field.sh[order, 0]).clamp(0.0, 1.0)
    quaternions = torch.nn.functional.normalize(field.quaternions[order], dim=1)
    packed = np.zeros(len(order), LAYOUT)
    packed["mean"], packed["scale"] = field.means[order].numpy(), field.log_scales[order].exp().numpy()
    packed["rgba"] = (torch.cat([colors, opacities[order, None]], dim=1) * 255.0).round().numpy()
    packed["quaternion"] = (quaternions * 128.0 + 128.0).round().clamp(0.0, 255.0).numpy()
    return packed.tobytes()


def _start(cameras: Sequence[Camera]) -> dict[str, Any]:
    """Return the first view for the page: pose, field of view, and the point and axis to turn around."""
    rig, camera = Rig.of(cameras), cameras[0]
    position, ahead = camera.position.double().numpy(), forward(camera)
    depth = max(float(np.dot(rig.focus - position, ahead)), NEAREST_TARGET * rig.distance)
    return {
        "place": position.tolist(),
        "rotation": camera.world_to_camera[:3, :3].double().numpy().ravel().tolist(),  # rows right, down, forward
        "target": (position + depth * ahead).tolist(),
        "up": rig.up.tolist(),
        "focal": [camera.fx / camera.width, camera.fy / camera.height],
    }
