"""Read and change values of a checkout's objects whatever their kind: settings, scenes, outputs of rasterizers."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.errors import UserInputError


def fields_of(settings: Any) -> dict[str, Any]:
    """Return the values of a named tuple, a dataclass or any other object by name."""
    if hasattr(settings, "_asdict"):
        return dict(zip(settings._fields, settings, strict=True))
    return dict(vars(settings)) if hasattr(settings, "__dict__") else {}


def with_values(settings: Any, changes: Mapping[str, Any]) -> Any:
    """Return an object of the same kind with other values by name."""
    if hasattr(settings, "_replace"):
        return settings._replace(**changes)
    if dataclasses.is_dataclass(settings) and not isinstance(settings, type):
        return dataclasses.replace(settings, **changes)
    changed = copy.copy(settings)
    for name, value in changes.items():
        setattr(changed, name, value)
    return changed


def matrix_keys(matrix: Any) -> tuple[bytes, bytes]:
    """Return the values of a matrix and of its transpose, by which views are recognised wherever the matrix is."""
    values = np.asarray(torch.as_tensor(matrix).detach().to("cpu", torch.float32))
    return values.tobytes(), np.ascontiguousarray(values.T).tobytes()


def size_of(settings: Any) -> tuple[int, ...]:
    """Return (height, width) of the view, empty if the settings do not say it."""
    sides = getattr(settings, "image_height", None), getattr(settings, "image_width", None)
    return tuple(int(side) for side in sides if side is not None)


@dataclasses.dataclass(frozen=True)
class RasterOutputs:
    """Hold the outputs of a rasterizer: an image, or an image among others.

    Attributes:
        outputs: as the rasterizer returned them.
        key: index or key of the image; None if the outputs are the image.
        channels_last: whether the stored image is (h, w, 3).
        rest: channels (k, h, w) that follow the image's in one tensor, such as normals; None without any.
    """

    outputs: Any
    key: Any
    channels_last: bool
    rest: Tensor | None

    @classmethod
    def of(cls, outputs: Any, size: tuple[int, ...]) -> RasterOutputs:
        """Find the image, the first output with three channels and the size (h, w) of the view, empty if unknown.

        Without any it is the first three channels of an output with more.

        Raises:
            UserInputError: there is none.
        """
        key = _image_key(outputs, size)
        stored = outputs if key is None else outputs[key]
        shape = stored.shape
        last = shape[-1] == 3 and (shape[-3] != 3 or shape[-3:-1] == size)
        return cls(outputs, key, last, None if last or shape[-3] == 3 else stored[..., 3:, :, :])

    @property
    def image(self) -> Tensor:
        """The image (3, h, w)."""
        stored = self._stored
        if stored.ndim == 3 and not self.channels_last and self.rest is None:
            return stored  # views would be steps of the backward pass
        image = stored.reshape(stored.shape[-3:])  # some have a leading axis for several views
        return image.permute(2, 0, 1) if self.channels_last else image[:3]

    @property
    def maps_beside(self) -> list[Tensor]:
        """Other outputs with a value of each pixel that gradients may come from, such as depths."""
        items = () if self.key is None else _items(self.outputs)
        others = [self.rest, *(value for key, value in items if key != self.key)]
        others = [value for value in others if isinstance(value, Tensor) and value.requires_grad]
        if not others:
            return []
        size = tuple(self.image.shape[1:])
        return [v for v in others if size in (tuple(v.shape[-2:]), tuple(v.shape[-3:-1]))]

    def with_image(self, image: Tensor) -> Any:
        """Return the outputs with another image (3, h, w) at the key and in the shape of the first."""
        if image is self._stored:
            return self.outputs
        if self.rest is not None:
            image = torch.cat([image.expand(*self.rest.shape[:-3], -1, -1, -1), self.rest], -3)
        if self.channels_last:
            image = image.permute(1, 2, 0)
        if image.shape != self._stored.shape:
            image = image.reshape(self._stored.shape)
        return image if self.key is None else _with_item(self.outputs, self.key, image)

    @property
    def _stored(self) -> Tensor:
        stored: Tensor = self.outputs if self.key is None else self.outputs[self.key]
        return stored


def _image_key(outputs: Any, size: tuple[int, ...]) -> Any:
    """Return where the image is among a rasterizer's outputs, None if they are the image.

    Three channels come before or after the axes of pixels, more of them before.
    """
    if isinstance(outputs, Tensor):
        return None
    shapes, more = [], []
    for key, value in _items(outputs):
        if not isinstance(value, Tensor) or not value.is_floating_point():
            continue
        shape = tuple(value.shape)
        shapes.append(shape)
        if not 3 <= len(shape) <= 4 or any(length != 1 for length in shape[:-3]):
            continue
        first, last = shape[-3] == 3 and shape[-2:] == size, shape[-1] == 3 and shape[-3:-1] == size
        if first or last or (not size and 3 in (shape[-3], shape[-1])):
            return key
        if shape[-3] > 3 and shape[-2:] == size:
            more.append(key)
    if more:
        return more[0]
    returned = ", ".join(map(str, shapes)) or "no tensor"
    raise UserInputError(
        f"the checkout's rasterizer returns {returned}, expected an image (3, h, w)"
        f"{' of ' + 'x'.join(map(str, size[::-1])) if size else ''}; `lapgs run --off` runs the script as it is"
    )


def _items(outputs: Any) -> Iterable[tuple[Any, Any]]:
    return outputs.items() if isinstance(outputs, dict) else enumerate(outputs)


def _with_item(outputs: Any, key: Any, image: Tensor) -> Any:
    """Return a tuple, list or dict of outputs with another image."""
    if isinstance(outputs, dict):
        return {**outputs, key: image}
    items = [image if i == key else value for i, value in enumerate(outputs)]
    return type(outputs)(*items) if hasattr(outputs, "_fields") else type(outputs)(items)
