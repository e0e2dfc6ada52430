"""Write a page that shows a field in any browser with WebGL 2: one file, which needs no network."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from markupsafe import Markup
from numpy.typing import NDArray
from torch import Tensor

from lapgs_plugin.errors import FieldError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.quantization import (
    codebook,
    fixed_point,
    low_and_high,
    morton_order,
    packed_rotations,
    palette,
)
from lapgs_plugin.files import write_text
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH
from lapgs_plugin.rendering.rig import Rig, forward
from lapgs_plugin.reports.report import render_page

TEMPLATE = Path(__file__).with_name("splats.html.jinja")
NEAREST_TARGET = 0.05
"""Least distance of the point that the view turns around, in distances of the cameras from their focus."""

INVISIBLE = 1.0 / 255.0
"""Opacity below which no rasterizer draws a Gaussian."""

PART = 65_536
"""Gaussians of one part of a level, which a browser unpacks while the next one arrives."""

FIRST_PART = 16_384
"""Gaussians of the first part of a level, for an early first picture."""

SETS = 32_768
"""Most sets of coefficients in the palette: half of what SOG allows, as they would be 40 % of the page."""

COARSER = 0.5
"""A coarser level is shown first if it has at most this share of the Gaussians of the next finer one."""


def write_splat_page(
    fields: Sequence[GaussianField],
    path: Path,
    title: str,
    cameras: Sequence[Camera],
    background: tuple[float, float, float],
    near: float = NEAR_DEPTH,
    *,
    antialiased: bool = False,
) -> None:
    """Write the page.

    Args:
        fields: levels of detail, ordinary fields, the coarsest first. The page shows one until the next has arrived.
        path: of the page.
        title: of the page.
        cameras: of the training views; the page starts at the first and turns around the point that all look at.
        background: RGB in [0, 1] behind the Gaussians.
        near: least depth of Gaussians that are drawn, in world units.
        antialiased: dim Gaussians that are smaller than a pixel.

    Raises:
        FieldError: a field is a residual, or holds NaN or inf.
        RunFolderError: the page cannot be written.
    """
    levels = [pack_level(field, shaded=field is fields[-1]) for field in fields]
    parts = [base64.b64encode(part).decode() for level in levels for part in level.parts]
    start = {**_start(cameras), "background": background, "near": near, "antialiased": antialiased}
    start["levels"] = [level.header for level in levels]
    # Base64 and our own JSON of numbers hold nothing to escape.
    values = {"title": title, "start": Markup(json.dumps(start)), "parts": [Markup(part) for part in parts]}
    write_text(path, render_page(TEMPLATE, characters=sum(map(len, parts)), **values))


def shown_first(counts: Sequence[int]) -> list[int]:
    """Return the indices of levels that a page has, the coarsest first.

    Args:
        counts: Gaussians of the levels, the finest first.
    """
    chosen = [0]
    for index, count in enumerate(counts[1:], start=1):
        if count <= COARSER * counts[chosen[-1]]:
            chosen.append(index)
    return chosen[::-1]


@dataclass(frozen=True)
class PackedLevel:
    """A level as the page holds it.

    Attributes:
        header: what the page needs to unpack the parts.
        parts: each compressed by zlib. All but the last hold Gaussians, the most important ones first, as 17 planes of
            a byte for each: position (low bytes of x, y, z; high bytes), scale (3), colour (3), opacity, rotation (4).
            The last one has the higher SH coefficients, if any: low bytes and high bytes of labels, then the sets.
    """

    header: dict[str, Any]
    parts: list[bytes]


def pack_level(field: GaussianField, *, shaded: bool) -> PackedLevel:
    """Round the visible Gaussians of a field, as SOG does.

    Args:
        field: an ordinary one.
        shaded: keep SH coefficients above degree 0.

    Raises:
        FieldError: the field is a residual, or holds NaN or inf.
    """
    if field.signed:
        raise FieldError("a residual has signed colours, which no viewer shows by themselves; merge the run first")
    field = field.detach().to("cpu", torch.float32)
    field.require_finite()
    field = field.kept(_order(field))
    header: dict[str, Any] = {"count": len(field), "parts": 0, "degree": 0}
    if len(field) == 0:
        return PackedLevel(header, [])
    low, high, positions = fixed_point(field.means)
    header["scales"], scales = codebook(field.log_scales.numpy())
    header["colors"], colors = codebook(field.sh[:, 0].numpy())
    opacities = (torch.sigmoid(field.opacity_logits) * 255.0).round().byte().numpy()[:, None]
    rotations = packed_rotations(field.quaternions)
    rows = np.concatenate([low_and_high(positions), scales, colors, opacities, rotations], axis=1)  # (n, 17)
    parts = [_compressed(part) for part in np.split(rows, np.cumsum(_sizes(len(rows)))[:-1])]
    header |= {"low": low.tolist(), "high": high.tolist(), "parts": len(parts)}
    if shaded and field.sh_degree > 0:
        sets, labels = palette(field.sh[:, 1:], SETS)
        header["rest"], codes = codebook(sets)
        header |= {"degree": field.sh_degree, "sets": len(sets)}
        parts.append(_compressed(low_and_high(labels[:, None]), codes.reshape(1, -1)))
    return PackedLevel(header, parts)


def _order(field: GaussianField) -> Tensor:
    """Return the visible Gaussians: the most important part first, neighbours in a part beside each other."""
    opacities = torch.sigmoid(field.opacity_logits)
    order = (opacities.log() + field.log_scales.sum(dim=1)).argsort(descending=True)
    order = order[opacities[order] >= INVISIBLE]
    if len(order) == 0:
        return order
    parts = torch.split(order, _sizes(len(order)))
    return torch.cat([part[torch.from_numpy(morton_order(field.means[part].numpy()))] for part in parts])


def _sizes(count: int) -> list[int]:
    """Return how many Gaussians the parts of a level have."""
    first = min(count, FIRST_PART)
    return [first, *(min(PART, count - start) for start in range(first, count, PART))]


def _compressed(*tables: NDArray[np.uint8]) -> bytes:
    """Return the columns of tables one after the other, compressed."""
    return zlib.compress(b"".join(np.ascontiguousarray(table.T).tobytes() for table in tables), 9)


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
