"""Store the images that a stage trains on, and return them on the training device by the name of their view."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from lapgs_plugin.hierarchy.masks import masked_gaussian
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.ops.mixed_sizes import stack_padded
from lapgs_plugin.ops.photometric_loss import decoded
from lapgs_plugin.runs.image_store import DTYPES, ImageStore, choose_place
from lapgs_plugin.runs.upsampled_images import UpsampledImages


@dataclass(frozen=True)
class ImageStores:
    """Make stores for one image a view.

    Attributes:
        sizes: (width, height) of all views at full size.
        device: of the images that the stores return.
        eight_bit: whether all full-size images are 8-bit ones.
        where: a place of `ImageStore`; AUTO chooses one by the size of the images. "gpu" is memory for a CPU.
        folder: for images on the disk.
    """

    sizes: Sequence[tuple[int, int]]
    device: torch.device
    eight_bit: bool = False
    where: str = AUTO
    folder: Path | None = None

    def target_precision(self, level: int) -> str:
        """Return the precision of targets: 8-bit photos are exact in uint8 at full size, their averages are not."""
        return "uint8" if level == 0 and self.eight_bit else "float16"

    def num_bytes(self, level: int, precision: str) -> int:
        """Return the bytes of the images of all views at a level."""
        pixels = sum(math.prod(level_size(size, level)) for size in self.sizes)
        return 3 * pixels * DTYPES[precision].itemsize

    def make(self, level: int, precision: str, name: str, beside: int = 0) -> ImageStore:
        """Return an empty store for images of a level; `beside` are bytes of others that are needed with them."""
        where = self.where
        if where == AUTO:
            where = choose_place(self.num_bytes(level, precision) + beside, self.device)
        elif where == "gpu" and self.device.type == "cpu":
            where = "memory"
        folder = None if self.folder is None else self.folder / name
        return ImageStore(where, precision, device=self.device, folder=folder)

    def make_upsampled(self, level: int, precision: str, name: str, pyramid: Pyramid) -> UpsampledImages:
        """Return an empty store for images of a level that the next finer one uses upsampled, beside its targets."""
        targets = self.num_bytes(level - 1, self.target_precision(level - 1))
        return UpsampledImages(self.make(level, precision, name, beside=targets), pyramid)


class HeldImages:
    """Keep images as the tensors they are. It has those methods of an `ImageStore` that training calls."""

    where = "memory"
    bytes_on_device = 0  # nothing has to be copied

    def __init__(self) -> None:
        self._images: dict[str, Tensor] = {}

    def put(self, name: str, image: Tensor) -> None:
        self._images[name] = image.contiguous()

    def prefetch(self, name: str) -> None:
        """Do nothing: images are on the device."""

    def get(self, *names: str) -> Tensor:
        return self._images[names[0]] if len(names) == 1 else stack_padded([self._images[name] for name in names])

    get_stored = get

    def close(self) -> None:
        self._images.clear()


class LevelImages:
    """Store the images of one level: I^l, and Up(I^(l+1)) for supervisions that need it.

    Args:
        level: l.
        with_coarse: also store I^(l+1).
        masked: whether views have masks.
        exact: keep the images as float32, without encoding them, for training on a CPU.

    Attributes:
        targets: I^l.
        coarse: Up(I^(l+1)); None unless asked for.
        weights: share of each pixel inside of the mask; None without masks.
    """

    def __init__(
        self,
        stores: ImageStores,
        level: int,
        pyramid: Pyramid,
        *,
        with_coarse: bool = False,
        masked: bool = False,
        exact: bool = False,
    ) -> None:
        self._level, self._pyramid, self._device = level, pyramid, stores.device

        def store(precision: str, name: str) -> ImageStore | HeldImages:
            if exact and stores.where != "disk":
                return HeldImages()
            return stores.make(level, "float32" if exact else precision, f"{name}_{level}")

        self.targets = store(stores.target_precision(level), "targets")
        self.coarse: UpsampledImages | None = None
        if with_coarse:
            precision = "float32" if exact else "float16"
            self.coarse = stores.make_upsampled(level + 1, precision, f"coarse_{level}", pyramid)
        self.weights = store("uint8", "weights") if masked else None

    def put(self, name: str, image: Tensor, mask: Tensor | None = None, *, with_coarse: bool = True) -> None:
        """Make and store the images of a view.

        Args:
            image: (3, h, w) at full size, floats, or uint8 levels k of k / 255.
            mask: (1, h, w), False where the image is ignored; None uses all of it.
            with_coarse: False for a view whose Up(I^(l+1)) is not needed.
        """
        coarse = self.coarse if with_coarse else None
        # Levels are contiguous and floats on a GPU, where that takes no time.
        image, levels = decoded(image.to(self._device).contiguous()), self._level + 1 + (coarse is not None)
        if mask is None:
            images = self._pyramid.gaussian(image, levels)
            weight = torch.ones_like(images[self._level][:1])
        else:
            masked = masked_gaussian(self._pyramid, image, mask.to(self._device), levels)
            images, weight = [levels_image for levels_image, _ in masked], masked[self._level][1]
        if self.weights is not None:
            self.weights.put(name, weight)
        target = images[self._level]
        self.targets.put(name, target)
        if coarse is not None:
            coarse.put(name, images[self._level + 1], (target.shape[1], target.shape[2]))

    @property
    def takes_readers(self) -> bool:
        """Whether an image is on the disk as it is at full size, so that `put_reader` can leave it in its own file."""
        return self._level == 0 and self.targets.where == "disk" and self.coarse is None and self.weights is None

    def put_reader(self, name: str, size: tuple[int, int], read: Callable[[], Tensor]) -> None:
        """Store I^0 of a view of this (width, height) as `ImageStore.put_reader` does."""
        assert self.takes_readers
        assert isinstance(self.targets, ImageStore)
        self.targets.put_reader(name, (3, size[1], size[0]), read)

    def prefetch(self, *names: str) -> None:
        """Start copying the images of views to the device."""
        for store in self.stores:
            for name in names:
                store.prefetch(name)

    def get(self, *names: str) -> tuple[Tensor, Tensor | None]:
        """Return I^l of views as `ImageStore.get` does, and Up(I^(l+1)) or None."""
        return self.targets.get(*names), None if self.coarse is None else self.coarse.get(*names)

    def get_weights(self, *names: str) -> Tensor | None:
        """Return the weights (1, h, w) of a view or (b, 1, h, w) of several; None without masks."""
        return None if self.weights is None else self.weights.get(*names)

    @property
    def stores(self) -> Iterable[ImageStore | HeldImages]:
        """The stores of the images."""
        coarse = None if self.coarse is None else self.coarse.store
        return tuple(store for store in (self.targets, coarse, self.weights) if store is not None)

    @property
    def bytes_on_device(self) -> int:
        """Bytes of the images on a GPU."""
        return sum(store.bytes_on_device for store in self.stores)

    def close(self) -> None:
        """Drop all images."""
        for store in self.stores:
            store.close()
