"""Compose the levels of a hierarchy to images: I_hat^l = Up(I_hat^(l+1)) + R_hat^l."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.mixed_sizes import Sizes
from lapgs_plugin.ops.upsample import upsample, upsample_add

AS_TRAINED: Mapping[int, float] = MappingProxyType({})


@dataclass(frozen=True)
class Composition:
    """Hold one view, or a batch of views of one size, level by level. Sums are not clamped.

    Attributes:
        base: (3, h, w), or (b, 3, h, w) of a batch, like all images: the coarsest level's render over the background.
        residuals: by level, finest last: the signed render R_hat^l at that level's size. With nested levels it is
            I_hat^l - Up(I_hat^(l+1)). Base and residuals include their gains.
        composed: by level, finest last: I_hat^l at that level's size; at the coarsest level it is `base`.
    """

    base: Tensor
    residuals: dict[int, Tensor]
    composed: dict[int, Tensor]

    @property
    def image(self) -> Tensor:
        """The finest composed image."""
        return self.composed[min(self.composed)]

    def view(self, index: int) -> Composition:
        """Return one view of a batch."""
        residuals, composed = (
            {level: images[index] for level, images in band.items()} for band in (self.residuals, self.composed)
        )
        return Composition(self.base[index], residuals, composed)


def compose(
    pyramid: Pyramid,
    renders: Iterable[tuple[int, Tensor]],
    *,
    nested: bool = False,
    gains: Mapping[int, float] = AS_TRAINED,
    clamped: int | None = None,
    sizes: Sizes | None = None,
) -> Composition:
    """Compose the renders of contiguous levels, with gradients where these have them.

    Args:
        pyramid: Up between two levels.
        renders: level and image (3, h, w) or (b, 3, h, w), coarsest first. The first is an image; the others are
            residuals, or images as well where levels are nested.
        nested: whether every render is its level's whole image.
        gains: by level, the factor on its band; 1 for levels that are not in it.
        clamped: a level whose sum is clamped to [0, 1], the last one; None for none.
        sizes: (width, height) at full size of the views of a batch, if they differ; not with nested levels.

    Raises:
        UserInputError: no renders, levels that do not count down by one, or a render that is not twice the coarser one.
    """
    residuals: dict[int, Tensor] = {}
    composed: dict[int, Tensor] = {}
    base: Tensor | None = None
    render: Tensor | None = None
    as_trained = True
    for level, image in renders:
        coarser, render, gain = render, image, gains.get(level, 1.0)
        as_trained = as_trained and gain == 1.0
        if base is None or coarser is None:
            composed[level] = base = scaled(image, gain)
            continue
        if level + 1 not in composed:
            raise UserInputError(f"a render of level {level} after those of {list(composed)}: expected coarsest first")
        residual = image - pyramid.up(coarser, (image.shape[-2], image.shape[-1])) if nested else image
        residuals[level] = scaled(residual, gain)
        whole = nested and as_trained
        coarse, shown = composed[level + 1], level == clamped
        own = None if sizes is None else [level_size(size, level) for size in sizes]
        composed[level] = image if whole else upsample_add(pyramid, coarse, residuals[level], clamped=shown, sizes=own)
    if base is None:
        raise UserInputError("no renders: expected at least that of the coarsest level")
    return Composition(base, residuals, composed)


def add_prediction(render: Tensor, accumulated: Tensor | None) -> Tensor:
    """Return I_hat^l from R_hat^l and Up(I_hat^(l+1)), which is None below the coarsest level."""
    return render if accumulated is None else render + accumulated


def scaled(image: Tensor, gain: float) -> Tensor:
    """Return an image times its gain; nothing is computed for 1."""
    return image if gain == 1.0 else gain * image


def to_full_size(image: Tensor, size: tuple[int, int], level: int, pyramid: Pyramid, finest: int = 0) -> Tensor:
    """Upsample a composed image of `level` to the size of the full-resolution view, as if finer residuals were zero.

    Args:
        image: (3, h, w) at the size of `level`.
        size: (width, height) of the full-resolution view.
        finest: level at whose size to end instead.
    """
    for finer in range(level - 1, finest - 1, -1):
        width, height = level_size(size, finer)
        image = upsample(pyramid, image, (height, width))
    return image
