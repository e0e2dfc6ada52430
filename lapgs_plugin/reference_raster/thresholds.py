"""Find the pixels and Gaussians on which two correct rasterizers may disagree, because rounding decides a comparison.

A rasterizer compares numbers to decide: in front or behind, in which tiles, in which order, visible or skipped, last
Gaussian or not. Where compared numbers are equal up to rounding, two implementations may decide differently and then
differ by far more than rounding. Everywhere else they must agree, so tests compare them outside of this mask.

The mask is computed in float64 with a running first-order error bound. `tolerance` is the relative error of an
elementary result (a dot product of a few terms). The bound of each quantity follows from its own formula, including
cancellation: the 2D determinant of a needle, for example, is less precise than its entries. A pixel is masked if,
before the transmittance has certainly fallen under its limit, for any Gaussian
    - alpha is within its bound of 1/255, or of the cap 0.99 and not certainly above it,
    - the transmittance is within its bound of 1e-4,
    - the bounds of centre, radius (rounded up) or ellipse, and depth (culled at 0.2) leave open if it is in the pixel's
      tile, or
      its determinant may be 0 (culled) or negative (skipped where the exponent becomes positive),
    - the next contributing Gaussian is not certainly behind it. Exactly equal centres are not masked: their depths are
      computed from the same numbers, so they tie in any implementation, and the index decides.
For a Gaussian, the mask says if its radius is open and if its gradient has a kink: a colour channel at the clamp, a
centre at the limit where the Jacobian is clamped, or a factor of antialiasing at its lower bound.

Gradients mix pixels. Compare those of a loss whose weights vanish on the masked pixels, for Gaussians not at a kink.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import degree_to_evaluate
from lapgs_plugin.fields.spherical_harmonics import sh_basis
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
from lapgs_plugin.reference_raster.oracle import (
    Ellipses,
    inverse_covariances,
    projection_jacobians,
    reaches,
    tile_lists,
    tile_rectangles,
    world_covariances,
)

ROUNDINGS = 8
"""Default tolerance in units of the float type's epsilon, for the longest dot products of the projection."""


@dataclass(frozen=True)
class ThresholdMask:
    """Mark pixels and Gaussians on which two correct implementations may disagree.

    Attributes:
        pixels: (h, w) True where a decision within rounding changes the pixel.
        radii: (n,) True where a Gaussian's radius, or whether it is culled, is within rounding.
        kinks: (n,) True where a Gaussian's gradient has a kink within rounding.
    """

    pixels: Tensor
    radii: Tensor
    kinks: Tensor


@dataclass(frozen=True)
class _Bounded:
    """Hold the v Gaussians that might reach the image, each quantity with its error bound, in float64.

    Attributes:
        ids: (v,) their index in the field.
        means: (v, 3) centres in world coordinates.
        depths, depth_errors: (v,) camera-space z; the error is 0 where every implementation computes the same bits.
        means2d, mean_errors: (v, 2) centres in pixels.
        shapes: their footprints.
        opacities, opacity_errors: (v,) the error is relative.
        surely: (v, 4) tiles the Gaussian touches with any rounding: x0, y0, x1, y1; empty if it may be culled.
        possibly: (v, 4) tiles it touches with some rounding.
        open_radii, kinks: (v,) as in `ThresholdMask`.
    """

    ids: Tensor
    means: Tensor
    depths: Tensor
    depth_errors: Tensor
    means2d: Tensor
    mean_errors: Tensor
    shapes: _Shapes
    opacities: Tensor
    opacity_errors: Tensor
    surely: Tensor
    possibly: Tensor
    open_radii: Tensor
    kinks: Tensor


@torch.no_grad()
def threshold_mask(
    field: GaussianField,
    camera: Camera,
    *,
    sh_degree: int | None = None,
    tolerance: float | None = None,
    three_sigma_cut: bool = True,
    mult: float | None = None,
    antialiasing: bool = False,
    exact_antialiasing: bool = False,
    blur: float = PIXEL_VARIANCE,
) -> ThresholdMask:
    """Find the pixels and Gaussians whose rendering depends on rounding.

    Args:
        field: n Gaussians, the same bits as rendered.
        sh_degree: highest SH degree rendered; None means all.
        tolerance: relative error of an elementary result; None takes 8 epsilon of the field's float type.
        three_sigma_cut, mult, antialiasing, exact_antialiasing, blur: as in `OracleRasterizer`.
    """
    if tolerance is None:
        tolerance = ROUNDINGS * torch.finfo(field.means.dtype).eps
    field, camera = field.to(dtype=torch.float64), camera.to(field.means.device, torch.float64)
    degree = degree_to_evaluate(field, sh_degree)
    bounded = _project(field, camera, degree, tolerance, three_sigma_cut and mult is None, blur)
    if antialiasing:
        bounded = (_dimmed_exactly if exact_antialiasing else _dimmed)(bounded)
    ellipses = None if mult is None else _ellipses(bounded, mult, tolerance)
    radii, kinks = torch.zeros(2, len(field), dtype=torch.bool, device=field.means.device)  # (n,) each
    radii[bounded.ids], kinks[bounded.ids] = bounded.open_radii, bounded.kinks
    pixels, met_perhaps = _open_pixels(bounded, camera, tolerance, ellipses)
    radii[bounded.ids[met_perhaps]] = True
    return ThresholdMask(pixels, radii, kinks)


def _project(
    field: GaussianField,
    camera: Camera,
    degree: int,
    tolerance: float,
    three_sigma_cut: bool,
    blur: float,
) -> _Bounded:
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]  # (3, 3), (3,)
    points = field.means @ rotation.T + translation  # (n, 3)
    errors = tolerance * (field.means.abs() @ rotation.abs().T + translation.abs())  # (n, 3)
    ids = (points[:, 2] > NEAR_DEPTH - errors[:, 2] - tolerance).nonzero()[:, 0]  # (v,)
    points, errors = points[ids], errors[ids]  # (v, 3)
    depths = points[:, 2]  # (v,)
    slopes = points[:, :2] / depths[:, None]  # (v, 2)
    slope_errors = (errors[:, :2] + slopes.abs() * errors[:, 2:]) / depths[:, None] + tolerance * slopes.abs()  # (v, 2)
    focal = points.new_tensor([camera.fx, camera.fy])  # (2,)
    principal = points.new_tensor([camera.cx - 0.5, camera.cy - 0.5])  # (2,)
    means2d = focal * slopes + principal  # (v, 2)
    mean_errors = focal * slope_errors + tolerance * (means2d.abs() + principal.abs())  # (v, 2)

    relative = tolerance + 4 * errors.norm(dim=1) / depths  # (v,) error of the Jacobian, twice in the covariance
    shapes = _shapes(field, ids, points, camera, relative, tolerance, blur)
    may_be_culled = (depths - NEAR_DEPTH <= errors[:, 2] + tolerance) | shapes.degenerate  # (v,)
    surely, possibly = _tiles(means2d, mean_errors, shapes, camera, three_sigma_cut)  # (v, 4) each
    surely = surely * (~may_be_culled)[:, None]  # (v, 4)
    touched, surely_touched = _area(possibly) > 0, _area(surely) > 0  # (v,) each
    open_radii = touched & ((shapes.smallest_radii != shapes.largest_radii) | ~surely_touched)  # (v,)

    limits = points.new_tensor(camera.tan_half_fov) * JACOBIAN_LIMIT  # (2,)
    at_limit = ((slopes.abs() - limits).abs() <= slope_errors + tolerance * limits).any(1)  # (v,)
    kinks = touched & (at_limit | _at_clamp(field, camera, ids, degree, tolerance))  # (v,)
    # If the rotation only picks a coordinate, the depth is one exactly rounded sum: the same bits everywhere.
    axis_aligned = bool((rotation[2].abs() == 1).any())
    logits = field.opacity_logits[ids]  # (v,)
    return _Bounded(
        ids=ids,
        means=field.means[ids],
        depths=depths,
        depth_errors=torch.zeros_like(depths) if axis_aligned else errors[:, 2],
        means2d=means2d,
        mean_errors=mean_errors,
        shapes=shapes,
        opacities=torch.sigmoid(logits),
        opacity_errors=tolerance * (1 + logits.abs()),
        surely=surely,
        possibly=possibly,
        open_radii=open_radii,
        kinks=kinks,
    )


@dataclass(frozen=True)
class _Shapes:
    """Hold the footprints of v Gaussians.

    Attributes:
        conics: (v, 3) xx, xy, yy of the inverse covariance.
        conic_errors: (v,) relative error of the quadratic form with this conic.
        smallest_radii, largest_radii: (v,) whole pixels.
        degenerate: (v,) True where the determinant may round to 0 or below.
        own, own_errors: (v,) the determinants without the blur.
        shares, share_errors: (v,) these over the determinants with it.
    """

    conics: Tensor
    conic_errors: Tensor
    smallest_radii: Tensor
    largest_radii: Tensor
    degenerate: Tensor
    own: Tensor
    own_errors: Tensor
    shares: Tensor
    share_errors: Tensor


def _shapes(
    field: GaussianField, ids: Tensor, points: Tensor, camera: Camera, relative: Tensor, tolerance: float, blur: float
) -> _Shapes:
    """Compute footprints of Gaussians `ids` at camera-space points (v, 3), with relative errors (v,) of Jacobians."""
    jacobians = projection_jacobians(points, (camera.fx, camera.fy), camera.tan_half_fov)  # (v, 2, 3)
    to_screen = jacobians @ camera.world_to_camera[:3, :3]  # (v, 2, 3)
    covariances = to_screen @ world_covariances(field.quaternions[ids], field.log_scales[ids]) @ to_screen.mT
    xx, yy = covariances[:, 0, 0] + blur, covariances[:, 1, 1] + blur  # (v,)
    xy = covariances[:, 0, 1]  # (v,)
    # Sigma' is a sum of terms as large as the longest axis seen from the side, even if these cancel.
    largest_term = jacobians.square().sum((1, 2)) * torch.exp(2 * field.log_scales[ids].amax(1)) + blur
    errors = largest_term * relative  # (v,) of each entry of the covariance
    determinants = xx * yy - xy * xy  # (v,)
    determinant_errors = tolerance * (xx * yy + xy * xy)  # (v,) of the subtraction alone

    middle = (xx + yy) / 2  # (v,)
    squared = (middle * middle - determinants).clamp(min=MIN_ROOT)  # (v,)
    squared_errors = 4 * middle * errors + tolerance * middle * middle + determinant_errors  # (v,)
    root_errors = (squared_errors / squared.sqrt()).minimum(squared_errors.sqrt())  # (v,)
    largest = middle + squared.sqrt()  # (v,) eigenvalue
    smallest = determinants.abs() / largest  # (v,) eigenvalue
    radii = RADIUS_SIGMAS * largest.sqrt()  # (v,) before they are rounded up
    radius_errors = RADIUS_SIGMAS * (errors + root_errors) / largest.sqrt() + tolerance * radii  # (v,)
    own = covariances[:, 0, 0] * covariances[:, 1, 1] - xy * xy  # (v,) determinants without the blur
    own_errors = (covariances[:, 0, 0] + covariances[:, 1, 1]) * 2 * errors  # (v,)
    own_errors += tolerance * (covariances[:, 0, 0] * covariances[:, 1, 1] + xy * xy)
    conic_errors = 2 * errors / smallest + determinant_errors / determinants.abs()  # (v,)
    shares = own / determinants  # (v,)
    return _Shapes(
        conics=inverse_covariances(xx, xy, yy, determinants),
        conic_errors=conic_errors,
        smallest_radii=torch.ceil(radii - radius_errors).clamp(max=MAX_RADIUS),
        largest_radii=torch.ceil(radii + radius_errors).clamp(max=MAX_RADIUS),
        degenerate=determinants.abs() <= determinant_errors + 4 * middle * errors,
        own=own,
        own_errors=own_errors,
        shares=shares,
        share_errors=own_errors / determinants.abs() + shares.abs() * conic_errors,
    )


def _dimmed(bounded: _Bounded) -> _Bounded:
    """Dim the opacities by antialiasing with its lower bound."""
    shapes = bounded.shapes
    shares = shapes.shares.clamp(min=MIN_SHARE)  # (v,)
    return replace(
        bounded,
        opacities=bounded.opacities * shares.sqrt(),
        opacity_errors=bounded.opacity_errors + shapes.share_errors / shares / 2,
        kinks=bounded.kinks | ((shapes.shares - MIN_SHARE).abs() <= shapes.share_errors),
    )


def _dimmed_exactly(bounded: _Bounded) -> _Bounded:
    """Dim the opacities by antialiasing as Mip-Splatting does."""
    shapes = bounded.shapes
    shown, is_open = shapes.own > VANISHING, (shapes.own - VANISHING).abs() <= shapes.own_errors  # (v,) each
    shares = shapes.shares.clamp(min=0) + VANISHING  # (v,)
    errors = bounded.opacity_errors + shapes.share_errors / shares / 2  # (v,)
    return replace(
        bounded,
        opacities=bounded.opacities * torch.where(shown | is_open, shares.sqrt(), 0),
        opacity_errors=torch.where(is_open, errors.clamp(min=1), errors),
        kinks=bounded.kinks | is_open,
    )


@dataclass(frozen=True)
class _Ellipses:
    """Hold the ellipses that tiles are chosen by, with the errors (v,) of squared distances near their borders."""

    ellipses: Ellipses
    errors: Tensor


def _ellipses(bounded: _Bounded, mult: float, tolerance: float) -> _Ellipses:
    limits = reaches(bounded.opacities, mult)  # (v,)
    steepest = bounded.shapes.conics[:, 0] + bounded.shapes.conics[:, 2]  # (v,) largest eigenvalue at most
    # Implementations intersect the border with the tiles' edges: their error is one of positions.
    shifts = bounded.mean_errors.sum(1) + tolerance * (bounded.means2d.abs().sum(1) + TILE)  # (v,) pixels
    errors = 2 * (limits.clamp(min=0) * steepest).sqrt() * shifts + steepest * shifts * shifts
    errors += limits.abs() * (bounded.shapes.conic_errors + tolerance)
    errors += 2 * mult * (bounded.opacity_errors + tolerance)
    return _Ellipses(Ellipses(bounded.means2d, bounded.shapes.conics, limits), errors)


def _tiles(
    means2d: Tensor, errors: Tensor, shapes: _Shapes, camera: Camera, three_sigma_cut: bool
) -> tuple[Tensor, Tensor]:
    """Return (v, 4) tiles that each Gaussian certainly touches, and those it may touch, given (v, 2) centre errors."""
    if not three_sigma_cut:
        everywhere = tile_rectangles(means2d, torch.full_like(means2d[:, 0], math.inf), camera)  # (v, 4)
        return everywhere, everywhere
    extremes = torch.stack(
        [
            tile_rectangles(means2d + side * errors, radii, camera)
            for radii in (shapes.smallest_radii, shapes.largest_radii)
            for side in (-1, 1)
        ]
    )  # (4, v, 4)
    low, high = extremes.amin(0), extremes.amax(0)  # (v, 4)
    return torch.cat([high[:, :2], low[:, 2:]], dim=1), torch.cat([low[:, :2], high[:, 2:]], dim=1)


def _area(rectangles: Tensor) -> Tensor:
    """Return the number of tiles (v,) of rectangles (v, 4)."""
    return (rectangles[:, 2:] - rectangles[:, :2]).clamp(min=0).prod(dim=1)


def _at_clamp(field: GaussianField, camera: Camera, ids: Tensor, degree: int, tolerance: float) -> Tensor:
    """Return (v,) True where a colour channel is within rounding of 0, at which unsigned fields clamp."""
    if field.signed:
        return torch.zeros(len(ids), dtype=torch.bool, device=ids.device)
    offsets = field.means[ids] - camera.position  # (v, 3)
    basis = sh_basis(torch.nn.functional.normalize(offsets, dim=-1), degree)[:, :, None]  # (v, k, 1)
    sh = field.sh[ids, : basis.shape[1]]  # (v, k, 3)
    values = (basis * sh).sum(1) + 0.5  # (v, 3)
    # The direction is a difference of positions: its relative error is larger for Gaussians near the camera.
    positions = (field.means[ids].abs() + camera.position.abs()).sum(1)  # (v,)
    steepness = 1 + degree * (1 + positions / offsets.norm(dim=1))  # (v,)
    errors = tolerance * (0.5 + steepness[:, None] * sh.abs().sum(1))  # (v, 3)
    return torch.any(values.abs() <= errors, dim=1)


def _open_pixels(
    bounded: _Bounded, camera: Camera, tolerance: float, ellipses: _Ellipses | None
) -> tuple[Tensor, Tensor]:
    """Return the pixels and the Gaussians for which rounding can turn a comparison of blending.

    Returns:
        (h, w) for each pixel, and (v,) whether rounding decides if a Gaussian's ellipse meets any tile.
    """
    lists = tile_lists(bounded.depths, bounded.possibly, camera)
    offsets = torch.arange(TILE, dtype=torch.float64, device=bounded.depths.device)  # (16,)
    mask = torch.zeros(lists.rows, lists.columns, TILE, TILE, dtype=torch.bool, device=bounded.depths.device)
    met, met_perhaps = torch.zeros(2, len(bounded.ids), dtype=torch.bool, device=bounded.depths.device)  # (v,) each
    for index, members in enumerate(torch.split(lists.members, lists.counts)):
        row, column = divmod(index, lists.columns)
        y, x = torch.meshgrid(offsets + row * TILE, offsets + column * TILE, indexing="ij")  # (16, 16) each
        pixels = torch.stack([x, y], dim=-1).reshape(-1, 2)  # (256, 2)
        x0, y0, x1, y1 = bounded.surely[members].unbind(-1)  # (k,) each
        surely_here = (x0 <= column) & (column < x1) & (y0 <= row) & (row < y1)  # (k,)
        if ellipses is not None:
            inside = ellipses.ellipses.reaches[members] - ellipses.ellipses.nearest(members, pixels[:1])  # (k,)
            perhaps = inside >= -ellipses.errors[members]  # (k,)
            surely_here = (surely_here & (inside > ellipses.errors[members]))[perhaps]
            members = members[perhaps]  # noqa: PLW2901  # of the tile's list, those that remain
            met_perhaps[members], met[members[surely_here]] = True, True
        mask[row, column] = _open_in_tile(bounded, members, surely_here, pixels, tolerance).reshape(TILE, TILE)
    image = mask.permute(0, 2, 1, 3).reshape(lists.rows * TILE, lists.columns * TILE)
    return image[: camera.height, : camera.width], met_perhaps & ~met


def _open_in_tile(bounded: _Bounded, members: Tensor, surely_here: Tensor, pixels: Tensor, tolerance: float) -> Tensor:
    """Find the pixels of a tile with an open decision.

    Args:
        members: (k,) rows of `bounded` that may be in the tile, by depth.
        surely_here: (k,) False for those whose presence is open.
        pixels: (p, 2) pixel coordinates.

    Returns:
        (p,) bool.
    """
    low, middle, high = _alphas(bounded, members, pixels, tolerance)  # (p, k) each
    maybe_visible = high >= MIN_ALPHA  # (p, k)
    alpha = torch.where(maybe_visible, middle.clamp(max=MAX_ALPHA), 0)  # (p, k)
    alpha_errors = torch.where(maybe_visible, high.clamp(max=MAX_ALPHA) - low.clamp(max=MAX_ALPHA), 0)  # (p, k)
    behind = torch.cumprod(1 - alpha, dim=1)  # (p, k) transmittance behind each Gaussian
    behind_errors = (alpha_errors / (1 - alpha) + tolerance * maybe_visible).cumsum(1)  # (p, k) relative
    before = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], dim=1)  # (p, k)
    before_errors = torch.cat([torch.zeros_like(behind[:, :1]), behind_errors[:, :-1]], dim=1)  # (p, k)
    reached = before * (1 + before_errors) >= MIN_TRANSMITTANCE  # (p, k)

    presence = (low < MIN_ALPHA) | ~surely_here  # (p, k)
    at_cap = (low <= MAX_ALPHA) & (high >= MAX_ALPHA)  # (p, k)
    at_stop = (behind - MIN_TRANSMITTANCE).abs() <= behind * behind_errors  # (p, k)
    decisions = presence | at_cap | at_stop | _ties(bounded, members, maybe_visible)  # (p, k)
    return (decisions & maybe_visible & reached).any(1)


def _alphas(bounded: _Bounded, members: Tensor, pixels: Tensor, tolerance: float) -> tuple[Tensor, ...]:
    """Return lower bound, value and upper bound of o exp(-q) before the cap; (p, k) each."""
    dx, dy = (bounded.means2d[members] - pixels[:, None]).unbind(-1)  # (p, k) each
    xx, xy, yy = bounded.shapes.conics[members].unbind(-1)  # (k,) each
    q = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy  # (p, k)
    terms = 0.5 * (xx * dx * dx + yy * dy * dy) + (xy * dx * dy).abs()  # (p, k)
    shift_x, shift_y = bounded.mean_errors[members].unbind(-1)  # (k,) each
    shifted = (xx * dx + xy * dy).abs() * shift_x + (xy * dx + yy * dy).abs() * shift_y  # (p, k) |grad q| . error
    q_errors = q * bounded.shapes.conic_errors[members] + tolerance * (1 + terms) + shifted  # (p, k)
    opacities, relative = bounded.opacities[members], bounded.opacity_errors[members]  # (k,) each
    low = opacities * (1 - relative) * torch.exp(-q - q_errors)  # (p, k)
    high = opacities * (1 + relative) * torch.exp((q_errors - q).clamp(max=0))  # (p, k)
    return low, opacities * torch.exp(-q), high


def _ties(bounded: _Bounded, members: Tensor, visible: Tensor) -> Tensor:
    """Return (p, k) True where a Gaussian is not certainly behind the previous contributing one in that pixel."""
    order = torch.arange(len(members), device=members.device).expand_as(visible)  # (p, k)
    latest = torch.where(visible, order, -1).cummax(dim=1).values  # (p, k)
    previous = torch.cat([torch.full_like(latest[:, :1], -1), latest[:, :-1]], dim=1)  # (p, k), -1: none
    depths, errors = bounded.depths[members], bounded.depth_errors[members]  # (k,) each
    close = depths - depths[previous] < errors + errors[previous]  # (p, k)
    means = bounded.means[members]  # (k, 3)
    same_centre = (means == means[previous]).all(-1)  # (p, k)
    return (previous >= 0) & close & ~same_centre
