"""Filter a checkout's Gaussians in space by our kernels, where its own model does the same.

Its properties take 55 launches an iteration with their gradients. Filters themselves are made by a loop over all
cameras, with some 35 launches and five waits for each.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from functools import cache, partial, wraps
from inspect import getattr_static
from numbers import Real
from types import FunctionType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.checkouts.attachment import Replacement, of_class
from lapgs_plugin.ops import smoothing_filter
from lapgs_plugin.ops.self_check import SelfCheck, is_rows, largest
from lapgs_plugin.ops.smoothing_filter.in_torch import CameraRow, seen_from
from lapgs_plugin.ops.smoothing_filter.in_torch import gaussians as examples

FILTERS = "filter_3D"
"""Attribute of models with filters: (n, 1) standard deviations."""
SCALES, OPACITIES = "get_scaling_with_3D_filter", "get_opacity_with_3D_filter"
"""Their properties that renderers read."""
COMPUTE = "compute_3D_filter"
"""Their method that makes the filters, of a list of cameras."""
ACTIVATIONS = {"scaling_activation": torch.exp, "opacity_activation": torch.sigmoid}
"""Functions that a model's properties have to use."""
VARIANCE = 0.2
"""Variance of a filter in pixels of the camera with the largest focal length."""
LARGEST_DIFFERENCE = 1e-4
"""Largest difference from the checkout's results that counts as rounding, relative to each value.

That of gradients, which it may compute as differences of larger numbers, is relative to the largest.
"""


def replacements(model: type, consumer: str) -> list[Replacement]:
    """Return the replacements in a class of models; none if it has no filters."""
    makers: dict[str, Callable[[Any], Any]] = {
        SCALES: lambda original: _property(model, original, _our_scales),
        OPACITIES: lambda original: _property(model, original, _our_opacities),
        COMPUTE: computing,
    }
    return [
        replacement
        for name, make in makers.items()
        for replacement in of_class(model, name, make, consumer)
        if _is_plain(vars(replacement.owner)[name])
    ]


def _is_plain(member: Any) -> bool:
    """Return whether a class's member is a method, or a property that is read by one."""
    return isinstance(member.fget if isinstance(member, property) else member, FunctionType)


def _property(model: type, original: property, ours: Callable[[Any], Tensor]) -> property:
    """Return the replacement of a property of models; where it differs from ours, it is read itself."""
    getter = original.fget
    assert getter is not None, "as it is plain"
    name = f"{getter.__module__}.{getter.__qualname__} of the checkout"
    agrees = cache(SelfCheck(partial(_property_difference, model, getter, ours), name, LARGEST_DIFFERENCE).passes_on)

    @wraps(getter)
    def read(gaussians: Any) -> Any:
        # Resets of opacities divide by the share that filters leave: a quotient above 1 has no logit. So without
        # gradients, as there, all bits are the checkout's.
        suits = torch.is_grad_enabled() and _fits(gaussians) and _has_kernels(gaussians._scaling)
        return ours(gaussians) if suits and agrees(gaussians._scaling.device) else getter(gaussians)

    return property(read, original.fset, original.fdel, original.__doc__)


def computing(original: Callable[..., Any]) -> Callable[..., Any]:
    """Return the replacement of a method that makes filters, of one argument; where it differs, it is called itself."""
    name = f"{original.__module__}.{original.__qualname__} of the checkout"
    said = list[str]()  # by the checkout's method, which may tell that it is called
    agrees = cache(SelfCheck(partial(_filter_difference, original, said), name, LARGEST_DIFFERENCE).passes_on)

    @wraps(original)
    def compute(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
        filters, cameras = None, [*args, *kwargs.values()]
        if len(cameras) == 1 and _has_centers(gaussians) and agrees(gaussians._xyz.device):
            filters = _filters(gaussians._xyz.detach(), cameras[0])
        if filters is None:
            return original(gaussians, *args, **kwargs)
        print("".join(said), end="")
        setattr(gaussians, FILTERS, filters)
        return None

    return compute


def _our_scales(gaussians: Any) -> Tensor:
    return smoothing_filter.filtered_scales(gaussians._scaling, _filters_of(gaussians))


def _our_opacities(gaussians: Any) -> Tensor:
    return smoothing_filter.filtered_opacities(gaussians._opacity, gaussians._scaling, _filters_of(gaussians))


def _filters_of(gaussians: Any) -> Tensor:
    """Return a model's filters, one for each Gaussian; models of archived fields have one for all."""
    filters: Tensor = getattr(gaussians, FILTERS)
    return filters.expand(len(gaussians._scaling), 1).contiguous()


@torch.no_grad()
def _filters(means: Tensor, cameras: Any) -> Tensor | None:
    """Return filters (n, 1) of centres (n, 3); None if cameras are not as expected, or see none of them."""
    rows = _rows(cameras)
    if not rows:
        return None
    table = torch.tensor([row.numbers for row in rows], dtype=torch.float32)
    depths = smoothing_filter.nearest_depths(means, table.to(means.device))
    seen = depths < torch.inf
    if not bool(seen.any()):
        return None
    depths = torch.where(seen, depths, torch.where(seen, depths, 0.0).amax())
    filters: Tensor = depths / max(row.focal[0] for row in rows) * VARIANCE**0.5
    return filters[:, None]


def _rows(cameras: Any) -> list[CameraRow]:
    """Return the numbers of cameras; none if one of them has others than the family's."""
    rows = []
    for camera in cameras if isinstance(cameras, Sequence) else ():
        numbers = [getattr(camera, name, None) for name in ("focal_x", "focal_y", "image_width", "image_height")]
        matrix: Any = getattr(camera, "R", None)
        shift: Any = getattr(camera, "T", None)
        if not (_is_array(matrix, (3, 3)) and _is_array(shift, (3,)) and all(isinstance(n, Real) for n in numbers)):
            return []
        fx, fy, width, height = map(float, numbers)  # type: ignore[arg-type]  # they are real numbers
        rows.append(CameraRow(tuple(matrix.ravel().tolist()), tuple(shift.tolist()), (fx, fy), (width, height)))
    return rows


def _is_array(value: Any, shape: tuple[int, ...]) -> bool:
    return isinstance(value, np.ndarray) and value.shape == shape and value.dtype.kind == "f"


def _has_centers(gaussians: Any) -> bool:
    """Return whether kernels read a model's centres, which are its parameter and nothing else."""
    means: Any = getattr(gaussians, "_xyz", None)
    return is_rows(means, 3) and _has_kernels(means) and getattr(gaussians, "get_xyz", None) is means


def _fits(gaussians: Any) -> bool:
    """Return whether our operations take a model's tensors in the place of its properties."""
    if any(getattr(gaussians, name, None) is not function for name, function in ACTIVATIONS.items()):
        return False
    filters: Any = getattr(gaussians, FILTERS, None)
    log_scales, logits = gaussians._scaling, gaussians._opacity
    if not (is_rows(log_scales, 3) and is_rows(logits, 1) and is_rows(filters, 1)):
        return False
    fit = len(log_scales) == len(logits) and len(filters) in (1, len(logits)) and not filters.requires_grad
    return fit and log_scales.device == logits.device == filters.device


def _has_kernels(tensor: Tensor) -> bool:
    """Return whether kernels compute with a tensor; on a CPU the checkout's own operations do."""
    return smoothing_filter.triton_works(tensor)


def _property_difference(
    model: type, getter: Callable[[Any], Any], ours: Callable[[Any], Tensor], device: torch.device
) -> float:
    """Return how far a property is from ours for Gaussians of many sizes, and its gradients.

    It is read of an object that has its class's activations and nothing else.
    """
    names = "get_scaling", "get_opacity"
    own = {name: getattr_static(model, name) for name in names if hasattr(model, name)}
    logits, log_scales, filters = examples(device)
    log_scales, filters = 3 * log_scales - 3, filters**3  # a bound on either is a difference
    weights = torch.cos(torch.arange(len(logits), device=device))[:, None]
    results = []
    for read in (ours, getter):
        probe = type("Probe", (), own)()
        leaves = [value.clone().requires_grad_() for value in (logits, log_scales)]
        vars(probe).update({"_opacity": leaves[0], "_scaling": leaves[1], FILTERS: filters, **ACTIVATIONS})
        before = set(vars(probe))
        output = read(probe)
        if set(vars(probe)) != before:
            return math.inf  # it does more
        gradients = torch.autograd.grad((output * weights).sum(), leaves, materialize_grads=True, allow_unused=True)
        results.append((output, *gradients))
    ours_and_theirs = zip(*results, strict=True)
    outputs = next(ours_and_theirs)
    return largest([_apart(*outputs), *(_apart(one, other, other.abs().max()) for one, other in ours_and_theirs)])


def _filter_difference(original: Callable[..., Any], said: list[str], device: torch.device) -> float:
    """Return how far filters are from ours for some centres and cameras, and note what is printed meanwhile."""
    all_means, rows = seen_from(device)
    cameras = [_Camera.of(row) for row in rows.cpu().numpy().astype(np.float64)]
    differences, texts = [], []
    for means in (all_means, all_means[: len(all_means) // 2], 100 * all_means):
        probe = SimpleNamespace(get_xyz=means, _xyz=means)
        before = set(vars(probe))
        with redirect_stdout(io.StringIO()) as text:
            returned = original(probe, cameras)
        texts.append(text.getvalue())
        if returned is not None or vars(probe).keys() != before | {FILTERS} or texts[0] != texts[-1]:
            return math.inf  # it does more, or tells of the centres
        ours = _filters(means, cameras)
        assert ours is not None, "they are made to be seen"
        differences.append(_apart(ours, getattr(probe, FILTERS)))
    said[:] = texts[:1]
    return largest(differences)


class _Camera(NamedTuple):
    """Hold what a checkout's method needs of a camera; it cannot ask for more."""

    R: Any
    T: Any
    focal_x: float
    focal_y: float
    image_width: int
    image_height: int

    @classmethod
    def of(cls, row: Any) -> _Camera:
        """Return the camera of a row of `nearest_depths`."""
        fx, fy, width, height = row[12:]
        return cls(row[:9].reshape(3, 3), row[9:12], float(fx), float(fy), int(width), int(height))


def _apart(one: Tensor, other: Tensor, scale: Tensor | None = None) -> Tensor:
    """Return the largest difference of two tensors, relative to a scale or else each value; inf for other shapes."""
    if one.shape != other.shape:
        return one.new_tensor(torch.inf)
    return ((one - other).abs() / (other.abs() if scale is None else scale).clamp_min(1e-30)).max()
