"""Read and change values of a checkout's objects, such as settings and scenes, whatever their kind."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch


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
    fields = fields_of(settings)
    return tuple(int(fields[name]) for name in ("image_height", "image_width") if name in fields)
