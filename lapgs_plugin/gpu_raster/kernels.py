"""Project Gaussians and evaluate their colours for several cameras at once, and the gradients of both, in Triton.

A thread has a Gaussian and goes from camera to camera: parameters are read, and the gradients by them summed, once for
all cameras. The formulas and limits of projection are gsplat's (`projection_ewa_3dgs_fused`) or those of the 3DGS
family, see `rules.Rules`; where they limit the Jacobian, so do we.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.gpu_raster.cameras import DeviceCameras
from lapgs_plugin.gpu_raster.memory_kernels import load_four, load_three, store_four, store_three
from lapgs_plugin.gpu_raster.records import COLOR_IN_RECORD, GRADIENT, RECORD, TILE, Parameters, Projected
from lapgs_plugin.gpu_raster.rules import GSPLAT, NUMBERS, Numbers, Rules
from lapgs_plugin.gpu_raster.sh_kernels import (
    NOT_SPECIALIZED,
    color_gradient_kernel,
    color_of,
    direction_to,
    is_visible,
)
from lapgs_plugin.gpu_raster.walk_kernels import FAINTEST, meets
from lapgs_plugin.ops.launch import blocks, launch
from lapgs_plugin.reference_raster.layout import (
    JACOBIAN_LIMIT,
    MAX_RADIUS,
    MIN_ROOT,
    MIN_SHARE,
    RADIUS_SIGMAS,
    VANISHING,
)

BLOCK = 128
"""Gaussians of a program."""
REACH = tl.constexpr(3.33)
"""Standard deviations at which every footprint ends, as gsplat has it; fainter Gaussians end where alpha is 1/255."""
BEYOND = tl.constexpr(0.3)
"""The Jacobian is that of a point this share of half the image beyond its border at most."""
CENTRED = tl.constexpr(JACOBIAN_LIMIT)
"""The family's limit of the Jacobian, in half images from the centre."""
SIGMAS = tl.constexpr(RADIUS_SIGMAS)
"""The family's radius of a Gaussian, in standard deviations along its longer axis."""
LEAST_ROOT = tl.constexpr(MIN_ROOT)
"""The family's lower bound of half the difference of the 2D covariance's eigenvalues, squared."""
LARGEST = tl.constexpr(MAX_RADIUS)
"""Largest radius of a Gaussian in pixels."""
OVERFLOWN = tl.constexpr(1e37)
"""Area or coordinate from which on a Gaussian is not drawn."""
LEAST_SHARE = tl.constexpr(MIN_SHARE)
"""Where Gaussians are dimmed: lower bound of the determinant without the blur over that with it."""
LEAST_AREA = tl.constexpr(VANISHING)
"""Where Gaussians are dimmed: lower bound of the determinant without the blur."""


@triton.jit
def _unit_quaternions(quaternions: tl.tensor, row: tl.tensor) -> tl.tensor:
    """Return w, x, y, z of unit length, and one over the length they had."""
    w, x, y, z = load_four(quaternions + 4 * row)
    inverse = 1.0 / tl.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@triton.jit
def _rotation(w: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tl.tensor:
    """Return the rotation matrix of a unit quaternion, row by row."""
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def _covariance(
    a: tl.tensor, b: tl.tensor, c: tl.tensor, d: tl.tensor, e: tl.tensor, f: tl.tensor,
    g: tl.tensor, h: tl.tensor, i: tl.tensor,
) -> tl.tensor:  # fmt: skip
    """Return xx, xy, xz, yy, yz and zz of a matrix, given row by row, times its transpose."""
    return (
        a * a + b * b + c * c, a * d + b * e + c * f, a * g + b * h + c * i,
        d * d + e * e + f * f, d * g + e * h + f * i, g * g + h * h + i * i,
    )  # fmt: skip


@triton.jit
def _shape(
    quaternions: tl.tensor, scales: tl.tensor, row: tl.tensor, modifier: float, family: tl.constexpr,
    covariances: tl.constexpr, activated: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return w, x, y, z of quaternions and one over their length, scales, and covariances as `_covariance` has.

    Given covariances have no quaternions and scales, which are 0.
    """
    if covariances:
        xx, xy, xz = load_three(scales + 6 * row)
        yy, yz, zz = load_three(scales + 6 * row + 3)
        none = 0.0 * xx
        return none, none, none, none, none, none, none, none, xx, xy, xz, yy, yz, zz
    s0, s1, s2 = load_three(scales + 3 * row)
    if family:
        w, x, y, z = load_four(quaternions + 4 * row)
        length = 0.0 * w + 1.0
        s0, s1, s2 = s0 * modifier, s1 * modifier, s2 * modifier
    else:
        w, x, y, z, length = _unit_quaternions(quaternions, row)
        if not activated:
            s0, s1, s2 = tl.exp(s0), tl.exp(s1), tl.exp(s2)
    a, b, c, d, e, f, g, h, i = _rotation(w, x, y, z)
    xx, xy, xz, yy, yz, zz = _covariance(a * s0, b * s1, c * s2, d * s0, e * s1, f * s2, g * s0, h * s1, i * s2)
    return w, x, y, z, length, s0, s1, s2, xx, xy, xz, yy, yz, zz


@triton.jit
def _size_of(sizes: tl.tensor, camera: tl.tensor, width: int, height: int, mixed: tl.constexpr) -> tl.tensor:
    """Return the width and height of a camera's image, which is smaller than others if sizes are `mixed`."""
    if mixed:
        width, height = tl.load(sizes + 2 * camera), tl.load(sizes + 2 * camera + 1)
    return width, height


@triton.jit
def _seen_from(
    poses: tl.tensor, intrinsics: tl.tensor, camera: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor,
    width: int, height: int, closest: float, family: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return a mean in a camera's image plane, and the Jacobian's numbers there.

    They are x / z and y / z; the same where the Jacobian is taken; one over z; z; and the Jacobian's entries by x and z
    of x, and by y and z of y.
    """
    pose, matrix = poses + 16 * camera, intrinsics + 9 * camera
    right = tl.load(pose) * x + tl.load(pose + 1) * y + tl.load(pose + 2) * z + tl.load(pose + 3)
    down = tl.load(pose + 4) * x + tl.load(pose + 5) * y + tl.load(pose + 6) * z + tl.load(pose + 7)
    ahead = tl.load(pose + 8) * x + tl.load(pose + 9) * y + tl.load(pose + 10) * z + tl.load(pose + 11)
    inverse = 1.0 / tl.where(ahead >= closest, ahead, 1.0)
    u, v = right * inverse, down * inverse
    fx, cx, fy, cy = tl.load(matrix), tl.load(matrix + 2), tl.load(matrix + 4), tl.load(matrix + 5)
    if family:
        past, under = CENTRED * 0.5 * width / fx, CENTRED * 0.5 * height / fy
        limited_u = tl.minimum(past, tl.maximum(-past, u))
        limited_v = tl.minimum(under, tl.maximum(-under, v))
    else:
        past, under = BEYOND * 0.5 * width / fx, BEYOND * 0.5 * height / fy
        limited_u = tl.minimum((width - cx) / fx + past, tl.maximum(-(cx / fx + past), u))
        limited_v = tl.minimum((height - cy) / fy + under, tl.maximum(-(cy / fy + under), v))
    return (
        u, v, limited_u, limited_v, inverse, ahead,
        fx * inverse, -fx * limited_u * inverse, fy * inverse, -fy * limited_v * inverse,
    )  # fmt: skip


@triton.jit
def _rows_of_projection(
    poses: tl.tensor, camera: tl.tensor, by_x: tl.tensor, x_by_z: tl.tensor, by_y: tl.tensor, y_by_z: tl.tensor
) -> tl.tensor:
    """Return the rows of the Jacobian times the camera's rotation: the gradients of a pixel's x and y by a mean."""
    pose = poses + 16 * camera
    r8, r9, r10 = tl.load(pose + 8), tl.load(pose + 9), tl.load(pose + 10)
    return (
        by_x * tl.load(pose) + x_by_z * r8, by_x * tl.load(pose + 1) + x_by_z * r9,
        by_x * tl.load(pose + 2) + x_by_z * r10,
        by_y * tl.load(pose + 4) + y_by_z * r8, by_y * tl.load(pose + 5) + y_by_z * r9,
        by_y * tl.load(pose + 6) + y_by_z * r10,
    )  # fmt: skip


@triton.jit
def _times(
    xx: tl.tensor, xy: tl.tensor, xz: tl.tensor, yy: tl.tensor, yz: tl.tensor, zz: tl.tensor,
    x: tl.tensor, y: tl.tensor, z: tl.tensor,
) -> tl.tensor:  # fmt: skip
    """Return a symmetric matrix times a vector."""
    return xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z


@triton.jit
def _on_screen(
    xx: tl.tensor, xy: tl.tensor, xz: tl.tensor, yy: tl.tensor, yz: tl.tensor, zz: tl.tensor,
    px: tl.tensor, py: tl.tensor, pz: tl.tensor, qx: tl.tensor, qy: tl.tensor, qz: tl.tensor,
) -> tl.tensor:  # fmt: skip
    """Return xx, xy and yy of a covariance in pixels, from that in the world and the projection's rows; no blur."""
    ux, uy, uz = _times(xx, xy, xz, yy, yz, zz, px, py, pz)
    vx, vy, vz = _times(xx, xy, xz, yy, yz, zz, qx, qy, qz)
    return px * ux + py * uy + pz * uz, qx * ux + qy * uy + qz * uz, qx * vx + qy * vy + qz * vz


@triton.jit
def _half_sides(
    x: tl.tensor, y: tl.tensor, wide: tl.tensor, high: tl.tensor, area: tl.tensor, opacity: tl.tensor,
    in_front: tl.tensor, width: int, height: int,
) -> tl.tensor:  # fmt: skip
    """Return half a footprint's width and height in whole pixels, as gsplat has it, and where it is in the image."""
    reach = tl.minimum(REACH, tl.sqrt(2.0 * tl.log(tl.maximum(opacity / FAINTEST, 1.0))))
    across, down = tl.ceil(reach * tl.sqrt(wide)), tl.ceil(reach * tl.sqrt(high))
    visible = in_front & (area > 0.0) & (opacity >= FAINTEST) & (across > 0.0) & (down > 0.0)
    visible = visible & (x + across > 0.0) & (x - across < width)
    visible = visible & (y + down > 0.0) & (y - down < height)
    return tl.where(visible, across, 0.0).to(tl.int32), tl.where(visible, down, 0.0).to(tl.int32), visible


@triton.jit
def _tiles_between(low: tl.tensor, high: tl.tensor, tiles: int) -> tl.tensor:
    """Return the first tile and one past the last, limited to the image, in 16 bits each; 0 if there is none."""
    # Limited before they are integers: a footprint may reach further than these count.
    low = tl.minimum(tl.maximum(low, 0.0), tiles * 1.0).to(tl.int32)
    high = tl.minimum(tl.maximum(high, 0.0), tiles * 1.0).to(tl.int32)
    return tl.where(low < high, low | (high << 16), 0)


@triton.jit
def _footprint(
    x: tl.tensor, y: tl.tensor, wide: tl.tensor, skew: tl.tensor, high: tl.tensor, area: tl.tensor, opacity: tl.tensor,
    in_front: tl.tensor, across: int, down: int, mult: float, snug: tl.constexpr, tile: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return columns and rows of tiles as `_tiles_between` does, the three-sigma radius, and where that is seen.

    `x` and `y` are pixels, of which the first has its centre at 0.
    """
    half = 0.5 * (wide - high)
    root = tl.sqrt(tl.maximum(half * half + skew * skew, LEAST_ROOT))
    radius = tl.minimum(tl.ceil(SIGMAS * tl.sqrt(0.5 * (wide + high) + root)), LARGEST)
    # Comparisons with NaN are false, so that broken parameters are culled here.
    in_front = in_front & (area < OVERFLOWN) & (tl.abs(x) < OVERFLOWN) & (tl.abs(y) < OVERFLOWN)
    limit = tl.log(opacity / FAINTEST)  # of half the squared distance, where alpha is `FAINTEST`
    if snug:
        limit = mult * limit
        reach_x, reach_y = tl.sqrt(2.0 * limit * wide), tl.sqrt(2.0 * limit * high)
        columns = _tiles_between(tl.floor((x - reach_x) / tile), tl.floor((x + reach_x) / tile + 1.0), across)
        rows = _tiles_between(tl.floor((y - reach_y) / tile), tl.floor((y + reach_y) / tile + 1.0), down)
        inverse = 1.0 / area
        shown = in_front & (area > 0.0) & (limit > 0.0) & (columns > 0) & (rows > 0)
        shown = shown & meets(
            x, y, high * inverse, -skew * inverse, wide * inverse, limit, 1.0, across * tile * 1.0, down * tile * 1.0
        )
        return tl.where(shown, columns, 0), tl.where(shown, rows, 0), radius, shown
    # As in the CUDA code, a last tile counts only if the square reaches its second pixel.
    columns = _tiles_between(tl.floor((x - radius) / tile), tl.floor((x + radius + (tile - 1)) / tile), across)
    rows = _tiles_between(tl.floor((y - radius) / tile), tl.floor((y + radius + (tile - 1)) / tile), down)
    seen = in_front & (area != 0.0) & (columns > 0) & (rows > 0)
    # In the other tiles alpha is less than `FAINTEST`, even with rounding.
    limit = 2.0 * (limit * 1.0001 + 0.01)
    reach_x, reach_y = tl.sqrt(limit * wide), tl.sqrt(limit * high)
    left = tl.maximum(tl.floor(tl.ceil(x - reach_x) / tile), (columns & 0xFFFF) * 1.0)
    right = tl.minimum(tl.floor((x + reach_x) / tile) + 1.0, (columns >> 16) * 1.0)
    top = tl.maximum(tl.floor(tl.ceil(y - reach_y) / tile), (rows & 0xFFFF) * 1.0)
    bottom = tl.minimum(tl.floor((y + reach_y) / tile) + 1.0, (rows >> 16) * 1.0)
    shown = seen & (area > 0.0) & (limit > 0.0)
    columns, rows = _tiles_between(left, right, across), _tiles_between(top, bottom, down)
    shown = shown & (columns > 0) & (rows > 0)
    return tl.where(shown, columns, 0), tl.where(shown, rows, 0), radius, seen


@triton.jit
def _dimming(
    wide: tl.tensor, skew: tl.tensor, high: tl.tensor, area: tl.tensor, exact: tl.constexpr
) -> tl.tensor:  # fmt: skip
    """Return the factors on opacities of antialiasing, and the shares that they are the roots of.

    Of the arguments `area` alone has the blur.
    """
    own = wide * high - skew * skew
    share = own / area
    factor = tl.sqrt(tl.maximum(share, LEAST_SHARE))
    if exact:
        factor = tl.where(own > LEAST_AREA, tl.sqrt(tl.abs(own / (area + LEAST_AREA)) + LEAST_AREA), 0.0)
    return factor, share


@triton.jit(do_not_specialize=(*NOT_SPECIALIZED, "width", "height", "first", "start"))
def _project_kernel(
    means: tl.tensor, quaternions: tl.tensor, scales: tl.tensor, opacities: tl.tensor, sh: tl.tensor,
    first_sh: tl.tensor, poses: tl.tensor, intrinsics: tl.tensor, centres: tl.tensor, sizes: tl.tensor,
    radii: tl.tensor, pixels: tl.tensor, depths: tl.tensor, records: tl.tensor,
    visible_radii: tl.tensor, visible_pixels: tl.tensor,
    width: int, height: int, n: int, first: int, cameras: int, active: int, signed: int, start: int,
    modifier: float, blur: float, mult: float, closest: float, farthest: float,
    coefficients: tl.constexpr, with_radii: tl.constexpr, with_centres: tl.constexpr, record: tl.constexpr,
    block: tl.constexpr, tile: tl.constexpr, family: tl.constexpr, covariances: tl.constexpr, apart: tl.constexpr,
    dimmed: tl.constexpr, exact: tl.constexpr, snug: tl.constexpr, activated: tl.constexpr, alpha: tl.constexpr,
    mixed: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here, row = rows < n, tl.minimum(rows, n - 1)
    mean_x, mean_y, mean_z = load_three(means + 3 * row)
    _, _, _, _, _, _, _, _, xx, xy, xz, yy, yz, zz = _shape(
        quaternions, scales, row, modifier, family, covariances, activated
    )
    opacity = tl.load(opacities + row)
    if not family and not activated:
        opacity = 1.0 / (1.0 + tl.exp(-opacity))
    camera, placed = first, start + rows
    while camera < first + cameras:  # `range` of a tensor cannot be interpreted with NumPy 2.4
        own_width, own_height = _size_of(sizes, camera, width, height, mixed)
        u, v, _, _, near, depth, by_x, x_by_z, by_y, y_by_z = _seen_from(
            poses, intrinsics, camera, mean_x, mean_y, mean_z, own_width, own_height, closest, family
        )
        matrix = intrinsics + 9 * camera
        pixel_x, pixel_y = (
            tl.load(matrix) * u + tl.load(matrix + 2), tl.load(matrix + 4) * v + tl.load(matrix + 5)
        )  # fmt: skip
        px, py, pz, qx, qy, qz = _rows_of_projection(poses, camera, by_x, x_by_z, by_y, y_by_z)
        sharp_wide, skew, sharp_high = _on_screen(xx, xy, xz, yy, yz, zz, px, py, pz, qx, qy, qz)
        wide, high = sharp_wide + blur, sharp_high + blur
        area = wide * high - skew * skew
        effective = opacity
        if dimmed:
            effective = opacity * _dimming(sharp_wide, skew, sharp_high, area, exact)[0]
        if family:
            in_columns, in_rows, radius, seen = _footprint(
                pixel_x - 0.5, pixel_y - 0.5, wide, skew, high, area, effective,
                here & (depth > closest) & (depth <= farthest),
                (own_width + tile - 1) // tile, (own_height + tile - 1) // tile, mult, snug, tile,
            )  # fmt: skip
            visible = in_columns > 0
            tl.store(radii + 2 * placed, in_columns, here)
            tl.store(radii + 2 * placed + 1, in_rows, here)
            tl.store(depths + placed, tl.where(seen, depth, 0.0), here)
        else:
            across, down, visible = _half_sides(
                pixel_x,
                pixel_y,
                wide,
                high,
                area,
                opacity,
                here & (depth >= closest) & (depth <= farthest),
                own_width,
                own_height,
            )
            seen, radius = visible, tl.maximum(across, down)
            tl.store(radii + 2 * placed, across, here)
            tl.store(radii + 2 * placed + 1, down, here)
            tl.store(pixels + 2 * placed, pixel_x, visible)
            tl.store(pixels + 2 * placed + 1, pixel_y, visible)
            tl.store(depths + placed, depth, visible)

        x, y, z, _ = direction_to(centres + 3 * camera, mean_x, mean_y, mean_z, visible)
        colored = tl.where(visible, row, 0)  # so that memory of others is not read
        red, green, blue = color_of(first_sh, sh, colored, x, y, z, active, coefficients, apart)
        if coefficients > 0 and signed == 0:
            red, green, blue = tl.maximum(red + 0.5, 0.0), tl.maximum(green + 0.5, 0.0), tl.maximum(blue + 0.5, 0.0)

        inverse = 1.0 / area
        into = records + placed * record
        store_four(into, pixel_x, pixel_y, high * inverse, -skew * inverse, visible)
        store_four(into + 4, wide * inverse, effective, effective, effective, visible)
        store_four(into + 8, red, green, blue, 0.0 * near + 1.0 if alpha else near, visible)
        if with_radii:
            tl.store(visible_radii + placed, tl.where(seen, radius, 0).to(tl.int32), here)
        if with_centres:
            tl.store(visible_pixels + 2 * placed, tl.where(seen, pixel_x - 0.5, 0.0), here)
            tl.store(visible_pixels + 2 * placed + 1, tl.where(seen, pixel_y - 0.5, 0.0), here)
        camera, placed = camera + 1, placed + n


@triton.jit
def _of_covariance(
    wide: tl.tensor, skew: tl.tensor, high: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor, visible: tl.tensor
) -> tl.tensor:
    """Return gradients by xx, by xy and yx each, and by yy of a covariance from those by its inverse (a, b, c).

    They are minus the inverse, times the gradient by the inverse, times the inverse; 0 where nothing is visible.
    """
    half = 0.5 * skew
    t00, t01, t10, t11 = a * wide + b * half, a * half + b * high, b * wide + c * half, b * half + c * high
    return (
        tl.where(visible, -(t00 * a + t01 * b), 0.0), tl.where(visible, -(t00 * b + t01 * c), 0.0),
        tl.where(visible, -(t10 * b + t11 * c), 0.0),
    )  # fmt: skip


@triton.jit
def _grad_of_mean(
    pose: tl.tensor, u: tl.tensor, v: tl.tensor, limited_u: tl.tensor, limited_v: tl.tensor, inverse: tl.tensor,
    x_by_x: tl.tensor, y_by_y: tl.tensor, of_x: tl.tensor, of_y: tl.tensor, of_depth: tl.tensor,
    fx: tl.tensor, fy: tl.tensor, fz: tl.tensor, gx: tl.tensor, gy: tl.tensor, gz: tl.tensor, family: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return the gradient by a mean from those by its pixel, x and y, its depth, and the projection's rows, f and g.

    These last ones are halved.

    The others are results of `_seen_from`.
    """
    r0, r1, r2 = tl.load(pose), tl.load(pose + 1), tl.load(pose + 2)
    r4, r5, r6 = tl.load(pose + 4), tl.load(pose + 5), tl.load(pose + 6)
    r8, r9, r10 = tl.load(pose + 8), tl.load(pose + 9), tl.load(pose + 10)
    of_x_by_x, of_y_by_y = 2.0 * (fx * r0 + fy * r1 + fz * r2), 2.0 * (gx * r4 + gy * r5 + gz * r6)
    of_x_by_z, of_y_by_z = 2.0 * (fx * r8 + fy * r9 + fz * r10), 2.0 * (gx * r8 + gy * r9 + gz * r10)
    # The Jacobian's entries are f / z and -f u / z; where u is limited, it does not depend on the mean. In the CUDA
    # code of the family, u z does not.
    free_u, free_v = limited_u == u, limited_v == v
    twice_u, twice_v = tl.where(free_u, 2.0, 1.0), tl.where(free_v, 2.0, 1.0)
    if family:
        twice_u, twice_v = 2.0, 2.0
    right = x_by_x * (of_x - tl.where(free_u, of_x_by_z * inverse, 0.0))
    down = y_by_y * (of_y - tl.where(free_v, of_y_by_z * inverse, 0.0))
    ahead = of_depth - x_by_x * (u * of_x + inverse * (of_x_by_x - twice_u * limited_u * of_x_by_z))
    ahead -= y_by_y * (v * of_y + inverse * (of_y_by_y - twice_v * limited_v * of_y_by_z))
    return (
        r0 * right + r4 * down + r8 * ahead,
        r1 * right + r5 * down + r9 * ahead,
        r2 * right + r6 * down + r10 * ahead,
    )


@triton.jit
def _store_shape_gradients(
    by_quaternion: tl.tensor, by_scale: tl.tensor, rows: tl.tensor, here: tl.tensor,
    w: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor, length: tl.tensor,
    s0: tl.tensor, s1: tl.tensor, s2: tl.tensor,
    xx: tl.tensor, xy: tl.tensor, xz: tl.tensor, yy: tl.tensor, yz: tl.tensor, zz: tl.tensor, family: tl.constexpr,
    activated: tl.constexpr,
) -> None:  # fmt: skip
    """Backpropagate from covariances to quaternions and scales, and store the gradients of these.

    `xx` to `zz` are the gradients of the entries of the covariances. `xy` is that of xy and also that of yx.
    The gradient is that of scales if `family` or `activated`, otherwise of their logarithms. As in the family's CUDA
    code, it lacks the scale modifier, by which the scales were multiplied.
    """
    a, b, c, d, e, f, g, h, i = _rotation(w, x, y, z)
    # By the columns of the rotation, without their factor of twice the square of the scale.
    ux, uy, uz = _times(xx, xy, xz, yy, yz, zz, a, d, g)
    vx, vy, vz = _times(xx, xy, xz, yy, yz, zz, b, e, h)
    wx, wy, wz = _times(xx, xy, xz, yy, yz, zz, c, f, i)
    by_0, by_1, by_2 = ux * a + uy * d + uz * g, vx * b + vy * e + vz * h, wx * c + wy * f + wz * i
    if family or activated:
        store_three(by_scale + 3 * rows, 2.0 * s0 * by_0, 2.0 * s1 * by_1, 2.0 * s2 * by_2, here)
    s0, s1, s2 = 2.0 * s0 * s0, 2.0 * s1 * s1, 2.0 * s2 * s2
    if not family and not activated:
        store_three(by_scale + 3 * rows, s0 * by_0, s1 * by_1, s2 * by_2, here)
    ux, uy, uz, vx, vy, vz, wx, wy, wz = s0 * ux, s0 * uy, s0 * uz, s1 * vx, s1 * vy, s1 * vz, s2 * wx, s2 * wy, s2 * wz
    of_w = 2.0 * (x * (vz - wy) + y * (wx - uz) + z * (uy - vx))
    of_x = 2.0 * (-2.0 * x * (vy + wz) + y * (vx + uy) + z * (wx + uz) + w * (vz - wy))
    of_y = 2.0 * (x * (vx + uy) - 2.0 * y * (ux + wz) + z * (wy + vz) + w * (wx - uz))
    of_z = 2.0 * (x * (wx + uz) + y * (wy + vz) - 2.0 * z * (ux + vy) + w * (uy - vx))
    if not family:
        along = of_w * w + of_x * x + of_y * y + of_z * z  # its length does not matter
        of_w, of_x, of_y, of_z = of_w - along * w, of_x - along * x, of_y - along * y, of_z - along * z
    store_four(by_quaternion + 4 * rows, of_w * length, of_x * length, of_y * length, of_z * length, here)


@triton.jit
def _dimming_backward(
    sharp_wide: tl.tensor, skew: tl.tensor, sharp_high: tl.tensor, blur: float, opacity: tl.tensor,
    of_wide: tl.tensor, of_skew: tl.tensor, of_high: tl.tensor, of_opacity: tl.tensor, visible: tl.tensor,
    exact: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return gradients by xx, by xy and yx each, by yy of a covariance and by opacity, from those by dimmed ones."""
    wide, high = sharp_wide + blur, sharp_high + blur
    area = wide * high - skew * skew
    factor, share = _dimming(sharp_wide, skew, sharp_high, area, exact)
    of_factor = of_opacity * opacity
    of_opacity = tl.where(visible, of_opacity * factor, 0.0)
    if exact:
        of_own = tl.where(visible & (factor > 0.0), of_factor / (2.0 * factor * (area + LEAST_AREA)), 0.0)
        of_area = -of_own * (sharp_wide * sharp_high - skew * skew) / (area + LEAST_AREA)
        return (
            of_wide + of_own * sharp_high + of_area * high, of_skew - skew * (of_own + of_area),
            of_high + of_own * sharp_wide + of_area * wide, of_opacity,
        )  # fmt: skip
    of_share = tl.where(visible & (share > LEAST_SHARE), of_factor / (2.0 * factor), 0.0)
    # The CUDA code differentiates the share at covariances that already have the blur, and not at those that it is
    # computed from.
    larger = (wide + blur) * (high + blur) - skew * skew
    common = tl.where(visible, blur * of_share / (larger * larger), 0.0)
    return (
        of_wide + (blur * high + high * high + skew * skew) * common, of_skew - skew * (blur + wide + high) * common,
        of_high + (blur * wide + wide * wide + skew * skew) * common, of_opacity,
    )  # fmt: skip


@triton.jit
def _by_depth(
    others: tl.tensor, inverse: tl.tensor, visible: tl.tensor, stride: tl.constexpr, depth: tl.constexpr
) -> tl.tensor:
    """Return the gradient by depth from that by its inverse, which is among the others if there is one."""
    if depth:
        return tl.where(visible, -tl.load(others + (stride // 2 + 1)), 0.0) * inverse * inverse
    return 0.0 * inverse


@triton.jit(do_not_specialize=("width", "height", "n", "cameras"))
def _shape_gradient_kernel(
    means: tl.tensor, quaternions: tl.tensor, scales: tl.tensor, opacities: tl.tensor,
    poses: tl.tensor, intrinsics: tl.tensor, sizes: tl.tensor, radii: tl.tensor, records: tl.tensor,
    by_records: tl.tensor, others: tl.tensor,
    by_mean: tl.tensor, by_quaternion: tl.tensor, by_scale: tl.tensor, by_opacity: tl.tensor,
    by_color: tl.tensor, by_screen: tl.tensor,
    width: int, height: int, n: int, cameras: int, modifier: float, blur: float, closest: float,
    record: tl.constexpr, gradient: tl.constexpr, stride: tl.constexpr, block: tl.constexpr,
    colored: tl.constexpr, columns: tl.constexpr, family: tl.constexpr, covariances: tl.constexpr,
    dimmed: tl.constexpr, exact: tl.constexpr, depth: tl.constexpr, activated: tl.constexpr, mixed: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here, row = rows < n, tl.minimum(rows, n - 1)
    mean_x, mean_y, mean_z = load_three(means + 3 * row)
    w, x, y, z, length, s0, s1, s2, xx, xy, xz, yy, yz, zz = _shape(
        quaternions, scales, row, modifier, family, covariances, activated
    )
    none = 0.0 * mean_x
    by_x, by_y, by_z, total = none, none, none, none
    by_xx, by_xy, by_xz, by_yy, by_yz, by_zz = none, none, none, none, none, none
    camera = 0
    while camera < cameras:
        placed = camera * n + row
        visible = is_visible(radii, placed)
        placed = tl.where(visible, placed, 0)  # so that memory of others is not read
        red, green, blue, of_opacity = load_four(by_records + placed * gradient)
        of_x, of_y, of_wide, of_skew = load_four(by_records + placed * gradient + 4)
        of_high = tl.load(others + placed * stride)
        _, _, conic_a, conic_b = load_four(records + placed * record)
        conic_c = tl.load(records + placed * record + 4)
        of_opacity, of_x, of_y = (
            tl.where(visible, of_opacity, 0.0), tl.where(visible, of_x, 0.0), tl.where(visible, of_y, 0.0)
        )  # fmt: skip
        wide, skew, high = _of_covariance(of_wide, of_skew, of_high, conic_a, conic_b, conic_c, visible)
        own_width, own_height = _size_of(sizes, camera, width, height, mixed)
        u, v, limited_u, limited_v, inverse, _, x_by_x, x_by_z, y_by_y, y_by_z = _seen_from(
            poses, intrinsics, camera, mean_x, mean_y, mean_z, own_width, own_height, closest, family
        )
        px, py, pz, qx, qy, qz = _rows_of_projection(poses, camera, x_by_x, x_by_z, y_by_y, y_by_z)
        if dimmed:
            of_xx, of_xy, of_yy = _on_screen(xx, xy, xz, yy, yz, zz, px, py, pz, qx, qy, qz)
            wide, skew, high, of_opacity = _dimming_backward(
                of_xx, of_xy, of_yy, blur, tl.load(opacities + row), wide, skew, high, of_opacity, visible, exact
            )
        total += of_opacity
        # By the rows of the projection, halved; and by the covariance in the world.
        fx, fy, fz = wide * px + skew * qx, wide * py + skew * qy, wide * pz + skew * qz
        gx, gy, gz = skew * px + high * qx, skew * py + high * qy, skew * pz + high * qz
        by_xx, by_xy, by_xz = by_xx + fx * px + gx * qx, by_xy + fx * py + gx * qy, by_xz + fx * pz + gx * qz
        by_yy, by_yz, by_zz = by_yy + fy * py + gy * qy, by_yz + fy * pz + gy * qz, by_zz + fz * pz + gz * qz
        fx, fy, fz = _times(xx, xy, xz, yy, yz, zz, fx, fy, fz)
        gx, gy, gz = _times(xx, xy, xz, yy, yz, zz, gx, gy, gz)
        right, under, ahead = _grad_of_mean(
            poses + 16 * camera, u, v, limited_u, limited_v, inverse, x_by_x, y_by_y, of_x, of_y,
            _by_depth(others + placed * stride, inverse, visible, stride, depth), fx, fy, fz, gx, gy, gz, family,
        )  # fmt: skip
        by_x, by_y, by_z = by_x + right, by_y + under, by_z + ahead
        if colored:
            red, green = tl.where(visible, red, 0.0), tl.where(visible, green, 0.0)
            store_three(by_color + 3 * rows, red, green, tl.where(visible, blue, 0.0), here)
        if columns > 0:
            _store_screen_gradients(by_screen + columns * rows, of_x, of_y, others + placed * stride, 0.5 * own_width,
                                    0.5 * own_height, visible, here, columns)  # fmt: skip
        camera += 1
    store_three(by_mean + 3 * rows, by_x, by_y, by_z, here)
    if not family and not activated:
        opacity = 1.0 / (1.0 + tl.exp(-tl.load(opacities + row)))
        total *= opacity * (1.0 - opacity)
    tl.store(by_opacity + rows, total, here)
    if covariances:
        store_three(by_scale + 6 * rows, by_xx, 2.0 * by_xy, 2.0 * by_xz, here)
        store_three(by_scale + 6 * rows + 3, by_yy, 2.0 * by_yz, by_zz, here)
    else:
        _store_shape_gradients(
            by_quaternion, by_scale, rows, here, w, x, y, z, length, s0, s1, s2,
            by_xx, by_xy, by_xz, by_yy, by_yz, by_zz, family, activated,
        )  # fmt: skip


@triton.jit
def _store_screen_gradients(
    into: tl.tensor, of_x: tl.tensor, of_y: tl.tensor, others: tl.tensor, half_width: tl.tensor, half_height: tl.tensor,
    visible: tl.tensor, here: tl.tensor, columns: tl.constexpr,
) -> None:  # fmt: skip
    """Store the gradients by centres in half images; of four columns the last two are sums of absolute values."""
    tl.store(into, of_x * half_width, here)
    tl.store(into + 1, of_y * half_height, here)
    if columns == 4:
        tl.store(into + 2, tl.where(visible, tl.load(others + 1) * half_width, 0.0), here)
        tl.store(into + 3, tl.where(visible, tl.load(others + 2) * half_height, 0.0), here)
    else:
        tl.store(into + 2, 0.0 * of_x, here)


@triton.jit(do_not_specialize=("width", "height", "down_1", "right_1", "down_2", "right_2", "down_3"))
def _camera_kernel(
    view: tl.tensor, full: tl.tensor, centre: tl.tensor, pose: tl.tensor, intrinsics: tl.tensor, position: tl.tensor,
    width: int, height: int, down_1: int, right_1: int, down_2: int, right_2: int, down_3: int,
    tan_x: float, tan_y: float,
) -> None:  # fmt: skip
    """Write a camera as other kernels read it from transposed matrices, of any strides, as the CUDA code takes them."""
    number = tl.arange(0, 16)
    tl.store(position + number, tl.load(centre + number * down_3, number < 3, 0.0), number < 3)
    tl.store(pose + number, tl.load(view + number % 4 * down_1 + number // 4 * right_1))
    # The axis of the camera in the world, by the rotation's inverse: R (r0 x r1) is along it.
    a, b, c = tl.load(view), tl.load(view + down_1), tl.load(view + 2 * down_1)
    d, e, f = tl.load(view + right_1), tl.load(view + down_1 + right_1), tl.load(view + 2 * down_1 + right_1)
    g, h, i = (
        tl.load(view + 2 * right_1), tl.load(view + down_1 + 2 * right_1), tl.load(view + 2 * down_1 + 2 * right_1)
    )  # fmt: skip
    x, y, z = b * f - c * e, c * d - a * f, a * e - b * d
    inverse = 1.0 / (x * g + y * h + z * i)
    across = (tl.load(full) * x + tl.load(full + down_2) * y + tl.load(full + 2 * down_2) * z) * inverse
    full += right_2
    down = (tl.load(full) * x + tl.load(full + down_2) * y + tl.load(full + 2 * down_2) * z) * inverse
    tl.store(intrinsics, 0.5 * width / tan_x)
    tl.store(intrinsics + 2, 0.5 * width * (1.0 + across))
    tl.store(intrinsics + 4, 0.5 * height / tan_y)
    tl.store(intrinsics + 5, 0.5 * height * (1.0 + down))


def camera_of(
    view: Tensor, full: Tensor, centre: Tensor, tangents: tuple[float, float], size: tuple[int, int]
) -> DeviceCameras:
    """Return a camera from transposed matrices on the device, as the CUDA code takes them, without reading them.

    Args:
        view: (4, 4) world to camera.
        full: (4, 4) world to clip space; only its principal point is used.
        centre: (3,) in world coordinates.
        tangents: of half the fields of view, across and down.
        size: (width, height).
    """
    centre = centre.reshape(3)
    # One allocation, in which each part begins at a multiple of 16 bytes.
    numbers = view.new_empty(32)
    pose = numbers.as_strided((1, 4, 4), (16, 4, 1), 0)
    intrinsics = numbers.as_strided((1, 3, 3), (9, 3, 1), 16)
    position = numbers.as_strided((1, 3), (3, 1), 28)
    launch(
        _camera_kernel, (1,),
        view, full, centre, pose, intrinsics, position, *size, *view.stride(), *full.stride(), *centre.stride(),
        float(tangents[0]), float(tangents[1]),
    )  # fmt: skip
    return DeviceCameras(pose, intrinsics, position, *size)


def project(
    parameters: Parameters, cameras: DeviceCameras, degree: int, signed: bool, with_geometry: bool = False,
    rules: Rules = GSPLAT, numbers: Numbers = NUMBERS, first: Tensor | None = None,
    into: Sequence[Tensor] | None = None, with_centres: bool = True,
) -> Projected:  # fmt: skip
    """Project at least one Gaussian, and evaluate its colour.

    Args:
        degree: highest of SH to evaluate.
        signed: whether colours are the raw SH values.
        with_geometry: fill in visible radii, and centres if `with_centres`.
        rules, numbers: those of `parameters`, too.
        first: (n, 1, 3) first coefficients, if they are apart.
        into: radii, centres, depths and records to write to, as in `Projected`; None for new ones.
        with_centres: else those of the result have no meaning.
    """
    count, n, like = cameras.poses.shape[0], parameters.means.shape[0], parameters.means
    if into is None:
        into = (
            like.new_empty(count, n, 2, dtype=torch.int32), like.new_empty(count, 0 if rules.family else n, 2),
            like.new_empty(count, n), like.new_empty(count, n, RECORD),
        )  # fmt: skip
    radii, means2d, depths, records = into
    rows = n if with_geometry else 0
    projected = Projected(
        radii, means2d, depths, records, like.new_empty(count, rows, dtype=torch.int32),
        like.new_empty(count, rows, 2) if with_centres else means2d,
    )  # fmt: skip
    described = with_geometry, with_geometry and with_centres
    _project(parameters, first, cameras, (0, count), degree, signed, projected, 0, described, rules, numbers)
    return projected


def project_into(
    stacked: Sequence[Tensor], start: int, parameters: Parameters, cameras: DeviceCameras, camera: int, signed: bool
) -> None:
    """Write the projection of one field, seen by one of some cameras, to the tensors of a stack of fields.

    Args:
        stacked: radii (m, 2), centres (m, 2), depths (m,) and records (m, RECORD) of all fields.
        start: first row of this one.
        camera: number of its camera; its size is that of all.
        parameters, cameras, signed: as `project` takes them; all coefficients are evaluated.
    """
    projected = Projected(*stacked, *stacked[:2])
    degree = math.isqrt(parameters.sh.shape[1]) - 1
    _project(parameters, None, cameras, (camera, 1), degree, signed, projected, start, (False, False), GSPLAT, NUMBERS)


def _sizes_of(cameras: DeviceCameras) -> Tensor:
    """Return the sizes of cameras, or a tensor that is not read where all have one size."""
    return cameras.poses if cameras.sizes is None else cameras.sizes


def _coefficients(sh: Tensor, rules: Rules) -> int:
    """Return the number of SH coefficients, 0 if there are colours (n, 3) instead."""
    return sh.shape[1] + rules.apart if sh.ndim == 3 else 0


def _project(
    parameters: Parameters, first: Tensor | None, cameras: DeviceCameras, chosen: tuple[int, int], degree: int,
    signed: bool, into: Projected, start: int, described: tuple[bool, bool], rules: Rules, numbers: Numbers,
) -> None:  # fmt: skip
    """Launch the projection; `described` says whether visible radii and centres are wanted."""
    n = parameters.means.shape[0]
    launch(
        _project_kernel, (blocks(n, BLOCK),),
        *parameters, parameters.sh if first is None else first, *cameras[:3], _sizes_of(cameras), *into,
        cameras.width, cameras.height, n, *chosen, (degree + 1) ** 2, int(signed), start, *numbers,
        coefficients=_coefficients(parameters.sh, rules), with_radii=described[0],
        with_centres=described[1], record=RECORD, block=BLOCK, tile=TILE,
        family=rules.family, covariances=rules.covariances, apart=rules.apart, dimmed=rules.dimmed,
        exact=rules.exact, snug=rules.snug, activated=rules.activated, alpha=rules.alpha,
        mixed=cameras.sizes is not None,
    )  # fmt: skip


def project_backward(
    parameters: Parameters, cameras: DeviceCameras, degree: int, signed: bool, radii: Tensor, records: Tensor,
    by_records: Tensor, others: Tensor, rules: Rules = GSPLAT, numbers: Numbers = NUMBERS,
) -> Parameters:  # fmt: skip
    """Return the gradients by parameters, summed over cameras.

    Args:
        parameters, cameras, degree, signed, rules, numbers: arguments of `project`.
        radii, records: its results.
        by_records, others: gradients (c, n, GRADIENT) and (c, n, 1 or more) as `blend_backward` returns them.
    """
    by = Parameters(*(torch.empty_like(value) for value in parameters))
    _project_backward(
        parameters, None, cameras, degree, signed, radii, records, by_records, others, by, None, None,
        rules, numbers,
    )  # fmt: skip
    return by


def project_family_backward(
    parameters: Parameters, first: Tensor | None, cameras: DeviceCameras, degree: int, signed: bool, radii: Tensor,
    records: Tensor, by_records: Tensor, others: Tensor, rules: Rules, numbers: Numbers, columns: int,
) -> tuple[Parameters, Tensor | None, Tensor]:  # fmt: skip
    """Return the gradients by parameters, by the first coefficients, and by centres in units of half images.

    Args:
        parameters, first, cameras, degree, signed, rules, numbers: arguments of `project`; one camera.
        radii, records: its results.
        by_records, others: as `blend_backward` returns them.
        columns: of the gradient by centres: 3, or 4 of which the last two are sums of absolute values.
    """
    by = Parameters(*(torch.empty_like(value) for value in parameters))
    by_first = None if first is None else torch.empty_like(first)
    by_screen = parameters.means.new_empty(parameters.means.shape[0], columns)
    _project_backward(
        parameters, first, cameras, degree, signed, radii, records, by_records, others, by, by_first, by_screen,
        rules, numbers,
    )  # fmt: skip
    return by, by_first, by_screen


def _project_backward(
    parameters: Parameters, first: Tensor | None, cameras: DeviceCameras, degree: int, signed: bool, radii: Tensor,
    records: Tensor, by_records: Tensor, others: Tensor, by: Parameters, by_first: Tensor | None,
    by_screen: Tensor | None, rules: Rules, numbers: Numbers,
) -> None:  # fmt: skip
    n, count = parameters.means.shape[0], cameras.poses.shape[0]
    coefficients = _coefficients(parameters.sh, rules)
    launch(
        _shape_gradient_kernel, (blocks(n, BLOCK),),
        *parameters[:4], *cameras[:2], _sizes_of(cameras), radii, records, by_records, others,
        *by, by.means if by_screen is None else by_screen,
        cameras.width, cameras.height, n, count, numbers.modifier, numbers.blur, numbers.near,
        record=RECORD, gradient=GRADIENT, stride=others.shape[-1], block=BLOCK, colored=coefficients == 0,
        columns=0 if by_screen is None else by_screen.shape[1], family=rules.family, covariances=rules.covariances,
        dimmed=rules.dimmed, exact=rules.exact, depth=rules.depth, activated=rules.activated,
        mixed=cameras.sizes is not None,
    )  # fmt: skip
    if coefficients == 0:
        return
    launch(
        color_gradient_kernel, (blocks(n, BLOCK),),
        parameters.means, cameras.centres, parameters.sh, parameters.sh if first is None else first,
        radii, records, by_records, by.means, by.sh, by.sh if by_first is None else by_first,
        n, count, (degree + 1) ** 2, int(signed),
        record=RECORD, color_in_record=COLOR_IN_RECORD, gradient=GRADIENT,
        coefficients=coefficients, padded=triton.next_power_of_2(coefficients), block=BLOCK, apart=rules.apart,
    )  # fmt: skip
