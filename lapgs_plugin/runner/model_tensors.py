"""Tell whether our kernels take the tensors of a checkout's model in the place of its own operations."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

ACTIVATIONS = {"scaling_activation": torch.exp, "opacity_activation": torch.sigmoid}
"""Functions by which models make scales and opacities, by the names of their attributes."""


def is_rows(value: Any, columns: int) -> bool:
    """Return whether a value is one that kernels read: contiguous rows of float32, one at least."""
    is_float = isinstance(value, Tensor) and value.dtype == torch.float32 and value.ndim == 2
    return is_float and value.shape[1] == columns and value.is_contiguous() and len(value) > 0


def has_activations(model: Any) -> bool:
    """Return whether a model has the activations."""
    return all(getattr(model, name, None) is function for name, function in ACTIVATIONS.items())
