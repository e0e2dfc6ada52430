"""Divide training views into shards, which ranks own, so that the sums of a step do not depend on the number of ranks.

A view belongs to shard (index mod number of shards) for good, and a shard to rank (shard mod number of ranks). An epoch
takes a view of each shard in turn, so that ranks have equally many views of every step. A sum over views adds up those
of each shard, and then shards by `tree_sum`, whose subtrees are the shards of single ranks where their number divides
that of shards.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from torch import Tensor

from lapgs_plugin.training.views import shuffled

LEAST_SHARDS = 8
"""Shards of a run on several ranks, at least: 2, 4 and 8 ranks share them out evenly."""


def shards_of(ranks: int) -> int:
    """Return the number of shards of a run that was started on so many ranks."""
    return max(LEAST_SHARDS, ranks)


@lru_cache(maxsize=4)
def epoch_order(count: int, seed: int, level: int, epoch: int, shards: int) -> list[int]:
    """Return all views in the order of an epoch: one of each shard in turn, drawn at random.

    >>> [view % 4 for view in epoch_order(10, 0, 0, 0, 4)]
    [0, 1, 2, 3, 0, 1, 2, 3, 0, 1]
    """
    order = shuffled(count, seed, level, epoch)
    members = [[view for view in order if view % shards == shard] for shard in range(shards)]
    rounds = range(max(map(len, members)))
    return [views[number] for number in rounds for views in members if number < len(views)]


def tree_sum(parts: Sequence[Sequence[Tensor] | None]) -> list[Tensor] | None:
    """Add up the tensors of parts pairwise: those at even places, and to them those at odd places.

    Args:
        parts: of tensors of the same shapes, written to; None counts as zeros.

    Returns:
        The sums; None if every part is.
    """
    if len(parts) == 1:
        return None if parts[0] is None else list(parts[0])
    even, odd = tree_sum(parts[0::2]), tree_sum(parts[1::2])
    if even is None or odd is None:
        return odd if even is None else even
    return [left.add_(right) for left, right in zip(even, odd, strict=True)]
