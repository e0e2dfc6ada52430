"""Render with a triple loop over plain floats: rows, columns, Gaussians. It shares no formula with the oracle.

The oracle multiplies matrices, this file adds up rank-one terms; the oracle has polynomials, this file uses recurrences
of associated Legendre functions; the oracle evaluates many pixels at once, this file one. It is slow, in double
precision, and has no gradients: those of other rasterizers are compared with its finite differences.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tests.raster.scenes import Case

Vector = Sequence[float]
Pin = tuple[float | None, float | None]
"""Camera-space x and y at which a Gaussian's Jacobian is taken; None where that is its own centre."""


@dataclass(frozen=True)
class NaiveResult:
    """Hold image (3, h, w), transmittance (h, w), radii (n,) int32, as in `RenderResult`."""

    image: Tensor
    transmittance: Tensor
    radii: Tensor


@dataclass(frozen=True)
class Splat:
    """Hold one Gaussian on the image plane."""

    depth: float
    center: tuple[float, float]
    covariance: tuple[float, float, float]  # xx, xy, yy
    determinant: float
    radius: int
    tiles: tuple[int, int, int, int]  # x0, y0, x1, y1; the last are exclusive
    opacity: float
    color: Vector


def render(case: Case, *, shifts: Sequence[Vector] | None = None, pins: Sequence[Pin] | None = None) -> NaiveResult:
    """Render a case.

    Args:
        case: any dtype; computed in double precision.
        shifts: n (x, y) pixels by which each centre is moved when blending, after its tiles were chosen.
        pins: n fixed points for the Jacobians, from `jacobian_pins`; None uses the 1.3 tan(fov / 2) limit.
    """
    camera, n = case.camera, len(case.field)
    splats = project(case, pins or [(None, None)] * n)
    moved = shifts or [(0.0, 0.0)] * n
    seen = [(splat.depth, i, splat) for i, splat in enumerate(splats) if splat is not None]
    front_to_back = [(splat, moved[i]) for _, i, splat in sorted(seen, key=lambda entry: entry[:2])]
    pixels = [
        blend_pixel(x, y, front_to_back, case.background) for y in range(camera.height) for x in range(camera.width)
    ]
    image = torch.tensor([color for color, _ in pixels], dtype=torch.float64)
    remaining = torch.tensor([transmittance for _, transmittance in pixels], dtype=torch.float64)
    radii = torch.tensor([0 if splat is None else splat.radius for splat in splats], dtype=torch.int32)
    shape = camera.height, camera.width
    return NaiveResult(image.T.reshape(3, *shape), remaining.reshape(shape), radii)


def blend_pixel(
    x: int, y: int, front_to_back: Sequence[tuple[Splat, Vector]], background: Vector
) -> tuple[list[float], float]:
    """Return the colour and the remaining transmittance of one pixel."""
    color = [0.0, 0.0, 0.0]
    transmittance = 1.0
    for splat, shift in front_to_back:
        x0, y0, x1, y1 = splat.tiles
        if not (x0 <= x // 16 < x1 and y0 <= y // 16 < y1):
            continue
        dx, dy = x - splat.center[0] - shift[0], y - splat.center[1] - shift[1]
        xx, xy, yy = splat.covariance
        power = -0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / splat.determinant
        if power > 0:
            continue
        alpha = min(0.99, splat.opacity * math.exp(power))
        if alpha < 1 / 255:
            continue
        if transmittance * (1 - alpha) < 1e-4:
            break
        for channel in range(3):
            color[channel] += transmittance * alpha * splat.color[channel]
        transmittance *= 1 - alpha
    return [c + transmittance * b for c, b in zip(color, background, strict=True)], transmittance


def project(case: Case, pins: Sequence[Pin]) -> list[Splat | None]:
    """Return every Gaussian's splat, None where it is culled."""
    field = case.field
    degree = field.sh_degree if case.sh_degree is None else case.sh_degree
    pose = case.camera.world_to_camera.double().tolist()
    eye = [-sum(pose[row][column] * pose[row][3] for row in range(3)) for column in range(3)]
    splats = []
    values = (value.detach().double().tolist() for value in field.parameters.values())
    for pin, mean, quaternion, log_scales, logit, sh in zip(pins, *values, strict=True):
        axes = [[math.exp(s) * c for c in rotate(quaternion, k)] for k, s in enumerate(log_scales)]
        splat = footprint(case, to_camera(pose, mean), [turn(pose, axis) for axis in axes], pin)
        if splat is not None:
            basis = harmonics([m - e for m, e in zip(mean, eye, strict=True)], degree)
            color = [sum(b * sh[k][channel] for k, b in enumerate(basis)) for channel in range(3)]
            color = color if field.signed else [max(c + 0.5, 0.0) for c in color]
            splat = replace(splat, opacity=1 / (1 + math.exp(-logit)), color=color)
        splats.append(splat)
    return splats


def to_camera(pose: Sequence[Vector], point: Vector) -> list[float]:
    return [c + row[3] for c, row in zip(turn(pose, point), pose[:3], strict=True)]


def turn(pose: Sequence[Vector], vector: Vector) -> list[float]:
    return [sum(row[k] * vector[k] for k in range(3)) for row in pose[:3]]


def jacobian_limits(case: Case) -> tuple[float, float]:
    """Return the largest |x / z| and |y / z| at which a Jacobian is taken."""
    camera = case.camera
    return 1.3 * camera.width / (2 * camera.fx), 1.3 * camera.height / (2 * camera.fy)


def jacobian_pins(case: Case) -> list[Pin]:
    """Return the points of the clamped Jacobians, which the gradient of the CUDA code holds constant."""
    pose = case.camera.world_to_camera.double().tolist()
    pins = []
    for mean in case.field.means.detach().double().tolist():
        *point, z = to_camera(pose, mean)
        pins.append(
            tuple(
                math.copysign(bound * z, c) if z > 0.2 and abs(c / z) > bound else None
                for c, bound in zip(point, jacobian_limits(case), strict=True)
            )
        )
    return pins


def footprint(case: Case, point: Vector, axes: Sequence[Vector], pin: Pin) -> Splat | None:
    """Return the splat, without opacity and colour, of a centre and three semi-axes in camera coordinates."""
    camera = case.camera
    x, y, z = point
    if z <= 0.2:
        return None
    center = (camera.fx * x / z + camera.cx - 0.5, camera.fy * y / z + camera.cy - 0.5)
    slope_x, slope_y = (
        max(-bound, min(bound, c / z)) if fixed is None else fixed / z
        for c, bound, fixed in zip((x, y), jacobian_limits(case), pin, strict=True)
    )
    # Each semi-axis as a difference of pixel positions, to first order; the covariance is the sum of their squares.
    flat = [(camera.fx * (a - slope_x * c) / z, camera.fy * (b - slope_y * c) / z) for a, b, c in axes]
    xx, yy = sum(u * u for u, _ in flat) + 0.3, sum(v * v for _, v in flat) + 0.3
    xy = sum(u * v for u, v in flat)
    # By Cauchy-Binet, so that nothing cancels.
    areas = [flat[i][0] * flat[j][1] - flat[j][0] * flat[i][1] for i, j in ((0, 1), (0, 2), (1, 2))]
    determinant = sum(a * a for a in areas) + 0.3 * (xx + yy - 0.6) + 0.09
    radius = math.ceil(3 * math.sqrt((xx + yy) / 2 + math.sqrt(max(0.1, ((xx - yy) / 2) ** 2 + xy * xy))))
    across, down = math.ceil(camera.width / 16), math.ceil(camera.height / 16)
    tiles = (
        min(across, max(0, int((center[0] - radius) / 16))),
        min(down, max(0, int((center[1] - radius) / 16))),
        min(across, max(0, int((center[0] + radius + 15) / 16))),
        min(down, max(0, int((center[1] + radius + 15) / 16))),
    )
    if tiles[0] >= tiles[2] or tiles[1] >= tiles[3]:
        return None
    return Splat(z, center, (xx, xy, yy), determinant, radius, tiles, opacity=0.0, color=())


def rotate(quaternion: Vector, axis: int) -> list[float]:
    """Rotate the unit vector along `axis` by a wxyz quaternion of any length: v + 2 r x (r x v + w v) with r = xyz."""
    length = math.sqrt(sum(c * c for c in quaternion))
    w, *r = (c / length for c in quaternion)
    v = [1.0 if k == axis else 0.0 for k in range(3)]
    inner = [c + w * k for c, k in zip(cross(r, v), v, strict=True)]
    return [k + 2 * c for k, c in zip(v, cross(r, inner), strict=True)]


def cross(a: Vector, b: Vector) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def harmonics(direction: Vector, degree: int) -> list[float]:
    """Return real spherical harmonics with the Condon-Shortley phase, from angles, l by l and m from -l to l."""
    x, y, z = direction
    cosine, azimuth = z / math.sqrt(x * x + y * y + z * z), math.atan2(y, x)
    values = []
    for l in range(degree + 1):  # noqa: E741 - the degree's name everywhere
        for m in range(-l, l + 1):
            order = abs(m)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - order) / math.factorial(l + order))
            angular = 1.0 if m == 0 else math.sqrt(2) * (math.cos(m * azimuth) if m > 0 else math.sin(order * azimuth))
            values.append(norm * angular * legendre(l, order, cosine))
    return values


def legendre(degree: int, order: int, x: float) -> float:
    """Return the associated Legendre function P_l^m(x) with the phase (-1)^m, by the usual recurrence in l."""
    previous, current = 0.0, 1.0
    for k in range(order):
        current *= -(2 * k + 1) * math.sqrt(max(0.0, 1 - x * x))
    for l in range(order + 1, degree + 1):  # noqa: E741 - the degree's name everywhere
        previous, current = current, ((2 * l - 1) * x * current - (l + order - 1) * previous) / (l - order)
    return current
