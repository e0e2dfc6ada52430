"""Make views of a checkout's scene at a level's size, with images from a store instead of from the cameras."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, SupportsIndex

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.runs.image_store import eight_bit_levels
from lapgs_plugin.scenes.masks import ALPHA, NONE, find_masks, read_mask, resolve_masks


@dataclass(frozen=True)
class FullSizeImage:
    """Hold a full-size image (3, h, w) on the CPU: uint8 if all values are k/255, otherwise float16."""

    stored: Tensor  # (3, h, w)

    @classmethod
    def of(cls, image: Tensor) -> FullSizeImage:
        """Return the image for values (3, h, w) in [0, 1]."""
        if (levels := eight_bit_levels(image)) is not None:
            return cls(levels.cpu())
        return cls(image.to("cpu", torch.float16))

    @property
    def exact(self) -> bool:
        """Whether it is an 8-bit image, stored without rounding."""
        return self.stored.dtype == torch.uint8

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)"""
        return self.stored.shape[2], self.stored.shape[1]

    def load(self, device: torch.device) -> Tensor:
        """Return the image (3, h, w) in [0, 1] on a device, float32."""
        moved = self.stored.to(device)
        return moved / 255 if self.exact else moved.float()


class SceneImages:
    """Take a scene's images out of its cameras when these are made, and look them up by key.

    Keys are unique even if names are not: Blender scenes have an r_0 for training and another for testing.

    Attributes:
        masks: (1, h, w) bool by key, False where the image is ignored; empty without masks.
    """

    def __init__(self) -> None:
        self._images: dict[str, FullSizeImage] = {}
        self._keys: dict[int, str] = {}
        self.masks: dict[str, Tensor] = {}
        self._cameras: list[Any] = []  # objects that live keep their ids, which `_keys` has

    def adopting(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return a replacement of the checkout's Camera class that takes the image out of every camera it makes."""

        def make_camera(*args: Any, **kwargs: Any) -> Any:
            # Avoids a copy of the image to the GPU and back.
            camera = original(*args, **{**kwargs, "data_device": "cpu"})
            channels = len(camera.original_image)
            if channels != 3:
                raise UserInputError(
                    f"image {camera.image_name}: the checkout reads {channels} channel(s) of it, expected 3; save the "
                    "scene's images as RGB"
                )
            key = f"{len(self._images):05d}-{camera.image_name}"
            self._images[key] = FullSizeImage.of(camera.original_image)
            del camera.original_image
            self._keys[id(camera)] = key
            self._cameras.append(camera)
            return camera

        return make_camera

    def read_masks(self, scene: Path, setting: str) -> None:
        """Read the mask of every image; `setting` is a value of --masks.

        Raises:
            SceneError, UserInputError: as `scenes.masks`; or the value is "alpha".
        """
        resolved = resolve_masks(scene, setting)
        if resolved == ALPHA:
            raise UserInputError(
                "--masks alpha: the checkout decides what alpha channels mean to it; give a folder of masks"
            )
        if resolved == NONE:
            return
        files = find_masks(scene / resolved, [view_name(key) for key in self._images])
        for key, image in self._images.items():
            self.masks[key] = read_mask(files[view_name(key)], image.size, image.size)

    @property
    def exact(self) -> bool:
        """Whether all images are 8-bit images."""
        return all(image.exact for image in self._images.values())

    def key(self, camera: Any) -> str:
        """Return the key of a camera's image.

        Raises:
            UserInputError: the camera was not made by the replaced class.
        """
        try:
            return self._keys[id(camera)]
        except KeyError:
            raise UserInputError(
                f"camera {getattr(camera, 'image_name', '?')} of the checkout was not made by "
                "utils.camera_utils.Camera, expected of every camera of the scene; this checkout loads scenes "
                "in another way: use `lapgs run --off`"
            ) from None

    def __getitem__(self, key: str) -> FullSizeImage:
        return self._images[key]

    def smallest_size(self) -> tuple[int, int]:
        """Return the smallest width and the smallest height over all images, as `Scene.smallest_size` does."""
        sizes = [image.size for image in self._images.values()]
        return min(width for width, _ in sizes), min(height for _, height in sizes)


def view_name(key: str) -> str:
    """Return the checkout's name of the image with a key of `SceneImages`."""
    return key.partition("-")[2]


def make_level_view(camera: Any, size: tuple[int, int], image: Callable[[], Tensor]) -> Any:
    """Return a copy of a camera with another size, whose `original_image` is loaded on every access.

    Args:
        camera: the checkout's camera; the copy shares all attributes but the size.
        size: (width, height).
        image: returns the image (3, height, width).
    """
    view = copy.copy(camera)
    view.__class__ = _level_class(type(camera))
    view.image_width, view.image_height = size
    view.lapgs_image = image
    return view


class PrefetchingViews(list[Any]):
    """Prefetch the next view that a training loop draws.

    The loop draws by `stack = views.copy()`, then `stack.pop(randint(0, len(stack) - 1))`. The next index follows from
    the state of Python's generator, which can be read without changing it. If other code draws random numbers in
    between, another view is drawn, and the prefetch was useless.

    Args:
        views: views in the scene's order.
        prefetch: called with the next view.
    """

    def __init__(self, views: Iterable[Any], prefetch: Callable[[Any], None]) -> None:
        super().__init__(views)
        self._prefetch = prefetch

    def copy(self) -> PrefetchingViews:
        """Return a copy that prefetches, too."""
        return PrefetchingViews(self, self._prefetch)

    def pop(self, index: SupportsIndex = -1, /) -> Any:
        """Remove and return a view, and prefetch the next one."""
        drawn = super().pop(index)
        if self:
            _PEEK.setstate(random.getstate())
            self._prefetch(self[_PEEK.randint(0, len(self) - 1)])
        return drawn


_PEEK = random.Random()
"""Generator that takes on the state of Python's own to compute its next number."""

_LEVEL_CLASSES: dict[type, type] = {}


def _level_class(kind: type) -> type:
    if kind not in _LEVEL_CLASSES:
        read = property(lambda view: view.lapgs_image(), doc="(3, h, w) the level's ground truth, float32.")
        _LEVEL_CLASSES[kind] = type(f"Level{kind.__name__}", (kind,), {"original_image": read})
    return _LEVEL_CLASSES[kind]
