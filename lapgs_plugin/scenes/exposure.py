"""Measure from the photos of a scene whether exposure and white balance change between them.

Each sparse point is looked up in all photos that see it. A photo's gain is the factor by which its points are brighter
than the same points in the other photos. Points behind nearer points are left out. Other hidden points disagree widely
between photos and get small weights. Gains are measured for the left and the right half of each photo separately: a
change of exposure changes both halves alike, reflections and shadows do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes.scene import Scene, View

POINTS = 4_000
"""Most sparse points that are looked up."""
SIDE = 250
"""Longer side in pixels of the photos that are looked up, so small that blur and pose errors are within a pixel."""
CELLS = 30
"""Cells along each side of a photo in which points hide each other."""
DEPTH_MARGIN = 1.05
"""Depth of a hidden point in multiples of its cell's least depth."""
DARKEST = 0.04
"""Least usable value; lower ones are noise."""
BRIGHTEST = 0.96
"""Greatest usable value; higher ones are clipped."""
LEAST_POINTS = 40
"""Fewest visible points of half a photo whose gain is measured."""
LEAST_VIEWS = 4
"""Fewest photos of a point that is used, and fewest photos with a gain."""
BANDWIDTHS = (0.8, 0.8, 0.4, 0.4, 0.2, 0.2, 0.15, 0.15)
"""Widths in stops of the weights of differences, one for each step of an estimate."""


@dataclass(frozen=True)
class MeasuredExposure:
    """Hold how the exposure of a scene's training photos differs.

    Attributes:
        gains: (v, 3) base-2 logarithm of the gain of each photo and channel, with median 0 over photos; 0 where a photo
            shows too few points.
        spread: robust standard deviation of the photos' gains in stops, corrected for the disagreement of their halves.
    """

    gains: Tensor  # (v, 3)
    spread: float


class SparseColors(NamedTuple):
    """Hold the colours of sparse points in the training photos.

    Attributes:
        points: (n, 3) in the world.
        colors: (v, n, 3) in each photo, 0 where a point is not seen.
        right: (v, n) bool, which points are in a photo's right half.
    """

    points: Tensor  # (n, 3)
    colors: Tensor  # (v, n, 3)
    right: Tensor  # (v, n)


LookUp = Callable[[Tensor], Sequence[tuple[Tensor, Tensor]]]
"""Returns `colors_at` of all training photos at sparse points (n, 3)."""


def sparse_colors(scene: Scene, look_up: LookUp | None = None) -> SparseColors | None:
    """Look up sparse points in all training photos; None if all have one colour, as random points do.

    Args:
        scene: with its photos.
        look_up: reads the photos in another way than one after the other.
    """
    if len(scene.points) and bool((scene.colors == scene.colors[0]).all()):
        return None
    chosen = torch.randperm(len(scene.points), generator=torch.Generator().manual_seed(0))[:POINTS]
    points = scene.points[chosen]
    looked_up = [colors_at(view, points) for view in scene.train] if look_up is None else look_up(points)
    colors, right = (torch.stack(views) for views in zip(*looked_up, strict=True))
    return SparseColors(points, colors, right)


def measure_exposure(scene: Scene, seen: SparseColors | None) -> MeasuredExposure:
    """Measure how the exposure of a scene's training photos differs.

    The spread is 0 if too few points are visible.

    Args:
        scene: whose photos they are.
        seen: of its training photos; None if they cannot be compared.
    """
    if seen is None:
        return MeasuredExposure(torch.zeros(len(scene.train), 3), 0.0)
    _, colors, right = seen
    usable = ((colors > DARKEST) & (colors < BRIGHTEST)).all(-1)  # (v, n)
    often = usable.sum(0) >= LEAST_VIEWS
    usable, right = usable[:, often], right[:, often]
    colors = colors[:, often].clamp(DARKEST, BRIGHTEST)
    brightness = colors.mean(-1).log2()  # (v, n)
    halves = [usable & side for side in (~right, right)]
    known = torch.stack([half.sum(1) >= LEAST_POINTS for half in halves]).all(0)  # (v,)
    gains = torch.zeros(len(scene.train), 3)
    if int(known.sum()) < LEAST_VIEWS:
        return MeasuredExposure(gains, 0.0)
    weights = agreement(brightness, usable)
    _, points = solve_gains(brightness, weights)
    left, other = (_modes(brightness - points, half)[known] for half in halves)
    left, other = left - left.median(), other - other.median()
    for channel in range(3):
        logarithms, _ = solve_gains(colors[..., channel].log2(), weights)
        gains[known, channel] = (logarithms - logarithms[known].median())[known]
    agreed, disagreed = (_robust_deviation((left + sign * other) / 2) for sign in (1, -1))
    return MeasuredExposure(gains, math.sqrt(max(0.0, agreed**2 - disagreed**2)))


def colors_at(view: View, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return a photo's colours (n, 3) at sparse points, 0 at unseen ones, and which are in its right half, (n,)."""
    step = max(1, round(max(view.camera.size) / SIDE))
    image, mask = view.image[None], view.mask
    small = torch.nn.functional.avg_pool2d(image, step) if step > 1 else image
    x, y, seen = _visible(view.camera, points)
    if mask is not None:
        row, column = (y * view.camera.height).long(), (x * view.camera.width).long()
        inside = mask[0, row.clamp(0, view.camera.height - 1), column.clamp(0, view.camera.width - 1)]
        seen = seen & inside
    grid = torch.stack([2 * x - 1, 2 * y - 1], -1).nan_to_num()
    colors = torch.nn.functional.grid_sample(small, grid[None, None], padding_mode="border", align_corners=False)
    middle = x[seen].median() if bool(seen.any()) else x.new_zeros(())
    return colors[0, :, 0].T * seen[:, None], x >= middle


def _visible(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Project points: x and y (n,) in image widths and heights, and which are visible (n,)."""
    x, y, depth = place_in_image(camera, points)
    inside = camera.shown(camera.local(points))[1]
    cell = torch.where(inside, (CELLS * y).floor() * CELLS + (CELLS * x).floor(), 0.0).long()
    nearest = torch.full((CELLS * CELLS,), math.inf).scatter_reduce(0, cell[inside], depth[inside], "amin")
    return x, y, inside & (depth <= nearest[cell] * DEPTH_MARGIN)


def place_in_image(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Project points: x and y (n,) in image widths and heights, and their depths (n,)."""
    local = camera.local(points)
    pixels, _ = camera.projected(local)
    return pixels[:, 0] / camera.width, pixels[:, 1] / camera.height, local[:, 2]


def agreement(values: Tensor, usable: Tensor) -> Tensor:
    """Return weights (v, n) of the usable values of photos and points: near 0 where a photo sees something else."""
    gains = values.new_zeros(len(values))
    points = torch.where(usable, values, math.nan).nanmedian(dim=0).values.nan_to_num()
    weights = usable.float()
    for bandwidth in BANDWIDTHS:
        weights = torch.exp(-(((values - gains[:, None] - points) / bandwidth) ** 2)) * usable
        gains, points = solve_gains(values, weights)
    return weights


def solve_gains(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return gains (v,) of photos and values (n,) of points whose sums are closest to values (v, n), in least squares.

    Solved for all photos at once, because gains are related only between photos that see the same points.
    """
    by_point = weights.sum(0).clamp_min(1e-6)
    means = (weights * values).sum(0) / by_point
    system = torch.diag(weights.sum(1) + 1e-3) - (weights / by_point) @ weights.T  # a sum of all gains would be free
    gains = torch.linalg.solve(system.double(), (weights * (values - means)).sum(1).double()).float()
    return gains, (weights * (values - gains[:, None])).sum(0) / by_point


def _modes(values: Tensor, usable: Tensor) -> Tensor:
    """Return the mode of the usable values of each row by mean shift from the median; 0 for a row without any."""
    mode = torch.where(usable, values, math.nan).nanmedian(dim=1).values.nan_to_num()
    for bandwidth in BANDWIDTHS:
        weights = torch.exp(-(((values - mode[:, None]) / bandwidth) ** 2)) * usable
        mode = (weights * values).sum(1) / weights.sum(1).clamp_min(1e-6)
    return mode


def _robust_deviation(values: Tensor) -> float:
    """Return the standard deviation that a normal distribution of the same median absolute deviation has."""
    return 1.4826 * float((values - values.median()).abs().median())
