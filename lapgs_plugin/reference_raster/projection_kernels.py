"""Project Gaussians to splats on the image, and take gradients back.

Sixteen Gaussians are processed at once, one in each lane. Kernels take the parameters that training optimizes ("raw")
or activated ones: standard deviations, opacities in [0, 1] and quaternions that are not normalised.

The 2D covariance is M M^T + 0.3 I with the 2x3 matrix M = J W R S. Its determinant is a sum of squares of the 2x2
minors of M. The usual difference of products would lose all digits of an elongated Gaussian in float32.

Gradients follow the CUDA code: where the Jacobian's x / z is clamped, the clamped x counts as a constant.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.jit.compiler import inline, jit
from lapgs_plugin.jit.lanes import (
    WIDTH,
    Floats,
    Lanes,
    Lanes3,
    Lanes4,
    Mask,
    absolute,
    any_lane,
    borrowed,
    ceil,
    exp,
    fetch_add,
    floor,
    fma,
    keep_alive,
    load,
    load_columns,
    load_rows,
    log2,
    maximum,
    minimum,
    prefetch,
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
    BLUR,
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
    MAX_RADIUS,
    MIN_ROOT,
    NEAR_DEPTH,
    OPACITY_RATE,
    POSITION,
    PRINCIPAL_X,
    PRINCIPAL_Y,
    RADIUS_SIGMAS,
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
from lapgs_plugin.reference_raster.sh_kernels import (
    COLUMNS,
    sh_color,
    sh_direction_gradient,
    sh_rows,
    store_sh_gradient,
)

HUGE = 1e37
"""Gaussians with a determinant in px^4 or a coordinate in px from here on are culled as overflown."""
# Margins against rounding for the ellipse of alpha 1/255; only speed depends on their size.
REACH_SLACK, REACH_SLOPE = 1e-3, 1e-5
MIN_NORM = 1e-12
"""Shorter quaternions are divided by this instead of their length, as in torch.nn.functional.normalize."""
AHEAD = 64
"""How many slots ahead of their use they are prefetched."""

_UNIT = 1.0 / FACTOR_SCALE**2  # removes the scale from a product of two factors, or of two of u and v

_Box = Lanes4  # first tile across and down, one past the last across and down


# ------------------------------------------------------------------------------------------- reading parameters


@inline
def _rows(array: Floats, first: int, n: int, columns: int, spare: Floats) -> tuple[Floats, int]:
    """Return an array with 16 of n rows and their start: `array`, or `spare` with a copy padded with zeros."""
    start = first * columns
    if first + WIDTH <= n:
        return array, start
    for i in range(WIDTH * columns):
        spare[i] = array[start + i] if start + i < n * columns else 0.0
    return spare, 0


@inline
def _columns3(array: Floats, first: int, n: int, spare: Floats) -> Lanes3:
    """Load three columns of 16 rows from `first` on; rows past the n-th are zero."""
    rows, start = _rows(array, first, n, 3, spare)
    return load_columns(rows, start, 3)


@inline
def _columns4(array: Floats, first: int, n: int, spare: Floats) -> Lanes4:
    """Load four columns of 16 rows from `first` on; rows past the n-th are zero."""
    rows, start = _rows(array, first, n, 4, spare)
    return load_columns(rows, start, 4)


@inline
def _scale(scales: Floats, first: int, n: int, raw: bool, spare: Floats) -> Lanes3:
    """Return the standard deviations of 16 Gaussians."""
    scale = _columns3(scales, first, n, spare)
    if raw:
        scale = (exp(scale[0]), exp(scale[1]), exp(scale[2]))
    return scale


@inline
def _unit(q: Lanes4, length: Lanes) -> Lanes4:
    inverse = 1.0 / maximum(length, MIN_NORM)
    return q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse


@inline
def _length(q: Lanes4) -> Lanes:
    return sqrt(fma(q[0], q[0], fma(q[1], q[1], fma(q[2], q[2], q[3] * q[3]))))


@inline
def _opacity(opacities: Floats, first: int, n: int, raw: bool, spare: Floats) -> tuple[Lanes, Lanes]:
    """Return the opacities of 16 Gaussians, and the derivatives of their logarithms by the parameters."""
    rows, start = _rows(opacities, first, n, 1, spare)
    opacity = load(rows, start)
    if raw:
        odds_against = exp(-opacity)
        opacity = 1.0 / (1.0 + odds_against)
        return opacity, odds_against * opacity  # 1 - opacity, without cancellation near 1
    return opacity, 1.0 / opacity


# ------------------------------------------------------------------------------------------------ geometry


@inline
def _dot(a: Lanes3, b: Lanes3) -> Lanes:
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


@inline
def _each(a: Lanes3, b: Lanes3) -> Lanes3:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inline
def _mixed(a: Lanes, u: Lanes3, b: Lanes, v: Lanes3) -> Lanes3:
    """Return a u + b v."""
    return fma(a, u[0], b * v[0]), fma(a, u[1], b * v[1]), fma(a, u[2], b * v[2])


@inline
def _times(row: Lanes3, matrix: tuple[Lanes3, Lanes3, Lanes3]) -> Lanes3:
    """Multiply a row vector by a matrix given by its rows."""
    m0, m1, m2 = matrix
    return (
        fma(row[0], m0[0], fma(row[1], m1[0], row[2] * m2[0])),
        fma(row[0], m0[1], fma(row[1], m1[1], row[2] * m2[1])),
        fma(row[0], m0[2], fma(row[1], m1[2], row[2] * m2[2])),
    )


@inline
def _clamped(value: Lanes, limit: float) -> Lanes:
    return minimum(maximum(value, -limit), limit)


@inline
def _rotate(camera: Floats, row: int, vector: Lanes3) -> Lanes:
    """Multiply a row of the camera's rotation by a vector."""
    i = ROTATION + 3 * row
    return fma(vector[0], camera[i], fma(vector[1], camera[i + 1], vector[2] * camera[i + 2]))


@inline
def _rotate_back(camera: Floats, vector: Lanes3) -> Lanes3:
    """Multiply the transposed rotation by a vector."""
    x, y, z = vector
    r = ROTATION
    return (
        fma(x, camera[r], fma(y, camera[r + 3], z * camera[r + 6])),
        fma(x, camera[r + 1], fma(y, camera[r + 4], z * camera[r + 7])),
        fma(x, camera[r + 2], fma(y, camera[r + 5], z * camera[r + 8])),
    )


@inline
def _in_view(camera: Floats, mean: Lanes3) -> Lanes3:
    """Return x / z, y / z and z of a point in camera coordinates."""
    depth = _rotate(camera, 2, mean) + camera[TRANSLATION + 2]
    inverse = 1.0 / depth
    x = (_rotate(camera, 0, mean) + camera[TRANSLATION]) * inverse
    y = (_rotate(camera, 1, mean) + camera[TRANSLATION + 1]) * inverse
    return x, y, depth


@inline
def _screen_rows(camera: Floats, x_scale: Lanes, y_scale: Lanes, x: Lanes, y: Lanes) -> tuple[Lanes3, Lanes3]:
    """Return the rows of J W, the derivative of the pixel coordinates by the position in the world.

    Args:
        x_scale, y_scale: focal lengths over the depth.
        x, y: x / z and y / z, clamped.
    """
    r = ROTATION
    x_row = (
        x_scale * (camera[r] - x * camera[r + 6]),
        x_scale * (camera[r + 1] - x * camera[r + 7]),
        x_scale * (camera[r + 2] - x * camera[r + 8]),
    )
    y_row = (
        y_scale * (camera[r + 3] - y * camera[r + 6]),
        y_scale * (camera[r + 4] - y * camera[r + 7]),
        y_scale * (camera[r + 5] - y * camera[r + 8]),
    )
    return x_row, y_row


@inline
def _axes(q: Lanes4) -> tuple[Lanes3, Lanes3, Lanes3]:
    """Return the rows of the rotation matrix of a quaternion (w, x, y, z)."""
    w, x, y, z = q
    return (
        (1.0 - 2.0 * fma(y, y, z * z), 2.0 * fma(x, y, -(w * z)), 2.0 * fma(x, z, w * y)),
        (2.0 * fma(x, y, w * z), 1.0 - 2.0 * fma(x, x, z * z), 2.0 * fma(y, z, -(w * x))),
        (2.0 * fma(x, z, -(w * y)), 2.0 * fma(y, z, w * x), 1.0 - 2.0 * fma(x, x, y * y)),
    )


@inline
def _direction(camera: Floats, mean: Lanes3) -> tuple[Lanes3, Lanes]:
    """Return the unit vector from the camera to the centre, and one over the distance."""
    x = mean[0] - camera[POSITION]
    y = mean[1] - camera[POSITION + 1]
    z = mean[2] - camera[POSITION + 2]
    inverse = 1.0 / sqrt(fma(x, x, fma(y, y, z * z)))
    return (x * inverse, y * inverse, z * inverse), inverse


# ------------------------------------------------------------------------------------------------ forward


@jit
def project(
    counter: NDArray[np.int64],  # (1,) zero
    n: int,
    means: Floats,  # (n * 3,)
    quats: Floats,  # (n * 4,)
    scales: Floats,  # (n * 3,)
    opacities: Floats,  # (n,)
    sh: Floats,  # (n * columns,)
    colors: Floats,  # (n * 3,), read if `columns` is 0
    columns: int,  # floats a row of `sh`: 3 for each coefficient
    raw: bool,  # logarithms of scales, logits of opacities, quaternions of any length
    signed: bool,  # the colour is the SH value; otherwise max(value + 0.5, 0)
    degree: int,  # highest degree of the harmonics that is evaluated
    camera: Floats,  # (CAMERA,)
    tiles_x: int,
    tiles_y: int,
    splats: Floats,  # (m * SPLAT,), m: n rounded up to whole vectors
    boxes: NDArray[np.int32],  # (m * 4,) first tile across, down, one past the last across, down; empty: not seen
    radii: NDArray[np.int32],  # (m,) three-sigma radii in pixels; 0: culled
    depths: Floats,  # (m,)
    centres: Floats,  # (m * 2,) pixel coordinates; 0: culled
) -> None:
    """Project Gaussians to splats."""
    scratch = np.empty(WIDTH * COLUMNS, splats.dtype)
    spare, means, quats, scales = borrowed(scratch), borrowed(means), borrowed(quats), borrowed(scales)
    opacities, sh, colors, camera = borrowed(opacities), borrowed(sh), borrowed(colors), borrowed(camera)
    splats, boxes, radii = borrowed(splats), borrowed(boxes), borrowed(radii)
    depths, centres = borrowed(depths), borrowed(centres)
    while True:
        first = fetch_add(counter, 1) * WIDTH
        if first >= n:
            break
        mean = _columns3(means, first, n, spare)
        x, y, depth = _in_view(camera, mean)
        in_front = depth > NEAR_DEPTH
        if not any_lane(in_front):
            _store_unseen(first, splats, boxes, radii, centres)
            continue
        centre_x = fma(x, camera[FOCAL_X], camera[PRINCIPAL_X] - 0.5)
        centre_y = fma(y, camera[FOCAL_Y], camera[PRINCIPAL_Y] - 0.5)

        quat = _columns4(quats, first, n, spare)
        if raw:
            quat = _unit(quat, _length(quat))
        scale = _scale(scales, first, n, raw, spare)
        x_scale, y_scale = camera[FOCAL_X] / depth, camera[FOCAL_Y] / depth
        near_x, near_y = _clamped(x, camera[LIMIT_X]), _clamped(y, camera[LIMIT_Y])
        x_row, y_row = _screen_rows(camera, x_scale, y_scale, near_x, near_y)
        axes = _axes(quat)
        m_x, m_y = _each(_times(x_row, axes), scale), _each(_times(y_row, axes), scale)
        xx, xy, yy, determinant = _covariance(m_x, m_y, camera[BLUR])

        radius = _radius(xx, xy, yy)
        box = _rectangle(centre_x, centre_y, radius, tiles_x, tiles_y)
        # Comparisons with NaN are false, so broken parameters are culled here.
        finite = (determinant < HUGE) & (absolute(centre_x) < HUGE) & (absolute(centre_y) < HUGE)
        seen = in_front & finite & (box[0] < box[2]) & (box[1] < box[3])

        opacity, opacity_rate = _opacity(opacities, first, n, raw, spare)
        log2_opacity = log2(opacity)
        margin = log2_opacity - LOG2_MIN_ALPHA
        # u is a difference of products; rounding moves the border of 1/255 by some epsilon of these.
        reach = fma(absolute(margin), sqrt(xx * yy / determinant) * REACH_SLOPE, margin + REACH_SLACK)
        box = _tight_box(box, centre_x, centre_y, sqrt(reach * xx * _UNIT), sqrt(reach * yy * _UNIT))
        _store_boxes(boxes, first, box, seen & (reach > 0.0))
        store_whole(radii, first, select(seen, radius, 0.0))
        store(depths, first, depth)
        store_columns(centres, first * 2, select(seen, centre_x, 0.0), select(seen, centre_y, 0.0))

        color, free = _color(camera, mean, sh, colors, first, n, columns, signed, degree, spare)
        factor_xx, ridge_x = sqrt(yy / determinant) * FACTOR_SCALE, xy / yy
        store_rows(
            splats, first * SPLAT, SPLAT,
            centre_x, centre_y, factor_xx, ridge_x * -factor_xx, FACTOR_SCALE / sqrt(yy), log2_opacity,
            color[0], color[1], color[2], reach, ridge_x, xy / xx, free[0], free[1], free[2], opacity_rate,
        )  # fmt: skip
    keep_alive(scratch)


@inline
def _covariance(m_x: Lanes3, m_y: Lanes3, blur: float) -> Lanes4:
    """Return the entries xx, xy, yy of M M^T + blur I, and its determinant."""
    xx, xy, yy = _dot(m_x, m_x), _dot(m_x, m_y), _dot(m_y, m_y)
    minors = (
        fma(m_x[0], m_y[1], -(m_x[1] * m_y[0])),
        fma(m_x[0], m_y[2], -(m_x[2] * m_y[0])),
        fma(m_x[1], m_y[2], -(m_x[2] * m_y[1])),
    )
    determinant = fma(xx + yy, blur, _dot(minors, minors) + blur * blur)
    return xx + blur, xy, yy + blur, determinant


@inline
def _radius(xx: Lanes, xy: Lanes, yy: Lanes) -> Lanes:
    """Return three standard deviations along the longer axis, in whole pixels."""
    half_difference = 0.5 * (xx - yy)
    root = sqrt(maximum(fma(half_difference, half_difference, xy * xy), MIN_ROOT))
    return minimum(ceil(RADIUS_SIGMAS * sqrt(0.5 * (xx + yy) + root)), MAX_RADIUS)


@inline
def _rectangle(centre_x: Lanes, centre_y: Lanes, radius: Lanes, tiles_x: int, tiles_y: int) -> _Box:
    """Return the tiles that a square around the centre touches; see `oracle.tile_rectangles` for the last ones."""
    return (
        _clipped(floor((centre_x - radius) * (1.0 / TILE)), tiles_x),
        _clipped(floor((centre_y - radius) * (1.0 / TILE)), tiles_y),
        _clipped(floor((centre_x + radius + (TILE - 1.0)) * (1.0 / TILE)), tiles_x),
        _clipped(floor((centre_y + radius + (TILE - 1.0)) * (1.0 / TILE)), tiles_y),
    )


@inline
def _clipped(tile: Lanes, tiles: int) -> Lanes:
    """Clamp a tile's number to the image; NaN becomes 0."""
    return minimum(maximum(tile, 0.0), tiles)


@inline
def _tight_box(box: _Box, centre_x: Lanes, centre_y: Lanes, half_width: Lanes, half_height: Lanes) -> _Box:
    """Return the tiles of a box that hold pixels of a rectangle around the centre."""
    return (
        maximum(floor(ceil(centre_x - half_width) * (1.0 / TILE)), box[0]),
        maximum(floor(ceil(centre_y - half_height) * (1.0 / TILE)), box[1]),
        minimum(floor((centre_x + half_width) * (1.0 / TILE)) + 1.0, box[2]),
        minimum(floor((centre_y + half_height) * (1.0 / TILE)) + 1.0, box[3]),
    )


@inline
def _color(
    camera: Floats, mean: Lanes3, sh: Floats, colors: Floats, first: int, n: int, columns: int, signed: bool,
    degree: int, spare: Floats,
) -> tuple[Lanes3, Lanes3]:  # fmt: skip
    """Return the colours of 16 Gaussians, and 1 where they pass gradients on."""
    one = splat(spare, 1.0)
    if columns == 0:
        return _columns3(colors, first, n, spare), (one, one, one)
    rows, start = sh_rows(sh, first, n, columns, spare)
    color, free = sh_color(rows, start, degree, _direction(camera, mean)[0]), (one, one, one)
    if not signed:
        color = (color[0] + 0.5, color[1] + 0.5, color[2] + 0.5)
        # A comparison with NaN is false, so NaN stays and reaches the loss.
        under_0, under_1, under_2 = color[0] < 0.0, color[1] < 0.0, color[2] < 0.0
        free = (select(under_0, 0.0, one), select(under_1, 0.0, one), select(under_2, 0.0, one))
        color = (select(under_0, 0.0, color[0]), select(under_1, 0.0, color[1]), select(under_2, 0.0, color[2]))
    return color, free


@inline
def _store_boxes(boxes: NDArray[np.int32], first: int, box: _Box, shown: Mask) -> None:
    """Write 16 boxes, empty ones where not shown."""
    shown = shown & (box[0] < box[2]) & (box[1] < box[3])
    store_whole(
        boxes, first * 4,
        select(shown, box[0], 0.0), select(shown, box[1], 0.0), select(shown, box[2], 0.0), select(shown, box[3], 0.0),
    )  # fmt: skip


@inline
def _store_unseen(
    first: int, splats: Floats, boxes: NDArray[np.int32], radii: NDArray[np.int32], centres: Floats
) -> None:
    """Store the results of 16 Gaussians that are all behind the camera."""
    none = splat(splats, 0.0)
    store_whole(boxes, first * 4, none, none, none, none)
    store_whole(radii, first, none)
    store_columns(centres, first * 2, none, none)


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
    places: NDArray[np.int32],  # (pairs,) numbers of the slots
    slots: Floats,  # (pairs * SLOT,)
    grad_means: Floats,  # (m * 3,)
    grad_quats: Floats,  # (m * 4,)
    grad_scales: Floats,  # (m * 3,)
    grad_opacities: Floats,  # (m,)
    grad_sh: Floats,  # (m * columns,)
    grad_colors: Floats,  # (m * 3,), written if `columns` is 0
    grad_centres: Floats,  # (m * 2,)
    absgrad_centres: Floats,  # (m * 2,)
) -> None:
    """Compute gradients by the arguments of `project` from the sums of the tiles' backward passes."""
    last_place = places.size - 1
    scratch, scratch_sums = np.empty(WIDTH * COLUMNS, splats.dtype), np.empty(WIDTH * (SLOT + 1), splats.dtype)
    spare, sums, pairs = borrowed(scratch), borrowed(scratch_sums), borrowed(scratch_sums[WIDTH * SLOT :])
    means, quats, scales = borrowed(means), borrowed(quats), borrowed(scales)
    sh, camera = borrowed(sh), borrowed(camera)
    splats, first_pair, places, slots = borrowed(splats), borrowed(first_pair), borrowed(places), borrowed(slots)
    grad_means, grad_quats, grad_scales = borrowed(grad_means), borrowed(grad_quats), borrowed(grad_scales)
    grad_opacities, grad_sh, grad_colors = borrowed(grad_opacities), borrowed(grad_sh), borrowed(grad_colors)
    grad_centres, absgrad_centres = borrowed(grad_centres), borrowed(absgrad_centres)
    while True:
        first = fetch_add(counter, 1) * WIDTH
        if first >= n:
            break
        _sum_slots(first, n, first_pair, places, last_place, slots, sums, pairs)
        blended = load(pairs, 0) > 0.0
        if not any_lane(blended):
            _store_no_gradient(
                first, columns, grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, grad_colors,
                grad_centres, absgrad_centres,
            )  # fmt: skip
            continue
        total, shape = load_rows(sums, 0, SLOT), load_rows(splats, first * SPLAT, SPLAT)
        mean = _columns3(means, first, n, spare)
        d_color = (
            total[SUM_RED] * shape[RED_FREE], total[SUM_GREEN] * shape[GREEN_FREE], total[SUM_BLUE] * shape[BLUE_FREE]
        )  # fmt: skip
        if columns == 0:
            _store3(grad_colors, first, d_color, blended)
            none = splat(splats, 0.0)
            by_color = (none, none, none)
        else:
            by_color = _color_backward(camera, mean, sh, first, n, columns, degree, d_color, blended, spare, grad_sh)
        store(grad_opacities, first, select(blended, total[SUM_1] * shape[OPACITY_RATE], 0.0))
        d_centre_x = total[SUM_U] * shape[FACTOR_XX] * _UNIT
        d_centre_y = fma(total[SUM_U], shape[FACTOR_XY], total[SUM_V] * shape[FACTOR_YY]) * _UNIT
        _store2(grad_centres, first, d_centre_x, d_centre_y, blended)
        absolute_x, absolute_y = total[SUM_ABS_X] * shape[FACTOR_XX] * _UNIT, total[SUM_ABS_Y] * _UNIT
        _store2(absgrad_centres, first, absolute_x, absolute_y, blended)

        scale, quat = _scale(scales, first, n, raw, spare), _columns4(quats, first, n, spare)
        length = _length(quat)
        if raw:
            quat = _unit(quat, length)
        d_scale, d_quat, by_shape = _shape_backward(camera, mean, scale, quat, shape, total, d_centre_x, d_centre_y)
        if raw:
            d_scale, d_quat = _each(d_scale, scale), _unit_backward(quat, length, d_quat)
        _store3(grad_scales, first, d_scale, blended)
        _store4(grad_quats, first, d_quat, blended)
        d_mean = (by_color[0] + by_shape[0], by_color[1] + by_shape[1], by_color[2] + by_shape[2])
        _store3(grad_means, first, d_mean, blended)
    keep_alive(scratch)
    keep_alive(scratch_sums)


@inline
def _sum_slots(
    first: int, n: int, first_pair: NDArray[np.int64], places: NDArray[np.int32], last_place: int, slots: Floats,
    sums: Floats, pairs: Floats,
) -> None:  # fmt: skip
    """Add up the slots of 16 Gaussians, tile by tile; `pairs` gets the number of slots of each."""
    for lane in range(WIDTH):
        total = splat(slots, 0.0)
        pairs[lane] = 0.0
        if first + lane < n:
            start, end = first_pair[first + lane], first_pair[first + lane + 1]
            pairs[lane] = end - start
            for pair in range(start, end):
                prefetch(slots, places[min(pair + AHEAD, last_place)] * SLOT)
                total = total + load(slots, places[pair] * SLOT)
        store(sums, lane * SLOT, total)


@inline
def _color_backward(
    camera: Floats, mean: Lanes3, sh: Floats, first: int, n: int, columns: int, degree: int, d_color: Lanes3,
    blended: Mask, spare: Floats, grad_sh: Floats,
) -> Lanes3:  # fmt: skip
    """Store the gradient by the coefficients; return that by the centre, through the view direction."""
    direction, inverse_distance = _direction(camera, mean)
    rows, start = sh_rows(sh, first, n, columns, spare)
    g = sh_direction_gradient(rows, start, degree, direction, d_color)
    store_sh_gradient(grad_sh, first, columns, degree, direction, d_color, blended, spare)
    along = _dot(direction, g)
    return (
        fma(-along, direction[0], g[0]) * inverse_distance,
        fma(-along, direction[1], g[1]) * inverse_distance,
        fma(-along, direction[2], g[2]) * inverse_distance,
    )


@inline
def _shape_backward(
    camera: Floats, mean: Lanes3, scale: Lanes3, quat: Lanes4, shape: tuple[Lanes, ...], total: tuple[Lanes, ...],
    d_centre_x: Lanes, d_centre_y: Lanes,
) -> tuple[Lanes3, Lanes4, Lanes3]:  # fmt: skip
    """Return gradients by the standard deviations, the quaternion, and the centre through the projection.

    Args:
        scale, quat: activated.
        shape: the splat.
        total: sums over its tiles' slots.
        d_centre_x, d_centre_y: gradient by the centre on the image.
    """
    x, y, depth = _in_view(camera, mean)
    x_scale, y_scale = camera[FOCAL_X] / depth, camera[FOCAL_Y] / depth
    near_x, near_y = _clamped(x, camera[LIMIT_X]), _clamped(y, camera[LIMIT_Y])
    x_row, y_row = _screen_rows(camera, x_scale, y_scale, near_x, near_y)
    axes = _axes(quat)
    n_x, n_y = _times(x_row, axes), _times(y_row, axes)  # J W R
    d_m_x, d_m_y = _covariance_backward(shape, total, _each(n_x, scale), _each(n_y, scale))
    d_scale = (
        fma(d_m_x[0], n_x[0], d_m_y[0] * n_y[0]),
        fma(d_m_x[1], n_x[1], d_m_y[1] * n_y[1]),
        fma(d_m_x[2], n_x[2], d_m_y[2] * n_y[2]),
    )
    d_x, d_y = _each(d_m_x, scale), _each(d_m_y, scale)
    d_quat = _quaternion_gradient(
        quat,
        _mixed(x_row[0], d_x, y_row[0], d_y),
        _mixed(x_row[1], d_x, y_row[1], d_y),
        _mixed(x_row[2], d_x, y_row[2], d_y),
    )
    d_x_row = (_dot(axes[0], d_x), _dot(axes[1], d_x), _dot(axes[2], d_x))
    d_y_row = (_dot(axes[0], d_y), _dot(axes[1], d_y), _dot(axes[2], d_y))
    by_x, by_depth_x = _axis_backward(camera, 0, x, near_x, x_scale, depth, d_x_row, d_centre_x)
    by_y, by_depth_y = _axis_backward(camera, 1, y, near_y, y_scale, depth, d_y_row, d_centre_y)
    return d_scale, d_quat, _rotate_back(camera, (by_x, by_y, by_depth_x + by_depth_y))


@inline
def _covariance_backward(
    shape: tuple[Lanes, ...], total: tuple[Lanes, ...], m_x: Lanes3, m_y: Lanes3
) -> tuple[Lanes3, Lanes3]:
    """Return the gradient by the rows of M.

    With the inverse covariance L^T L and E = ((uu, uv), (uv, vv)), the gradient by the covariance is L^T E L / 2, and
    that by M is twice this times M.
    """
    l_xx, l_xy, l_yy = shape[FACTOR_XX], shape[FACTOR_XY], shape[FACTOR_YY]
    uu, uv, vv = total[SUM_UU], total[SUM_UV], total[SUM_VV]
    mixed = fma(l_xy, uu, l_yy * uv)
    g_xx = l_xx * l_xx * uu * (_UNIT * _UNIT)
    g_xy = l_xx * mixed * (_UNIT * _UNIT)
    g_yy = fma(l_xy, mixed, l_yy * fma(l_xy, uv, l_yy * vv)) * (_UNIT * _UNIT)
    return _mixed(g_xx, m_x, g_xy, m_y), _mixed(g_xy, m_x, g_yy, m_y)


@inline
def _quaternion_gradient(q: Lanes4, r0: Lanes3, r1: Lanes3, r2: Lanes3) -> Lanes4:
    """Return the gradient by a quaternion from that by the rows of its rotation matrix."""
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
def _unit_backward(unit: Lanes4, length: Lanes, g: Lanes4) -> Lanes4:
    """Backpropagate through `_unit`: return the gradient of its argument, given `g`, the gradient of its result."""
    along = fma(unit[0], g[0], fma(unit[1], g[1], fma(unit[2], g[2], unit[3] * g[3])))
    along = select(length > MIN_NORM, along, 0.0)
    inverse = 1.0 / maximum(length, MIN_NORM)
    return (
        fma(-along, unit[0], g[0]) * inverse,
        fma(-along, unit[1], g[1]) * inverse,
        fma(-along, unit[2], g[2]) * inverse,
        fma(-along, unit[3], g[3]) * inverse,
    )


@inline
def _axis_backward(
    camera: Floats, axis: int, x: Lanes, near_x: Lanes, x_scale: Lanes, depth: Lanes, d_row: Lanes3, d_centre: Lanes
) -> tuple[Lanes, Lanes]:
    """Return the gradient by the camera coordinate along one axis of the image (0 or 1) and by the depth.

    Args:
        x, near_x: the coordinate over the depth, before and after clamping.
        x_scale: focal length over the depth.
        d_row: gradient by the axis's row of J W.
        d_centre: gradient by the centre on the image.
    """
    across, along = _rotate(camera, axis, d_row) * x_scale, _rotate(camera, 2, d_row) * x_scale
    free = select(absolute(x) > camera[LIMIT_X + axis], 0.0, along)
    by_coordinate = fma(d_centre, x_scale, -(free / depth))
    by_depth = fma(2.0 * near_x, along, -across) / depth - d_centre * x_scale * x
    return by_coordinate, by_depth


@inline
def _store2(array: Floats, first: int, x: Lanes, y: Lanes, where: Mask) -> None:
    store_columns(array, first * 2, select(where, x, 0.0), select(where, y, 0.0))


@inline
def _store3(array: Floats, first: int, v: Lanes3, where: Mask) -> None:
    store_columns(array, first * 3, select(where, v[0], 0.0), select(where, v[1], 0.0), select(where, v[2], 0.0))


@inline
def _store4(array: Floats, first: int, v: Lanes4, where: Mask) -> None:
    store_columns(
        array, first * 4,
        select(where, v[0], 0.0), select(where, v[1], 0.0), select(where, v[2], 0.0), select(where, v[3], 0.0),
    )  # fmt: skip


@inline
def _store_no_gradient(
    first: int, columns: int, grad_means: Floats, grad_quats: Floats, grad_scales: Floats, grad_opacities: Floats,
    grad_sh: Floats, grad_colors: Floats, grad_centres: Floats, absgrad_centres: Floats,
) -> None:  # fmt: skip
    """Store zero gradients of 16 Gaussians that are in no tile's list."""
    none = splat(grad_means, 0.0)
    store_columns(grad_means, first * 3, none, none, none)
    store_columns(grad_quats, first * 4, none, none, none, none)
    store_columns(grad_scales, first * 3, none, none, none)
    store(grad_opacities, first, none)
    store_columns(grad_centres, first * 2, none, none)
    store_columns(absgrad_centres, first * 2, none, none)
    if columns == 0:
        store_columns(grad_colors, first * 3, none, none, none)
    for i in range(columns):
        store(grad_sh, first * columns + i * WIDTH, none)
