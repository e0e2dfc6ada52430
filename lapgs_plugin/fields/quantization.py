"""Round the numbers of Gaussians to few bytes, as the files for web viewers hold them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

CODES = 256
CODE_ROUNDS = 20
"""Rounds of k-means over one number."""

MOST_SETS = 65_536
"""Sets of coefficients in a palette: labels have 16 bits."""

ROWS_FOR_A_SET = 2
"""Gaussians that share a set of a palette, on average, at least."""

SET_ROUNDS = 8
"""Rounds of k-means over sets of coefficients."""

ROWS_AT_ONCE = 65_536
"""Rows whose distances from all centres are in memory together."""

Bytes = NDArray[np.uint8]


def fixed_point(means: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint16]]:
    """Return the least and the largest y = sign(x) log(1 + |x|) of positions x (n, 3), and y as 16 bits between."""
    folded = (means.double().sign() * means.double().abs().log1p()).numpy()  # (n, 3)
    low, high = folded.min(axis=0), folded.max(axis=0)
    return low, high, np.rint(65_535.0 * (folded - low) / np.where(high > low, high - low, 1.0)).astype(np.uint16)


def morton_order(points: NDArray[Any]) -> NDArray[np.int64]:
    """Return the order of points (n, 3) along a Z-shaped curve, in which neighbours are similar."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    cells = ((points - low) / np.where(extent > 0.0, extent, 1.0) * 1023.0).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def packed_rotations(quaternions: Tensor) -> Bytes:
    """Return rotations as (n, 4) bytes: the three smaller components in the order wxyz, then 252 + the largest."""
    unit = torch.nn.functional.normalize(quaternions.double(), dim=1).numpy()
    largest = np.abs(unit).argmax(axis=1)
    unit = unit * np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0.0, -1.0, 1.0)
    others = unit[np.arange(4) != largest[:, None]].reshape(-1, 3)
    small = np.rint(255.0 * (others * math.sqrt(0.5) + 0.5))
    return np.concatenate([small, 252.0 + largest[:, None]], axis=1).astype(np.uint8)


def codebook(values: NDArray[Any]) -> tuple[list[float], Bytes]:
    """Return 256 numbers by k-means, ascending, and the index of the nearest one to each value."""
    ordered = np.sort(values, axis=None).astype(np.float64)
    if len(different := np.unique(ordered)) <= CODES:
        return np.pad(different, (0, CODES - len(different)), "edge").tolist(), _nearest(different, values)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    # Between equal numbers of values and equal distances, so that rare values get codes, too.
    shares = (np.arange(CODES) + 0.5) / CODES
    codes = (np.quantile(ordered, shares) + ordered[0] + shares * (ordered[-1] - ordered[0])) / 2.0
    for _ in range(CODE_ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2.0), [len(ordered)]])
        counts = np.diff(ends)
        codes = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), codes)
    return codes.tolist(), _nearest(codes, values)


def _nearest(codes: NDArray[np.float64], values: NDArray[Any]) -> Bytes:
    """Return the index of the nearest of at most 256 ascending numbers to each value."""
    return np.searchsorted((codes[1:] + codes[:-1]) / 2.0, values).astype(np.uint8)


def palette(coefficients: Tensor, most: int = MOST_SETS) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return a palette (count, k, 3) of at most `most` sets of coefficients, and the label (n,) of each row.

    Gaussians are grouped coarsely, then each group by itself, which takes far less time than one step.
    """
    rows = coefficients.flatten(1)  # (n, 3 k)
    count = min(most, -(-len(rows) // ROWS_FOR_A_SET))
    generator = torch.Generator().manual_seed(0)
    _, groups = _clusters(rows, math.isqrt(count), generator)
    labels, parts, used = torch.empty(len(rows), dtype=torch.long), [], 0
    taken = int((torch.bincount(groups) > 0).sum())  # each group has one set; they share the others by their sizes
    for group in range(int(groups.max()) + 1):
        members = (groups == group).nonzero()[:, 0]
        if len(members):
            more = (count - taken) * (len(members) - 1) // max(len(rows) - taken, 1)
            centres, own = _clusters(rows[members], 1 + more, generator)
            labels[members] = own + used
            parts.append(centres)
            used += len(centres)
    return torch.cat(parts).view(used, *coefficients.shape[1:]).numpy(), labels.numpy()


def _clusters(rows: Tensor, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return `count` centres by k-means, and the label of each row's nearest one."""
    centres = rows[torch.randperm(len(rows), generator=generator)[:count]]
    for last in [False] * SET_ROUNDS + [True]:
        labels = torch.cat([torch.cdist(part, centres).argmin(dim=1) for part in torch.split(rows, ROWS_AT_ONCE)])
        if not last:
            sums = torch.zeros_like(centres).index_add_(0, labels, rows)
            members = torch.bincount(labels, minlength=len(centres))[:, None]
            centres = torch.where(members > 0, sums / members.clamp(min=1), centres)
    return centres, labels


def low_and_high(values: NDArray[Any]) -> Bytes:
    """Return integers of 16 bits (n, k) as their low bytes, then their high bytes: (n, 2 k)."""
    return np.concatenate([values & 255, values >> 8], axis=1).astype(np.uint8)
