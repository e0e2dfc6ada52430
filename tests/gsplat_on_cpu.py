"""gsplat's CUDA kernels on the CPU: its own PyTorch code of them, or plain tiles and blending.

They take and return what those of gsplat 1.5.3 do, as far as rendering without gradients asks for it, and refuse what
those cannot bear. gsplat's functions are its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from gsplat.cuda import _torch_impl, _wrapper
from torch import Tensor

FAINTEST, OPAQUEST, LAST = 1 / 255, 0.999, 1e-4
"""Alpha that is blended at least and at most, and the transmittance that no pixel goes below."""


def _spherical_harmonics(degree: int, directions: Tensor, coefficients: Tensor, masks: None) -> Tensor:
    values: Tensor = _torch_impl._spherical_harmonics(degree, directions, coefficients)
    return values


def _project(
    means: Tensor, covariances: None, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, eps2d: float, near: float, far: float, clip: float, compensates: bool, camera_model: str,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    assert len(means) > 0, "the kernel's launch divides by it"
    assert camera_model == "CameraModelType.PINHOLE"
    covariances_3d, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, means2d, depths, conics, dimmed = _torch_impl._fully_fused_projection(
        means, covariances_3d, viewmats, Ks, width, height,
        eps2d=eps2d, near_plane=near, far_plane=far, calc_compensations=compensates,
    )  # fmt: skip
    faint = opacities * (1 if dimmed is None else dimmed[0]) < FAINTEST
    radii[0, faint] = 0
    culled = ~(radii > clip).all(-1)  # (1, n)
    for values in (means2d, depths, conics):
        values[culled] = torch.nan  # the kernel leaves memory as it was
    return radii, means2d, depths, conics, dimmed


def _intersect(
    means2d: Tensor, radii: Tensor, depths: Tensor, image_ids: Tensor, gaussian_ids: Tensor, images: int, tile: int,
    columns: int, rows: int, sort: bool, segmented: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Of a packed list: how many tiles each has; and sorted, which tile over all images it is, and which Gaussian."""
    assert means2d.ndim == 2
    assert sort
    assert len(means2d) == len(image_ids) == len(gaussian_ids)
    assert image_ids.dtype == gaussian_ids.dtype == torch.int64
    most = torch.tensor([columns, rows])
    first = ((means2d - radii) / tile).floor().clamp_min(0).minimum(most).nan_to_num().int().tolist()
    past = ((means2d + radii) / tile).ceil().clamp_min(0).minimum(most).nan_to_num().int().tolist()
    found, counts = [], [0] * len(depths)
    for i in (radii > 0).all(-1).nonzero()[:, 0].tolist():
        assert image_ids[i] < images
        for y in range(first[i][1], past[i][1]):
            for x in range(first[i][0], past[i][0]):
                found.append(((int(image_ids[i]) * rows + y) * columns + x, float(depths[i]), i))
                counts[i] += 1
    found.sort()
    keys, _, order = zip(*found, strict=True) if found else ((), (), ())
    return torch.tensor(counts), torch.tensor(keys, dtype=torch.int64), torch.tensor(order, dtype=torch.int32)


def _offsets(keys: Tensor, images: int, columns: int, rows: int) -> Tensor:
    return torch.searchsorted(keys, torch.arange(images * rows * columns)).view(images, rows, columns)


def _blend(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: None, masks: None,
    width: int, height: int, tile_size: int, offsets: Tensor, order: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    assert len(means2d) == len(conics) == len(colors) == len(opacities)
    assert backgrounds is None
    assert masks is None
    count, rows, columns = offsets.shape
    images = torch.zeros(count, rows * tile_size, columns * tile_size, 4)  # with opacities
    ends = [*offsets.flatten().tolist(), len(order)]
    within = torch.arange(tile_size) + 0.5
    for tile in range(count * rows * columns):
        ids = order[ends[tile] : ends[tile + 1]]  # (m,)
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
    images = images[:, :height, :width]
    return images[..., :3].contiguous(), images[..., 3:].contiguous(), torch.empty(0)


KERNELS: dict[str, Callable[..., Any]] = {
    "spherical_harmonics_fwd": _spherical_harmonics,
    "projection_ewa_3dgs_fused_fwd": _project,
    "intersect_tile": _intersect,
    "intersect_offset": _offsets,
    "rasterize_to_pixels_3dgs_fwd": _blend,
}


def _checked(name: str) -> Callable[..., Any]:
    def kernel(*args: Any) -> Any:
        assert all(value.is_contiguous() for value in args if isinstance(value, Tensor)), name
        return KERNELS[name](*args)

    return kernel


@contextmanager
def gsplat_on_cpu() -> Iterator[None]:
    """Let gsplat find these kernels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_wrapper, "_make_lazy_cuda_func", _checked)
        patch.setattr(_wrapper, "_make_lazy_cuda_obj", lambda name: name)
        yield
