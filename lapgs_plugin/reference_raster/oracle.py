"""Render 3D Gaussians in readable PyTorch, differentiated by autograd: the oracle for all other rasterizers.

It has the semantics of the CUDA rasterizers of the 3DGS family:

    projection   EWA splatting (Zwicker et al. 2002, eq. 29 and 31): Sigma' = J W Sigma W^T J^T, plus 0.3 px on the
                 diagonal; pixel j of a row has the coordinate j, so a centre lands at fx X/Z + cx - 0.5
    culling      depth <= 0.2, or no tile touched by [centre - radius, centre + radius], radius three sigma, rounded up
    blending     per tile of 16x16 pixels, front to back by depth (ties by index):
                 alpha = min(0.99, o exp(-q)), skipped under 1/255, ended before the transmittance would fall under 1e-4
    background   blended last with the remaining transmittance

In tiles that its rectangle misses, an opaque Gaussian is cut at alpha = o exp(-4.5), which is above 1/255. The image
depends on that cut. Options of some forks change the tiles, the 0.3 px and the opacities; see `OracleRasterizer`.

Gradients are those of the CUDA code. They differ from the derivative of the image in three places, marked DEPARTURE.
Two guards of the CUDA code against division by zero are left out: 1e-7 is not added to w, nor to the squared
determinant in the backward pass, where it slightly shortens the gradient of the smallest Gaussians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult, degree_to_evaluate, require_color
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.reference_raster.layout import (
    JACOBIAN_LIMIT,
    MAX_ALPHA,
    MAX_RADIUS,
    MIN_ALPHA,
    MIN_ROOT,
    MIN_SHARE,
    MIN_TRANSMITTANCE,
    NEAR_DEPTH,
    PIXEL_VARIANCE,
    RADIUS_SIGMAS,
    TILE,
    VANISHING,
)

KEPT_ALPHAS = 1 << 19
"""Pairs of a pixel and a Gaussian up to which intermediates of all tiles are kept for the backward pass. Computing them
again imports PyTorch's compiler, which takes seconds, and self-checks come before each command's first GPU render."""


@dataclass(frozen=True)
class Projection:
    """Hold v Gaussians on the image plane, in the order of their index.

    Attributes:
        ids: (v,) their index in the field.
        depths: (v,) camera-space z.
        means2d: (v, 2) centres in pixel coordinates (the first pixel is at 0).
        determinants: (v,) of the 2D covariances with the blur added, in px^4.
        conics: (v, 3) entries xx, xy, yy of the inverse covariance.
        radii: (v,) three-sigma radii in whole pixels, in the field's float type.
        rectangles: (v, 4) int64 tiles touched: x0, y0 (first), x1, y1 (one past the last).
    """

    ids: Tensor
    depths: Tensor
    means2d: Tensor
    determinants: Tensor
    conics: Tensor
    radii: Tensor
    rectangles: Tensor


@dataclass(frozen=True)
class TileLists:
    """List the Gaussians that each tile blends, front to back.

    Attributes:
        members: (i,) positions in the projection, tile after tile, in each tile by depth, ties by index.
        counts: length of each tile's part of `members`, row by row of tiles.
        columns, rows: number of tiles across and down.
    """

    members: Tensor
    counts: list[int]
    columns: int
    rows: int


class OracleRasterizer(Rasterizer):
    """Render in plain PyTorch, on the device and in the precision (float32 or float64) of the field's tensors.

    The backward pass of all but small images computes each tile again, so that memory holds the intermediates of one
    tile at a time.

    Args:
        three_sigma_cut: False for rasterizers that blend a Gaussian wherever alpha reaches 1/255: every Gaussian in
            front of the camera is then in every tile and has a radius.
        mult: instead of that cut, blend a Gaussian in the tiles that the ellipse of `mult` times the squared distance
            meets at which alpha reaches 1/255 (FastGS).
        antialiasing: multiply opacities by sqrt(|Sigma| / |Sigma + blur|), at least by 0.005.
        exact_antialiasing: do that as Mip-Splatting: leave out what is smaller than `layout.VANISHING`.
        blur: variance added to 2D covariances, in px^2.
    """

    name = "oracle"
    devices = ("cpu",)

    def __init__(
        self,
        *,
        three_sigma_cut: bool = True,
        mult: float | None = None,
        antialiasing: bool = False,
        exact_antialiasing: bool = False,
        blur: float = PIXEL_VARIANCE,
    ) -> None:
        self._three_sigma_cut = three_sigma_cut and mult is None
        self._mult, self._antialiasing, self._exact, self._blur = mult, antialiasing, exact_antialiasing, blur

    def __call__(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int | None = None
    ) -> RenderResult:
        """Render `field`; see `fields.rasterizer.Rasterizer`.

        Raises:
            UserInputError: the field has no such `sh_degree`, or `background` is not a colour.
        """
        degree = degree_to_evaluate(field, sh_degree)
        require_color(background)
        camera = camera.to(field.means.device, field.means.dtype)
        background = background.to(field.means)  # (3,)

        n = len(field)
        seen = project(field, camera, three_sigma_cut=self._three_sigma_cut, blur=self._blur)
        opacities = torch.sigmoid(field.opacity_logits[seen.ids])  # (v,)
        if self._antialiasing:
            opacities = opacities * antialiasing_factors(seen, self._blur, self._exact)
        ellipses = None if self._mult is None else Ellipses(seen.means2d, seen.conics, reaches(opacities, self._mult))
        lists = tile_lists(seen.depths, seen.rectangles, camera, ellipses)
        if ellipses is not None:
            lists, seen, opacities = _without_unlisted(lists, seen, opacities)
        means2d = field.means.new_zeros(n, 2).index_put((seen.ids,), seen.means2d)  # (n, 2)
        if means2d.requires_grad:
            means2d.retain_grad()
        absgrad2d = torch.zeros_like(means2d, requires_grad=False)  # (n, 2)
        radii = torch.zeros(n, dtype=torch.int32, device=means2d.device)  # (n,)
        radii[seen.ids] = seen.radii.to(torch.int32)

        directions = torch.nn.functional.normalize(field.means[seen.ids] - camera.position, dim=-1)  # (v, 3)
        splats = torch.cat(
            [
                means2d[seen.ids],  # (v, 2)
                seen.conics,  # (v, 3)
                opacities[:, None],  # (v, 1)
                sh_to_color(field.sh[seen.ids], directions, degree, signed=field.signed),  # (v, 3)
            ],
            dim=1,
        )  # (v, 9)
        color, transmittance = _blend_tiles(splats, seen.ids, lists, absgrad2d)
        height, width = camera.height, camera.width
        color, transmittance = color[:, :height, :width], transmittance[:height, :width]
        image = color + transmittance * background[:, None, None]  # (3, h, w)
        return RenderResult(image, transmittance, radii, means2d, absgrad2d)


def project(
    field: GaussianField, camera: Camera, *, three_sigma_cut: bool = True, blur: float = PIXEL_VARIANCE
) -> Projection:
    """Project the Gaussians that reach the image (EWA).

    Args:
        field: n Gaussians.
        camera: with its pose on the field's device and in its precision.
        three_sigma_cut, blur: as in `OracleRasterizer`.
    """
    # Culled without gradients first: in the graph, the zero gradient of a Gaussian times the infinite derivative by a
    # depth or determinant of zero would be NaN.
    with torch.no_grad():
        ids = torch.arange(len(field), device=field.means.device)
        everyone = _project_all(field, camera, ids, three_sigma_cut, blur)
        first, last = everyone.rectangles[:, :2], everyone.rectangles[:, 2:]  # (n, 2) each
        seen = (everyone.depths > NEAR_DEPTH) & (everyone.determinants != 0) & (first < last).all(dim=1)  # (n,)
    return _project_all(field, camera, ids[seen], three_sigma_cut, blur)


def _project_all(field: GaussianField, camera: Camera, ids: Tensor, three_sigma_cut: bool, blur: float) -> Projection:
    """Project the Gaussians `ids`, also those that do not reach the image."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]  # (3, 3), (3,)
    points = field.means[ids] @ rotation.T + translation  # (v, 3) in camera coordinates
    x, y, depths = points.unbind(-1)  # (v,) each
    means2d = torch.stack(
        [camera.fx * x / depths + camera.cx - 0.5, camera.fy * y / depths + camera.cy - 0.5], dim=-1
    )  # (v, 2)

    covariances3d = world_covariances(field.quaternions[ids], field.log_scales[ids])  # (v, 3, 3)
    to_screen = projection_jacobians(points, (camera.fx, camera.fy), camera.tan_half_fov) @ rotation  # (v, 2, 3)
    covariances2d = to_screen @ covariances3d @ to_screen.mT  # (v, 2, 2)
    xx = covariances2d[:, 0, 0] + blur  # (v,)
    xy = covariances2d[:, 0, 1]  # (v,)
    yy = covariances2d[:, 1, 1] + blur  # (v,)
    determinants = xx * yy - xy * xy  # (v,)
    conics = inverse_covariances(xx, xy, yy, determinants)  # (v, 3)

    with torch.no_grad():
        radii = footprint_radii(xx, yy, determinants)  # (v,)
        reach = radii if three_sigma_cut else torch.full_like(radii, math.inf)  # (v,)
        rectangles = tile_rectangles(means2d, reach, camera)  # (v, 4)
    return Projection(ids, depths, means2d, determinants, conics, radii, rectangles)


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Return the matrices (n, 3, 3) of quaternions (n, 4), wxyz, not normalised: rotations if their length is 1."""
    w, x, y, z = quaternions.unbind(-1)  # (n,) each
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        dim=-1,
    ).reshape(-1, 3, 3)  # fmt: skip


def world_covariances(quaternions: Tensor, log_scales: Tensor) -> Tensor:
    """Compute Sigma = R S S^T R^T in world coordinates, (n, 3, 3), from quaternions (n, 4) and log scales (n, 3)."""
    rotations = rotation_matrices(torch.nn.functional.normalize(quaternions, dim=-1))  # (n, 3, 3)
    axes = rotations * torch.exp(log_scales)[:, None, :]  # (n, 3, 3) R S
    return axes @ axes.mT


def projection_jacobians(points: Tensor, focal: tuple[float, float], tan_half_fov: tuple[float, float]) -> Tensor:
    """Compute the derivative of pixel coordinates by camera-space points, which are clamped to near the frustum.

    Args:
        points: (n, 3) in camera coordinates, in front of the camera.
        focal: in pixels, x and y.
        tan_half_fov: of a `Camera`.

    Returns:
        (n, 2, 3) Jacobians.
    """
    x, y, depth = points.unbind(-1)  # (n,) each
    limit_x, limit_y = (JACOBIAN_LIMIT * tangent for tangent in tan_half_fov)
    # DEPARTURE: a clamped coordinate is limit * depth, but the CUDA code differentiates the Jacobian as if it were a
    # constant: its backward pass zeroes the derivative by x and keeps that by the depth as for a free x.
    x = torch.where((x / depth).abs() > limit_x, (limit_x * depth * x.sign()).detach(), x)
    y = torch.where((y / depth).abs() > limit_y, (limit_y * depth * y.sign()).detach(), y)
    zero = torch.zeros_like(depth)
    return torch.stack(
        [
            focal[0] / depth, zero, -focal[0] * x / (depth * depth),
            zero, focal[1] / depth, -focal[1] * y / (depth * depth),
        ],
        dim=-1,
    ).reshape(-1, 2, 3)  # fmt: skip


def inverse_covariances(xx: Tensor, xy: Tensor, yy: Tensor, determinants: Tensor) -> Tensor:
    """Return (n, 3) entries xx, xy, yy of the inverses of 2D covariances, from (n,) entries and determinants."""
    return torch.stack([yy, -xy, xx], dim=-1) / determinants[:, None]


def antialiasing_factors(seen: Projection, blur: float, exact: bool) -> Tensor:
    """Return the factors (v,) of antialiasing on opacities; see `OracleRasterizer`."""
    xx, xy, yy = (seen.conics[:, i] * seen.determinants * sign for i, sign in ((2, 1), (1, -1), (0, 1)))

    def share(xx: Tensor, yy: Tensor) -> Tensor:
        return (xx * yy - xy * xy) / ((xx + blur) * (yy + blur) - xy * xy)

    if exact:
        own = (xx - blur) * (yy - blur) - xy * xy  # (v,)
        shown = own > VANISHING  # (v,)
        share_of_shown = own.where(shown, 1.0) / (seen.determinants + VANISHING)  # (v,)
        return torch.where(shown, (share_of_shown + VANISHING).sqrt(), 0.0)
    # DEPARTURE: the CUDA code differentiates the share at covariances that already have the blur.
    true, shifted = share(xx - blur, yy - blur), share(xx, yy)  # (v,) each
    return (true.detach() + shifted - shifted.detach()).clamp(min=MIN_SHARE).sqrt()


def footprint_radii(xx: Tensor, yy: Tensor, determinant: Tensor) -> Tensor:
    """Return ceil(3 sqrt(lambda_max)) in whole pixels, (n,), with the larger eigenvalue of the 2D covariance.

    Args:
        xx, yy, determinant: (n,) diagonal in px^2, and determinant in px^4, of the covariance.
    """
    middle = (xx + yy) / 2  # (n,)
    largest = middle + (middle * middle - determinant).clamp(min=MIN_ROOT).sqrt()  # (n,)
    return torch.ceil(RADIUS_SIGMAS * largest.sqrt()).clamp(max=MAX_RADIUS)


def tile_rectangles(means2d: Tensor, radii: Tensor, camera: Camera) -> Tensor:
    """Return the tiles touched by [centre - radius, centre + radius].

    As in the CUDA code, a last tile counts only if centre + radius reaches its second pixel.

    Args:
        means2d: (n, 2) centres in pixel coordinates.
        radii: (n,) in pixels.

    Returns:
        (n, 4) int64: x0, y0, x1, y1 in tiles, first inclusive, last exclusive, empty outside the image.
    """
    grid = means2d.new_tensor([-(-camera.width // TILE), -(-camera.height // TILE)])  # (2,) tiles across and down
    first = torch.floor((means2d - radii[:, None]) / TILE)  # (n, 2)
    last = torch.floor((means2d + radii[:, None] + (TILE - 1)) / TILE)  # (n, 2)
    corners = torch.cat([first, last], dim=1)  # (n, 4)
    # A centre that overflowed is NaN here; an empty rectangle culls it.
    return corners.nan_to_num(0, math.inf, -math.inf).clamp(min=0).minimum(grid.repeat(2)).to(torch.int64)


def reaches(opacities: Tensor, mult: float) -> Tensor:
    """Return `mult` times the squared Mahalanobis distances at which opacities (v,) become alphas of 1/255."""
    return 2 * mult * torch.log(opacities.detach() / MIN_ALPHA)


@dataclass(frozen=True)
class Ellipses:
    """Hold the ellipses around v Gaussians that tiles are chosen by.

    Attributes:
        means2d: (v, 2) centres in pixels.
        conics: (v, 3) entries xx, xy, yy of the inverse covariances.
        reaches: (v,) squared Mahalanobis distances of their borders; negative ones meet no tile.
    """

    means2d: Tensor
    conics: Tensor
    reaches: Tensor

    def nearest(self, which: Tensor, corners: Tensor) -> Tensor:
        """Return the least squared Mahalanobis distances (i,) of points of tiles.

        Args:
            which: (i,) a row of the ellipses for each tile.
            corners: (i, 2) first pixels of the tiles, which reach 16 pixels further.
        """
        low = corners - self.means2d[which].detach()  # (i, 2)
        high = low + TILE  # (i, 2)
        xx, xy, yy = self.conics[which].detach().unbind(-1)  # (i,) each
        distances = []
        for x in (low[:, 0], high[:, 0]):  # on an edge, the point nearest to its line's own nearest point
            y = (-xy * x / yy).clamp(low[:, 1], high[:, 1])
            distances.append(xx * x * x + 2 * xy * x * y + yy * y * y)
        for y in (low[:, 1], high[:, 1]):
            x = (-xy * y / xx).clamp(low[:, 0], high[:, 0])
            distances.append(xx * x * x + 2 * xy * x * y + yy * y * y)
        around = ((low <= 0) & (high >= 0)).all(1)  # (i,) the centre is in the tile
        return torch.stack(distances).amin(0).masked_fill(around, 0)


def tile_lists(depths: Tensor, rectangles: Tensor, camera: Camera, ellipses: Ellipses | None = None) -> TileLists:
    """List every (tile, Gaussian) pair, sorted by tile, then depth, then index.

    Args:
        depths: (v,) camera-space z.
        rectangles: (v, 4) tiles touched: x0, y0, x1, y1, as `tile_rectangles` returns them.
        ellipses: leave out tiles that these do not meet.
    """
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    order = torch.sort(depths.detach(), stable=True).indices  # (v,) front to back
    x0, y0, x1, y1 = rectangles[order].unbind(-1)  # (v,) each
    areas = (x1 - x0) * (y1 - y0)  # (v,)
    which = torch.repeat_interleave(areas)  # (i,) position in `order`
    within = torch.arange(len(which), device=order.device) - (areas.cumsum(0) - areas)[which]  # (i,) 0 ... area - 1
    width = (x1 - x0)[which]  # (i,)
    row, column = y0[which] + within // width, x0[which] + within % width  # (i,) each
    if ellipses is not None:
        corners = TILE * torch.stack([column, row], 1).to(depths)  # (i, 2)
        met = ellipses.nearest(order[which], corners) <= ellipses.reaches[order[which]]  # (i,)
        which, row, column = which[met], row[met], column[met]
    tiles = row * columns + column  # (i,)
    by_tile = torch.sort(tiles, stable=True).indices  # (i,)
    counts = torch.bincount(tiles, minlength=columns * rows).tolist()
    return TileLists(order[which[by_tile]], counts, columns, rows)


def _without_unlisted(lists: TileLists, seen: Projection, opacities: Tensor) -> tuple[TileLists, Projection, Tensor]:
    """Leave out the Gaussians that are in no tile."""
    listed, rows = torch.unique(lists.members, return_inverse=True)
    kept = Projection(**{name: value[listed] for name, value in vars(seen).items()})
    return replace(lists, members=rows), kept, opacities[listed]


def _blend_tiles(splats: Tensor, ids: Tensor, lists: TileLists, absgrad2d: Tensor) -> tuple[Tensor, Tensor]:
    """Blend every tile and assemble the image.

    Args:
        splats: (v, 9) centre (2), conic (3), opacity (1), colour (3).
        ids: (v,) rows of `absgrad2d`.
        absgrad2d: (n, 2) buffer filled during the backward pass.

    Returns:
        (3, 16 rows, 16 columns) colour over black, (16 rows, 16 columns) transmittance.
    """
    # One gather for all tiles: one for each tile would each have a gradient as large as the field.
    parts = torch.split(splats[lists.members], lists.counts)  # (k, 9) for each tile
    owners = torch.split(ids[lists.members], lists.counts)  # (k,) for each tile
    steps = torch.arange(TILE, dtype=splats.dtype, device=splats.device)  # (16,)
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(-1, 2)  # (256, 2) x, y
    tiles, recompute = [], len(grid) * sum(lists.counts) > KEPT_ALPHAS
    for index, (part, owner) in enumerate(zip(parts, owners, strict=True)):
        row, column = divmod(index, lists.columns)
        pixels = grid + grid.new_tensor([column * TILE, row * TILE])  # (256, 2)
        blended = _decide(part, pixels)  # (256, k)
        used = blended.any(dim=0).nonzero()[:, 0]  # (m,) the others have no gradient
        blend = partial(_blend, pixels=pixels, blended=blended[:, used], ids=owner[used], absgrad2d=absgrad2d)
        if recompute:
            tiles.append(checkpoint(blend, part[used], use_reentrant=False, preserve_rng_state=False))
        else:
            tiles.append(blend(part[used]))
    tiled = torch.stack(tiles).reshape(lists.rows, lists.columns, TILE, TILE, 4)
    image = tiled.permute(4, 0, 2, 1, 3).reshape(4, lists.rows * TILE, lists.columns * TILE)
    return image[:3], image[3]


@torch.no_grad()
def _decide(splats: Tensor, pixels: Tensor) -> Tensor:
    """Return (p, k) True where a pixel blends a Gaussian: visible there, and reached before the pixel is opaque.

    Args:
        splats: (k, 9) centre (2), conic (3), opacity (1), colour (3), front to back.
        pixels: (p, 2) pixel coordinates.
    """
    centres, conics, opacities, _ = torch.split(splats, [2, 3, 1, 3], dim=1)  # (k, 2), (k, 3), (k, 1), (k, 3)
    alphas = _alphas(centres - pixels[:, None], conics, opacities[:, 0])  # (p, k)
    visible = alphas >= MIN_ALPHA  # (p, k)
    behind = torch.cumprod(1 - alphas * visible, dim=1)  # (p, k) the transmittance if no pixel ended early
    return visible & (behind >= MIN_TRANSMITTANCE)


def _blend(splats: Tensor, pixels: Tensor, blended: Tensor, ids: Tensor, absgrad2d: Tensor) -> Tensor:
    """Compute C = sum_i c_i alpha_i T_i with T_i = prod_{j<i} (1 - alpha_j), over the Gaussians each pixel blends.

    Args:
        splats: (k, 9) centre (2), conic (3), opacity (1), colour (3), front to back.
        pixels: (p, 2) pixel coordinates.
        blended: (p, k) which Gaussians each pixel blends.
        ids: (k,) rows of `absgrad2d`.
        absgrad2d: (n, 2) buffer filled during the backward pass.

    Returns:
        (p, 4) colour C and the remaining transmittance.
    """
    centres, conics, opacities, colors = torch.split(splats, [2, 3, 1, 3], dim=1)  # (k, 2), (k, 3), (k, 1), (k, 3)
    offsets = centres - pixels[:, None]  # (p, k, 2)
    if offsets.requires_grad:
        offsets.register_hook(  # type: ignore[no-untyped-call]  # torch leaves this method without types
            lambda gradient: _accumulate_absolute(gradient, ids, absgrad2d)
        )
    alphas = _alphas(offsets, conics, opacities[:, 0]).masked_fill(~blended, 0)  # (p, k)
    behind = torch.cumprod(1 - alphas, dim=1)  # (p, k)
    transmittances = torch.cat([torch.ones_like(pixels[:, :1]), behind], dim=1)  # (p, k + 1)
    color = (alphas * transmittances[:, :-1]) @ colors  # (p, 3)
    return torch.cat([color, transmittances[:, -1:]], dim=1)


def _alphas(offsets: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """Compute alpha = min(0.99, o exp(-q)) with q = d^T conic d / 2.

    Args:
        offsets: (p, k, 2) centre minus pixel.
        conics: (k, 3) entries xx, xy, yy.
        opacities: (k,).

    Returns:
        (p, k) alphas; 0 where q < 0, which happens if rounding makes a conic indefinite.
    """
    dx, dy = offsets.unbind(-1)  # (p, k) each
    xx, xy, yy = conics.unbind(-1)  # (k,) each
    power = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy  # (p, k) = -q
    return _cap(opacities * torch.exp(power.masked_fill(power.detach() > 0, -math.inf)))


def _cap(alpha: Tensor) -> Tensor:
    """Return min(alpha, 0.99).

    DEPARTURE: the CUDA code's backward pass ignores the cap, so the gradient passes straight through it.
    """
    return alpha - (alpha.detach() - MAX_ALPHA).clamp(min=0)


def _accumulate_absolute(gradient: Tensor, ids: Tensor, absgrad2d: Tensor) -> None:
    """Add the (p, k, 2) gradient's absolute value, summed over the pixels, to the rows `ids` of the buffer."""
    absgrad2d.index_add_(0, ids, gradient.abs().sum(dim=0))
