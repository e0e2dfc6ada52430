"""Store images of views at half their size and upsample them when they are used.

A residual stage needs Up of an image that has a quarter of its pixels; only that one is stored and copied.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from lapgs_plugin.hierarchy.pyramid import Pyramid, require_half
from lapgs_plugin.ops.mixed_sizes import if_mixed, largest_size
from lapgs_plugin.ops.photometric_loss import decoded
from lapgs_plugin.ops.upsample import upsample, upsample_add
from lapgs_plugin.runs.image_store import ImageStore


class UpsampledImages:
    """Return Up of images by name; `store` has the images before Up."""

    def __init__(self, store: ImageStore, pyramid: Pyramid) -> None:
        self.store, self.pyramid = store, pyramid
        self._sizes: dict[str, tuple[int, int]] = {}  # (width, height)

    def put(self, name: str, image: Tensor, size: tuple[int, int]) -> None:
        """Store a view's image (c, ceil(h / 2), ceil(w / 2)), replacing an earlier one; `get` returns it at (h, w).

        Raises:
            UserInputError: the image is not half of `size`; and all that `ImageStore.put` raises.
        """
        require_half(image, size)
        self.store.put(name, image)
        self._sizes[name] = size[1], size[0]

    @property
    def where(self) -> str:
        """As `ImageStore.where`."""
        return self.store.where

    def prefetch(self, name: str) -> None:
        """Start copying a view's stored image to the device; see `ImageStore.prefetch`."""
        self.store.prefetch(name)

    def get(self, *names: str) -> Tensor:
        """Return Up of an image, or of several, as a new tensor; see `ImageStore.get`."""
        sizes = [self._sizes[name] for name in names]
        width, height = largest_size(sizes)
        coarse = decoded(self.store.get_stored(*names))
        return upsample(self.pyramid, coarse, (height, width), if_mixed(sizes))

    def adder(self, names: Sequence[str]) -> Callable[[Tensor], Tensor]:
        """Return a function that adds Up of the images of some views to (c, h, w), or to (b, c, h, w).

        The images stay at half size until it is called.
        """
        stored = self.store.get_stored(*names)
        if stored.dtype == torch.uint8:
            stored = stored.div(255)
        sizes = if_mixed([self._sizes[name] for name in names])
        return partial(upsample_add, self.pyramid, stored, sizes=sizes)

    def close(self) -> None:
        """Drop all images and remove the files."""
        self.store.close()
