"""Make views of a checkout's scene at a level's size, with images from a store instead of from the cameras."""

from __future__ import annotations

import copy
import ctypes
import inspect
import os
import random
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, wraps
from pathlib import Path
from typing import Any, SupportsIndex, cast

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.files import one_line_errors
from lapgs_plugin.runs.image_store import eight_bit_levels, tensor_bytes
from lapgs_plugin.scenes.masks import ALPHA, NONE, find_masks, read_mask, resolve_masks

KEY = "lapgs_key"
"""Attribute of cameras, and of all copies of them, with the key of the image."""

SCALED = {
    **dict.fromkeys(
        ("image_width", "width", "img_width", "w", "focal", "focal_length", "focal_x", "fl_x", "fx", "cx"), 0
    ),
    **dict.fromkeys(("image_height", "height", "img_height", "h", "focal_y", "fl_y", "fy", "cy"), 1),
}
"""Numbers of cameras in pixels by lower-case name, each with its axis: 0 is horizontal.

Up to 1 they are no pixels: shares of the image, or the -1 of what is unknown.
"""

INTRINSICS = {"K", "intrinsic", "intrinsics", "camera_matrix"}
"""Matrices of cameras in pixels."""

DEPTH_MAPS = {"invdepthmap", "depth_mask"}
"""Maps of cameras by which depth is supervised."""


Keep = Callable[[Tensor], Callable[[], Tensor]]
"""Keep a tensor of the CPU, and return a function that returns it."""


@dataclass(frozen=True)
class FullSizeImage:
    """Hold a full-size image (3, h, w) on the CPU: uint8 if all values are k/255, otherwise float16.

    Attributes:
        size: (width, height).
        exact: whether it is an 8-bit image, stored without rounding.
        stored: returns it as it is stored.
    """

    size: tuple[int, int]
    exact: bool
    stored: Callable[[], Tensor]  # (3, h, w)

    @classmethod
    def of(cls, image: Tensor, keep: Keep) -> FullSizeImage:
        """Return the image for values (3, h, w) in [0, 1]."""
        levels = eight_bit_levels(image)
        stored = image.to(torch.float16) if levels is None else levels
        return cls((image.shape[2], image.shape[1]), levels is not None, keep(stored.cpu()))

    def load(self, device: torch.device) -> Tensor:
        """Return the image (3, h, w) in [0, 1] on a device, float32."""
        moved = self.stored().to(device)
        return moved / 255 if self.exact else moved.float()


class _NamelessFile:
    """Keep tensors in a file without a name, which ends with the process, however that ends."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, threading.Lock()
        with one_line_errors(folder):
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # open as long as this object is used
        weakref.finalize(self, self._file.close)

    def keep(self, tensor: Tensor) -> Callable[[], Tensor]:
        """Append a tensor; see `Keep`."""
        shape, dtype, data = tensor.shape, tensor.dtype, tensor_bytes(tensor.contiguous())
        with self._lock, one_line_errors(self._folder):
            start = self._file.seek(0, os.SEEK_END)
            self._file.write(data)
            self._file.flush()
        _return_free_memory()

        def read() -> Tensor:
            stored = torch.empty(shape, dtype=dtype)
            with self._lock, one_line_errors(self._folder, "read"):
                self._file.seek(start)
                self._file.readinto(tensor_bytes(stored))
            return stored

        return read


def _return_free_memory() -> None:
    """Return freed memory to the system. glibc keeps it where something smaller follows, such as each camera's mask."""
    with suppress(AttributeError, OSError, TypeError):  # other C libraries have no such call
        ctypes.CDLL(None).malloc_trim(0)


class SceneImages:
    """Take a scene's images out of its cameras when these are made, and look them up by key.

    Keys are unique even if names are not: Blender scenes have an r_0 for training and another for testing.

    They are kept in memory, unless `keep_on_disk` is called first.
    """

    def __init__(self) -> None:
        # Some checkouts make their cameras in several threads.
        self._making, self._lock = threading.local(), threading.Lock()
        self.clear()

    def clear(self) -> None:
        """Drop all images and masks: a script may train on another scene after one, in the same process."""
        self._keep: Keep = lambda tensor: lambda: tensor
        self._images: dict[str, FullSizeImage] = {}
        self._masks: dict[str, Callable[[], Tensor]] = {}

    def keep_on_disk(self, folder: Path) -> None:
        """Keep images and masks in a file that nobody sees, on the disk of a folder that exists.

        Raises:
            RunFolderError: the folder cannot be written. Later: its disk is full.
        """
        self._keep = _NamelessFile(folder).keep

    def adopting(self, original: Callable[..., None]) -> Callable[..., None]:
        """Return a replacement of a camera class's `__init__` that takes the image out of every camera it makes."""
        signature = inspect.signature(original)

        @wraps(original)
        def make(camera: Any, *args: Any, **kwargs: Any) -> None:
            bound = signature.bind(camera, *args, **kwargs)
            if "data_device" in signature.parameters:
                bound.arguments["data_device"] = "cpu"  # avoids a copy of the image to the GPU and back
            outermost = not getattr(self._making, "now", False)
            self._making.now = True
            try:
                original(*bound.args, **bound.kwargs)
            finally:
                self._making.now = not outermost
            if outermost:  # a derived class calls this one before it is ready
                self._adopt(camera)

        return make

    def _adopt(self, camera: Any) -> None:
        image = getattr(camera, "original_image", None)
        channels = len(image) if isinstance(image, Tensor) and image.ndim == 3 else 0
        if not isinstance(image, Tensor) or channels != 3:
            raise UserInputError(
                f"image {camera.image_name}: the checkout reads {channels} channel(s) of it, expected 3; save the "
                "scene's images as RGB"
            )
        stored = FullSizeImage.of(image, self._keep)
        with self._lock:
            key = f"{len(self._images):05d}-{camera.image_name}"
            self._images[key] = stored
        del camera.original_image
        mask = getattr(camera, "alpha_mask", None)
        if isinstance(mask, Tensor) and _opaque(mask):
            camera.alpha_mask = mask.new_ones(()).expand_as(mask)  # the same in four bytes; no level uses it
        setattr(camera, KEY, key)

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
            self._masks[key] = self._keep(read_mask(files[view_name(key)], image.size, image.size))

    @property
    def masked(self) -> bool:
        """Whether images have masks."""
        return bool(self._masks)

    def mask(self, key: str) -> Tensor | None:
        """Return a view's mask (1, h, w) bool, False where the image is ignored; None without masks."""
        return self._masks[key]() if self._masks else None

    @property
    def exact(self) -> bool:
        """Whether all images are 8-bit images."""
        return all(image.exact for image in self._images.values())

    def key(self, camera: Any) -> str:
        """Return the key of a camera's image.

        Raises:
            UserInputError: the camera was not made by the replaced class.
        """
        key = view_key(camera)
        if key is None:
            raise UserInputError(
                f"camera {getattr(camera, 'image_name', '?')} of the checkout was made without "
                f"{type(camera).__name__}.__init__, expected of every camera of the scene; this checkout loads scenes "
                "in another way: use `lapgs run --off`"
            )
        return key

    def __getitem__(self, key: str) -> FullSizeImage:
        return self._images[key]

    def smallest_size(self) -> tuple[int, int]:
        """Return the smallest width and the smallest height over all images, as `Scene.smallest_size` does."""
        sizes = [image.size for image in self._images.values()]
        return min(width for width, _ in sizes), min(height for _, height in sizes)


def view_name(key: str) -> str:
    """Return the checkout's name of the image with a key of `SceneImages`."""
    return key.partition("-")[2]


def view_key(value: Any) -> str | None:
    """Return the key of a camera of the scene or of a copy of it at any level; None for any other object."""
    key = getattr(value, KEY, None)
    return key if isinstance(key, str) else None


def make_level_view(camera: Any, size: tuple[int, int], image: Callable[[], Tensor]) -> Any:
    """Return a copy of a camera with another size, whose `original_image` is loaded on every access.

    Attributes that depend on the size follow it: focal lengths, centres, sizes, and maps with a value for each pixel.
    The copy shares all others.

    Args:
        camera: the checkout's camera.
        size: (width, height).
        image: returns the image (3, height, width).
    """
    view = copy.copy(camera)
    view.__class__ = _level_class(type(camera))  # type: ignore[arg-type]  # classes are hashable
    full = int(camera.image_width), int(camera.image_height)
    for name, value in list(vars(camera).items()):
        at_level = _at_level(name, value, full, size)
        if at_level is not value:
            setattr(view, name, at_level)
    view.image_width, view.image_height = size
    view.lapgs_image = image
    return view


def without_depth(view: Any) -> None:
    """Take the maps away by which a loop supervises depth."""
    for name in DEPTH_MAPS & vars(view).keys():
        setattr(view, name, None)
    if hasattr(view, "depth_reliable"):
        view.depth_reliable = False


def _at_level(name: str, value: Any, full: tuple[int, int], size: tuple[int, int]) -> Any:
    """Return an attribute of a camera at another size, the same object if it does not depend on the size."""
    if isinstance(value, np.ndarray) and value.shape[-2:] == full[::-1]:
        return shrunk(torch.from_numpy(value), size).numpy()
    if isinstance(value, (Tensor, np.ndarray)) and name in INTRINSICS and value.shape[-2:] in ((3, 3), (4, 4)):
        scaled: Any = copy.deepcopy(value)
        for row in range(2):
            scaled[..., row, :] = scaled[..., row, :] * size[row] / full[row]
        return scaled
    if isinstance(value, Tensor) and value.shape[-2:] == full[::-1] and value.ndim > 1:
        opaque = name == "alpha_mask" and _opaque(value)
        return None if opaque else shrunk(value, size)  # without a mask loops save a pass over the image
    if isinstance(value, (tuple, list)) and tuple(value) in (full, full[::-1]):
        return type(value)(size if tuple(value) == full else size[::-1])
    if isinstance(value, (int, float, np.number)) and name.lower() in SCALED and value > 1:
        axis, kind = SCALED[name.lower()], cast("Any", type(value))
        return kind(float(value) * size[axis] / full[axis]) if value != full[axis] else size[axis]
    return value


def _opaque(mask: Tensor) -> bool:
    return bool((mask == 1).all())


def shrunk(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Return an image (..., h, w) at a smaller `size` (width, height).

    Floats are averaged, to float32; a mask has what most of the pixels are. Whole numbers are labels, which have no
    averages: they are sampled.
    """
    flat = image.reshape(-1, 1, *image.shape[-2:]).float()
    labels = not (image.is_floating_point() or image.dtype == torch.bool)
    result = torch.nn.functional.interpolate(flat, size[::-1], mode="nearest-exact" if labels else "area")
    result = result.reshape(*image.shape[:-2], *size[::-1])
    return result >= 0.5 if image.dtype == torch.bool else result.to(image.dtype) if labels else result


class PrefetchingViews(list[Any]):
    """Prefetch the next view that a training loop draws.

    The loop draws by `stack = views.copy()`, then `stack.pop(randint(0, len(stack) - 1))`. The next index follows from
    the state of Python's generator, which can be read without changing it. If other code draws random numbers in
    between, another view is drawn, and the prefetch was useless.

    Args:
        views: views in the scene's order.
        prefetch: called after each draw with a function that returns the next view, which takes a while.
    """

    def __init__(self, views: Iterable[Any], prefetch: Callable[[Callable[[], Any]], None]) -> None:
        super().__init__(views)
        self._prefetch = prefetch

    def copy(self) -> PrefetchingViews:
        """Return a copy that prefetches, too."""
        return PrefetchingViews(self, self._prefetch)

    def pop(self, index: SupportsIndex = -1, /) -> Any:
        """Remove and return a view, and prefetch the next one."""
        drawn = super().pop(index)
        if self:
            self._prefetch(self._next)
        return drawn

    def _next(self) -> Any:
        _PEEK.setstate(random.getstate())
        return self[_PEEK.randint(0, len(self) - 1)]


_PEEK = random.Random()
"""Generator that takes on the state of Python's own to compute its next number."""


@cache
def _level_class(kind: type) -> type:
    image = property(lambda view: view.lapgs_image(), _keep_image, doc="(3, h, w) the level's ground truth, float32.")
    return type(f"Level{kind.__name__}", (kind,), {"original_image": image})


def _keep_image(view: Any, image: Tensor) -> None:
    """Keep the image that a checkout sets, which some move to the GPU once and for all."""
    view.lapgs_image = lambda: image
