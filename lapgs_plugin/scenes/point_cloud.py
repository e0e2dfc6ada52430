"""Read points with colours from PLY files of any program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.errors import SceneError
from lapgs_plugin.fields.ply import read_ply, scalar_names
from lapgs_plugin.fields.spherical_harmonics import SH_C0

COLOR_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
    ("f_dc_0", "f_dc_1", "f_dc_2"),
)
"""Names of a point's colour, in lower case; the last are spherical harmonics of degree 0 in files of 3DGS."""
RANGES = (1.0, 255.0, 65535.0)
"""Values of full brightness; integers have one of the last two."""
MOST = (0.01, 0.99)
"""Quantiles of colours that decide on their range. Few colours, such as highlights, are far outside of it."""
DARK = 0.1
"""Share of the range below which most colours are suspiciously dark, as if they had fewer bits, such as 12."""
UNDERSHOOT = 0.05
"""Excess of resampled colours below 0, as a share of the range."""
OVERSHOOT = 1.0
"""Excess of colours above the range, as a share of it."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """The points of a PLY file.

    Attributes:
        xyz: (n, 3) float64.
        rgb: (n, 3) float64 in [0, 1]; resampled colours may be slightly outside.
        warning: a line for the user who trains on the points, or "".
    """

    xyz: NDArray[np.float64]  # (n, 3)
    rgb: NDArray[np.float64]  # (n, 3)
    warning: str


def read_point_cloud(file: Path, subject: str) -> PointCloud:
    """Read the points of a PLY file; grey ones where it has no colours of a known name.

    Args:
        file: the PLY file.
        subject: begins messages, with the file in it.

    Raises:
        SceneError: it is not readable, has no positions, or colours of an unknown range.
    """
    try:
        element = read_ply(file)["vertex"]
    except (OSError, KeyError, ValueError) as error:
        raise SceneError(f"{subject}: not readable as a PLY of points ({error}); export or remove it") from error
    names = {prop.name.lower(): prop.name for prop in element.properties}
    channels = next((known for known in COLOR_NAMES if set(known) <= set(names)), ())
    numbers = {name.lower() for name in scalar_names(element)}
    if unusable := sorted({"x", "y", "z", *channels} - numbers):
        raise SceneError(
            f"{subject}: not readable as a PLY of points ({', '.join(unusable)} missing or a list, expected a number "
            "of each point); export or remove it"
        )
    xyz = np.stack([element.data[names[axis]] for axis in "xyz"], axis=1).astype(np.float64)
    if not channels:
        warning = f"{subject}: no colours among {', '.join(names.values())}; its points start grey"
        return PointCloud(xyz, np.full_like(xyz, 0.5), warning)
    values = np.stack([element.data[names[channel]] for channel in channels], axis=1)
    if channels == COLOR_NAMES[-1]:
        return PointCloud(xyz, 0.5 + SH_C0 * values.astype(np.float64), "")
    brightest, most = _range(values, subject)
    dark = most < DARK * brightest and len(xyz) > 0
    warning = f"{subject}: its colours are at most {most:g} of {brightest:g}, so that its points start dark; scale them"
    return PointCloud(xyz, values.astype(np.float64) / brightest, warning if dark else "")


def _range(values: NDArray[np.generic], subject: str) -> tuple[float, float]:
    """Return the value of full brightness of colours (n, 3), and the quantile below which most of them are."""
    finite = values[np.isfinite(values)].astype(np.float64)
    least, most = np.quantile(finite, MOST) if finite.size else (0.0, 0.0)
    ranges = RANGES if values.dtype.kind == "f" else RANGES[1:]
    brightest = next((value for value in ranges if most <= (1.0 + OVERSHOOT) * value), None)
    if brightest is None or least < -UNDERSHOOT * brightest:
        raise SceneError(
            f"{subject}: most of its colours are from {least:g} to {most:g}, expected 0 to 1, 0 to 255 or 0 to 65535; "
            "export them again"
        )
    return brightest, float(most)
