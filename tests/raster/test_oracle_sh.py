"""Spherical harmonics: orthonormal, in SciPy's Legendre functions, and with the sign convention of 3DGS."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import lpmv
from torch import Tensor

from lapgs_plugin.fields.spherical_harmonics import sh_basis, sh_to_color


def sphere_quadrature(degree: int) -> tuple[Tensor, Tensor]:
    """Directions (n, 3) and weights (n,) that integrate polynomials of up to `degree` over the sphere exactly."""
    cosines, weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    azimuths = np.arange(degree + 1) * 2 * math.pi / (degree + 1)
    sines = np.sqrt(1 - cosines**2)
    directions = np.stack(
        [
            np.outer(sines, np.cos(azimuths)),
            np.outer(sines, np.sin(azimuths)),
            np.outer(cosines, np.ones_like(azimuths)),
        ],
        axis=-1,
    )
    measure = np.repeat(weights * 2 * math.pi / (degree + 1), degree + 1)
    return torch.from_numpy(directions.reshape(-1, 3)), torch.from_numpy(measure)


def random_directions(n: int) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=torch.float64), dim=-1)


def test_basis_is_orthonormal_on_the_sphere() -> None:
    directions, weights = sphere_quadrature(degree=6)
    basis = sh_basis(directions, 3)  # (n, 16)
    gram = basis.T @ (weights[:, None] * basis)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-14)  # worst seen 1.1e-15


def test_basis_equals_scipys_legendre_functions_with_the_condon_shortley_phase() -> None:
    directions = random_directions(200)
    x, y, z = directions.numpy().T
    azimuth = np.arctan2(y, x)
    basis = sh_basis(directions, 3).numpy()
    for degree in range(4):
        for m in range(-degree, degree + 1):
            order = abs(m)
            norm = math.sqrt(
                (2 * degree + 1) / (4 * math.pi) * math.factorial(degree - order) / math.factorial(degree + order)
            )
            angular = {1: np.cos, -1: np.sin}.get(int(np.sign(m)))
            expected = (
                norm * lpmv(order, degree, z) * (1 if angular is None else math.sqrt(2) * angular(order * azimuth))
            )
            actual = basis[:, degree * degree + degree + m]
            np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-14)  # worst seen 3.0e-15


@pytest.mark.parametrize(
    ("direction", "index", "sign"),
    [((0, 1, 0), 1, -1), ((0, 0, 1), 2, 1), ((1, 0, 0), 3, -1), ((0.6, 0.8, 0), 4, 1), ((0, 0.6, 0.8), 5, -1)],
)
def test_signs_of_the_first_functions(direction: tuple[float, float, float], index: int, sign: int) -> None:
    """Y_1^-1 falls along y, Y_1^0 rises along z, Y_1^1 falls along x, Y_2^-2 rises with xy, Y_2^-1 falls with yz."""
    value = float(sh_basis(torch.tensor([direction], dtype=torch.float64), 2)[0, index])
    assert math.copysign(1, value) == sign


@pytest.mark.parametrize("degree", range(4))
def test_lower_degrees_are_prefixes(degree: int) -> None:
    directions = random_directions(20)
    assert torch.equal(sh_basis(directions, degree), sh_basis(directions, 3)[:, : (degree + 1) ** 2])


def test_color_reads_no_higher_degree() -> None:
    sh = torch.randn(5, 16, 3, dtype=torch.float64)
    sh[:, 4:] = math.nan
    assert torch.isfinite(sh_to_color(sh, random_directions(5), 1, signed=True)).all()


def test_unsigned_color_is_the_signed_one_shifted_and_clamped() -> None:
    sh, directions = torch.randn(50, 9, 3, dtype=torch.float64), random_directions(50)
    signed = sh_to_color(sh, directions, 2, signed=True)
    unsigned = sh_to_color(sh, directions, 2, signed=False)
    assert torch.equal(unsigned, torch.maximum(signed + 0.5, torch.zeros_like(signed)))
    assert (unsigned == 0).any()


def test_clamped_channels_pass_no_gradient_and_a_channel_at_zero_does() -> None:
    """As in the CUDA code, whose flag is set for values under 0 only."""
    constant = math.sqrt(1 / (4 * math.pi))
    at_zero = -0.5 / constant
    assert at_zero * constant == -0.5
    sh = torch.tensor([[[at_zero, at_zero - 1e-9, at_zero + 1e-9]]], dtype=torch.float64, requires_grad=True)
    sh_to_color(sh, random_directions(1), 0, signed=False).sum().backward()
    assert sh.grad is not None
    assert sh.grad.flatten().tolist() == [constant, 0.0, constant]
