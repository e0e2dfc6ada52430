"""Run gsplat's PyTorch rasterizer on a CPU, for comparison in `lapgs bench raster`.

gsplat has its rasterizer twice: as CUDA kernels, and as the PyTorch code that its tests compare them with. The PyTorch
code still calls CUDA in two places: a kernel that lists which Gaussian meets which pixel, and the scans of the package
nerfacc. During a call both are replaced by PyTorch code that does the same on a CPU. Everything else, with its Python
loop over the tiles of each Gaussian, is gsplat's own.

Its images differ a little from ours: it caps alpha at 0.999 instead of 0.99, cuts a footprint at 3.33 sigma along each
image axis instead of 3 sigma of the longest, and measures the limit of the Jacobian from the principal point instead of
the image centre. Elsewhere the two agree to rounding.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from types import ModuleType

import torch
from gsplat.cuda import _torch_impl, _wrapper
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult
from lapgs_plugin.reference_raster.layout import MIN_ALPHA, MIN_TRANSMITTANCE, NEAR_DEPTH, TILE

MAX_ALPHA = 0.999


class GsplatTorchRasterizer(Rasterizer):
    """Render unsigned float32 fields on the CPU with gsplat's `_torch_impl`.

    Attributes:
        tile_loop_seconds: seconds that the last call spent in gsplat's Python loop over Gaussians and tiles.
    """

    name = "gsplat, PyTorch"

    def __init__(self) -> None:
        self.tile_loop_seconds = 0.0

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        """Render `field`; see `fields.rasterizer.Rasterizer`."""
        assert not field.signed
        degree = field.sh_degree if sh_degree is None else sh_degree
        size = camera.width, camera.height
        directions = field.means - camera.position  # (n, 3)
        colors = _torch_impl._spherical_harmonics(degree, directions, field.sh)  # (n, 3)
        covariances, _ = _torch_impl._quat_scale_to_covar_preci(
            field.quaternions, field.log_scales.exp(), compute_preci=False
        )  # (n, 3, 3)
        radii, means2d, depths, conics, _ = _torch_impl._fully_fused_projection(
            field.means,
            covariances,
            camera.world_to_camera[None],
            camera.intrinsics[None],
            *size,
            near_plane=NEAR_DEPTH,
        )  # (1, n, 2), (1, n, 2), (1, n), (1, n, 3)
        screen = means2d[0]  # (n, 2)
        if screen.requires_grad:
            screen.retain_grad()
        columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
        start = time.perf_counter()
        _, tile_ids, gaussian_ids = _torch_impl._isect_tiles(means2d, radii, depths, TILE, columns, rows)
        self.tile_loop_seconds = time.perf_counter() - start
        offsets = _torch_impl._isect_offset_encode(tile_ids, 1, columns, rows)  # (1, rows, columns)
        with _cuda_parts_replaced():
            image, alpha = _torch_impl._rasterize_to_pixels(
                screen[None],
                conics,
                torch.clamp(colors + 0.5, min=0)[None],
                torch.sigmoid(field.opacity_logits)[None],
                *size,
                TILE,
                offsets,
                gaussian_ids,
                backgrounds=background[None],
            )  # (1, h, w, 3), (1, h, w, 1)
        return RenderResult(
            image[0].permute(2, 0, 1), 1 - alpha[0, ..., 0], radii[0].amax(dim=1).to(torch.int32), screen
        )


@contextmanager
def _cuda_parts_replaced() -> Iterator[None]:
    """Replace gsplat's index kernel and nerfacc by ours, and restore them afterwards."""
    nerfacc = ModuleType("nerfacc")
    vars(nerfacc).update(render_weight_from_alpha=_weights_from_alphas, accumulate_along_rays=_sums_along_rays)
    kernel, module = _wrapper.rasterize_to_indices_in_range, sys.modules.get("nerfacc")
    _wrapper.rasterize_to_indices_in_range, sys.modules["nerfacc"] = _indices_in_range, nerfacc
    try:
        yield
    finally:
        _wrapper.rasterize_to_indices_in_range = kernel
        del sys.modules["nerfacc"]
        if module is not None:
            sys.modules["nerfacc"] = module


@torch.no_grad()
def _indices_in_range(
    first_batch: int,
    last_batch: int,
    transmittances: Tensor,  # (1, h, w)
    means2d: Tensor,  # (1, n, 2)
    conics: Tensor,  # (1, n, 3)
    opacities: Tensor,  # (1, n)
    width: int,
    height: int,
    tile_size: int,
    offsets: Tensor,  # (1, rows, columns)
    gaussian_ids: Tensor,  # (i,)
) -> tuple[Tensor, Tensor, Tensor]:
    """List every pair of a Gaussian and a pixel that blends it: Gaussian, pixel and image (always 0), (m,) each.

    A pixel's pairs are contiguous and front to back. Names and order of the arguments are those of gsplat's kernel.
    """
    bounds = [*offsets.flatten().tolist(), len(gaussian_ids)]
    columns, batch = offsets.shape[2], tile_size * tile_size
    steps = torch.arange(tile_size)
    gaussians, pixels = [], []
    for tile, (start, stop) in enumerate(pairwise(bounds)):
        ids = gaussian_ids[start:stop][first_batch * batch : last_batch * batch]  # (k,)
        if len(ids) == 0:
            continue
        row, column = divmod(tile, columns)
        y, x = row * tile_size + steps, column * tile_size + steps
        y, x = y[y < height], x[x < width]
        pixel_ids = (y[:, None] * width + x).flatten()  # (p,)
        dx = means2d[0, ids, 0] - (x.repeat(len(y))[:, None] + 0.5)  # (p, k)
        dy = means2d[0, ids, 1] - (y.repeat_interleave(len(x))[:, None] + 0.5)  # (p, k)
        xx, xy, yy = conics[0, ids].unbind(-1)  # (k,) each
        sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy  # (p, k)
        alphas = (opacities[0, ids] * torch.exp(-sigma)).clamp(max=MAX_ALPHA)  # (p, k)
        visible = (sigma >= 0) & (alphas >= MIN_ALPHA)  # (p, k)
        behind = torch.cumprod(1 - alphas * visible, dim=1) * transmittances.view(-1)[pixel_ids, None]  # (p, k)
        which_pixel, which_gaussian = torch.nonzero(visible & (behind > MIN_TRANSMITTANCE), as_tuple=True)
        gaussians.append(ids[which_gaussian])
        pixels.append(pixel_ids[which_pixel])
    if not pixels:
        nothing = torch.zeros(0, dtype=torch.int64)
        return nothing, nothing, nothing
    all_pixels = torch.cat(pixels)
    return torch.cat(gaussians), all_pixels, torch.zeros_like(all_pixels)


def _weights_from_alphas(alphas: Tensor, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """Return alpha_i T_i and T_i, (m,) each, for samples sorted by ray, as `nerfacc.render_weight_from_alpha`."""
    first = torch.cat([ray_indices.new_ones(1, dtype=torch.bool), ray_indices[1:] != ray_indices[:-1]])  # (m,)
    starts = torch.nonzero(first)[:, 0]  # (r,)
    lengths = torch.diff(starts, append=starts.new_tensor([len(alphas)]))  # (r,)
    # One running sum over all rays; float64, because it becomes large.
    logs = torch.log1p(-alphas).double()  # (m,)
    before = torch.cumsum(logs, dim=0) - logs  # (m,)
    transmittances = torch.exp(before - before[starts].repeat_interleave(lengths)).to(alphas.dtype)  # (m,)
    return alphas * transmittances, transmittances


def _sums_along_rays(weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Return the weighted sum of each ray's values, (n_rays, c), as `nerfacc.accumulate_along_rays`."""
    weighted = weights[:, None] if values is None else weights[:, None] * values  # (m, c)
    return weighted.new_zeros(n_rays, weighted.shape[1]).index_add(0, ray_indices, weighted)
