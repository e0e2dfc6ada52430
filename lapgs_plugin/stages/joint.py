"""Predict views by finished levels in joint training: rendered, with gradients, instead of read from a cache.

A frozen coarse level cannot correct errors that the finer level is unable to represent. So towards the end of a
residual stage the finished fields are rendered in every iteration, and step whenever the residual does. Each adds the
launches of a render to an iteration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from torch import Tensor

from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.composition import compose
from lapgs_plugin.ops.mixed_sizes import Sizes, if_mixed, largest_size
from lapgs_plugin.ops.upsample import upsample, upsample_add
from lapgs_plugin.runs.upsampled_images import UpsampledImages


@dataclass(frozen=True)
class RenderedPredictions:
    """Predict views by rendering finished levels. It has those methods of `UpsampledImages` that training calls.

    Attributes:
        levels: of the fields, coarsest first.
        render: returns the image (3, h, w) of a level's field for a view, or (b, 3, h, w) of several.
        sizes: (width, height) of the views at full size, by name.
        pyramid: Up between two levels.
    """

    levels: Sequence[int]
    render: Callable[[int, Sequence[str]], Tensor]
    sizes: Mapping[str, tuple[int, int]]
    pyramid: Pyramid

    where = "gpu"  # nothing has to be copied

    def prefetch(self, name: str) -> None:
        """Do nothing: predictions are rendered."""

    def get(self, *names: str) -> Tensor:
        """Return Up of the levels' composed image, (3, h, w) of a view or (b, 3, h, w) of several.

        Those of several sizes are padded, see `ops.mixed_sizes`.
        """
        sizes = self._sizes(names, self.levels[-1] - 1)
        width, height = largest_size(sizes)
        return upsample(self.pyramid, self._composed(names), (height, width), if_mixed(sizes))

    def adder(self, names: Sequence[str]) -> Callable[[Tensor], Tensor]:
        """Return the function that adds `get` of the views to an image of that shape."""
        sizes = if_mixed(self._sizes(names, self.levels[-1] - 1))
        return partial(upsample_add, self.pyramid, self._composed(names), sizes=sizes)

    def _composed(self, names: Sequence[str]) -> Tensor:
        """Return the composed image of the finest level."""
        renders = ((level, self.render(level, names)) for level in self.levels)
        return compose(self.pyramid, renders, sizes=if_mixed(self._sizes(names, 0))).image

    def _sizes(self, names: Sequence[str], level: int) -> Sizes:
        return [level_size(self.sizes[name], level) for name in names]


Predictions = UpsampledImages | RenderedPredictions
"""Upsampled predictions of the coarser levels by view: cached, or rendered."""
