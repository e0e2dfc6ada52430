"""The views of a checkout's scene at the size of a level, their images in an ImageStore instead of in the cameras."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, SupportsIndex

import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError

BYTE_TOLERANCE = 1e-3
"""How far 255 times a value may be from a whole number to count as a pixel of an 8-bit image: float32 gives 2e-5."""


@dataclass(frozen=True)
class Photo:
    """A full-size image on the CPU: (3, h, w) uint8 where its values are k/255, float16 where not."""

    stored: Tensor  # (3, h, w)

    @classmethod
    def of(cls, image: Tensor) -> Photo:
        levels = image * 255
        rounded = levels.round()
        if bool(((levels - rounded).abs() <= BYTE_TOLERANCE).all()):
            return cls(rounded.to("cpu", torch.uint8))
        return cls(image.to("cpu", torch.float16))

    @property
    def exact(self) -> bool:
        return self.stored.dtype == torch.uint8

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)"""
        return self.stored.shape[2], self.stored.shape[1]

    def image(self, device: torch.device) -> Tensor:
        """(3, h, w) float32."""
        moved = self.stored.to(device)
        return moved / 255 if self.exact else moved.float()


class PhotoAlbum:
    """The images of a scene, taken out of its cameras while those are made.

    A camera keeps everything but its image; `key` says which image was its. Keys are unique where names need not be:
    Blender scenes have an r_0 for training and another for testing.
    """

    def __init__(self) -> None:
        self._photos: dict[str, Photo] = {}
        self._keys: dict[int, str] = {}
        self._cameras: list[Any] = []  # keeps the identities in `_keys` from being given to other objects

    def adopting(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """A replacement of the checkout's Camera class, under the name that its loader calls."""

        def make_camera(*args: Any, **kwargs: Any) -> Any:
            # The image would be copied to the GPU only to be taken from there.
            camera = original(*args, **{**kwargs, "data_device": "cpu"})
            channels = len(camera.original_image)
            if channels != 3:
                raise UserInputError(
                    f"image {camera.image_name}: the checkout reads {channels} channel(s) of it, expected 3; save the "
                    "scene's images as RGB"
                )
            key = f"{len(self._photos):05d}-{camera.image_name}"
            self._photos[key] = Photo.of(camera.original_image)
            del camera.original_image
            self._keys[id(camera)] = key
            self._cameras.append(camera)
            return camera

        return make_camera

    def __len__(self) -> int:
        return len(self._photos)

    @property
    def exact(self) -> bool:
        """Whether all images are 8-bit ones."""
        return all(photo.exact for photo in self._photos.values())

    def key(self, camera: Any) -> str:
        try:
            return self._keys[id(camera)]
        except KeyError:
            raise UserInputError(
                f"camera {getattr(camera, 'image_name', '?')} of the checkout was not made by "
                "utils.camera_utils.Camera, expected of every camera of the scene; this checkout loads scenes "
                "in another way: use `lapgs run --off`"
            ) from None

    def photo(self, key: str) -> Photo:
        return self._photos[key]

    def smallest_size(self) -> tuple[int, int]:
        """Smallest width and smallest height over all images, as `Scene.smallest_size` has it."""
        sizes = [photo.size for photo in self._photos.values()]
        return min(width for width, _ in sizes), min(height for _, height in sizes)


def view_name(key: str) -> str:
    """The checkout's name of the image that an album calls `key`."""
    return key.partition("-")[2]


def make_level_view(camera: Any, size: tuple[int, int], image: Callable[[], Tensor]) -> Any:
    """A camera with another size whose `original_image` is asked for whenever it is looked at.

    Args:
        camera: the checkout's; shared with the copy is everything but the size.
        size: (width, height).
        image: gives (3, height, width).
    """
    view = copy.copy(camera)
    view.__class__ = _level_class(type(camera))
    view.image_width, view.image_height = size
    view.lapgs_image = image
    return view


class AnnouncingViews(list[Any]):
    """Views from which a training loop draws: `stack = views.copy()`, then `stack.pop(randint(0, len(stack) - 1))`.

    With every draw the next one is announced. It is known: the loop will ask Python's generator, whose state can be
    looked at without changing it. Where somebody else draws in between, an announcement is in vain, nothing more.

    Args:
        views: in the scene's order.
        prefetch: told of the view that will be drawn next.
    """

    def __init__(self, views: Iterable[Any], prefetch: Callable[[Any], None]) -> None:
        super().__init__(views)
        self._announce = announce

    def copy(self) -> AnnouncingViews:
        return AnnouncingViews(self, self._announce)

    def pop(self, index: SupportsIndex = -1, /) -> Any:
        drawn = super().pop(index)
        if self:
            _PEEK.setstate(random.getstate())
            self._announce(self[_PEEK.randint(0, len(self) - 1)])
        return drawn


_PEEK = random.Random()
"""Generator that takes the state of Python's own to see what that one will say."""

_LEVEL_CLASSES: dict[type, type] = {}


def _level_class(kind: type) -> type:
    if kind not in _LEVEL_CLASSES:
        read = property(lambda view: view.lapgs_image(), doc="(3, h, w) the level's ground truth, float32.")
        _LEVEL_CLASSES[kind] = type(f"Level{kind.__name__}", (kind,), {"original_image": read})
    return _LEVEL_CLASSES[kind]
