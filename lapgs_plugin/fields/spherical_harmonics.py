"""Evaluate real spherical harmonics up to degree 3 in the order and with the signs of 3D Gaussian Splatting.

The functions are ordered Y_0^0, Y_1^-1, Y_1^0, Y_1^1, Y_2^-2, ..., Y_3^3 and orthonormal on the unit sphere. They carry
the Condon-Shortley phase, (-1)^m: every function of odd order m is negated against the convention without it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_SH_DEGREE = 3

SH_C0 = math.sqrt(1 / (4 * math.pi))
"""The constant function: a coefficient of (rgb - 0.5) / SH_C0 is the colour rgb from every direction."""
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = math.sqrt(15 / (4 * math.pi)), math.sqrt(5 / (16 * math.pi)), math.sqrt(15 / (16 * math.pi))
_C3 = (
    math.sqrt(35 / (32 * math.pi)),
    math.sqrt(105 / (4 * math.pi)),
    math.sqrt(21 / (32 * math.pi)),
    math.sqrt(7 / (16 * math.pi)),
    math.sqrt(105 / (16 * math.pi)),
)


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate basis functions up to a degree from 0 to 3 at unit vectors (n, 3): (n, (degree + 1)^2)."""
    assert 0 <= degree <= MAX_SH_DEGREE, degree
    x, y, z = directions.unbind(-1)  # (n,) each
    values = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        values += [
            _C2[0] * x * y,
            -_C2[0] * y * z,
            _C2[1] * (2 * z * z - x * x - y * y),
            -_C2[0] * x * z,
            _C2[2] * (x * x - y * y),
        ]
    if degree >= 3:
        values += [
            -_C3[0] * y * (3 * x * x - y * y),
            _C3[1] * x * y * z,
            -_C3[2] * y * (4 * z * z - x * x - y * y),
            _C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -_C3[2] * x * (4 * z * z - x * x - y * y),
            _C3[4] * z * (x * x - y * y),
            -_C3[0] * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, dim=-1)


def sh_to_color(sh: Tensor, directions: Tensor, degree: int, *, signed: bool) -> Tensor:
    """Return the colour of each Gaussian seen along a direction.

    Args:
        sh: (n, k, 3) coefficients, k at least (degree + 1)^2; higher ones are not read.
        directions: (n, 3) unit vectors from the camera to the Gaussian.
        degree: highest degree evaluated, 0 to 3.
        signed: True returns the raw value, False max(value + 0.5, 0).

    Returns:
        (n, 3) colours. A channel clamped to 0 passes no gradient; one at exactly 0 does, as in the CUDA code.
    """
    basis = sh_basis(directions, degree)  # (n, (degree + 1)^2)
    value = torch.einsum("nk,nkc->nc", basis, sh[:, : basis.shape[1]])  # (n, 3)
    return value if signed else (value + 0.5).clamp(min=0)
