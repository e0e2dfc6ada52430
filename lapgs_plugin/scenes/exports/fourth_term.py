"""Fit OpenCV's rational distortion to a radial polynomial with a fourth term, which COLMAP's lenses lack."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

SAMPLES = 400
WIDEST = 3.0
"""Largest undistorted radius that is tried, in distorted radii of the corner."""


def rational_terms(radial: Sequence[float], corner: float) -> tuple[NDArray[np.float64], float]:
    """Return k1 to k6 of (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶), and the largest error of r.

    Args:
        radial: the four factors of the polynomial 1 + k1 r² + ... + k4 r⁸.
        corner: distorted radius of the image's corner, at depth 1.
    """
    radius = np.linspace(0.0, WIDEST * corner, SAMPLES)
    distorted = radius * _polynomial(radial, radius)
    beyond = np.flatnonzero((distorted > corner) | (np.gradient(distorted) <= 0))  # where it turns back, no pixel is
    radius = np.linspace(0.0, radius[beyond[0]] if len(beyond) else radius[-1], SAMPLES)
    value, unit = _polynomial(radial, radius), radius[-1]
    powers = (radius[:, None] / unit) ** (2, 4, 6)
    solved = np.linalg.lstsq(np.c_[powers, -value[:, None] * powers], value - 1.0, rcond=None)[0]
    fitted = (1.0 + powers @ solved[:3]) / (1.0 + powers @ solved[3:])
    terms: NDArray[np.float64] = solved / unit ** np.array([2, 4, 6, 2, 4, 6])
    return terms, float(np.abs(radius * (fitted - value)).max())


def _polynomial(radial: Sequence[float], radius: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.polynomial.Polynomial([1.0, *radial])(radius**2)
