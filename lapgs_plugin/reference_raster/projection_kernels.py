"""From Gaussians in the world to splats on the image and back: EWA projection, spherical harmonics, their gradients.

Sixteen Gaussians are worked on at once, one in each lane. Kernels take the parameters that training optimizes ("raw") or
activated ones: standard deviations, opacities in [0, 1] and quaternions used as they are, as the CUDA rasterizers do.

The 2D covariance is M M^T + 0.3 I with the 2x3 matrix M = J W R S. Its determinant comes from the 2x2 minors of M, sums
of squares, where the usual difference of products loses all digits of an elongated Gaussian in float32.

Gradients follow the CUDA code: where the Jacobian's x / z is clamped, the clamped x is taken for a constant.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.reference_raster._jit import inline, jit
from lapgs_plugin.reference_raster.lanes import (
    WIDTH,
    Floats,
    Lanes,
    Mask,
    absolute,
    any_lane,
    at,
    ceil,
    exp,
    fetch_add,
    floor,
    fma,
    load,
    load_columns,
    load_rows,
    log2,
    maximum,
    minimum,
    select,
    splat,
    sqrt,
    store,
    store_columns,
    store_rows,
    store_whole,
)
from lapgs_plugin.reference_raster.layout import (
    BLUE_FREE,
    FACTOR_SCALE,
    FACTOR_XX,
    FACTOR_XY,
    FACTOR_YY,
    FOCAL_X,
    FOCAL_Y,
    GREEN_FREE,
    LIMIT_X,
    LIMIT_Y,
    LOG2_MIN_ALPHA,
    NEAR_DEPTH,
    OPACITY,
    PIXEL_VARIANCE,
    POSITION,
    PRINCIPAL_X,
    PRINCIPAL_Y,
    RED_FREE,
    ROTATION,
    SLOT,
    SPLAT,
    SUM_1,
    SUM_ABS_X,
    SUM_ABS_Y,
    SUM_BLUE,
    SUM_GREEN,
    SUM_RED,
    SUM_U,
    SUM_UU,
    SUM_UV,
    SUM_V,
    SUM_VV,
    TILE,
    TRANSLATION,
)

SH_COLUMNS = 48
"""Coefficients of degree 3, three channels each."""

RADIUS_SIGMAS = 3.0
MIN_ROOT = 0.1
"""Lower bound of the squared half difference of the covariance's eigenvalues, in px^4, as in the CUDA code."""
MAX_RADIUS = 2.0**30
"""Radii saturate here, in px, so that they fit int32."""
HUGE = 1e37
"""Determinants in px^4 and coordinates in px from here on are taken for overflown, and the Gaussian is culled."""
REACH_SLACK = 1e-3
REACH_SLOPE = 1e-5
"""By how much the ellipse that holds all alpha of 1/255 or more is widened against rounding; only speed depends on it."""

MIN_NORM = 1e-12
"""Shorter quaternions are divided by this instead of their length, as torch.nn.functional.normalize does."""

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

_Vector = tuple[Lanes, Lanes, Lanes]
_Floats9 = tuple[float, float, float, float, float, float, float, float, float]


# ------------------------------------------------------------------------------------------- reading and writing


@inline
def _columns3(array: Floats, first: int, n: int, spare: Floats) -> _Vector:
    """Three columns of 16 rows from `first` on; rows past the n-th are zero."""
    if first + WIDTH <= n:
        return load_columns(array, first * 3, 3)
    for i in range(3 * WIDTH):
        spare[i] = at(array, first * 3 + i) if first * 3 + i < 3 * n else 0.0
    return load_columns(spare, 0, 3)


@inline
def _columns4(array: Floats, first: int, n: int, spare: Floats) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Four columns of 16 rows from `first` on; rows past the n-th are zero."""
    if first + WIDTH <= n:
        return load_columns(array, first * 4, 4)
    for i in range(4 * WIDTH):
        spare[i] = at(array, first * 4 + i) if first * 4 + i < 4 * n else 0.0
    return load_columns(spare, 0, 4)


@inline
def _column(array: Floats, first: int, n: int, spare: Floats) -> Lanes:
    """16 elements from `first` on; those past the n-th are zero."""
    if first + WIDTH <= n:
        return load(array, first)
    for i in range(WIDTH):
        spare[i] = at(array, first + i) if first + i < n else 0.0
    return load(spare, 0)


@inline
def _sh_rows(sh: Floats, first: int, n: int, columns: int, spare: Floats) -> tuple[Floats, int]:
    """Where 16 rows of 48 coefficients begin: in `sh` itself, or filled up with zeros in `spare`."""
    if columns == SH_COLUMNS and first + WIDTH <= n:
        return sh, first * SH_COLUMNS
    for lane in range(WIDTH):
        for i in range(SH_COLUMNS):
            known = first + lane < n and i < columns
            spare[lane * SH_COLUMNS + i] = at(sh, (first + lane) * columns + i) if known else 0.0
    return spare, 0


# ------------------------------------------------------------------------------------------------ geometry


@inline
def _dot(a: _Vector, b: _Vector) -> Lanes:
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


@inline
def _turned(camera: Floats, row: int, vector: _Vector) -> Lanes:
    """A row of the camera's rotation times a vector."""
    i = ROTATION + 3 * row
    return fma(vector[0], at(camera, i), fma(vector[1], at(camera, i + 1), vector[2] * at(camera, i + 2)))


@inline
def _axes(q: tuple[Lanes, Lanes, Lanes, Lanes]) -> tuple[_Vector, _Vector, _Vector]:
    """Rows of the rotation matrix of a quaternion (w, x, y, z)."""
    w, x, y, z = q
    return (
        (1.0 - 2.0 * fma(y, y, z * z), 2.0 * fma(x, y, -(w * z)), 2.0 * fma(x, z, w * y)),
        (2.0 * fma(x, y, w * z), 1.0 - 2.0 * fma(x, x, z * z), 2.0 * fma(y, z, -(w * x))),
        (2.0 * fma(x, z, -(w * y)), 2.0 * fma(y, z, w * x), 1.0 - 2.0 * fma(x, x, y * y)),
    )


@inline
def _length(q: tuple[Lanes, Lanes, Lanes, Lanes]) -> Lanes:
    return sqrt(fma(q[0], q[0], fma(q[1], q[1], fma(q[2], q[2], q[3] * q[3]))))


@inline
def _scaled(q: tuple[Lanes, Lanes, Lanes, Lanes], factor: Lanes) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    return q[0] * factor, q[1] * factor, q[2] * factor, q[3] * factor


@inline
def _screen_rows(camera: Floats, inverse_depth: Lanes, x: Lanes, y: Lanes) -> tuple[_Vector, _Vector]:
    """The 2x3 matrix J W: rows of the derivative of the pixel coordinates by the position in the world.

    Args:
        inverse_depth: 1 / z of the centre in camera coordinates.
        x, y: x / z and y / z, clamped.
    """
    x_scale, y_scale = inverse_depth * at(camera, FOCAL_X), inverse_depth * at(camera, FOCAL_Y)
    r = ROTATION
    x_row = (
        x_scale * (at(camera, r) - x * at(camera, r + 6)),
        x_scale * (at(camera, r + 1) - x * at(camera, r + 7)),
        x_scale * (at(camera, r + 2) - x * at(camera, r + 8)),
    )
    y_row = (
        y_scale * (at(camera, r + 3) - y * at(camera, r + 6)),
        y_scale * (at(camera, r + 4) - y * at(camera, r + 7)),
        y_scale * (at(camera, r + 5) - y * at(camera, r + 8)),
    )
    return x_row, y_row


@inline
def _clamped(value: Lanes, limit: float) -> Lanes:
    return minimum(maximum(value, -limit), limit)


@inline
def _times(row: _Vector, axes: tuple[_Vector, _Vector, _Vector]) -> _Vector:
    """A row vector times a matrix given by its rows."""
    return (
        fma(row[0], axes[0][0], fma(row[1], axes[1][0], row[2] * axes[2][0])),
        fma(row[0], axes[0][1], fma(row[1], axes[1][1], row[2] * axes[2][1])),
        fma(row[0], axes[0][2], fma(row[1], axes[1][2], row[2] * axes[2][2])),
    )


@inline
def _each(a: _Vector, b: _Vector) -> _Vector:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


# ------------------------------------------------------------------------------------------------ colour


@inline
def _direction(camera: Floats, mean: _Vector) -> tuple[_Vector, Lanes]:
    """Unit vector from the camera to the centre, and one over the distance."""
    x = mean[0] - at(camera, POSITION)
    y = mean[1] - at(camera, POSITION + 1)
    z = mean[2] - at(camera, POSITION + 2)
    inverse = 1.0 / sqrt(fma(x, x, fma(y, y, z * z)))
    return (x * inverse, y * inverse, z * inverse), inverse


@inline
def _basis1(d: _Vector) -> _Vector:
    """Spherical harmonics of degree 1 of a unit vector."""
    return d[1] * -_C1, d[2] * _C1, d[0] * -_C1


@inline
def _basis2(d: _Vector) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes]:
    x, y, z = d
    xx, yy, zz = x * x, y * y, z * z
    return x * y * _C20, y * z * -_C20, (2.0 * zz - xx - yy) * _C21, x * z * -_C20, (xx - yy) * _C22


@inline
def _basis3(d: _Vector) -> tuple[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes]:
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
def _evaluate(rows: Floats, start: int, degree: int, d: _Vector) -> _Vector:
    """Sum of the harmonics up to `degree` in direction d, for three channels; 48 coefficients a row."""
    c = load_rows(rows, start, SH_COLUMNS)
    red, green, blue = c[0] * _C0, c[1] * _C0, c[2] * _C0
    if degree >= 1:
        b1 = _basis1(d)
        red = fma(b1[0], c[3], fma(b1[1], c[6], fma(b1[2], c[9], red)))
        green = fma(b1[0], c[4], fma(b1[1], c[7], fma(b1[2], c[10], green)))
        blue = fma(b1[0], c[5], fma(b1[1], c[8], fma(b1[2], c[11], blue)))
    if degree >= 2:
        c = load_rows(rows, start + 12, SH_COLUMNS)
        b2 = _basis2(d)
        red = fma(b2[0], c[0], fma(b2[1], c[3], fma(b2[2], c[6], fma(b2[3], c[9], fma(b2[4], c[12], red)))))
        green = fma(b2[0], c[1], fma(b2[1], c[4], fma(b2[2], c[7], fma(b2[3], c[10], fma(b2[4], c[13], green)))))
        blue = fma(b2[0], c[2], fma(b2[1], c[5], fma(b2[2], c[8], fma(b2[3], c[11], fma(b2[4], c[14], blue)))))
    if degree >= 3:
        c = load_rows(rows, start + 27, SH_COLUMNS)
        b3 = _basis3(d)
        red = fma(b3[0], c[0], fma(b3[1], c[3], fma(b3[2], c[6], fma(b3[3], c[9], red))))
        green = fma(b3[0], c[1], fma(b3[1], c[4], fma(b3[2], c[7], fma(b3[3], c[10], green))))
        blue = fma(b3[0], c[2], fma(b3[1], c[5], fma(b3[2], c[8], fma(b3[3], c[11], blue))))
        c = load_rows(rows, start + 32, SH_COLUMNS)
        red = fma(b3[4], c[7], fma(b3[5], c[10], fma(b3[6], c[13], red)))
        green = fma(b3[4], c[8], fma(b3[5], c[11], fma(b3[6], c[14], green)))
        blue = fma(b3[4], c[9], fma(b3[5], c[12], fma(b3[6], c[15], blue)))
    return red, green, blue


# ------------------------------------------------------------------------------------------------ forward


@jit
def project(
    counter: NDArray[np.int64],  # (1,) zero
    n: int,
    means: Floats,  # (n * 3,)
    quats: Floats,  # (n * 4,)
    scales: Floats,  # (n * 3,)
    opacities: Floats,  # (n,)
    sh: Floats,  # (n * columns,), or empty
    colors: Floats,  # (n * 3,), read if `sh` is empty
    columns: int,  # floats a row of `sh`: 3 for each coefficient
    raw: bool,  # logarithms of scales, logits of opacities, quaternions of any length
    signed: bool,  # the colour is the SH value; otherwise max(value + 0.5, 0)
    degree: int,
    camera: Floats,  # (CAMERA,)
    tiles_x: int,
    tiles_y: int,
    splats: Floats,  # (m * SPLAT,), m: n rounded up to whole vectors
    boxes: NDArray[np.int32],  # (4 * m,) first tile across, down, one past the last across, down; empty: not seen
    radii: NDArray[np.int32],  # (m,) three-sigma radii in pixels; 0: culled
    depths: Floats,  # (m,)
    centres: Floats,  # (m * 2,) pixel coordinates; 0: culled
) -> None:
    """Project Gaussians to splats."""
    padded = radii.size
    spare = np.empty(WIDTH * SH_COLUMNS, splats.dtype)
    while True:
        first = fetch_add(counter, 1) * WIDTH
        if first >= n:
            break
        mean = _columns3(means, first, n, spare)
        x = _turned(camera, 0, mean) + at(camera, TRANSLATION)
        y = _turned(camera, 1, mean) + at(camera, TRANSLATION + 1)
        depth = _turned(camera, 2, mean) + at(camera, TRANSLATION + 2)
        seen = depth > NEAR_DEPTH
        if not any_lane(seen):
            _store_unseen(first, splats, boxes, radii, centres)
            continue
        inverse_depth = 1.0 / depth
        x = x * inverse_depth
        y = y * inverse_depth
        centre_x = fma(x, at(camera, FOCAL_X), at(camera, PRINCIPAL_X) - 0.5)
        centre_y = fma(y, at(camera, FOCAL_Y), at(camera, PRINCIPAL_Y) - 0.5)

        quat = _columns4(quats, first, n, spare)
        scale = _columns3(scales, first, n, spare)
        opacity = _column(opacities, first, n, spare)
        if raw:
            quat = _scaled(quat, 1.0 / maximum(_length(quat), MIN_NORM))
            scale = (exp(scale[0]), exp(scale[1]), exp(scale[2]))
            opacity = 1.0 / (1.0 + exp(-opacity))
        limit_x, limit_y = at(camera, LIMIT_X), at(camera, LIMIT_Y)
        x_row, y_row = _screen_rows(camera, inverse_depth, _clamped(x, limit_x), _clamped(y, limit_y))
        axes = _axes(quat)
        m_x = _each(_times(x_row, axes), scale)
        m_y = _each(_times(y_row, axes), scale)
        xx, xy, yy = _dot(m_x, m_x), _dot(m_x, m_y), _dot(m_y, m_y)
        minor_0 = fma(m_x[0], m_y[1], -(m_x[1] * m_y[0]))
        minor_1 = fma(m_x[0], m_y[2], -(m_x[2] * m_y[0]))
        minor_2 = fma(m_x[1], m_y[2], -(m_x[2] * m_y[1]))
        area = _dot((minor_0, minor_1, minor_2), (minor_0, minor_1, minor_2))
        determinant = fma(xx + yy, PIXEL_VARIANCE, area + PIXEL_VARIANCE * PIXEL_VARIANCE)
        xx = xx + PIXEL_VARIANCE
        yy = yy + PIXEL_VARIANCE

        half_difference = 0.5 * (xx - yy)
        root = sqrt(maximum(fma(half_difference, half_difference, xy * xy), MIN_ROOT))
        radius = minimum(ceil(RADIUS_SIGMAS * sqrt(0.5 * (xx + yy) + root)), MAX_RADIUS)
        left = _clipped(floor((centre_x - radius) * (1.0 / TILE)), tiles_x)
        top = _clipped(floor((centre_y - radius) * (1.0 / TILE)), tiles_y)
        right = _clipped(floor((centre_x + radius + (TILE - 1.0)) * (1.0 / TILE)), tiles_x)
        bottom = _clipped(floor((centre_y + radius + (TILE - 1.0)) * (1.0 / TILE)), tiles_y)
        # What is not a number fails each comparison, so broken parameters are culled here.
        finite = (determinant < HUGE) & (absolute(centre_x) < HUGE) & (absolute(centre_y) < HUGE)
        seen = seen & finite & (left < right) & (top < bottom)

        factor_xx = sqrt(yy / determinant) * FACTOR_SCALE
        ridge_x, ridge_y = xy / yy, xy / xx
        log2_opacity = log2(opacity)
        margin = log2_opacity - LOG2_MIN_ALPHA
        # Rounding moves the border of 1/255 by some epsilon of the products whose difference u is.
        reach = fma(absolute(margin), sqrt(xx * yy / determinant) * REACH_SLOPE, margin + REACH_SLACK)
        box = (left, top, right, bottom)
        box = _tight_box(box, centre_x, centre_y, sqrt(reach * xx), sqrt(reach * yy), tiles_x, tiles_y)
        shown = seen & (reach > 0.0)
        store_whole(boxes, first, select(shown, box[0], 0.0))
        store_whole(boxes, first + padded, select(shown, box[1], 0.0))
        store_whole(boxes, first + 2 * padded, select(shown, box[2], 0.0))
        store_whole(boxes, first + 3 * padded, select(shown, box[3], 0.0))
        store_whole(radii, first, select(seen, radius, 0.0))
        store(depths, first, depth)
        store_columns(centres, first * 2, select(seen, centre_x, 0.0), select(seen, centre_y, 0.0))

        if colors.size > 0:
            red, green, blue = _columns3(colors, first, n, spare)
        else:
            rows, start = _sh_rows(sh, first, n, columns, spare)
            red, green, blue = _evaluate(rows, start, degree, _direction(camera, mean)[0])
        one = splat(splats, 1.0)
        red_free, green_free, blue_free = one, one, one
        if colors.size == 0 and not signed:
            red, green, blue = red + 0.5, green + 0.5, blue + 0.5
            red_free, green_free, blue_free = _free(red, one), _free(green, one), _free(blue, one)
            red, green, blue = maximum(red, 0.0), maximum(green, 0.0), maximum(blue, 0.0)
        store_rows(
            splats, first * SPLAT, SPLAT,
            centre_x, centre_y,
            factor_xx, ridge_x * -factor_xx, FACTOR_SCALE / sqrt(yy),
            log2_opacity, red, green, blue, reach, ridge_x, ridge_y,
            red_free, green_free, blue_free, opacity,
        )  # fmt: skip


@inline
def _free(color: Lanes, one: Lanes) -> Lanes:
    """1 where a colour is not under 0, so that clamping leaves it alone; 1 for NaN, which must stay visible."""
    return select(color < 0.0, 0.0, one)


@inline
def _clipped(tile: Lanes, tiles: int) -> Lanes:
    return minimum(maximum(tile, 0.0), tiles)


@inline
def _tight_box(
    box: tuple[Lanes, Lanes, Lanes, Lanes],
    centre_x: Lanes,
    centre_y: Lanes,
    root_x: Lanes,
    root_y: Lanes,
    tiles_x: int,
    tiles_y: int,
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """The tiles of a three-sigma rectangle that hold pixels of the ellipse's bounding box.

    Args:
        root_x, root_y: half the sides of that box, over sqrt(2 ln 2).
    """
    half_x, half_y = root_x * (1.0 / FACTOR_SCALE), root_y * (1.0 / FACTOR_SCALE)
    return (
        maximum(box[0], _clipped(floor(ceil(centre_x - half_x) * (1.0 / TILE)), tiles_x)),
        maximum(box[1], _clipped(floor(ceil(centre_y - half_y) * (1.0 / TILE)), tiles_y)),
        minimum(box[2], _clipped(floor((centre_x + half_x) * (1.0 / TILE)) + 1.0, tiles_x)),
        minimum(box[3], _clipped(floor((centre_y + half_y) * (1.0 / TILE)) + 1.0, tiles_y)),
    )


@inline
def _store_unseen(
    first: int,
    splats: Floats,
    boxes: NDArray[np.int32],
    radii: NDArray[np.int32],
    centres: Floats,
) -> None:
    """What `project` says of 16 Gaussians that are all behind the camera."""
    nothing = splat(splats, 0.0)
    for side in range(4):
        store_whole(boxes, first + side * radii.size, nothing)
    store_whole(radii, first, nothing)
    store_columns(centres, first * 2, nothing, nothing)


# ------------------------------------------------------------------------------------------------ backward


@jit
def project_backward(
    counter: NDArray[np.int64],  # (1,) zero
    n: int,
    means: Floats,
    quats: Floats,
    scales: Floats,
    sh: Floats,
    columns: int,
    raw: bool,
    degree: int,
    camera: Floats,
    splats: Floats,
    first_pair: NDArray[np.int64],  # (n + 1,) where the places of each Gaussian's slots begin
    places: NDArray[np.int32],  # (pairs,) number of the slot
    slots: Floats,  # (pairs * SLOT,)
    grad_means: Floats,  # (m * 3,)
    grad_quats: Floats,  # (m * 4,)
    grad_scales: Floats,  # (m * 3,)
    grad_opacities: Floats,  # (m,)
    grad_sh: Floats,  # (m * columns,), or empty
    grad_colors: Floats,  # (m * 3,), written if `sh` is empty
    grad_centres: Floats,  # (m * 2,)
    absgrad_centres: Floats,  # (m * 2,)
) -> None:
    """Gradients of what `project` takes, from the sums that the tiles' backward passes left. m: see there."""
    spare = np.empty(WIDTH * SH_COLUMNS, splats.dtype)
    sums = np.empty(WIDTH * SLOT, splats.dtype)
    pairs = np.empty(WIDTH, splats.dtype)
    while True:
        first = fetch_add(counter, 1) * WIDTH
        if first >= n:
            break
        _sum_slots(first, n, first_pair, places, slots, sums, pairs)
        blended = load(pairs, 0) > 0.0
        if not any_lane(blended):
            _store_no_gradient(
                first, columns, grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, grad_colors,
                grad_centres, absgrad_centres,
            )  # fmt: skip
            continue
        total = load_rows(sums, 0, SLOT)
        seen = load_rows(splats, first * SPLAT, SPLAT)
        mean = _columns3(means, first, n, spare)

        d_color = (
            total[SUM_RED] * seen[RED_FREE], total[SUM_GREEN] * seen[GREEN_FREE], total[SUM_BLUE] * seen[BLUE_FREE]
        )  # fmt: skip
        if sh.size > 0:
            direction, inverse_distance = _direction(camera, mean)
            rows, start = _sh_rows(sh, first, n, columns, spare)
            d_direction = _direction_gradient(rows, start, degree, direction, d_color)
            _store_sh_gradient(grad_sh, first, columns, degree, direction, d_color, blended, spare)
            d_mean = _normalize_backward(direction, inverse_distance, d_direction)
        else:
            _store3(grad_colors, first, d_color, blended)
            d_mean = (d_color[0] * 0.0, d_color[1] * 0.0, d_color[2] * 0.0)

        opacity = seen[OPACITY]
        d_opacity = total[SUM_1] * (1.0 - opacity) if raw else total[SUM_1] / opacity
        store(grad_opacities, first, select(blended, d_opacity, 0.0))

        l_xx, l_xy, l_yy = seen[FACTOR_XX], seen[FACTOR_XY], seen[FACTOR_YY]
        d_centre_x = total[SUM_U] * l_xx * _UNIT
        d_centre_y = fma(total[SUM_U], l_xy, total[SUM_V] * l_yy) * _UNIT
        store_columns(grad_centres, first * 2, select(blended, d_centre_x, 0.0), select(blended, d_centre_y, 0.0))
        absolute_x, absolute_y = total[SUM_ABS_X] * l_xx * _UNIT, total[SUM_ABS_Y] * _UNIT
        store_columns(absgrad_centres, first * 2, select(blended, absolute_x, 0.0), select(blended, absolute_y, 0.0))

        # With the inverse covariance L^T L and E = ((uu, uv), (uv, vv)) the derivative by the covariance is L^T E L / 2,
        # and that by M twice as much times M.
        uu, uv, vv = total[SUM_UU], total[SUM_UV], total[SUM_VV]
        mixed = fma(l_xy, uu, l_yy * uv)
        g_xx = l_xx * l_xx * uu * _UNIT**2
        g_xy = l_xx * mixed * _UNIT**2
        g_yy = fma(l_xy, mixed, l_yy * fma(l_xy, uv, l_yy * vv)) * _UNIT**2

        quat = _columns4(quats, first, n, spare)
        scale = _columns3(scales, first, n, spare)
        length = _length(quat)
        if raw:
            quat = _scaled(quat, 1.0 / maximum(length, MIN_NORM))
            scale = (exp(scale[0]), exp(scale[1]), exp(scale[2]))
        x = _turned(camera, 0, mean) + at(camera, TRANSLATION)
        y = _turned(camera, 1, mean) + at(camera, TRANSLATION + 1)
        depth = _turned(camera, 2, mean) + at(camera, TRANSLATION + 2)
        inverse_depth = 1.0 / depth
        x, y = x * inverse_depth, y * inverse_depth
        limit_x, limit_y = at(camera, LIMIT_X), at(camera, LIMIT_Y)
        near_x, near_y = _clamped(x, limit_x), _clamped(y, limit_y)
        x_row, y_row = _screen_rows(camera, inverse_depth, near_x, near_y)
        axes = _axes(quat)
        n_x, n_y = _times(x_row, axes), _times(y_row, axes)
        m_x, m_y = _each(n_x, scale), _each(n_y, scale)
        d_m_x, d_m_y = _mixed(g_xx, m_x, g_xy, m_y), _mixed(g_xy, m_x, g_yy, m_y)
        if raw:
            d_scale = _mixed3(d_m_x, m_x, d_m_y, m_y)
        else:
            d_scale = _mixed3(d_m_x, n_x, d_m_y, n_y)
        _store3(grad_scales, first, d_scale, blended)

        d_n_x, d_n_y = _each(d_m_x, scale), _each(d_m_y, scale)
        d_quat = _quaternion_gradient(
            quat,
            _mixed(x_row[0], d_n_x, y_row[0], d_n_y),
            _mixed(x_row[1], d_n_x, y_row[1], d_n_y),
            _mixed(x_row[2], d_n_x, y_row[2], d_n_y),
        )
        if raw:
            d_quat = _unit_quaternion_backward(quat, length, d_quat)
        store_columns(
            grad_quats, first * 4,
            select(blended, d_quat[0], 0.0), select(blended, d_quat[1], 0.0),
            select(blended, d_quat[2], 0.0), select(blended, d_quat[3], 0.0),
        )  # fmt: skip

        # The rows of J W by the depth and by x / z and y / z; then the chain from the centre on the image.
        d_x_row = (_dot(axes[0], d_n_x), _dot(axes[1], d_n_x), _dot(axes[2], d_n_x))
        d_y_row = (_dot(axes[0], d_n_y), _dot(axes[1], d_n_y), _dot(axes[2], d_n_y))
        x_scale, y_scale = inverse_depth * at(camera, FOCAL_X), inverse_depth * at(camera, FOCAL_Y)
        along_x, along_y = _turned(camera, 2, d_x_row) * x_scale, _turned(camera, 2, d_y_row) * y_scale
        across_x, across_y = _turned(camera, 0, d_x_row) * x_scale, _turned(camera, 1, d_y_row) * y_scale
        d_x = fma(d_centre_x, x_scale, -(select(absolute(x) > limit_x, 0.0, along_x) * inverse_depth))
        d_y = fma(d_centre_y, y_scale, -(select(absolute(y) > limit_y, 0.0, along_y) * inverse_depth))
        by_jacobian = 2.0 * fma(near_x, along_x, near_y * along_y) - across_x - across_y
        by_centre = fma(d_centre_x * x_scale, x, d_centre_y * y_scale * y)
        d_depth = fma(by_jacobian, inverse_depth, -by_centre)
        d_mean = (
            d_mean[0] + _turned_back(camera, 0, d_x, d_y, d_depth),
            d_mean[1] + _turned_back(camera, 1, d_x, d_y, d_depth),
            d_mean[2] + _turned_back(camera, 2, d_x, d_y, d_depth),
        )
        _store3(grad_means, first, d_mean, blended)


_UNIT = 1.0 / FACTOR_SCALE**2


@inline
def _sum_slots(
    first: int,
    n: int,
    first_pair: NDArray[np.int64],
    places: NDArray[np.int32],
    slots: Floats,
    sums: Floats,
    pairs: Floats,
) -> None:
    """Add up the slots of 16 Gaussians, tile after tile; `pairs` gets the number of each one's."""
    for lane in range(WIDTH):
        total = splat(slots, 0.0)
        pairs[lane] = 0.0
        if first + lane < n:
            start, end = at(first_pair, first + lane), at(first_pair, first + lane + 1)
            pairs[lane] = end - start
            for place in range(start, end):
                total = total + load(slots, np.int64(at(places, place)) * SLOT)
        store(sums, lane * SLOT, total)


@inline
def _mixed(a: Lanes, u: _Vector, b: Lanes, v: _Vector) -> _Vector:
    """a u + b v."""
    return fma(a, u[0], b * v[0]), fma(a, u[1], b * v[1]), fma(a, u[2], b * v[2])


@inline
def _mixed3(a: _Vector, u: _Vector, b: _Vector, v: _Vector) -> _Vector:
    """a u + b v, component by component."""
    return fma(a[0], u[0], b[0] * v[0]), fma(a[1], u[1], b[1] * v[1]), fma(a[2], u[2], b[2] * v[2])


@inline
def _turned_back(camera: Floats, column: int, x: Lanes, y: Lanes, z: Lanes) -> Lanes:
    """A row of the transposed rotation times a vector."""
    i = ROTATION + column
    return fma(x, at(camera, i), fma(y, at(camera, i + 3), z * at(camera, i + 6)))


@inline
def _normalize_backward(direction: _Vector, inverse_length: Lanes, gradient: _Vector) -> _Vector:
    along = _dot(direction, gradient)
    return (
        fma(-along, direction[0], gradient[0]) * inverse_length,
        fma(-along, direction[1], gradient[1]) * inverse_length,
        fma(-along, direction[2], gradient[2]) * inverse_length,
    )


@inline
def _quaternion_gradient(
    q: tuple[Lanes, Lanes, Lanes, Lanes], r0: _Vector, r1: _Vector, r2: _Vector
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Gradient by a quaternion from that by the rows of its rotation matrix."""
    w, x, y, z = q
    a, b, c = r2[1] - r1[2], r0[2] - r2[0], r1[0] - r0[1]
    d, e, f = r0[1] + r1[0], r0[2] + r2[0], r1[2] + r2[1]
    return (
        2.0 * fma(x, a, fma(y, b, z * c)),
        2.0 * fma(w, a, fma(y, d, fma(z, e, -2.0 * x * (r1[1] + r2[2])))),
        2.0 * fma(w, b, fma(x, d, fma(z, f, -2.0 * y * (r0[0] + r2[2])))),
        2.0 * fma(w, c, fma(x, e, fma(y, f, -2.0 * z * (r0[0] + r1[1])))),
    )


@inline
def _unit_quaternion_backward(
    unit: tuple[Lanes, Lanes, Lanes, Lanes], length: Lanes, gradient: tuple[Lanes, Lanes, Lanes, Lanes]
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Gradient by a quaternion from that by itself over its length, or over MIN_NORM if that is more."""
    along = fma(unit[0], gradient[0], fma(unit[1], gradient[1], fma(unit[2], gradient[2], unit[3] * gradient[3])))
    along = select(length > MIN_NORM, along, 0.0)
    inverse = 1.0 / maximum(length, MIN_NORM)
    return (
        fma(-along, unit[0], gradient[0]) * inverse,
        fma(-along, unit[1], gradient[1]) * inverse,
        fma(-along, unit[2], gradient[2]) * inverse,
        fma(-along, unit[3], gradient[3]) * inverse,
    )


@inline
def _weighted(color: _Vector, red: Lanes, green: Lanes, blue: Lanes) -> Lanes:
    return fma(color[0], red, fma(color[1], green, color[2] * blue))


@inline
def _direction_gradient(rows: Floats, start: int, degree: int, d: _Vector, color: _Vector) -> _Vector:
    """Gradient by the direction of the colour that `_evaluate` returns, from that by the colour."""
    x, y, z = d
    g_x, g_y, g_z = x * 0.0, x * 0.0, x * 0.0
    if degree >= 1:
        c = load_rows(rows, start, SH_COLUMNS)
        g_x = _weighted(color, c[9], c[10], c[11]) * -_C1
        g_y = _weighted(color, c[3], c[4], c[5]) * -_C1
        g_z = _weighted(color, c[6], c[7], c[8]) * _C1
    if degree >= 2:
        c = load_rows(rows, start + 12, SH_COLUMNS)
        s4 = _weighted(color, c[0], c[1], c[2]) * _C20
        s5 = _weighted(color, c[3], c[4], c[5]) * -_C20
        s6 = _weighted(color, c[6], c[7], c[8]) * (2.0 * _C21)
        s7 = _weighted(color, c[9], c[10], c[11]) * -_C20
        s8 = _weighted(color, c[12], c[13], c[14]) * (2.0 * _C22)
        g_x += fma(y, s4, fma(z, s7, x * (s8 - s6)))
        g_y += fma(x, s4, fma(z, s5, y * (-s8 - s6)))
        g_z += fma(y, s5, fma(x, s7, 2.0 * z * s6))
    if degree >= 3:
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        around = 4.0 * zz - xx - yy
        c = load_rows(rows, start + 27, SH_COLUMNS)
        s9 = _weighted(color, c[0], c[1], c[2]) * (-3.0 * _C30)
        s10 = _weighted(color, c[3], c[4], c[5]) * _C31
        s11 = _weighted(color, c[6], c[7], c[8]) * -_C32
        s12 = _weighted(color, c[9], c[10], c[11]) * (3.0 * _C33)
        c = load_rows(rows, start + 32, SH_COLUMNS)
        s13 = _weighted(color, c[7], c[8], c[9]) * -_C32
        s14 = _weighted(color, c[10], c[11], c[12]) * _C34
        s15 = _weighted(color, c[13], c[14], c[15]) * (-3.0 * _C30)
        g_x += fma(2.0 * xy, s9 - s11, fma(yz, s10, fma(-2.0 * xz, s12 - s14, fma(around - 2.0 * xx, s13, (xx - yy) * s15))))
        g_y += fma(xx - yy, s9, fma(xz, s10, fma(around - 2.0 * yy, s11, fma(-2.0 * yz, s12 + s14, -2.0 * xy * (s13 + s15)))))
        g_z += fma(xy, s10, fma(8.0 * yz, s11, fma(2.0 * zz - xx - yy, s12, fma(8.0 * xz, s13, (xx - yy) * s14))))
    return g_x, g_y, g_z


@inline
def _store_sh_gradient(
    grad_sh: Floats, first: int, columns: int, degree: int, d: _Vector, color: _Vector, where: Mask, spare: Floats
) -> None:
    """The gradient by the harmonics' coefficients: zero in bands that were not evaluated and lanes not in `where`."""
    r, g, b = select(where, color[0], 0.0), select(where, color[1], 0.0), select(where, color[2], 0.0)
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
    rows, start = (grad_sh, first * SH_COLUMNS) if columns == SH_COLUMNS else (spare, 0)
    store_rows(
        rows, start, SH_COLUMNS,
        r * _C0, g * _C0, b * _C0, r * d1[0], g * d1[0], b * d1[0], r * d1[1], g * d1[1], b * d1[1],
        r * d1[2], g * d1[2], b * d1[2], r * d2[0], g * d2[0], b * d2[0], r * d2[1],
    )  # fmt: skip
    store_rows(
        rows, start + 16, SH_COLUMNS,
        g * d2[1], b * d2[1], r * d2[2], g * d2[2], b * d2[2], r * d2[3], g * d2[3], b * d2[3],
        r * d2[4], g * d2[4], b * d2[4], r * d3[0], g * d3[0], b * d3[0], r * d3[1], g * d3[1],
    )  # fmt: skip
    store_rows(
        rows, start + 32, SH_COLUMNS,
        b * d3[1], r * d3[2], g * d3[2], b * d3[2], r * d3[3], g * d3[3], b * d3[3], r * d3[4], g * d3[4], b * d3[4],
        r * d3[5], g * d3[5], b * d3[5], r * d3[6], g * d3[6], b * d3[6],
    )  # fmt: skip
    if columns != SH_COLUMNS:
        for lane in range(WIDTH):
            for i in range(columns):
                grad_sh[(first + lane) * columns + i] = spare[lane * SH_COLUMNS + i]


@inline
def _store3(array: Floats, first: int, value: _Vector, where: Mask) -> None:
    store_columns(
        array, first * 3, select(where, value[0], 0.0), select(where, value[1], 0.0), select(where, value[2], 0.0)
    )


@inline
def _store_no_gradient(
    first: int,
    columns: int,
    grad_means: Floats,
    grad_quats: Floats,
    grad_scales: Floats,
    grad_opacities: Floats,
    grad_sh: Floats,
    grad_colors: Floats,
    grad_centres: Floats,
    absgrad_centres: Floats,
) -> None:
    """The gradients of 16 Gaussians that no pixel saw."""
    none = splat(grad_means, 0.0)
    store_columns(grad_means, first * 3, none, none, none)
    store_columns(grad_quats, first * 4, none, none, none, none)
    store_columns(grad_scales, first * 3, none, none, none)
    store(grad_opacities, first, none)
    store_columns(grad_centres, first * 2, none, none)
    store_columns(absgrad_centres, first * 2, none, none)
    if grad_sh.size > 0:
        for i in range(columns):
            store(grad_sh, first * columns + i * WIDTH, none)
    else:
        store_columns(grad_colors, first * 3, none, none, none)
