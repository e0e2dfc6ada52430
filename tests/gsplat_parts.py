"""The functions that `gsplat.rasterization` is made of, on the CPU: its own projection, plain tiles and blending.

They take and return what gsplat 1.5.3's do, as far as `GsplatStack` asks for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gsplat
import pytest
import torch
from gsplat.cuda import _torch_impl
from torch import Tensor

FAINTEST, OPAQUEST, LAST = 1 / 255, 0.999, 1e-4
"""Alpha that is blended at least and at most, and the transmittance that no pixel goes below."""


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor) -> Tensor:
    values: Tensor = _torch_impl._spherical_harmonics(degrees_to_use, dirs, coeffs)
    return values


def fully_fused_projection(
    means: Tensor, covars: None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int,
    *, eps2d: float, near_plane: float, calc_compensations: bool, opacities: Tensor,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    assert len(means) > 0, "gsplat divides by it"
    assert all(value.is_contiguous() for value in (means, quats, scales, opacities)), "a copy of it would be made"
    covariances, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, means2d, depths, conics, dimmed = _torch_impl._fully_fused_projection(
        means, covariances, viewmats, Ks, width, height,
        eps2d=eps2d, near_plane=near_plane, calc_compensations=calc_compensations,
    )  # fmt: skip
    faint = opacities * (1 if dimmed is None else dimmed[0]) < FAINTEST
    radii[0, faint] = 0
    culled = ~(radii > 0).all(-1)  # (1, n)
    for values in (means2d, depths, conics):
        values[culled] = torch.nan  # gsplat leaves memory as it was
    return radii, means2d, depths, conics, dimmed


def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int,
    *, packed: bool, n_images: int, image_ids: Tensor, gaussian_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """How many tiles each has, and by tile, nearest first, numbers of tiles over all images and of Gaussians."""
    assert packed
    assert len(means2d) == len(image_ids) == len(gaussian_ids)
    most = torch.tensor([tile_width, tile_height])
    first = ((means2d - radii) / tile_size).floor().clamp_min(0).minimum(most).nan_to_num().int().tolist()
    past = ((means2d + radii) / tile_size).ceil().clamp_min(0).minimum(most).nan_to_num().int().tolist()
    found, counts = [], [0] * len(depths)
    for i in (radii > 0).all(-1).nonzero()[:, 0].tolist():
        assert image_ids[i] < n_images
        for y in range(first[i][1], past[i][1]):
            for x in range(first[i][0], past[i][0]):
                tile = (int(image_ids[i]) * tile_height + y) * tile_width + x
                found.append((tile, float(depths[i]), i))
                counts[i] += 1
    found.sort()
    tiles, _, order = zip(*found, strict=True) if found else ((), (), ())
    return torch.tensor(counts), torch.tensor(tiles, dtype=torch.int64), torch.tensor(order, dtype=torch.int64)


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    tiles = torch.arange(n_images * tile_height * tile_width)
    return torch.searchsorted(isect_ids, tiles).view(n_images, tile_height, tile_width)


def rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, image_width: int, image_height: int,
    tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor, *, packed: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    assert packed
    assert len(means2d) == len(conics) == len(colors) == len(opacities)
    count, rows, columns = isect_offsets.shape
    images = torch.zeros(count, rows * tile_size, columns * tile_size, 4)  # with opacities
    ends = [*isect_offsets.flatten().tolist(), len(flatten_ids)]
    within = torch.arange(tile_size) + 0.5
    for tile in range(count * rows * columns):
        ids = flatten_ids[ends[tile] : ends[tile + 1]]  # (m,)
        image, row, column = tile // (rows * columns), tile // columns % rows * tile_size, tile % columns * tile_size
        down, across = torch.meshgrid(row + within, column + within, indexing="ij")
        pixels = torch.stack([across, down], -1)  # (t, t, 2)
        dx, dy = (means2d[ids][:, None, None] - pixels).unbind(-1)  # (m, t, t)
        xx, xy, yy = conics[ids][:, :, None, None].unbind(1)
        powers = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy
        alphas = (opacities[ids][:, None, None] * torch.exp(-powers)).clamp_max(OPAQUEST)
        alphas = torch.where((alphas < FAINTEST) | (powers < 0), 0.0, alphas)
        after = torch.cumprod(1 - alphas, 0)
        alphas = torch.where(after > LAST, alphas, 0.0)
        after = torch.cumprod(1 - alphas, 0)
        before = torch.cat([torch.ones_like(after[:1]), after])[: len(ids)]
        there = images[image, row : row + tile_size, column : column + tile_size]
        there[..., :3] = torch.einsum("mij,mc->ijc", alphas * before, colors[ids])
        there[..., 3] = 1 - torch.prod(1 - alphas, 0)
    images = images[:, :image_height, :image_width]
    return images[..., :3].contiguous(), images[..., 3:].contiguous()


PARTS: tuple[Any, ...] = (
    spherical_harmonics, fully_fused_projection, isect_tiles, isect_offset_encode, rasterize_to_pixels,
)  # fmt: skip


@contextmanager
def on_cpu() -> Iterator[None]:
    """Let gsplat's functions be these."""
    with pytest.MonkeyPatch.context() as patch:
        for part in PARTS:
            patch.setattr(gsplat, part.__name__, part)
        yield
