"""What a stage trains on: every view at the level's size, in a reproducible order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.runs.image_store import EIGHT_BIT_TOLERANCE, ImageStore, place
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.scenes.scene import View


@dataclass(frozen=True)
class LevelView:
    """A training view at one pyramid level.

    Attributes:
        name: of the image, unique in the scene.
        camera: the view's camera at the level's size.
    """

    name: str
    camera: Camera


class LevelImages:
    """The targets of a level's views, and of the next coarser one where a supervision looks at those.

    On a CPU targets are the views' own tensors. On a GPU an `ImageStore` brings them: 8-bit photographs as bytes,
    without loss, everything else in float16. Coarser ones wait at their own size.

    Args:
        views: at full resolution, their images on the CPU.
        level, levels: which one, of how many.
        pyramid: makes the targets, on `device`.
        with_coarse: also give Up of the coarser target, which only the `gt_laplacian` supervision looks at.
        device: where they are wanted.
    """

    def __init__(
        self, views: Sequence[View], level: int, levels: int, pyramid: Pyramid, with_coarse: bool, device: torch.device
    ) -> None:
        self._held: dict[str, Tensor] = {}
        self._targets = _empty_store(views, level, device) if _wants_store(device) else None
        self._coarse: UpsampledImages | None = None
        if with_coarse and level < levels - 1:
            precision = "float16" if _wants_store(device) else "float32"
            self._coarse = UpsampledImages(_empty_store(views, level + 1, device, precision), pyramid)
        for view in views:
            self._make(view, level, pyramid, device)

    def _make(self, view: View, level: int, pyramid: Pyramid, device: torch.device) -> None:
        images = pyramid.gaussian(view.image.to(device), level + 1 + (self._coarse is not None))
        target = images[level]
        if self._targets is None:
            self._held[view.name] = target.contiguous()
        else:
            self._targets.put(view.name, target)
        if self._coarse is not None:
            self._coarse.put(view.name, images[level + 1], (target.shape[1], target.shape[2]))

    def prefetch(self, name: str) -> None:
        """Start bringing a view's images, which the next iteration will ask for."""
        for store in self._stores:
            store.prefetch(name)

    def get(self, name: str) -> tuple[Tensor, Tensor | None]:
        """A view's target (3, h, w), and Up of the coarser one or None."""
        target = self._held[name] if self._targets is None else self._targets.get(name)
        return target, None if self._coarse is None else self._coarse.get(name)

    def get_batch(self, names: Sequence[str]) -> tuple[Tensor, Tensor | None]:
        """What `get` gives of several views of one size, (b, 3, h, w)."""
        if self._targets is None:
            target = torch.stack([self._held[name] for name in names])
        else:
            target = self._targets.get_batch(names)
        return target, None if self._coarse is None else self._coarse.get_batch(names)

    @property
    def bytes_on_device(self) -> int:
        """Bytes of them on a GPU."""
        return sum(store.bytes_on_device for store in self._stores)

    @property
    def stored_bytes(self) -> int:
        """Bytes of them wherever they wait to be brought."""
        return sum(store.bytes_on_device + store.bytes_in_memory for store in self._stores)

    def close(self) -> None:
        """Let go of everything."""
        self._held.clear()
        for store in self._stores:
            store.close()

    @property
    def _stores(self) -> list[ImageStore]:
        coarse = None if self._coarse is None else self._coarse.store
        return [store for store in (self._targets, coarse) if store is not None]


def _empty_store(views: Sequence[View], level: int, device: torch.device, precision: str | None = None) -> ImageStore:
    """A store for one image a view, in the place where it costs least."""
    if precision is None:
        precision = "uint8" if level == 0 and all(_is_eight_bit(view.image) for view in views) else "float16"
    return ImageStore(place(stored_bytes(views, level, precision), device), precision, device=device)


def stored_bytes(views: Sequence[View], level: int, precision: str) -> int:
    """What one image a view at a level takes."""
    sizes = (level_size((view.camera.width, view.camera.height), level) for view in views)
    return sum(3 * width * height for width, height in sizes) * {"uint8": 1, "float16": 2, "float32": 4}[precision]


def _wants_store(device: torch.device) -> bool:
    """Whether images are brought to the device one by one; on a CPU they are there."""
    return device.type == "cuda"


def _is_eight_bit(image: Tensor) -> bool:
    levels = (image * 255).round_()
    return bool(((levels / 255).sub_(image).abs_() <= EIGHT_BIT_TOLERANCE).all())


def level_views(views: Sequence[View], level: int) -> tuple[LevelView, ...]:
    """Every view's camera at `level`."""
    return tuple(LevelView(view.name, level_camera(view.camera, level)) for view in views)


def view_index(iteration: int, count: int, seed: int, level: int) -> int:
    """Which of `count` views iteration `iteration` (from 1) of a stage trains: every view once an epoch, shuffled.

    A pure function of its arguments, so that a resumed run sees the views an uninterrupted one would have seen.
    """
    epoch, position = divmod(iteration - 1, count)
    return _order(count, (seed * 1_000_003 + level) * 1_000_003 + epoch)[position]


@lru_cache(maxsize=4)
def _order(count: int, seed: int) -> list[int]:
    """The views of an epoch."""
    generator = torch.Generator().manual_seed(seed % 2**63)  # all that it takes; dates as seeds go beyond it
    order: list[int] = torch.randperm(count, generator=generator).tolist()
    return order
