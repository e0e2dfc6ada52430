"""Build image pyramids: Down and Up as a pair, Gaussian and Laplacian pyramids, reconstruction.

Down is the 5-tap binomial blur of Burt and Adelson (1983) followed by halving, odd sides rounded up. Up resizes to the
exact finer size and applies the same blur. Both act on rows and columns separately, preserve constants, and clamp
nothing.

A pixel grid defines where a coarse pixel lies among the fine ones. For a side of n fine and m = ceil(n / 2) coarse
pixels:

    camera   coarse i is at fine (i + 0.5) n / m - 0.5, where a camera with the same field of view at the coarse size
             sees it. For even n it is the middle of a pair of fine pixels. This is the default.
    even     coarse i is at fine 2 i: every second pixel is kept, as in OpenCV's pyrDown. It blurs a little less, and
             the image is shifted against the cameras by half a fine pixel per level.

The paper authors' release pairs Down of the even grid with Up of the camera grid, half a fine pixel apart. Its runs are
rendered on that grid, "mixed", which is not offered for training.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.settings import GRIDS

MIXED_GRID = "mixed"
"""Down of "even" with Up of "camera": the grid of runs of the paper authors' release."""
BLUR_RADIUS = 2


class Pyramid:
    """Downsample and upsample images on one pixel grid, and build pyramids.

    Images are (..., h, w) of any float type on any device, usually (3, h, w); results have the type and device of their
    argument. Half-precision images are filtered in float32 and rounded once. Everything is linear and differentiable.
    An image of integers raises UserInputError.

    Args:
        grid: "camera" or "even", or "mixed" for runs of the paper authors' release; see the module.

    Raises:
        UserInputError: another name.
    """

    def __init__(self, grid: str = "camera") -> None:
        if grid not in (*GRIDS, MIXED_GRID):
            raise UserInputError(f"--grid {grid}: expected {' or '.join(GRIDS)}")
        self.grid = grid

    def down(self, image: Tensor) -> Tensor:
        """Downsample (..., h, w) to (..., ceil(h / 2), ceil(w / 2))."""
        values = _working_precision(image)
        for dim in (-2, -1):  # rows first: halving them is cheap and halves the work on the columns
            fine = values.shape[dim]
            values = _sample(_blur(values, dim), dim, self._coarse_centres(fine, (fine + 1) // 2))
        return values.to(image.dtype)

    def up(self, image: Tensor, size: tuple[int, int]) -> Tensor:
        """Upsample (..., ceil(h / 2), ceil(w / 2)) to (..., h, w) = `size`.

        Raises:
            UserInputError: the image is not half of `size`.
        """
        require_half(image, size)
        values = _working_precision(image)
        for dim in (-1, -2):  # columns first, while there are half as many rows
            fine = size[dim]
            values = _blur(_sample(values, dim, self._fine_centres(fine, (fine + 1) // 2)), dim)
        return values.to(image.dtype)

    def up_taps(self, fine: int) -> tuple[Tensor, Tensor]:
        """Return Up to a side of `fine` as weighted sums: fine[i] = sum over k of weights[i, k] * coarse[first[i] + k].

        Returns:
            first (fine,) int64 and weights (fine, k) float64, k at most 5, both on the CPU.
        """
        coarse = (fine + 1) // 2
        centres = self._fine_centres(fine, coarse)
        lower, upper, fraction = _neighbours(coarse, centres, torch.float64, torch.device("cpu"))
        fraction = torch.zeros(fine, dtype=torch.float64) if fraction is None else fraction
        offsets = torch.arange(-BLUR_RADIUS, BLUR_RADIUS + 1)
        blurred = _reflected(torch.arange(fine)[:, None] + offsets, fine)  # (fine, 5)
        binomial = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0], dtype=torch.float64) / 16
        parts = torch.cat([lower[blurred], upper[blurred]], 1)  # (fine, 10) coarse samples, some of them the same
        shares = torch.cat([(1 - fraction[blurred]) * binomial, fraction[blurred] * binomial], 1)
        used = shares > 0
        first = torch.where(used, parts, coarse).amin(1)
        taps = int((torch.where(used, parts, 0).amax(1) - first).max()) + 1
        first = first.clamp_max(coarse - taps)
        weights = torch.zeros(fine, taps, dtype=torch.float64)
        return first, weights.scatter_add_(1, torch.where(used, parts - first[:, None], 0), shares)

    def gaussian(self, image: Tensor, levels: int) -> list[Tensor]:
        """Build the Gaussian pyramid I^0 = `image`, I^(l+1) = Down(I^l), finest first: `levels` images (..., h, w).

        Raises:
            UserInputError: fewer than one level.
        """
        if levels < 1:
            raise UserInputError(f"a pyramid of {levels} levels: expected at least 1")
        images = [image]
        while len(images) < levels:
            images.append(self.down(images[-1]))
        return images

    def laplacian(self, image: Tensor, levels: int) -> list[Tensor]:
        """Build the Laplacian pyramid R^l = I^l - Up(I^(l+1)) for l < levels - 1, then I^(levels-1); finest first.

        Raises:
            UserInputError: fewer than one level.
        """
        images = self.gaussian(image, levels)
        residuals = [fine - self.up(coarse, (fine.shape[-2], fine.shape[-1])) for fine, coarse in pairwise(images)]
        return [*residuals, images[-1]]

    def _coarse_centres(self, fine: int, coarse: int) -> tuple[float, float, int]:
        """Return where coarse samples lie among the fine ones: first position, spacing, count."""
        if self.grid != "camera":
            return 0.0, 2.0, coarse
        return 0.5 * fine / coarse - 0.5, fine / coarse, coarse

    def _fine_centres(self, fine: int, coarse: int) -> tuple[float, float, int]:
        """Return where fine samples lie among the coarse ones, likewise."""
        if self.grid == "even":
            return 0.0, 0.5, fine
        return 0.5 * coarse / fine - 0.5, coarse / fine, fine


def require_half(image: Tensor, size: tuple[int, int]) -> None:
    """Check that an image can be upsampled to (h, w) = `size`.

    Raises:
        UserInputError: it is not half of that, rounded up.
    """
    halved = tuple((side + 1) // 2 for side in size)
    if tuple(image.shape[-2:]) != halved:
        raise UserInputError(
            f"Up to {size[0]}x{size[1]} (height x width) needs an image of {halved[0]}x{halved[1]}, "
            f"got {image.shape[-2]}x{image.shape[-1]}"
        )


def transposed_taps(first: Tensor, weights: Tensor, samples: int) -> tuple[Tensor, Tensor]:
    """Return the taps of the transposed sums, which gradients take.

    Args:
        first (n,), weights (n, k): sums over coarse samples, as `Pyramid.up_taps` returns them.
        samples: number of coarse samples.

    Returns:
        first (samples,) and weights (samples, j) of sums over n fine samples, in the same form.
    """
    n, taps = weights.shape
    summed = first[:, None] + torch.arange(taps)  # (n, k)
    used = weights != 0
    sums = torch.arange(n)[:, None].expand(n, taps)[used]
    earliest = torch.full((samples,), n).scatter_reduce_(0, summed[used], sums, "amin")
    latest = torch.zeros(samples, dtype=torch.int64).scatter_reduce_(0, summed[used], sums, "amax")
    most = int((latest - earliest).max()) + 1
    earliest = earliest.clamp_max(n - most)
    back = weights.new_zeros(samples, most)
    back[summed[used], sums - earliest[summed[used]]] = weights[used]
    return earliest, back


def _working_precision(image: Tensor) -> Tensor:
    if not image.is_floating_point():
        raise UserInputError(f"an image of {image.dtype}: expected floats; divide levels from 0 to 255 by 255.0")
    return image.float() if image.dtype in (torch.float16, torch.bfloat16) else image


def _blur(image: Tensor, dim: int) -> Tensor:
    """Convolve one dimension with (1 4 6 4 1) / 16, mirrored at the border without repeating the edge pixel."""
    n = image.shape[dim]
    before, after = _mirrored(n, image.device)
    padded = torch.cat([image.index_select(dim, before), image, image.index_select(dim, after)], dim)
    taps = [padded.narrow(dim, offset, n) for offset in range(2 * BLUR_RADIUS + 1)]
    # Sums of shifted views: faster on a CPU than a convolution of one channel.
    total = taps[0] + taps[4]
    return total.add_(taps[1], alpha=4).add_(taps[3], alpha=4).add_(taps[2], alpha=6).mul_(1 / 16)


@lru_cache(maxsize=256)
@torch.inference_mode(False)  # cached for later calls, which may need gradients
def _mirrored(n: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the samples that pad a side of n before and after; sides of 1 and 2 are mirrored repeatedly."""
    before, after = _reflected(torch.tensor([[-2, -1], [n, n + 1]]), n).to(device)
    return before, after


def _reflected(positions: Tensor, n: int) -> Tensor:
    """Map integer positions to the n samples of a side, mirrored at its ends."""
    period = max(2 * (n - 1), 1)
    around = positions % period
    return torch.minimum(around, period - around).clamp_max(n - 1)


def _sample(image: Tensor, dim: int, centres: tuple[float, float, int]) -> Tensor:
    """Interpolate one dimension linearly at evenly spaced positions; constant beyond the ends."""
    lower, upper, fraction = _neighbours(image.shape[dim], centres, image.dtype, image.device)
    if fraction is None:
        return _take(image, dim, lower)
    shape = [1] * image.ndim
    shape[dim] = -1
    return torch.lerp(_take(image, dim, lower), _take(image, dim, upper), fraction.view(shape))


def _take(image: Tensor, dim: int, index: Tensor) -> Tensor:
    """Select samples of one dimension. On a CPU index_select is fast for rows and slow for columns."""
    return image[..., index] if dim == -1 else image.index_select(dim, index)


@lru_cache(maxsize=256)
@torch.inference_mode(False)  # cached for later calls, which may need gradients
def _neighbours(
    n: int, centres: tuple[float, float, int], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return the samples on both sides of each position, and the upper one's weight; None if all are on samples."""
    first, distance, count = centres
    positions = (first + distance * torch.arange(count, dtype=torch.float64)).clamp(0, n - 1)
    lower = positions.floor().long()
    fraction = positions - lower
    upper = (lower + 1).clamp_max(n - 1)
    weight = fraction.to(device, dtype) if bool(fraction.any()) else None
    return lower.to(device), upper.to(device), weight
