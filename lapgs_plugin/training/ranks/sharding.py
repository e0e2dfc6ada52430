"""Say which Gaussians of a field a rank trains: all of them, or with --shard a share.

A sharded field is whole in the run folder: in PLYs, in the optimizer's state and in checkpoints. So a run continues on
any number of ranks, and whatever reads it need not know how it was trained.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.training.ranks.group import ALONE, Ranks
from lapgs_plugin.training.ranks.sharded_rasterizer import ShardedRasterizer
from lapgs_plugin.training.strategies import Strategy


class WholeFields:
    """Train all Gaussians here, and equal ones on all other ranks.

    Attributes:
        divides: whether ranks have different Gaussians.
    """

    divides: bool = False

    def rasterizer(self, rasterizer: Rasterizer) -> Rasterizer:
        """Return what renders the field of all ranks."""
        return rasterizer

    def rows(self, count: int) -> Tensor:
        """Return the indices of those of a field's Gaussians that this rank trains."""
        return torch.arange(count)

    def dealt(self, field: GaussianField) -> GaussianField:
        """Return the Gaussians of a whole field that this rank trains."""
        return field

    def whole(self, value: Any) -> Any:
        """Return a tensor, or nested dictionaries of them, with the rows of all ranks on rank 0; others keep theirs."""
        return value

    def total(self, count: int) -> int:
        """Return the number of Gaussians on all ranks, given that on this one."""
        return count

    def idle_rounds(self, rounds: int) -> int:
        """Return in how many renders of other ranks this one takes part after so many of its own."""
        return 0

    def strategy(self, strategy: Strategy) -> Strategy:
        """Return a strategy's options for the Gaussians of this rank."""
        return strategy

    def draw_apart(self) -> None:
        """Let each rank draw other random numbers than the rest, if they train different Gaussians."""

    def edits_with(self, ranks: Ranks) -> Ranks:
        """Return the ranks that have to edit their fields alike."""
        return ranks


class ShardedFields(WholeFields):
    """Train every so many-th Gaussian of a field here, and the others on other ranks.

    Args:
        ranks: that share them.
    """

    divides = True

    def __init__(self, ranks: Ranks) -> None:
        self._ranks = ranks

    def rasterizer(self, rasterizer: Rasterizer) -> Rasterizer:
        return ShardedRasterizer(rasterizer, self._ranks)

    def rows(self, count: int) -> Tensor:
        return torch.arange(self._ranks.rank, count, self._ranks.size)

    def dealt(self, field: GaussianField) -> GaussianField:
        return field.kept(self.rows(len(field)))

    def whole(self, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: self.whole(part) for name, part in value.items()}
        return self._ranks.rows_of_all(value) if isinstance(value, Tensor) and value.ndim else value

    def total(self, count: int) -> int:
        return sum(self._ranks.gathered(count))

    def idle_rounds(self, rounds: int) -> int:
        return max(self._ranks.gathered(rounds)) - rounds

    def strategy(self, strategy: Strategy) -> Strategy:
        return strategy.of_shard(self._ranks.size)

    def draw_apart(self) -> None:
        draw = int(torch.randint(2**62, ()))
        if not self._ranks.leads:
            torch.manual_seed(draw + self._ranks.rank)

    def edits_with(self, ranks: Ranks) -> Ranks:
        return ALONE


def sharding_of(ranks: Ranks, shard: bool) -> WholeFields:
    """Return how the ranks of a run share its Gaussians."""
    return ShardedFields(ranks) if shard and ranks.size > 1 else WholeFields()
