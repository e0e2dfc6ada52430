"""Filter Gaussians in PyTorch's operations."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

NEAREST = 0.2
"""Depth that a camera sees at least."""
MARGIN = 0.15
"""Part of an image's size by which a centre may be beyond its border."""
FARTHEST = 100_000.0
"""Largest depth."""


class CameraRow(NamedTuple):
    """Hold a camera's numbers as `nearest_depths` reads them.

    Attributes:
        rotation: nine, by rows; a position as a row, times this, plus the translation, is in the camera.
        translation: three.
        focal: two, in pixels.
        size: (width, height).
    """

    rotation: tuple[float, ...]
    translation: tuple[float, ...]
    focal: tuple[float, float]
    size: tuple[float, float]

    @property
    def numbers(self) -> list[float]:
        """All 16 in order."""
        return [*self.rotation, *self.translation, *self.focal, *self.size]


def filtered_scales_torch(log_scales: Tensor, filters: Tensor) -> Tensor:
    """Do `filtered_scales` on any device."""
    return torch.sqrt(torch.exp(log_scales).square() + filters.square())


def filtered_opacities_torch(logits: Tensor, log_scales: Tensor, filters: Tensor) -> Tensor:
    """Do `filtered_opacities` on any device."""
    squares = torch.exp(log_scales).square()
    shrunk = squares.prod(dim=1, keepdim=True) / (squares + filters.square()).prod(dim=1, keepdim=True)
    return torch.sigmoid(logits) * torch.sqrt(shrunk)


def nearest_depths_torch(means: Tensor, cameras: Tensor) -> Tensor:
    """Do `nearest_depths` on any device."""
    nearest = means.new_full((len(means),), torch.inf)
    for row in cameras:
        x, y, depth = (means @ row[:9].view(3, 3) + row[9:12]).unbind(1)
        across, down = (
            at / depth.clamp_min(1e-3) * focal / size + 0.5
            for at, focal, size in zip((x, y), row[12:14], row[14:16], strict=True)
        )
        inside = [(share >= -MARGIN) & (share <= 1 + MARGIN) for share in (across, down)]
        seen = (depth > NEAREST) & inside[0] & inside[1]
        nearest = torch.where(seen, torch.minimum(nearest, depth.clamp_max(FARTHEST)), nearest)
    return nearest


def gaussians(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return logits (n, 1), log scales (n, 3) and filters (n, 1), to compare functions by."""
    generator = torch.Generator().manual_seed(0)
    logits, log_scales = 2 * torch.randn(300, 1, generator=generator), torch.randn(300, 3, generator=generator)
    return logits.to(device), log_scales.to(device), torch.rand(300, 1, generator=generator).to(device)


def seen_from(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return means (n, 3) around cameras (c, 16) that look in different directions, to compare functions by.

    Some are behind all cameras, some nearer than cameras see, some just beyond a border.
    """
    generator = torch.Generator().manual_seed(0)
    means = 2 * torch.randn(600, 3, generator=generator) * torch.rand(600, 1, generator=generator)
    rows = []
    for index in range(5):
        rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
        size = (60.0 + 7 * index, 40.0 + 3 * index)
        row = CameraRow(
            tuple(rotation.flatten().tolist()),
            tuple((0.3 * torch.randn(3, generator=generator)).tolist()),
            (30.0 + 5 * index, 25.0 + 4 * index),
            size,
        )
        rows.append(row.numbers)
    return means.to(device), torch.tensor(rows).to(device)
