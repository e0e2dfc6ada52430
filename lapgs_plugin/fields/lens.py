"""Describe lenses that bend rays, by OpenCV's models as gsplat's unscented transform (3DGUT) evaluates them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

LEAST_SHRINKING = 0.8
"""Least factor of a perspective lens on the distance from the axis. gsplat takes what a lens shrinks more for points
that it flips through the middle of the image."""
STEPS, FISHEYE_STEPS = 5, 20
"""Newton's steps from a pixel to its ray, of perspective and of fisheye lenses; where they do not end is no ray."""
CONVERGED = 1e-6
"""Largest last step."""


@dataclass(frozen=True)
class Lens:
    """Bend the rays of a camera.

    Points of the plane are at depth 1, before the focal lengths and the principal point are applied.

    Attributes:
        fisheye: whether the distance from the axis is a polynomial of the angle, not of the angle's tangent.
        radial: k1 to k3 of the polynomial and k4 to k6 of its denominator; k1 to k4 of a fisheye lens.
        tangential: p1 and p2; 0 of a fisheye lens.
    """

    fisheye: bool = False
    radial: tuple[float, ...] = (0.0,) * 6
    tangential: tuple[float, float] = (0.0, 0.0)

    def bent(self, points: Tensor, furthest: float) -> tuple[Tensor, Tensor]:
        """Return where a lens shows points.

        Args:
            points: (..., 3) in the camera's axes.
            furthest: largest distance of a corner of the image from the axis, on the plane.

        Returns:
            Points of the plane (..., 2), and whether they are valid (...).
        """
        x, y, depths = points.unbind(-1)
        ahead = depths > 0
        if self.fisheye:
            flat = torch.hypot(x, y).clamp_min(torch.finfo(x.dtype).tiny)
            angles = torch.atan2(flat, depths).clamp_max(self._largest_angle(furthest))
            factors = self._of_angle(angles) / flat
            return torch.stack([factors * x, factors * y], -1), ahead & (factors > 0)
        depths = torch.where(ahead, depths, 1.0)
        x, y = x / depths, y / depths
        shrinking, by_x, by_y = self._perspective(x, y)
        return torch.stack([shrinking * x + by_x, shrinking * y + by_y], -1), ahead & (shrinking > LEAST_SHRINKING)

    def rays(self, plane: Tensor, furthest: float) -> tuple[Tensor, Tensor]:
        """Return the directions (n, 3) of length 1 that a lens shows at points of the plane, and which have one (n,).

        Args:
            plane: (n, 2) in float64.
            furthest: as `bent` takes it.
        """
        return self._fisheye_rays(plane, furthest) if self.fisheye else self._perspective_rays(plane)

    def _perspective(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the radial factor at points of the straight plane, and what is added to x and to y."""
        k1, k2, k3, k4, k5, k6 = self.radial
        p1, p2 = self.tangential
        r2 = x * x + y * y
        factor = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return factor, 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y

    def _perspective_rays(self, plane: Tensor) -> tuple[Tensor, Tensor]:
        x, y = plane.unbind(1)
        done = torch.zeros(len(plane), dtype=torch.bool)
        for _ in range(STEPS):
            factor, by_x, by_y = self._perspective(x, y)
            right, down = factor * x + by_x - plane[:, 0], factor * y + by_y - plane[:, 1]
            by_right, mixed, by_down = self._slopes(x, y, factor)
            determinants = by_right * by_down - mixed * mixed
            solvable = (determinants.abs() > CONVERGED) & (factor > 0)
            across = (by_down * right - mixed * down) / determinants
            along = (by_right * down - mixed * right) / determinants
            moved = solvable & ~done
            x, y = torch.where(moved, x - across, x), torch.where(moved, y - along, y)
            done |= solvable & (across.abs() < CONVERGED) & (along.abs() < CONVERGED)
            if bool(done.all()):
                break
        shrinking = self._perspective(x, y)[0]
        rays = torch.nn.functional.normalize(torch.stack([x, y, torch.ones_like(x)], 1), dim=1)
        return rays, done & (shrinking > LEAST_SHRINKING)

    def _slopes(self, x: Tensor, y: Tensor, factor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the derivatives of a bent point: its x by x, its x by y, which is its y by x, and its y by y."""
        k1, k2, k3, k4, k5, k6 = self.radial
        p1, p2 = self.tangential
        r2 = x * x + y * y
        numerator, denominator = k1 + r2 * (2 * k2 + r2 * 3 * k3), k4 + r2 * (2 * k5 + r2 * 3 * k6)
        # Twice the derivative of the factor by r2.
        twice = 2 * (numerator - factor * denominator) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        mixed = twice * x * y + 2 * p1 * x + 2 * p2 * y
        return factor + twice * x * x + 2 * p1 * y + 6 * p2 * x, mixed, factor + twice * y * y + 6 * p1 * y + 2 * p2 * x

    def _of_angle(self, angles: Tensor) -> Tensor:
        """Return the distances from the axis on the plane of a fisheye lens."""
        k1, k2, k3, k4 = self.radial
        squares = angles * angles
        return angles * (1 + squares * (k1 + squares * (k2 + squares * (k3 + squares * k4))))

    def _fisheye_rays(self, plane: Tensor, furthest: float) -> tuple[Tensor, Tensor]:
        k1, k2, k3, k4 = self.radial
        distances = plane.norm(dim=1)
        angles, done = distances.clone(), torch.zeros(len(plane), dtype=torch.bool)
        for _ in range(FISHEYE_STEPS):
            squares = angles * angles
            slopes = 1 + squares * (3 * k1 + squares * (5 * k2 + squares * (7 * k3 + squares * 9 * k4)))
            steps = (self._of_angle(angles) - distances) / slopes
            angles = torch.where(done, angles, angles - steps)
            done |= steps.abs() < CONVERGED
            if bool(done.all()):
                break
        seen = done & (angles >= 0) & (angles < self._largest_angle(furthest))
        scaled = plane * (torch.sin(angles) / distances.clamp_min(CONVERGED))[:, None]
        return torch.cat([scaled, torch.cos(angles)[:, None]], 1), seen

    def _largest_angle(self, furthest: float) -> float:
        """Return the angle up to which a fisheye lens shows anything.

        That is where its polynomial turns back, at most `furthest`, and less than 90 degrees: gsplat renders what has a
        positive depth.
        """
        slope = [factor * k for factor, k in zip((9, 7, 5, 3), reversed(self.radial), strict=True)]
        roots = np.roots([*slope, 1.0])  # of squared angles
        turning = [math.sqrt(root.real) for root in roots if abs(root.imag) < 1e-9 and root.real > 0]
        return min([*turning, furthest, math.pi / 2])
