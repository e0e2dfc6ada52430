"""Describe the box or sphere of `--crop`. Imports no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations, pairwise, product
from typing import TYPE_CHECKING

from lapgs_plugin.errors import UserInputError

if TYPE_CHECKING:
    from torch import Tensor

Point = tuple[float, float, float]

CIRCLE = 64
"""Segments of each of the three circles that show a sphere."""


@dataclass(frozen=True)
class Crop:
    """Describe a box along the axes or a sphere, in world units.

    Attributes:
        numbers: six for a box: its lowest and its highest corner; four for a sphere: its centre and its radius.
    """

    numbers: tuple[float, ...]

    @classmethod
    def parse(cls, text: str) -> Crop:
        """Read a value of `--crop`.

        Raises:
            UserInputError: it is neither a box nor a sphere.
        """
        try:
            numbers = tuple(float(part) for part in text.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) not in (4, 6) or not all(map(math.isfinite, numbers)):
            raise UserInputError(
                f"--crop {text}: expected six numbers x0,y0,z0,x1,y1,z1 of a box or four x,y,z,r of a sphere, in the "
                "scene's units and without spaces"
            )
        if len(numbers) == 4 and numbers[3] <= 0.0:
            raise UserInputError(f"--crop {text}: the radius is {numbers[3]:g}, expected a positive one")
        if len(numbers) == 6:
            for axis, low, high in zip("xyz", numbers[:3], numbers[3:], strict=True):
                if low >= high:
                    expected = f"expected {axis}0 < {axis}1"
                    raise UserInputError(f"--crop {text}: {axis}0 is {low:g} and {axis}1 is {high:g}, {expected}")
        return cls(numbers)

    @property
    def text(self) -> str:
        """The value of `--crop`."""
        return ",".join(f"{number:g}" for number in self.numbers)

    def contains(self, points: Tensor) -> Tensor:
        """Return which of the points (n, 3) lie inside, (n,) bool."""
        if len(self.numbers) == 4:
            inside: Tensor = (points - points.new_tensor(self.numbers[:3])).norm(dim=1) <= self.numbers[3]
            return inside
        low, high = points.new_tensor(self.numbers[:3]), points.new_tensor(self.numbers[3:])
        return ((points >= low) & (points <= high)).all(dim=1)

    def edges(self) -> list[tuple[Point, Point]]:
        """Return line segments that show it: the twelve edges of a box, or circles of a sphere around the axes."""
        if len(self.numbers) == 6:
            x0, y0, z0, x1, y1, z1 = self.numbers
            corners = list(product((x0, x1), (y0, y1), (z0, z1)))
            pairs = combinations(corners, 2)
            return [(a, b) for a, b in pairs if sum(x != y for x, y in zip(a, b, strict=True)) == 1]
        x, y, z, radius = self.numbers
        angles = [2.0 * math.pi * step / CIRCLE for step in range(CIRCLE + 1)]
        circle = [(radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]
        rings = (
            [(x + u, y + v, z) for u, v in circle],
            [(x + u, y, z + v) for u, v in circle],
            [(x, y + u, z + v) for u, v in circle],
        )
        return [segment for ring in rings for segment in pairwise(ring)]
