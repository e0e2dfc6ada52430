"""Render and differentiate plain arrays with the CPU kernels; `fast` and the stand-ins wrap this for autograd.

`render` runs projection_kernels.project, then ordering_kernels, then tile_kernels.blend. `gradients` runs
tile_kernels.blend_backward, then projection_kernels.project_backward. Gaussians have raw or activated parameters, and
SH coefficients or colours.

Kernels are imported where they are called, so that commands that render on a GPU do without Numba.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.jit.buffers import empty
from lapgs_plugin.jit.lanes import WIDTH, Floats
from lapgs_plugin.jit.threads import num_threads, parallel
from lapgs_plugin.reference_raster.layout import JACOBIAN_LIMIT, PIXEL_VARIANCE, SLOT, SPLAT, TILE


@dataclass(frozen=True)
class View:
    """Hold an image size in pixels and a camera (CAMERA,), see `layout.CAMERA`."""

    width: int
    height: int
    camera: Floats

    @property
    def tiles(self) -> tuple[int, int]:
        """Return the number of tiles across and down."""
        return -(-self.width // TILE), -(-self.height // TILE)


@dataclass(frozen=True)
class Gaussians:
    """Hold n Gaussians as contiguous arrays of one float type.

    Attributes:
        means: (n, 3) centres in world coordinates.
        quats: (n, 4) rotations, wxyz.
        scales: (n, 3) standard deviations in world units, or their logarithms.
        opacities: (n,) opacities, or their logits.
        sh: (n, k, 3) spherical-harmonic coefficients, k of 1, 4, 9, 16; or None if there are colours.
        colors: (n, 3) colours, or None if there are coefficients.
        raw: True for logarithms, logits and quaternions of any length; False for activated values.
        signed: True if the colour is the SH value itself, False for max(value + 0.5, 0). `colors` are not mapped.
        sh_degree: highest degree evaluated, not more than k has.
    """

    means: Floats
    quats: Floats
    scales: Floats
    opacities: Floats
    sh: Floats | None
    colors: Floats | None
    raw: bool
    signed: bool
    sh_degree: int

    @property
    def columns(self) -> int:
        """Return the number of coefficients of a Gaussian, all channels."""
        return 0 if self.sh is None else self.sh.shape[1] * 3


@dataclass(frozen=True)
class Rendering:
    """Hold image (3, height, width), transmittance (height, width), radii (n,) int32 and centres (n, 2).

    The inputs of its backward pass are `kept` if they were asked for.
    """

    image: Floats
    transmittance: Floats
    radii: NDArray[np.int32]
    centres: Floats
    kept: Kept | None


@dataclass(frozen=True)
class Kept:
    """Hold the intermediates of a rendering that its backward pass needs; see `tile_kernels.blend` for shapes."""

    splats: Floats
    background: Floats
    first_pair: NDArray[np.int64]
    places: NDArray[np.int32]
    tile_start: NDArray[np.int64]
    members: NDArray[np.int32]
    hits: NDArray[np.uint16]
    reached: NDArray[np.int64]
    final: Floats


@dataclass(frozen=True)
class Gradients:
    """Hold derivatives of a loss.

    Attributes:
        means, quats, scales, opacities, sh, colors: by the arrays of `Gaussians`, in their shapes.
        centres: (n, 2) by the centres on the image, in loss per pixel.
        absolute_centres: (n, 2) the sum of the absolute values of each pixel's part of `centres`.
        slots: (pairs * SLOT,) the sums that these are made of, of each splat in each tile; see `layout.SLOT`.
    """

    means: Floats
    quats: Floats
    scales: Floats
    opacities: Floats
    sh: Floats | None
    colors: Floats | None
    centres: Floats
    absolute_centres: Floats
    slots: Floats


TileLists = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int64], NDArray[np.int32]]
"""first_pair (n + 1,), places (pairs,), tile_start (tiles + 1,), members (pairs,); see `ordering_kernels`."""


def render(
    gaussians: Gaussians,
    view: View,
    background: Floats,
    *,
    keep: bool,
    assign: Callable[[Floats, NDArray[np.int32]], TileLists] | None = None,
) -> Rendering:
    """Render n Gaussians.

    Args:
        background: (3,) in the Gaussians' float type.
        keep: whether to keep the inputs of `gradients`.
        assign: from the splats and the radii, which it may change, to the tiles' lists. None takes the tiles of the
            three-sigma rectangle, as all rasterizers but FastGS do.
    """
    from lapgs_plugin.reference_raster import projection_kernels, tile_kernels

    n, kind = len(gaussians.means), gaussians.means.dtype
    padded = -(-n // WIDTH) * WIDTH
    tiles_x, tiles_y = view.tiles
    splats, centres, depths = empty(padded * SPLAT, kind), empty(padded * 2, kind), empty(padded, kind)
    boxes, radii = empty(padded * 4, np.int32), empty(padded, np.int32)
    parallel(
        projection_kernels.project, n, *_arrays(gaussians), gaussians.raw, gaussians.signed, gaussians.sh_degree,
        view.camera, tiles_x, tiles_y, splats, boxes, radii, depths, centres,
    )  # fmt: skip
    if assign is None:
        first_pair, places, tile_start, members = list_tiles(n, boxes, depths, tiles_x, tiles_x * tiles_y)
    else:
        first_pair, places, tile_start, members = assign(splats, radii[:n])

    pairs, tiles, pixels = len(members), tiles_x * tiles_y, view.width * view.height
    image, transmittance = empty(3 * pixels, kind), empty(pixels, kind)
    reached = np.zeros(tiles, np.int64)
    hits = empty(pairs if keep else 0, np.uint16)
    final = empty(tiles * tile_kernels.FINAL if keep else 0, kind)
    parallel(
        tile_kernels.blend, view.width, view.height, tiles_x, tile_start, members, splats, background, offsets(kind),
        image, transmittance, keep, hits, reached, final,
    )  # fmt: skip
    kept = Kept(splats, background, first_pair, places, tile_start, members, hits, reached, final) if keep else None
    return Rendering(
        image.reshape(3, view.height, view.width),
        transmittance.reshape(view.height, view.width),
        radii[:n],
        centres[: n * 2].reshape(n, 2),
        kept,
    )


def gradients(
    gaussians: Gaussians, view: View, rendering: Rendering, grad_image: Floats, grad_transmittance: Floats | None
) -> Gradients:
    """Differentiate a loss of the image that `render` made of the same Gaussians with `keep`.

    Its derivatives are (3, height, width) by the image, and (height, width) by the transmittance or None for zero.
    """
    from lapgs_plugin.reference_raster import projection_kernels, tile_kernels

    kept = rendering.kept
    assert kept is not None, "rendered without keep=True"
    n, kind = len(gaussians.means), gaussians.means.dtype
    padded = -(-n // WIDTH) * WIDTH
    slots = empty(len(kept.members) * SLOT, kind)
    nothing = np.empty(0, kind)
    parallel(
        tile_kernels.blend_backward, view.width, view.height, view.tiles[0], kept.tile_start, kept.members, kept.splats,
        kept.background, offsets(kind), kept.hits, kept.reached, kept.final, grad_image.reshape(-1),
        nothing if grad_transmittance is None else grad_transmittance.reshape(-1), slots,
    )  # fmt: skip
    means, quats, scales, opacities, centres, absolute_centres = (
        empty(padded * columns, kind) for columns in (3, 4, 3, 1, 2, 2)
    )
    sh = empty(padded * gaussians.columns, kind)
    colors = empty(0 if gaussians.colors is None else padded * 3, kind)
    flat_means, flat_quats, flat_scales, _, flat_sh, _, columns = _arrays(gaussians)
    parallel(
        projection_kernels.project_backward, n, flat_means, flat_quats, flat_scales, flat_sh, columns, gaussians.raw,
        gaussians.sh_degree, view.camera, kept.splats, kept.first_pair, kept.places, slots, means, quats, scales,
        opacities, sh, colors, centres, absolute_centres,
    )  # fmt: skip
    return Gradients(
        means[: n * 3].reshape(n, 3),
        quats[: n * 4].reshape(n, 4),
        scales[: n * 3].reshape(n, 3),
        opacities[:n],
        None if gaussians.sh is None else sh[: n * columns].reshape(gaussians.sh.shape),
        None if gaussians.colors is None else colors[: n * 3].reshape(n, 3),
        centres[: n * 2].reshape(n, 2),
        absolute_centres[: n * 2].reshape(n, 2),
        slots,
    )


def make_view(
    width: int,
    height: int,
    world_to_camera: Floats,
    focal: tuple[float, float],
    principal: tuple[float, float],
    blur: float = PIXEL_VARIANCE,
) -> View:
    """Make a view from a camera as `fields.camera.Camera` describes one.

    Args:
        world_to_camera: (4, 4), in the Gaussians' float type.
        focal, principal: in pixels, x and y.
        blur: variance added to 2D covariances, in px^2.
    """
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    limits = JACOBIAN_LIMIT * width / (2 * focal[0]), JACOBIAN_LIMIT * height / (2 * focal[1])
    values = [*rotation.ravel(), *translation, *(-rotation.T @ translation), *focal, *principal, *limits, blur]
    return View(width, height, np.array(values, world_to_camera.dtype))


def _arrays(gaussians: Gaussians) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats, int]:
    """Flatten arrays for the projection kernels; missing colours or coefficients are empty."""
    sh, colors = (
        np.empty(0, gaussians.means.dtype) if array is None else array.reshape(-1)
        for array in (gaussians.sh, gaussians.colors)
    )
    means, quats, scales = (a.reshape(-1) for a in (gaussians.means, gaussians.quats, gaussians.scales))
    return means, quats, scales, gaussians.opacities, sh, colors, gaussians.columns


def list_tiles(n: int, boxes: NDArray[np.int32], depths: Floats, tiles_x: int, tiles: int) -> TileLists:
    """List the splats of each tile, front to back; see `ordering_kernels`."""
    from lapgs_plugin.reference_raster import ordering_kernels

    first_pair = empty(n + 1, np.int64)
    shown = ordering_kernels.count_pairs(n, boxes, first_pair)
    pairs = int(first_pair[n])
    keys = depths[:n].view(np.uint32 if depths.itemsize == 4 else np.uint64)
    order, spare = empty(shown, np.int32), empty(shown, np.int32)
    ordering_kernels.sort_by_depth(
        first_pair, keys, order, spare, empty(shown, keys.dtype), empty(shown, keys.dtype)
    )  # fmt: skip
    starts = np.zeros((num_threads(), tiles), np.int64)
    tile_start = np.empty(tiles + 1, np.int64)
    members, places = empty(pairs, np.int32), empty(pairs, np.int32)
    parallel(ordering_kernels.count_tiles, order, boxes, tiles_x, starts)
    ordering_kernels.start_tiles(starts, tile_start)
    parallel(ordering_kernels.list_by_tile, order, boxes, tiles_x, starts, first_pair, members, places)
    return first_pair, places, tile_start, members


@lru_cache
def offsets(kind: Any) -> Floats:
    """Return `tile_kernels.pixel_offsets` of a float type, aligned for vector loads."""
    from lapgs_plugin.reference_raster import tile_kernels

    unaligned = tile_kernels.pixel_offsets(kind)
    aligned = empty(unaligned.size, kind)
    np.copyto(aligned, unaligned)
    return aligned
