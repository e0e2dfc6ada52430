"""Evaluate spherical harmonics up to degree 3 in 16 directions at once, with gradients by direction and coefficients.

Order and signs are those of 3D Gaussian Splatting, see `fields.spherical_harmonics`. The 48 coefficients of a Gaussian
are contiguous, three channels each, and are loaded and stored transposed, 16 Gaussians by 16 coefficients at a time.
"""

from __future__ import annotations

import math

from lapgs_plugin.jit.compiler import inline
from lapgs_plugin.jit.lanes import WIDTH, Floats, Lanes, Lanes3, Mask, fma, load_rows, select, store_rows

COLUMNS = 48
"""Coefficients of degree 3, three channels each."""

_C0 = math.sqrt(1 / (4 * math.pi))
_C1 = math.sqrt(3 / (4 * math.pi))
_C20 = math.sqrt(15 / (4 * math.pi))
_C21 = math.sqrt(5 / (16 * math.pi))
_C22 = math.sqrt(15 / (16 * math.pi))
_C30 = math.sqrt(35 / (32 * math.pi))
_C31 = math.sqrt(105 / (4 * math.pi))
_C32 = math.sqrt(21 / (32 * math.pi))
_C33 = math.sqrt(7 / (16 * math.pi))
_C34 = math.sqrt(105 / (16 * math.pi))


@inline
def sh_rows(sh: Floats, first: int, n: int, columns: int, spare: Floats) -> tuple[Floats, int]:
    """Return an array with 16 rows of 48 coefficients and their start: `sh`, or `spare` with a copy padded with zeros.

    Args:
        sh: (n * columns,).
        first: the first of the 16 rows; there may be fewer.
    """
    if columns == COLUMNS and first + WIDTH <= n:
        return sh, first * COLUMNS
    for lane in range(WIDTH):
        for i in range(COLUMNS):
            known = first + lane < n and i < columns
            spare[lane * COLUMNS + i] = sh[(first + lane) * columns + i] if known else 0.0
    return spare, 0


@inline
def _basis1(d: Lanes3) -> Lanes3:
    return d[1] * -_C1, d[2] * _C1, d[0] * -_C1


@inline
def _basis2(d: Lanes3) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes]:
    x, y, z = d
    xx, yy, zz = x * x, y * y, z * z
    return x * y * _C20, y * z * -_C20, (2.0 * zz - xx - yy) * _C21, x * z * -_C20, (xx - yy) * _C22


@inline
def _basis3(d: Lanes3) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes]:
    x, y, z = d
    xx, yy, zz = x * x, y * y, z * z
    around = 4.0 * zz - xx - yy
    return (
        y * (3.0 * xx - yy) * -_C30,
        x * y * z * _C31,
        y * around * -_C32,
        z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * _C33,
        x * around * -_C32,
        z * (xx - yy) * _C34,
        x * (xx - 3.0 * yy) * -_C30,
    )


@inline
def _plus(color: Lanes3, factor: Lanes, red: Lanes, green: Lanes, blue: Lanes) -> Lanes3:
    return fma(factor, red, color[0]), fma(factor, green, color[1]), fma(factor, blue, color[2])


@inline
def sh_color(rows: Floats, start: int, degree: int, d: Lanes3) -> Lanes3:
    """Return the sum of the harmonics up to `degree` in direction d times their coefficients, three channels.

    Args:
        rows, start: as `sh_rows` returns them.
        d: unit vector.
    """
    c = load_rows(rows, start, COLUMNS)
    color = (c[0] * _C0, c[1] * _C0, c[2] * _C0)
    if degree >= 1:
        b1 = _basis1(d)
        color = _plus(color, b1[0], c[3], c[4], c[5])
        color = _plus(color, b1[1], c[6], c[7], c[8])
        color = _plus(color, b1[2], c[9], c[10], c[11])
    if degree >= 2:
        c = load_rows(rows, start + 12, COLUMNS)
        b2 = _basis2(d)
        color = _plus(color, b2[0], c[0], c[1], c[2])
        color = _plus(color, b2[1], c[3], c[4], c[5])
        color = _plus(color, b2[2], c[6], c[7], c[8])
        color = _plus(color, b2[3], c[9], c[10], c[11])
        color = _plus(color, b2[4], c[12], c[13], c[14])
    if degree >= 3:
        c = load_rows(rows, start + 27, COLUMNS)
        b3 = _basis3(d)
        color = _plus(color, b3[0], c[0], c[1], c[2])
        color = _plus(color, b3[1], c[3], c[4], c[5])
        color = _plus(color, b3[2], c[6], c[7], c[8])
        color = _plus(color, b3[3], c[9], c[10], c[11])
        c = load_rows(rows, start + 32, COLUMNS)
        color = _plus(color, b3[4], c[7], c[8], c[9])
        color = _plus(color, b3[5], c[10], c[11], c[12])
        color = _plus(color, b3[6], c[13], c[14], c[15])
    return color


@inline
def _weighted(color: Lanes3, red: Lanes, green: Lanes, blue: Lanes) -> Lanes:
    return fma(color[0], red, fma(color[1], green, color[2] * blue))


@inline
def sh_direction_gradient(rows: Floats, start: int, degree: int, d: Lanes3, color: Lanes3) -> Lanes3:
    """Return the gradient by the direction from that by the result of `sh_color`.

    The component along the direction depends on which polynomials the harmonics are written as; the gradient of the
    direction's normalisation removes it.
    """
    x, y, z = d
    g_x, g_y, g_z = x * 0.0, x * 0.0, x * 0.0
    if degree >= 1:
        c = load_rows(rows, start, COLUMNS)
        g_x = _weighted(color, c[9], c[10], c[11]) * -_C1
        g_y = _weighted(color, c[3], c[4], c[5]) * -_C1
        g_z = _weighted(color, c[6], c[7], c[8]) * _C1
    if degree >= 2:
        c = load_rows(rows, start + 12, COLUMNS)
        s4 = _weighted(color, c[0], c[1], c[2]) * _C20
        s5 = _weighted(color, c[3], c[4], c[5]) * -_C20
        s6 = _weighted(color, c[6], c[7], c[8]) * (2.0 * _C21)
        s7 = _weighted(color, c[9], c[10], c[11]) * -_C20
        s8 = _weighted(color, c[12], c[13], c[14]) * (2.0 * _C22)
        g_x = g_x + fma(y, s4, fma(z, s7, x * (s8 - s6)))
        g_y = g_y + fma(x, s4, fma(z, s5, y * (-s8 - s6)))
        g_z = g_z + fma(y, s5, fma(x, s7, 2.0 * z * s6))
    if degree >= 3:
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        around, apart = 4.0 * zz - xx - yy, xx - yy
        c = load_rows(rows, start + 27, COLUMNS)
        s9 = _weighted(color, c[0], c[1], c[2]) * (-3.0 * _C30)
        s10 = _weighted(color, c[3], c[4], c[5]) * _C31
        s11 = _weighted(color, c[6], c[7], c[8]) * -_C32
        s12 = _weighted(color, c[9], c[10], c[11]) * (3.0 * _C33)
        c = load_rows(rows, start + 32, COLUMNS)
        s13 = _weighted(color, c[7], c[8], c[9]) * -_C32
        s14 = _weighted(color, c[10], c[11], c[12]) * _C34
        s15 = _weighted(color, c[13], c[14], c[15]) * (-3.0 * _C30)
        g_x = g_x + fma(around - 2.0 * xx, s13, apart * s15)
        g_x = g_x + fma(2.0 * xy, s9 - s11, fma(yz, s10, -2.0 * xz * (s12 - s14)))
        g_y = g_y + fma(around - 2.0 * yy, s11, apart * s9)
        g_y = g_y + fma(xz, s10, -2.0 * fma(yz, s12 + s14, xy * (s13 + s15)))
        g_z = g_z + fma(2.0 * zz - xx - yy, s12, apart * s14)
        g_z = g_z + fma(xy, s10, 8.0 * fma(yz, s11, xz * s13))
    return g_x, g_y, g_z


@inline
def store_sh_gradient(
    grad_sh: Floats, first: int, columns: int, degree: int, d: Lanes3, color: Lanes3, where: Mask, spare: Floats
) -> None:
    """Store the gradient by the coefficients of 16 rows: zero above `degree` and in lanes outside of `where`.

    Args:
        grad_sh: (m * columns,) with room for all 16 rows.
        d: unit vector.
        color: gradient by the colour that `sh_color` returned.
        spare: at least 16 * 48 floats.
    """
    # Both factors are masked, because zero times the NaN direction of a broken centre is not zero.
    r, g, b = select(where, color[0], 0.0), select(where, color[1], 0.0), select(where, color[2], 0.0)
    d = (select(where, d[0], 0.0), select(where, d[1], 0.0), select(where, d[2], 0.0))
    none = r * 0.0
    d1 = (none, none, none)
    d2 = (none, none, none, none, none)
    d3 = (none, none, none, none, none, none, none)
    if degree >= 1:
        d1 = _basis1(d)
    if degree >= 2:
        d2 = _basis2(d)
    if degree >= 3:
        d3 = _basis3(d)
    rows, start = (grad_sh, first * COLUMNS) if columns == COLUMNS else (spare, 0)
    store_rows(
        rows, start, COLUMNS,
        r * _C0, g * _C0, b * _C0, r * d1[0], g * d1[0], b * d1[0], r * d1[1], g * d1[1], b * d1[1],
        r * d1[2], g * d1[2], b * d1[2], r * d2[0], g * d2[0], b * d2[0], r * d2[1],
    )  # fmt: skip
    store_rows(
        rows, start + 16, COLUMNS,
        g * d2[1], b * d2[1], r * d2[2], g * d2[2], b * d2[2], r * d2[3], g * d2[3], b * d2[3],
        r * d2[4], g * d2[4], b * d2[4], r * d3[0], g * d3[0], b * d3[0], r * d3[1], g * d3[1],
    )  # fmt: skip
    store_rows(
        rows, start + 32, COLUMNS,
        b * d3[1], r * d3[2], g * d3[2], b * d3[2], r * d3[3], g * d3[3], b * d3[3], r * d3[4], g * d3[4], b * d3[4],
        r * d3[5], g * d3[5], b * d3[5], r * d3[6], g * d3[6], b * d3[6],
    )  # fmt: skip
    if columns != COLUMNS:
        for lane in range(WIDTH):
            for i in range(columns):
                grad_sh[(first + lane) * columns + i] = spare[lane * COLUMNS + i]
