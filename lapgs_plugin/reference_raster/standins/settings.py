"""`GaussianRasterizationSettings` of all rasterizers: one table of the fields that each takes, in its order.

Names are the CUDA bindings'; matrices are transposed. Beside what describes a view:

    mult            FastGS: share of the ellipse alpha = 1/255 that tiles are chosen by
    get_flag        FastGS: count, for each Gaussian, the marked pixels it is blended in
    metric_map      FastGS: (height * width,) int32, 1 marks a pixel
    antialiasing    graphdeco: dim Gaussians that are smaller than a pixel
    pixel_weights   Taming-3DGS: (height, width) float32 to sum up for each Gaussian, or None
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

_VIEW = (
    "image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix",
    "sh_degree", "campos",
)  # fmt: skip

FIELDS = {
    "graphdeco": (*_VIEW, "prefiltered", "debug"),
    "graphdeco-aa": (*_VIEW, "prefiltered", "debug", "antialiasing"),
    "graphdeco-accel": (*_VIEW, "prefiltered", "debug", "antialiasing"),
    "taming": (*_VIEW, "prefiltered", "debug", "pixel_weights"),
    "taming-rasterizer": (*_VIEW, "prefiltered", "debug"),
    "fastgs": (*_VIEW, "mult", "prefiltered", "debug", "get_flag", "metric_map"),
}
"""By the names that patches go by."""


def settings_class(variant: str) -> Any:
    """The named tuple that this rasterizer takes for its settings."""
    return namedtuple("GaussianRasterizationSettings", FIELDS[variant])
