"""Read the views of a script's datasets once, and make its batches of them at a level's size."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import BatchSampler, RandomSampler, Sampler, SequentialSampler, default_collate

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.hierarchy.cameras import level_intrinsics
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.runs.level_images import LevelImages
from lapgs_plugin.scenes.parallel import in_threads

IMAGE = "image"
"""Entry of a dataset's item: the photo."""
MASK = "mask"
"""Entry of a dataset's item: which pixels count."""
POINTS = "points"
"""Entry of a dataset's item: where the scene's points are in the image, in pixels."""


@dataclass(frozen=True)
class SplatView:
    """Hold a view of a dataset.

    Attributes:
        name: of its image.
        item: what the dataset returned, without the image.
        pixels: (h, w, 3) uint8, on the CPU.
    """

    name: str
    item: Mapping[str, Any]
    pixels: Tensor  # (h, w, 3)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def image(self, device: torch.device) -> Tensor:
        """Return the image (3, h, w) in [0, 1], which is copied to the device in 8 bits."""
        return self.pixels.to(device).permute(2, 0, 1) / 255

    @property
    def mask(self) -> Tensor | None:
        """The mask (1, h, w) bool; None without one."""
        return self.item[MASK][None] if MASK in self.item else None

    @property
    def camera(self) -> Camera:
        """The camera at full size."""
        (fx, _, cx), (_, fy, cy), _ = self.item["K"].tolist()
        pose = torch.linalg.inv(self.item["camtoworld"].double()).float()
        return Camera(*self.size, fx, fy, cx, cy, pose)


def read_views(dataset: Any, names: Sequence[str], progress: bool = True) -> list[SplatView]:
    """Return the views of a dataset, whose items have at least "image" (h, w, 3) from 0 to 255, "K" and "camtoworld".

    Args:
        dataset: of the script.
        names: of the images, in its order.
        progress: whether a bar is shown.

    Raises:
        UserInputError: an image has values that are no 8-bit ones.
    """

    def read(index: int) -> SplatView:
        item = dict(dataset[index])
        image = item.pop(IMAGE)
        pixels = image.to(torch.uint8)
        if not torch.equal(pixels.to(image), image):
            raise UserInputError(
                f"{names[index]} has values that are no whole numbers from 0 to 255, expected an 8-bit image; convert "
                "it, or train with `lapgs run --off`"
            )
        return SplatView(names[index], item, pixels)

    return in_threads("Reading images", "images", read, range(len(dataset)), progress=progress)


class LevelBatches:
    """Make the batches of a script's training loop from its views at the running level's size.

    Takes the place of its `DataLoader`, in whose order views are drawn. Nothing is made ahead, because the level may
    change between two batches.

    Args:
        count: number of views.
        item: returns a view's item at the running level, by index.
        prefetch: called with the indices of the views of the batch that follows.
        begins: called before each batch.
        batch_size, shuffle, persistent: as of `DataLoader`.
    """

    def __init__(
        self,
        count: int,
        item: Callable[[int], Any],
        prefetch: Callable[[int], None],
        begins: Callable[[], None],
        batch_size: int,
        shuffle: bool,
        persistent: bool,
    ) -> None:
        indices = range(count)
        sampler: Sampler[int] = RandomSampler(indices) if shuffle else SequentialSampler(indices)
        self._order = BatchSampler(sampler, batch_size, drop_last=False)
        self._item, self._prefetch, self._begins = item, prefetch, begins
        self._persistent, self._seeded = persistent, False

    def __len__(self) -> int:
        return len(self._order)

    def __iter__(self) -> Iterator[Any]:
        if not (self._seeded and self._persistent):
            torch.empty((), dtype=torch.int64).random_()  # a loader draws a seed for its workers
            self._seeded = True
        order = iter(self._order)
        batch = next(order, None)
        while batch is not None:
            self._begins()
            items, batch = [self._item(index) for index in batch], next(order, None)
            for index in batch or ():
                self._prefetch(index)
            yield default_collate(items)


def level_item(view: SplatView, level: int, device: torch.device) -> dict[str, Any]:
    """Return what a dataset would return of a view if its images had a level's size, without image and mask."""
    size = level_size(view.size, level)
    item = {**view.item, "K": level_intrinsics(view.item["K"], view.size, level)}
    item.pop(MASK, None)
    if POINTS in item:  # (m, 2) in pixels
        factors = [part / of for part, of in zip(size, view.size, strict=True)]
        item[POINTS] = item[POINTS] * item[POINTS].new_tensor(factors)
    return {name: value.to(device) if isinstance(value, Tensor) else value for name, value in item.items()}


def level_pixels(view: SplatView, images: LevelImages) -> dict[str, Tensor]:
    """Return the image (h, w, 3) from 0 to 255 and the mask (h, w), if there is one, that a dataset would return."""
    stored = images.targets.get_stored(view.name)  # (3, h, w)
    image = stored.float() if stored.dtype == torch.uint8 else stored.float() * 255
    weights = images.get_weights(view.name) if MASK in view.item else None
    return {IMAGE: image.permute(1, 2, 0), **({} if weights is None else {MASK: weights[0] > 1 - 0.5 / 255})}


def camera_inputs(view: SplatView, level: int, config: Any, device: torch.device) -> dict[str, Any]:
    """Return the inputs of `rasterization` for a view at a level's size, besides those of a field.

    Args:
        view, level: which camera, and how many halvings smaller.
        config: settings of the script.
        device: that renders.
    """
    width, height = level_size(view.size, level)
    return {
        "viewmats": view.camera.world_to_camera.to(device)[None],
        "Ks": level_intrinsics(view.item["K"], view.size, level).to(device)[None].float(),
        "width": width,
        "height": height,
        "near_plane": config.near_plane,
        "far_plane": config.far_plane,
        "rasterize_mode": "antialiased" if getattr(config, "antialiased", False) else "classic",
        "packed": getattr(config, "packed", False),
    }
