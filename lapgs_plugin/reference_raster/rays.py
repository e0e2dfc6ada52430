"""Render Gaussians along the rays of a camera whose lens may bend them: 3DGUT as gsplat has it, on a CPU.

An unscented transform (Wu et al. 2025, "3DGUT") says which tiles a Gaussian may be visible in: seven points of it are
projected through the lens, and their mean and covariance give the ellipse outside of which its alpha is below 1/255.
In these tiles its alpha at a pixel is o exp(-d^2 / 2) with d the least distance of the pixel's ray from its centre, in
standard deviations. So nothing is linearised, and Gaussians that are smaller than a pixel are not blurred.

Of gradients by centres on the image there is the length alone, see `watched`. All others are those of autograd.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.jit.threads import parallel
from lapgs_plugin.reference_raster.layout import MIN_ALPHA, NEAR_DEPTH, PIXEL_VARIANCE, TILE, TILE_PIXELS
from lapgs_plugin.reference_raster.oracle import TileLists, rotation_matrices, tile_lists

SPREAD = 0.1
"""Distance of the projected points from the centre, over the root of 3 standard deviations."""
CENTRE_WEIGHT = 2.0
"""What the centre's weight in the covariance has more than in the mean, besides 1 - SPREAD^2; 2 for Gaussians."""
MARGIN = 0.1
"""Share of the image's size around it in which a projected point still counts as seen."""
MOST_SIGMAS = 3.33
"""Distance in standard deviations at which an opaque Gaussian has an alpha of 1/255."""
LEAST_ROOT = 0.01
"""Lower bound of the squared half difference of the 2D covariance's eigenvalues, in px^4."""


@dataclass(frozen=True)
class _Seen:
    """Hold the v Gaussians that reach the image.

    Attributes:
        ids: (v,) their index in the field.
        depths: (v,) along the axis.
        centres: (v, 2) on the image, where pixels have theirs at 0.5.
        radii: (v, 2) half the sides of the rectangle around them, in whole pixels.
    """

    ids: Tensor
    depths: Tensor
    centres: Tensor
    radii: Tensor


@dataclass(frozen=True)
class _Tiles:
    """Hold what the kernels read of a view's tiles besides splats; see `ray_kernels.blend_rays`."""

    starts: NDArray[np.int64]
    members: NDArray[np.int64]
    rays: NDArray[Any]
    seen: NDArray[np.bool_]


def render_along_rays(field: GaussianField, camera: Camera, background: Tensor, degree: int) -> RenderResult:
    """Render a field; arguments as a rasterizer takes them, but the SH degree to evaluate is known.

    `RenderResult.means2d.grad` has lengths alone, and there are no absolute gradients.
    """
    camera = camera.to(field.means.device, field.means.dtype)
    seen = _project(field, camera)
    n, ids = len(field), seen.ids
    means2d = field.means.new_zeros(n, 2)
    means2d[ids] = seen.centres - 0.5
    radii = torch.zeros(n, dtype=torch.int32, device=means2d.device)
    radii[ids] = seen.radii.amax(1).to(torch.int32)
    directions = torch.nn.functional.normalize(field.means[ids] - camera.position, dim=-1)  # (v, 3)
    means = watched(field.means, camera, means2d)
    splats = torch.cat(
        [
            _ray_forms(field.with_parameters({"means": means}), camera, ids),  # (v, 18)
            torch.sigmoid(field.opacity_logits[ids])[:, None],  # (v, 1)
            sh_to_color(field.sh[ids], directions, degree, signed=field.signed),  # (v, 3)
        ],
        dim=1,
    )  # (v, 22)
    lists = tile_lists(seen.depths, _rectangles(seen, camera), camera)
    blended: Tensor = _Blend.apply(_tiles_of(camera, lists, splats), splats)  # type: ignore[no-untyped-call]
    values = _as_image(blended, lists, camera)
    color, transmittance = values[:3], values[3]
    image = color + transmittance * background.to(color)[:, None, None]
    return RenderResult(image, transmittance, radii, means2d)


def watched(means: Tensor, camera: Camera, means2d: Tensor) -> Tensor:
    """Return centres (n, 3) whose gradient gives `means2d` one: its length, in loss per pixel, and 0.

    A pixel is a shift across the ray by the distance over the focal length, about. Along it there is no gradient.

    Args:
        means: those that Gaussians along rays depend on, and colours do not.
        camera: beside them.
        means2d: (n, 2) as `RenderResult` has it, without a gradient so far.
    """
    if not (torch.is_grad_enabled() and means.requires_grad):
        return means
    reference = weakref.ref(means2d.requires_grad_())
    seen = means.view_as(means)
    a_pixel = (means.detach() - camera.position.to(means)).norm(dim=1) / min(camera.fx, camera.fy)  # (n,)

    def hand_over(gradient: Tensor) -> None:
        if (held := reference()) is not None:
            lengths = gradient.norm(dim=1) * a_pixel
            held.grad = torch.stack([lengths, torch.zeros_like(lengths)], 1)

    seen.register_hook(hand_over)  # type: ignore[no-untyped-call]  # torch leaves this method without types
    return seen


@torch.no_grad()
def _project(field: GaussianField, camera: Camera) -> _Seen:
    """Project Gaussians by the unscented transform."""
    rotations = rotation_matrices(torch.nn.functional.normalize(field.quaternions, dim=-1))  # (n, 3, 3)
    reach = SPREAD * 3.0**0.5
    offsets = reach * (rotations * torch.exp(field.log_scales)[:, None, :]).mT  # (n, 3, 3) one in a row
    points = torch.cat([torch.zeros_like(offsets[:, :1]), offsets, -offsets], 1) + field.means[:, None]  # (n, 7, 3)
    local = camera.local(points.view(-1, 3)).view(points.shape)
    pixels, valid = _shown_nearby(camera, local)  # (n, 7, 2), (n, 7)
    others, middle = 1 / (2 * reach**2), 1 - 3 / reach**2
    weights = pixels.new_tensor([middle, *[others] * 6])  # (7,)
    centres = torch.einsum("k,nkc->nc", weights, pixels)  # (n, 2)
    weights[0] += 1 - SPREAD**2 + CENTRE_WEIGHT
    apart = pixels - centres[:, None]
    covariances = torch.einsum("k,nki,nkj->nij", weights, apart, apart)  # (n, 2, 2)
    xx, yy = covariances[:, 0, 0] + PIXEL_VARIANCE, covariances[:, 1, 1] + PIXEL_VARIANCE
    determinants = xx * yy - covariances[:, 0, 1] ** 2
    opacities, depths = torch.sigmoid(field.opacity_logits), local[:, 0, 2]
    sigmas = (2 * torch.log(opacities / MIN_ALPHA)).clamp_min(0).sqrt().clamp_max(MOST_SIGMAS)  # (n,)
    half = (xx + yy) / 2
    longest = sigmas * (half + (half * half - determinants).clamp_min(LEAST_ROOT).sqrt()).sqrt()
    sides = torch.stack([xx, yy], 1).clamp_min(0).sqrt() * sigmas[:, None]
    radii = torch.ceil(torch.minimum(sides, longest[:, None]))  # (n, 2)
    size = radii.new_tensor(camera.size)
    inside = ((centres + radii > 0) & (centres - radii < size)).all(1)
    reaches = (depths >= NEAR_DEPTH) & valid.any(1) & (determinants > 0) & (opacities >= MIN_ALPHA)
    ids = (reaches & inside & (radii > 0).any(1)).nonzero()[:, 0]
    return _Seen(ids, depths[ids], centres[ids], radii[ids])


def _shown_nearby(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return where points (..., 3) are shown, the corner of the image behind the camera, and which are on the image or
    beside it."""
    pixels, valid = camera.projected(points)
    pixels = torch.where((points[..., 2] > 0)[..., None], pixels, 0.0)
    size = pixels.new_tensor(camera.size)
    return pixels, valid & ((pixels >= -MARGIN * size) & (pixels < (1 + MARGIN) * size)).all(-1)


def _rectangles(seen: _Seen, camera: Camera) -> Tensor:
    """Return the tiles (v, 4) that the rectangles around Gaussians touch, as `oracle.tile_rectangles` does."""
    grid = seen.centres.new_tensor([-(-camera.width // TILE), -(-camera.height // TILE)])
    first = torch.floor((seen.centres - seen.radii) / TILE)
    last = torch.ceil((seen.centres + seen.radii) / TILE)
    return torch.cat([first, last], 1).clamp_min(0).minimum(grid.repeat(2)).long()


def _ray_forms(field: GaussianField, camera: Camera, ids: Tensor) -> Tensor:
    """Return six linear forms of a ray's direction for each Gaussian, (v, 18).

    In units of the standard deviations, the first three are the cross product of the direction and of the line from the
    centre to the camera, the others are the direction. The quotient of both lengths is the ray's distance.
    """
    rotations = rotation_matrices(torch.nn.functional.normalize(field.quaternions[ids], dim=-1))  # (v, 3, 3)
    whitening = torch.exp(-field.log_scales[ids])[:, :, None] * rotations.mT  # (v, 3, 3)
    x, y, z = (whitening @ (camera.position - field.means[ids])[:, :, None])[..., 0].unbind(1)  # (v,) each
    turned = whitening @ camera.world_to_camera[:3, :3].T  # of directions in the camera's axes
    zero = torch.zeros_like(x)
    crossing = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).view(-1, 3, 3)  # d -> d x (x, y, z)
    return torch.cat([crossing @ turned, turned], 1).view(-1, 18)


class _Blend(torch.autograd.Function):
    """Map (tiles, splats) to the values of all pixels: colours over black and transmittances, (t, 4, 256)."""

    @staticmethod
    def forward(ctx: Any, tiles: _Tiles, splats: Tensor) -> Tensor:
        from lapgs_plugin.reference_raster.ray_kernels import blend_rays

        values = splats.detach().contiguous().numpy()
        blended = np.empty((len(tiles.seen), 4, TILE_PIXELS), values.dtype)
        parallel(blend_rays, tiles.starts, tiles.members, values, tiles.rays, tiles.seen, blended)
        ctx.tiles, ctx.blended = tiles, blended
        ctx.save_for_backward(splats)
        return torch.from_numpy(blended)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, from_above: Tensor) -> tuple[None, Tensor]:
        from lapgs_plugin.reference_raster.ray_kernels import RAY_SPLAT, ray_gradients

        tiles: _Tiles = ctx.tiles
        (splats,) = ctx.saved_tensors
        values = splats.detach().contiguous().numpy()
        slots = np.empty((len(tiles.members), RAY_SPLAT), values.dtype)
        parallel(
            ray_gradients, tiles.starts, tiles.members, values, tiles.rays, tiles.seen, ctx.blended,
            from_above.contiguous().numpy(), slots,
        )  # fmt: skip
        return None, torch.zeros_like(splats).index_add_(0, torch.from_numpy(tiles.members), torch.from_numpy(slots))


def _tiles_of(camera: Camera, lists: TileLists, like: Tensor) -> _Tiles:
    """Return the tiles of a view, whose camera has the precision of `like`."""
    starts = np.concatenate([[0], np.cumsum(lists.counts, dtype=np.int64)])
    rays, seen = camera.pixel_rays()
    beyond = lists.columns * TILE - camera.width, lists.rows * TILE - camera.height
    rays = torch.nn.functional.pad(rays, (0, 0, 0, beyond[0], 0, beyond[1])).to(like)
    seen = torch.nn.functional.pad(seen, (0, beyond[0], 0, beyond[1]))

    def tiled(values: Tensor) -> Tensor:
        parts = values.view(lists.rows, TILE, lists.columns, TILE, -1).permute(0, 2, 4, 1, 3)
        return parts.reshape(lists.rows * lists.columns, -1, TILE_PIXELS)

    members = lists.members.contiguous().numpy()
    return _Tiles(starts, members, tiled(rays).numpy(), tiled(seen)[:, 0].contiguous().numpy())


def _as_image(blended: Tensor, lists: TileLists, camera: Camera) -> Tensor:
    """Return the values of tiles (t, 4, 256) as those of an image, (4, h, w)."""
    parts = blended.view(lists.rows, lists.columns, 4, TILE, TILE).permute(2, 0, 3, 1, 4)
    return parts.reshape(4, lists.rows * TILE, lists.columns * TILE)[:, : camera.height, : camera.width]
