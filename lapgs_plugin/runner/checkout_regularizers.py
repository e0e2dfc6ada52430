"""Add a checkout's regularizers of opacities and scales to its loss by our kernels, where its statements do the same.

With their gradients they are 22 launches over all Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from inspect import getattr_static
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.regularizer_statements import PROPERTIES, REGULARIZED, RegularizerStatements
from lapgs_plugin.checkouts.rewriting import rewritten
from lapgs_plugin.ops import regularization
from lapgs_plugin.runner.model_tensors import ACTIVATIONS, has_activations, is_rows


def in_one_kernel(training: Callable[..., Any]) -> Callable[..., Any]:
    """Return a script's training function, changed so that one kernel adds both terms."""
    if getattr(training, "__globals__", {}).get("torch") is not torch:
        return training
    return rewritten(training, lambda _: RegularizerStatements(), {REGULARIZED: _regularized})


def _regularized(loss: Any, model: Any, opacity_weight: Any, scale_weight: Any) -> Tensor | None:
    """Return the loss with both terms; None if the checkout's statements have to add them."""
    logits: Any = getattr(model, "_opacity", None)
    log_scales: Any = getattr(model, "_scaling", None)
    if not (is_rows(logits, 1) and is_rows(log_scales, 3) and len(logits) == len(log_scales)):
        return None
    if not (isinstance(loss, Tensor) and loss.ndim == 0 and loss.dtype == torch.float32 and loss.requires_grad):
        return None
    weights = opacity_weight, scale_weight
    if not all(isinstance(weight, (int, float)) for weight in weights) or not _has_kernels(loss, logits, log_scales):
        return None
    kind: Any = type(model)
    if loss.device != logits.device or not has_activations(model) or not _are_activations(kind):
        return None
    return regularization.regularized(loss, logits, log_scales, *map(float, weights))


def _has_kernels(*tensors: Tensor) -> bool:
    """Return whether kernels compute with tensors; on a CPU the checkout's own statements do."""
    return regularization.loss_works(*tensors)


@cache
def _are_activations(model: type) -> bool:
    """Return whether the properties of models are their activations and nothing else, tried on some numbers."""
    own = {name: getattr_static(model, name, None) for name in PROPERTIES}
    probe, generator = type("Probe", (), own)(), torch.Generator().manual_seed(0)
    logits, log_scales = (torch.randn(100, columns, generator=generator) for columns in (1, 3))
    vars(probe).update({"_opacity": logits, "_scaling": log_scales, **ACTIVATIONS})
    try:
        values = [getattr(probe, name) for name in PROPERTIES]
    except Exception:  # they need more of a model
        return False
    expected = torch.sigmoid(logits), torch.exp(log_scales)
    return all(isinstance(v, Tensor) and torch.equal(v, other) for v, other in zip(values, expected, strict=True))
