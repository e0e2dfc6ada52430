"""Sort Gaussians into tiles and blend them, without a GPU that waits for the processor to learn the number of pairs.

How much memory the pairs of Gaussians and tiles take is only known on the GPU. So there is room for as many as the
renders before had, and some more. Sorting and blending are launched with that room, and pairs that have no place in it
are left out. Then the processor reads the number of pairs, which the GPU knew before it began to sort: while it sorts
and blends, it has work, and the processor goes on in time. If there was too little room, both are launched again with
enough. This happens before anybody gets the image, and is seldom. By the family's rules the processor first launches
all else that belongs to a render.

Where gsplat's CUDA part is built already, its sorting is used, which takes the processor less time to launch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from torch import Tensor

from lapgs_plugin.errors import DeviceMemoryError
from lapgs_plugin.gpu_raster.arriving_number import ArrivingNumber
from lapgs_plugin.gpu_raster.bindings import compiled_functions, sort_by_gsplat
from lapgs_plugin.gpu_raster.records import Blended, Projected, grid_of
from lapgs_plugin.gpu_raster.rules import Rules

if TYPE_CHECKING:
    from lapgs_plugin.gpu_raster.replay import Frame

T = TypeVar("T")
Tiles = tuple[Tensor, Tensor]
"""Offsets and Gaussians of pairs, as `blend_kernels.blend_family` takes them."""
Blending = tuple[Tensor, Tensor, Tensor, Tensor]
"""Results of `blend_kernels.blend_family`."""

MARGIN = 1.125
"""Room for pairs, by their number in the last renders."""
FORGOTTEN = 0.02
"""Share of that room that is given up with each render."""
LEAST_ROOM = 2**14
"""Pairs that there is always room for."""
MOST_PAIRS = 2**31 - 2**9
"""Most pairs whose places our kernels can number."""

_rooms: dict[tuple[Any, ...], float] = {}  # by device, size, and number of images or rules; estimates


def blend_in_tiles(
    projected: Sequence[Tensor], background: Tensor, size: tuple[int, int], count: int = 1,
    of_image: Tensor | None = None, alphas: Tensor | None = None,
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:  # fmt: skip
    """Sort Gaussians into tiles, front to back, and blend them.

    Args:
        projected: radii (c, n, 2), centres (c, n, 2), depths (c, n) and records (c, n, RECORD); or, without the
            leading dimension, those of several images in one list.
        background: as `blend_forward` takes it.
        size: (width, height) of all images.
        count: number of images.
        of_image: in a list, the image number (n,) of each Gaussian.
        alphas: as `blend_forward` takes them.

    Returns:
        Offsets and Gaussians of pairs as `blend_forward` takes them, and its results.

    Raises:
        DeviceMemoryError: there are 2**31 pairs or more.
    """
    from lapgs_plugin.gpu_raster.blend_kernels import blend_forward

    radii, means2d, depths, records = projected[:4]
    filled: dict[str, Any] = {} if alphas is None else {"alphas": alphas}
    if records.is_cuda and (compiled := compiled_functions()) is not None:
        tiles = sort_by_gsplat(compiled, radii, means2d, depths, of_image, count, size)
        return tiles, blend_forward(records, background, *tiles, size, count, **filled)
    from lapgs_plugin.gpu_raster.tile_kernels import sort_by_depth, sort_by_tile

    grid = grid_of(size)
    order, ends = sort_by_depth(radii, means2d, depths, grid)

    def attempt(room: int) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]:
        tiles = sort_by_tile(radii, means2d, order, ends, of_image, count, grid, room)
        return tiles, blend_forward(records, background, *tiles, size, count, **filled)

    return _with_room((records.device, *size, count), ends[-1], attempt)


def blend_family_in_tiles(
    projected: Projected,
    background: Tensor,
    size: tuple[int, int],
    rules: Rules,
    mult: float,
    summed: bool,
    frame: Frame | None = None,
) -> tuple[Tiles, Blending, Tensor | None, Pairs]:
    """Sort Gaussians of one camera into tiles, front to back, and blend them by the family's rules.

    Args:
        background: (3,) on any device.
        size, rules, mult: as `blend_family` takes them.
        summed: whether to return sums over pixels.
        frame: that they were projected to.

    Returns:
        Offsets and Gaussians of pairs as `blend_family` takes them, its results, sums as `sums_over_pixels` returns
        them but for those of weights, of at least as many Gaussians, and the pairs. If these do not fit, all has to be
        made again.

    Raises:
        DeviceMemoryError: there are 2**31 pairs or more.
    """
    from lapgs_plugin.gpu_raster.tile_kernels import sort_by_depth, sort_by_tile

    radii, means2d, depths, records = projected[:4]
    key = records.device, *size, rules
    if frame is not None:
        pairs = Pairs(key, frame.sort())
        return *frame.blend(background, pairs.room), pairs
    grid = grid_of(size)
    order, ends = sort_by_depth(radii, means2d, depths, grid, True)
    pairs = Pairs(key, ArrivingNumber.of(ends[-1]))
    tiles = sort_by_tile(radii, means2d, order, ends, None, 1, grid, pairs.room, True)
    background = background.to(records).contiguous()
    return tiles, *blend_and_sum(records, background, tiles, size, rules, mult, summed), pairs


def blend_and_sum(
    records: Tensor, background: Tensor, tiles: Tiles, size: tuple[int, int], rules: Rules, mult: float, summed: bool
) -> tuple[Blending, Tensor | None]:
    """Return the results of `blend_family`, and if `summed` sums over pixels, those of weights without meaning."""
    from lapgs_plugin.gpu_raster.blend_kernels import blend_family
    from lapgs_plugin.gpu_raster.sum_kernels import sums_over_pixels

    blending = blend_family(records, background, *tiles, size, rules, mult)
    if not summed:
        return blending, None
    image, _, counts, words = blending
    return blending, sums_over_pixels(Blended(records, *tiles, image, counts, words), image)


def _with_room(key: tuple[Any, ...], number: Tensor, attempt: Callable[[int], T]) -> T:
    """Return what an attempt with enough room makes.

    Args:
        key: as `Pairs` takes it.
        number: of pairs, on the device.
        attempt: launches what has room for as many pairs.
    """
    while True:
        pairs = Pairs(key, ArrivingNumber.of(number))
        result = attempt(pairs.room)
        if pairs.fit():
            return result
        del result  # its memory is needed


class Pairs:
    """Estimate how many pairs a render has, and say later whether there was room for all.

    Args:
        key: of renders that have about as many.
        number: of pairs.

    Attributes:
        room: for pairs.

    Raises:
        DeviceMemoryError: there are 2**31 pairs or more.
    """

    def __init__(self, key: tuple[Any, ...], number: ArrivingNumber) -> None:
        self._key, self._number = key, number
        try:
            self.room = _rounded(_rooms[key] if key in _rooms else MARGIN * self._number.read())
        except DeviceMemoryError:
            _rooms.pop(key, None)  # the next render may have fewer
            raise

    def fit(self) -> bool:
        """Wait for their number, from which the next render has its room; return whether there was room for all."""
        number = self._number.read()
        _rooms[self._key] = max(MARGIN * number, (1 - FORGOTTEN) * _rooms.get(self._key, 0.0))
        return number <= self.room


def _rounded(pairs: float) -> int:
    """Round up to a number that comes often, so that PyTorch has memory of that size."""
    if pairs > MARGIN * MOST_PAIRS:
        raise DeviceMemoryError(
            f"the GPU would have to sort {pairs / MARGIN:.3g} pairs of Gaussians and tiles of 16x16 pixels, and "
            f"{MOST_PAIRS} at most can be; fewer or smaller Gaussians, fewer views at once or smaller images make fewer"
        )
    step = max(LEAST_ROOM, 1 << max(int(pairs).bit_length() - 5, 0))
    return min(max(-(-int(pairs) // step), 1) * step, MOST_PAIRS)
