"""Compare two renderings or two gradients. Each function catches errors that the others miss.

- `assert_elements_close`: no element is off by more than a bound relative to the largest one.
- `assert_same_zero_rows`: the same Gaussians have no gradient.
- `assert_aligned`: the vectors of all elements have the same direction (cosine) and length (relative L2). It catches a
  small error everywhere, which an element bound allows.
- `assert_rows_close`: each Gaussian's row is compared on its own scale. It catches a wrong gradient of a Gaussian with
  little influence.
- `assert_close_outside`: values are equal outside of a mask, and the mask has at most a given share.
- `assert_radii_close`: integers are equal, or differ by one where rounding up is open.

All return the worst value that they saw, for the test to state, and all fail on NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


def assert_elements_close(actual: Tensor, expected: Tensor, bound: float, *, name: str = "values") -> float:
    """Assert that every |actual - expected| is at most `bound` times the largest |expected| (or 1e-30)."""
    _assert_comparable(actual, expected, name)
    if expected.numel() == 0:
        return 0.0
    error = (actual.double() - expected.double()).abs() / expected.double().abs().max().clamp(min=1e-30)
    worst = float(error.max())
    if worst > bound:
        index = tuple(int(i) for i in torch.unravel_index(error.argmax(), error.shape))
        raise AssertionError(
            f"{name}: element {index} is {actual[index]}, expected {expected[index]}: "
            f"relative to the largest off by {worst:.2e} > {bound:.0e}"
        )
    return worst


def assert_rows_close(actual: Tensor, expected: Tensor, bound: float, *, floor: float, name: str = "values") -> float:
    """Assert that each row's error is at most `bound` times its norm, taken as at least `floor` of the largest."""
    _assert_comparable(actual, expected, name)
    if expected.numel() == 0:
        return 0.0
    difference = _rows(actual.double() - expected.double()).norm(dim=1)  # (n,)
    norms = _rows(expected.double()).norm(dim=1)  # (n,)
    error = difference / norms.clamp(min=max(floor * float(norms.max()), 1e-30))  # (n,)
    worst = float(error.max())
    assert worst <= bound, f"{name}: row {int(error.argmax())} is off by {worst:.2e} of its norm > {bound:.0e}"
    return worst


def assert_same_zero_rows(actual: Tensor, expected: Tensor, *, name: str = "values") -> int:
    """Assert that both have the same zero rows; return how many."""
    _assert_comparable(actual, expected, name)
    zero, should = (_rows(t).eq(0).all(dim=1) for t in (actual, expected))  # (n,) each
    wrong = (zero != should).nonzero()[:, 0].tolist()
    assert not wrong, f"{name}: {len(wrong)} rows are zero in one of the two only, the first is {wrong[0]}"
    return int(zero.sum())


def assert_aligned(
    actual: Tensor, expected: Tensor, *, min_cosine: float, max_relative_l2: float, name: str = "values"
) -> float:
    """Assert that both, as one vector, have the same direction and length; return the relative L2 distance."""
    _assert_comparable(actual, expected, name)
    a, e = actual.double().flatten(), expected.double().flatten()
    length = float(e.norm())
    if length == 0:
        assert float(a.norm()) == 0, f"{name}: expected zero, got a norm of {float(a.norm()):.2e}"
        return 0.0
    distance = float((a - e).norm()) / length
    cosine = float(a @ e) / max(length * float(a.norm()), 1e-300)
    assert cosine >= min_cosine, f"{name}: cosine {cosine:.9f} < {min_cosine}"
    assert distance <= max_relative_l2, f"{name}: relative L2 distance {distance:.2e} > {max_relative_l2:.0e}"
    return distance


def assert_close_outside(
    actual: Tensor, expected: Tensor, mask: Tensor, bound: float, *, max_masked: float = 1.0, name: str = "values"
) -> float:
    """Assert that |actual - expected| is at most `bound` outside of the mask, and that the mask has a limited share.

    Args:
        actual, expected: (..., h, w), or (n, ...) with an (n,) mask.
        mask: bool, True where a difference is excused; its shape is that of the last or the first dimensions.
        bound: largest absolute difference elsewhere.
        max_masked: largest share of the mask that may be True.
        name: for messages.
    """
    _assert_comparable(actual, expected, name)
    share = float(mask.double().mean()) if mask.numel() else 0.0
    assert share <= max_masked, f"{name}: the mask excuses {share:.2%}, expected at most {max_masked:.2%}"
    if mask.ndim == 1:
        mask = mask.reshape(-1, *[1] * (actual.ndim - 1))
    error = (actual.double() - expected.double()).abs().masked_fill(mask, 0)
    worst = float(error.max()) if error.numel() else 0.0
    assert worst <= bound, f"{name}: off by {worst:.2e} > {bound:.0e} outside the mask"
    return worst


def assert_radii_close(actual: Tensor, expected: Tensor, is_open: Tensor) -> int:
    """Assert that radii are equal; where `is_open`, they may differ by a pixel, or one may be culled.

    Args:
        actual, expected: (n,) whole pixels, 0 where culled.
        is_open: (n,) bool.

    Returns:
        The number that differ.
    """
    _assert_comparable(actual, expected, "radii")
    difference = (actual.long() - expected.long()).abs()  # (n,)
    excused = is_open & ((difference <= 1) | (actual == 0) | (expected == 0))
    wrong = ((difference > 0) & ~excused).nonzero()[:, 0].tolist()
    assert not wrong, (
        f"radii: {len(wrong)} differ, the first is {wrong[0]}: {actual[wrong[0]]}, expected {expected[wrong[0]]}"
    )
    return int((difference > 0).sum())


@dataclass(frozen=True)
class GradientBounds:
    """Hold the bounds of `assert_gradients_match`; see the functions of the same words.

    Attributes:
        element: largest error relative to the largest element.
        row: largest error of a Gaussian's row relative to the row's norm.
        row_floor: rows below this share of the largest norm are measured against that share instead.
        relative_l2: largest distance relative to the norm; the cosine has to follow from it.
    """

    element: float
    row: float
    row_floor: float
    relative_l2: float


def assert_gradients_match(
    actual: Mapping[str, Tensor],
    expected: Mapping[str, Tensor],
    bounds: GradientBounds,
    *,
    excused: Tensor | None = None,
) -> dict[str, float]:
    """Assert that all gradients of a field agree in every way above.

    Args:
        actual, expected: (n, ...) gradients by name; `actual` has at least the names of `expected`.
        bounds: of each comparison.
        excused: (n,) bool, Gaussians left out of the comparison.

    Returns:
        The worst element error by name.
    """
    worst = {}
    for name in expected:
        compared = slice(None) if excused is None else ~excused
        got, wanted = actual[name][compared], expected[name][compared]
        worst[name] = assert_elements_close(got, wanted, bounds.element, name=name)
        assert_rows_close(got, wanted, bounds.row, floor=bounds.row_floor, name=name)
        assert_same_zero_rows(got, wanted, name=name)
        # |a - e| <= r |e| bounds the angle by asin(r).
        cosine = (1 - min(bounds.relative_l2, 1) ** 2) ** 0.5 - 1e-12
        assert_aligned(got, wanted, min_cosine=cosine, max_relative_l2=bounds.relative_l2, name=name)
    return worst


def _rows(values: Tensor) -> Tensor:
    """Return (n, ...) as (n, m), also for n = 0."""
    return values.flatten(1) if values.ndim > 1 else values[:, None]


def _assert_comparable(actual: Tensor, expected: Tensor, name: str) -> None:
    assert actual.shape == expected.shape, f"{name}: shape {tuple(actual.shape)}, expected {tuple(expected.shape)}"
    assert bool(torch.isfinite(expected).all()), f"{name}: the expected values are not finite"
    assert bool(torch.isfinite(actual).all()), f"{name}: {int((~torch.isfinite(actual)).sum())} values are not finite"
