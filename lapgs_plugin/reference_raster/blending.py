"""Compute the sums per Gaussian of forks' CUDA rasterizers, tile by tile in NumPy.

Slower than the Numba kernels, and only done where a fork's module returns such sums.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.reference_raster.layout import (
    BLOCK,
    BLOCKS,
    CENTRE_X,
    FACTOR_XX,
    LOG2_MIN_ALPHA,
    LOG2_OPACITY,
    MAX_ALPHA,
    RED,
    SPLAT,
    TILE,
)
from lapgs_plugin.reference_raster.pipeline import Kept, Rendering, View

_LANES = BLOCK * BLOCK


@dataclass(frozen=True)
class Tile:
    """Hold how k Gaussians, front to back, are blended in the p pixels of a tile that are in the image.

    Attributes:
        members: (k,) their indices.
        pixels: (p,) indices of the pixels in the flat image.
        alpha: (k, p) 0 where a Gaussian is not blended.
        transmittance: (k, p) in front of each Gaussian.
        colors: (k, 3).
        opacities: (k,).
    """

    members: NDArray[np.int32]
    pixels: NDArray[np.int64]
    alpha: NDArray[np.float64]
    transmittance: NDArray[np.float64]
    colors: NDArray[np.float64]
    opacities: NDArray[np.float64]

    @property
    def weights(self) -> NDArray[np.float64]:
        """Return the Gaussians' shares in the pixels, (k, p)."""
        return self.alpha * self.transmittance


@dataclass(frozen=True)
class TiledBlending:
    """Hold a rendering of n Gaussians that was made with `keep`, and its tiles."""

    view: View
    rendering: Rendering

    @property
    def n(self) -> int:
        return len(self.rendering.radii)

    @property
    def kept(self) -> Kept:
        """What the rendering kept."""
        assert self.rendering.kept is not None, "rendered without keep=True"
        return self.rendering.kept

    @cached_property
    def tiles(self) -> tuple[Tile, ...]:
        """Return the tiles in which something is blended."""
        return tuple(self._tiles())

    def _tiles(self) -> Iterator[Tile]:
        splats = self.kept.splats.reshape(-1, SPLAT).astype(np.float64)
        final = self.kept.final.reshape(-1, BLOCKS, 2, _LANES)
        lane, block = np.arange(_LANES), np.arange(BLOCKS)[:, None]
        x = (block % (TILE // BLOCK) * BLOCK + lane % BLOCK).ravel()
        y = (block // (TILE // BLOCK) * BLOCK + lane // BLOCK).ravel()
        across = self.view.tiles[0]
        for tile, reached in enumerate(self.kept.reached):
            start = self.kept.tile_start[tile]
            members = self.kept.members[start : start + reached]
            here_x, here_y = x + tile % across * TILE, y + tile // across * TILE
            inside = (here_x < self.view.width) & (here_y < self.view.height)
            if not len(members):
                continue
            records = splats[members]
            dx, dy = here_x[inside] - records[:, CENTRE_X, None], here_y[inside] - records[:, CENTRE_X + 1, None]
            xx, xy, yy = (records[:, FACTOR_XX + i, None] for i in range(3))
            exponent = records[:, LOG2_OPACITY, None] - (xx * dx + xy * dy) ** 2 - (yy * dy) ** 2
            last = final[tile, :, 1].ravel()[inside]  # position of the last Gaussian that is blended
            blended = (exponent >= LOG2_MIN_ALPHA) & (np.arange(1, len(members) + 1)[:, None] <= last)
            alpha = np.where(blended, np.minimum(np.exp2(exponent), MAX_ALPHA), 0.0)
            behind = np.cumprod(1 - alpha, 0)
            yield Tile(
                members,
                here_y[inside].astype(np.int64) * self.view.width + here_x[inside],
                alpha,
                np.concatenate([np.ones_like(behind[:1]), behind[:-1]]),
                records[:, RED : RED + 3],
                np.exp2(records[:, LOG2_OPACITY]),
            )

    def leaders(self, ranks: int = 1) -> NDArray[np.int64]:
        """Return the Gaussians with the largest shares of each pixel, (ranks, height * width); -1 where are fewer."""
        leaders = np.full((ranks, self.view.width * self.view.height), -1, np.int64)
        for tile in self.tiles:
            order = np.argsort(-tile.weights, axis=0, kind="stable")[:ranks]  # (ranks, p)
            any_share = np.take_along_axis(tile.weights, order, 0) > 0
            leaders[: len(order), tile.pixels] = np.where(any_share, tile.members[order], -1)
        return leaders

    def weighted_shares(self, weights: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the sum over pixels of weight times alpha times the transmittance behind the Gaussian, (n,).

        Args:
            weights: (height * width,).
        """
        total = np.zeros(self.n)
        for tile in self.tiles:
            np.add.at(total, tile.members, (tile.weights * (1 - tile.alpha) * weights[tile.pixels]).sum(1))
        return total

    def squared_gradients(self, grad_image: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the sum over pixels of the squared derivative of the loss by each Gaussian's value there, (n,).

        The value is alpha over opacity; as in the CUDA code, the cap on alpha does not stop the derivative.

        Args:
            grad_image: (3, height * width) derivative of the loss by the image.
        """
        total, background = np.zeros(self.n), self.kept.background.astype(np.float64)
        transmittance = self.rendering.transmittance.ravel()
        for tile in self.tiles:
            above = grad_image[:, tile.pixels].astype(np.float64)  # (3, p)
            color = tile.colors @ above  # (k, p) derivative of the loss by a share
            parts = tile.weights * color
            last = transmittance[tile.pixels] * (background @ above)
            behind = np.cumsum(parts[::-1], 0)[::-1] - parts + last
            by_alpha = np.where(tile.alpha > 0, tile.transmittance * color - behind / (1 - tile.alpha), 0.0)
            np.add.at(total, tile.members, ((tile.opacities[:, None] * by_alpha) ** 2).sum(1))
        return total
