"""Images of views that wait at half their size and are raised when somebody looks at them.

What a residual stage builds on is Up of an image of a quarter of its pixels. That one is what is kept, and what travels
to the device.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lapgs_plugin.hierarchy.pyramid import Pyramid, require_half
from lapgs_plugin.ops.upsample import upsample
from lapgs_plugin.runs.image_store import ImageStore


class UpsampledImages:
    """Up of images by name.

    Attributes:
        store: keeps the images as they are before Up; where and how precisely is its affair.
        pyramid: Up between two levels.
    """

    def __init__(self, store: ImageStore, pyramid: Pyramid) -> None:
        self.store, self.pyramid = store, pyramid
        self._sizes: dict[str, tuple[int, int]] = {}

    def put(self, name: str, image: Tensor, size: tuple[int, int]) -> None:
        """Keep an image, in place of what was kept under the name before.

        Args:
            name: of the view.
            image: (c, ceil(h / 2), ceil(w / 2)), as `ImageStore.put` takes it.
            size: (h, w) of what `get` will give, height first.

        Raises:
            UserInputError: the image is not half of `size`; and whatever `ImageStore.put` raises.
        """
        require_half(image, size)
        self.store.put(name, image)
        self._sizes[name] = size

    def prefetch(self, name: str) -> None:
        """Start bringing what a view's image is made of to the device; see `ImageStore.prefetch`."""
        self.store.prefetch(name)

    @torch.no_grad()
    def get(self, name: str) -> Tensor:
        """(c, h, w) Up of an image on the device, float32, made anew by every call; see `ImageStore.get`."""
        return upsample(self.pyramid, self.store.get(name), self._sizes[name])

    def close(self) -> None:
        """Forget everything and remove the files."""
        self.store.close()

    @torch.no_grad()
    def get_batch(self, names: Sequence[str]) -> Tensor:
        """(b, c, h, w) Up of several images of one size, in as many launches as for one; see `get`."""
        return upsample(self.pyramid, self.store.get_batch(names), self._sizes[names[0]])
