"""Shapes a ray can hit: where it hits them, and their normals.

Rays start at one point: the camera, or the lamp when shadows are cast. Directions are unit vectors, float32, (3, n), so
that each coordinate is contiguous. Every shape works in its own frame, described at its class, and is placed in the
world by a rotation and a translation. Discriminants are written with the moment of the ray (a cross product), which
does not cancel: a wire of 5 mm, six metres away, keeps four digits in float32.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
Codes = NDArray[np.uint8]

Paint = Callable[[Floats, Floats], Codes]
"""Colour of a surface as a number in the world's palette (n,), from local points and local normals, (3, n) each."""
Hits = tuple[NDArray[np.intp], Floats]
"""The rays that hit something: their indices (k,) and the distances of their first hits (k,)."""
Cutout = Callable[[Floats, Floats], Mask]
"""Where a thin sheet is solid (n,), from its two surface coordinates (n,) in metres."""


def rotate(rotation: Floats, vectors: Floats) -> Floats:
    """rotation (3, 3) @ vectors (3, n), without BLAS: its own threads would compete with ours, and its last bits depend
    on their number."""
    if np.array_equal(rotation, np.eye(3)):
        return vectors
    result = np.empty_like(vectors)
    for row, target in zip(rotation, result, strict=True):
        np.multiply(vectors[0], row[0], out=target)
        for factor, vector in zip(row[1:], vectors[1:], strict=True):
            if factor != 0:
                np.add(target, factor * vector, out=target)
    return result


def dot(a: Floats, b: Floats) -> Floats:
    """Of vectors (3, n) or (3,): (n,)."""
    result: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return result


@dataclass(frozen=True)
class Pose:
    """Where a shape stands: world = rotation @ local + origin."""

    rotation: Floats  # (3, 3)
    origin: Floats  # (3,)

    @classmethod
    def standing(cls, x: float, y: float, z: float, turn: float = 0.0) -> Pose:
        """Upright at a place, turned about the vertical by `turn` radians."""
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], np.float32)
        return cls(rotation, np.array([x, y, z], np.float32))

    @classmethod
    def between(cls, start: tuple[float, float, float], end: tuple[float, float, float]) -> Pose:
        """Origin at `start`, third axis towards `end`."""
        axis = np.subtract(end, start)
        axis /= np.linalg.norm(axis)
        first = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
        first /= np.linalg.norm(first)
        rotation = np.stack([first, np.cross(axis, first), axis], axis=1).astype(np.float32)
        return cls(rotation, np.array(start, np.float32))


@dataclass(frozen=True)
class Shape(ABC):
    """A painted surface in the world.

    Attributes:
        pose: its place.
        paint: its colours.
        gloss: strength of the highlight, 0 for matt; highlights move with the camera.
        glows: shows its paint as it is, whatever the light.
    """

    pose: Pose
    paint: Paint
    gloss: float = field(default=0.0, kw_only=True)
    glows: bool = field(default=False, kw_only=True)

    @abstractmethod
    def _bounds(self) -> tuple[Floats, float] | None:
        """Centres (3, k) in local coordinates and radius of balls that cover the shape; None where it has no end."""

    @abstractmethod
    def _hit(self, origin: Floats, directions: Floats) -> Hits:
        """Which local rays hit the shape, and where first. Divisions by zero are not reported."""

    @abstractmethod
    def _normals(self, points: Floats) -> Floats:
        """Unit normals (3, n) at local points; either side."""

    def bounds(self) -> tuple[Floats, float] | None:
        """Centres (3, k) in world coordinates and radius of balls that cover the shape; None for the hall, which has
        no end and throws no shadow."""
        bounds = self._bounds()
        return bounds and (self.pose.rotation @ bounds[0] + self.pose.origin[:, None], bounds[1])

    def hit(self, origin: Floats, directions: Floats) -> Hits:
        """Which rays from `origin` (3,) in `directions` (3, n) hit the shape, and at which distance first."""
        to_local = self.pose.rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._hit(to_local @ (origin - self.pose.origin), rotate(to_local, directions))

    def surface(self, points: Floats) -> tuple[Codes, Floats]:
        """Palette numbers (n,) and world normals (3, n), of either side, at points (3, n) on the surface."""
        local = rotate(self.pose.rotation.T, points - self.pose.origin[:, None])
        normals = self._normals(local)
        return self.paint(local, normals), rotate(self.pose.rotation, normals)


@dataclass(frozen=True)
class Floor(Shape):
    """The plane z = 0."""

    def _bounds(self) -> None:
        return None

    def _hit(self, origin: Floats, directions: Floats) -> Hits:
        distance = -origin[2] / directions[2]
        return _select(distance > 0, distance)

    def _normals(self, points: Floats) -> Floats:
        return _axis_normals(points, 2)


@dataclass(frozen=True)
class Wall(Shape):
    """An upright cylinder around the z axis, seen from inside."""

    radius: float

    def _bounds(self) -> None:
        return None

    def _hit(self, origin: Floats, directions: Floats) -> Hits:
        which, square = _select(*_cylinder_square(origin, directions, self.radius))
        _, far = _cylinder_ends(origin, directions.take(which, axis=1), square)
        return which, far

    def _normals(self, points: Floats) -> Floats:
        return _radial_normals(points)


@dataclass(frozen=True)
class Dome(Shape):
    """A sphere around the origin, seen from inside."""

    radius: float

    def _bounds(self) -> None:
        return None

    def _hit(self, origin: Floats, directions: Floats) -> Hits:
        middle, square = _sphere(origin, directions, self.radius)
        return _select(square >= 0, middle + np.sqrt(square))

    def _normals(self, points: Floats) -> Floats:
        return points / np.float32(self.radius)


@dataclass(frozen=True)
class Ball(Shape):
    """A sphere around the origin, solid where `solid(longitude, latitude)` in radians; everywhere without it."""

    radius: float
    solid: Cutout | None = None

    def _bounds(self) -> tuple[Floats, float]:
        return np.zeros((3, 1), np.float32), self.radius

    def _hit(self, origin: Floats, directions: Floats) -> Hits:
        middle, square = _sphere(origin, directions, self.radius)
        which = np.flatnonzero(square > 0)
        middle, half = middle.take(which), np.sqrt(square.take(which))
        if self.solid is None:
            return which, middle - half
        rays = directions.take(which, axis=1)
        part, distance = _first_solid(origin, rays, (middle - half, middle + half), self._is_solid)
        return which.take(part), distance

    def _is_solid(self, points: Floats) -> Mask:
        assert self.solid is not None
        sine = np.clip(points[2] * np.float32(1 / self.radius), -1, 1)
        return self.solid(np.arctan2(points[1], points[0]), np.arcsin(sine))

    def _normals(self, points: Floats) -> Floats:
        return points / np.float32(self.radius)


@dataclass(frozen=True)
class Box(Shape):
    """A block centred at the origin; `size` are its full edges."""

    size: tuple[float, float, float]

    def _bounds(self) -> tuple[Floats, float]:
        return np.zeros((3, 1), np.float32), float(np.linalg.norm(self.size)) / 2

    def _hit(self, origin: Floats, directions: Floats) -> Hits:
        half = np.array(self.size, np.float32) / 2
        inverse = 1 / directions
        low, high = (-half - origin)[:, None] * inverse, (half - origin)[:, None] * inverse  # (3, n)
        enter = np.minimum(low, high).max(axis=0)
        leave = np.maximum(low, high).min(axis=0)
        return _select((enter <= leave) & (enter > 0), enter)

    def _normals(self, points: Floats) -> Floats:
        reach = points * (2 / np.array(self.size, np.float32))[:, None]
        size = np.abs(reach)
        normals: Floats = np.sign(reach) * (size == size.max(axis=0))
        return normals


@dataclass(frozen=True)
class Rod(Shape):
    """A closed cylinder around the z axis from z = 0 to `length`."""

    radius: float
    length: float

    def _bounds(self) -> tuple[Floats, float]:
        count = max(1, int(self.length / (4 * self.radius + 0.1)))
        step = self.length / count
        centres = np.zeros((3, count), np.float32)
        centres[2] = (np.arange(count) + 0.5) * step
        return centres, float(np.hypot(self.radius, step / 2))

    def _hit(self, origin: Floats, directions: Floats) -> Hits:
        which, square = _select(*_cylinder_square(origin, directions, self.radius))
        rays = directions.take(which, axis=1)
        near, far = _cylinder_ends(origin, rays, square)
        inverse = 1 / rays[2]
        bottom, top = -origin[2] * inverse, (np.float32(self.length) - origin[2]) * inverse
        enter = np.maximum(near, np.minimum(bottom, top))
        leave = np.minimum(far, np.maximum(bottom, top))
        part, distance = _select((enter <= leave) & (enter > 0), enter)
        return which.take(part), distance

    def _normals(self, points: Floats) -> Floats:
        off_side = np.float32(self.radius) - np.sqrt(points[0] ** 2 + points[1] ** 2)
        end = points[2] * np.float32(2 / self.length) - 1  # -1 to 1
        cap = (1 - np.abs(end)) * np.float32(self.length / 2) < off_side
        normals: Floats = _radial_normals(points) * ~cap
        normals[2] = np.sign(end) * cap
        return normals


@dataclass(frozen=True)
class Cone(Shape):
    """A cone with its tip at z = `height`; its base, of a radius at z = 0, is open and lies on the floor."""

    radius: float
    height: float

    def _bounds(self) -> tuple[Floats, float]:
        return np.array([[0], [0], [self.height / 2]], np.float32), float(np.hypot(self.radius, self.height / 2))

    def _hit(self, origin: Floats, directions: Floats) -> Hits:
        k = np.float32(self.radius / self.height)
        x, y, z = origin - np.array([0, 0, self.height], np.float32)
        dx, dy, dz = directions
        a = dx * dx + dy * dy - k * k * dz * dz
        b = x * dx + y * dy - k * k * z * dz
        # b^2 - a c by Lagrange's identity: the moment again.
        root = np.sqrt(k * k * ((x * dz - z * dx) ** 2 + (y * dz - z * dy) ** 2) - (x * dy - y * dx) ** 2)
        first, second = (-b - root) / a, (-b + root) / a
        low, high = np.minimum(first, second), np.maximum(first, second)
        near = np.where(self._on_side(origin, dz, low), low, high)
        return _select(self._on_side(origin, dz, near), near)

    def _on_side(self, origin: Floats, dz: Floats, distance: Floats) -> Mask:
        height = origin[2] + distance * dz
        valid: Mask = (distance > 0) & (height >= 0) & (height <= np.float32(self.height))
        return valid

    def _normals(self, points: Floats) -> Floats:
        slope = np.arctan2(self.radius, self.height)
        side: Floats = _radial_normals(points) * np.float32(np.cos(slope))
        side[2] = np.sin(slope)
        return side


@dataclass(frozen=True)
class Panel(Shape):
    """A thin upright sheet in the plane y = 0: |x| <= width / 2, 0 <= z <= height, solid where `solid(x, z)`."""

    width: float
    height: float
    solid: Cutout

    def _bounds(self) -> tuple[Floats, float]:
        return np.array([[0], [0], [self.height / 2]], np.float32), float(np.hypot(self.width, self.height)) / 2

    def _hit(self, origin: Floats, directions: Floats) -> Hits:
        return _first_solid(origin, directions, (-origin[1] / directions[1],), self._is_solid)

    def _is_solid(self, points: Floats) -> Mask:
        x, _, z = points
        inside = (np.abs(x) <= np.float32(self.width / 2)) & (z >= 0) & (z <= np.float32(self.height))
        solid: Mask = inside & self.solid(x, z)
        return solid

    def _normals(self, points: Floats) -> Floats:
        return _axis_normals(points, 1)


def _select(valid: Mask, distance: Floats) -> Hits:
    which = np.flatnonzero(valid)
    return which, distance.take(which)


def _first_solid(
    origin: Floats, directions: Floats, distances: tuple[Floats, ...], is_solid: Callable[[Floats], Mask]
) -> Hits:
    """The first of several hits with a sheet that has holes, given in the order in which a ray meets them."""
    result = np.zeros(directions.shape[1], np.float32)
    for distance in distances:
        asked = np.flatnonzero((distance > 0) & (result == 0))
        points = origin[:, None] + distance.take(asked) * directions.take(asked, axis=1)
        solid = asked[is_solid(points)]
        result[solid] = distance.take(solid)
    return _select(result > 0, result)


def _cylinder_square(origin: Floats, directions: Floats, radius: float) -> tuple[Mask, Floats]:
    """Where rays meet the endless cylinder around z, and the square of half their way in it seen along z, (n,) each."""
    dx, dy = directions[0], directions[1]
    moment = origin[0] * dy - origin[1] * dx
    square = (dx * dx + dy * dy) * np.float32(radius**2) - moment * moment
    return square > 0, square


def _cylinder_ends(origin: Floats, directions: Floats, square: Floats) -> tuple[Floats, Floats]:
    """Where rays with a positive square enter and leave the cylinder, (n,) each."""
    dx, dy = directions[0], directions[1]
    inverse = 1 / (dx * dx + dy * dy)
    middle = (origin[0] * dx + origin[1] * dy) * -inverse
    half = np.sqrt(square) * inverse
    return middle - half, middle + half


def _sphere(origin: Floats, directions: Floats, radius: float) -> tuple[Floats, Floats]:
    """Distance of the middle of the chord in a sphere around the origin, and the square of half its length."""
    middle = -dot(origin, directions)
    nearest = origin[:, None] + middle * directions  # (3, n) the moment, turned
    return middle, np.float32(radius**2) - dot(nearest, nearest)


def _axis_normals(points: Floats, axis: int) -> Floats:
    normals = np.zeros_like(points)
    normals[axis] = 1.0
    return normals


def _radial_normals(points: Floats) -> Floats:
    normals: Floats = points / np.maximum(np.sqrt(points[0] ** 2 + points[1] ** 2), np.float32(1e-12))
    normals[2] = 0.0
    return normals
