"""Say which views a step of a stage has, which of them this rank renders, and how their sums are made."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lapgs_plugin.training.ranks.group import ALONE, Ranks
from lapgs_plugin.training.ranks.shards import epoch_order, shards_of, tree_sum
from lapgs_plugin.training.views import shuffled, view_index


@dataclass(frozen=True)
class WholeSteps:
    """Train every view of a step here, in the order of the epoch.

    Attributes:
        views: number of training views.
        seed, level: of the run and the stage.
    """

    views: int
    seed: int
    level: int

    shared = False
    """Whether several ranks may render the views of a step."""
    summed = False
    """Whether gradients and statistics are summed over ranks, by shards."""

    @property
    def ranks(self) -> Ranks:
        """The processes that train the run."""
        return ALONE

    def view(self, iteration: int) -> int:
        """Return the index of the view that an iteration, from 1, trains."""
        return view_index(iteration, self.views, self.seed, self.level)

    def trained(self, views: int) -> int:
        """Return how many views a step of so many trains."""
        return views

    def decisive(self, iteration: int, step: range) -> int:
        """Return the iteration whose settings the view of an iteration of a step is rendered with."""
        return iteration

    def turn(self, iteration: int) -> int:
        """Return a number that decides whether what is due in every so many iterations is due in this one."""
        return iteration

    def own(self, views: Sequence[int]) -> list[list[int]]:
        """Return the parts of some views that are summed one after the other here, each by itself."""
        return [list(views)]

    def parts(self, iterations: Sequence[int]) -> list[list[int]]:
        """Return the parts of some iterations, by their views; see `own`."""
        return [list(iterations)]

    def total(self, parts: Sequence[Sequence[Tensor] | None], zeros: Callable[[], list[Tensor]]) -> list[Tensor]:
        """Return the sums over the views of all ranks.

        Args:
            parts: sums of the tensors over the views of each part of `own`, written to; None for none.
            zeros: makes the tensors of no view.
        """
        total = tree_sum(parts)
        return zeros() if total is None else total

    def generator(self, iteration: int, device: torch.device) -> torch.Generator | None:
        """Return the random numbers of an iteration; None for those of the process."""
        return None


@dataclass(frozen=True)
class SharedSteps(WholeSteps):
    """Train those views of a step that this rank owns, so that every number of ranks makes the same sums.

    Attributes:
        shards: of the views, see `ranks.shards`.
        group: the ranks.
        exact: sum each shard by itself, for the same bits on any number of ranks; where rendering is not
            reproducible to the bit, one part has all views.
    """

    shards: int
    group: Ranks
    exact: bool

    shared = summed = True

    @property
    def ranks(self) -> Ranks:
        return self.group

    def view(self, iteration: int) -> int:
        epoch, position = divmod(iteration - 1, self.views)
        return epoch_order(self.views, self.seed, self.level, epoch, self.shards)[position]

    def turn(self, iteration: int) -> int:
        """See `WholeSteps`. Iterations themselves would always give the same shards, and ranks, their turn.

        The parity of a place's bits differs between the views of a rank in a step, and, with the epoch, of a view.
        """
        epoch, position = divmod(iteration - 1, self.views)
        return epoch + position.bit_count()

    def own(self, views: Sequence[int]) -> list[list[int]]:
        return self._by_shard(views, views)

    def parts(self, iterations: Sequence[int]) -> list[list[int]]:
        return self._by_shard(iterations, [self.view(iteration) for iteration in iterations])

    def _by_shard(self, items: Sequence[int], views: Sequence[int]) -> list[list[int]]:
        """Return those items whose views this rank owns, by the views' shards."""
        rank, size = self.group.rank, self.group.size
        shards = [view % self.shards for view in views]
        own = [(item, shard) for item, shard in zip(items, shards, strict=True) if shard % size == rank]
        if not self.exact:
            return [[item for item, _ in own]]
        return [[item for item, shard in own if shard == mine] for mine in range(rank, self.shards, size)]

    def total(self, parts: Sequence[Sequence[Tensor] | None], zeros: Callable[[], list[Tensor]]) -> list[Tensor]:
        return self.group.sum(super().total(parts, zeros))

    def generator(self, iteration: int, device: torch.device) -> torch.Generator | None:
        draw = (self.seed * 1_000_003 + self.level) * 1_000_003 + iteration
        return torch.Generator(device).manual_seed(draw % 2**63)


@dataclass(frozen=True)
class ShardedSteps(SharedSteps):
    """Train a view of each rank in turn, so that all ranks render at the same time.

    A step has equally many views of each rank. If it has to end sooner, ranks render their next views all the same, and
    render them again in the next step.
    """

    summed = False

    def view(self, iteration: int) -> int:
        turn, rank = divmod(iteration - 1, self.group.size)
        own = range(rank, self.views, self.group.size)
        epoch, position = divmod(turn, len(own))
        return own[shuffled(len(own), self.seed, self.level, epoch * self.group.size + rank)[position]]

    def trained(self, views: int) -> int:
        return math.ceil(views / self.group.size) * self.group.size

    def decisive(self, iteration: int, step: range) -> int:
        return step[-1]  # ranks render together

    def own(self, views: Sequence[int]) -> list[list[int]]:
        return [[view for view in views if view % self.group.size == self.group.rank]]

    def parts(self, iterations: Sequence[int]) -> list[list[int]]:
        if not iterations:
            return [[]]
        whole = range(iterations[0], iterations[0] + self.trained(len(iterations)))
        return [[iteration for iteration in whole if (iteration - 1) % self.group.size == self.group.rank]]


def steps_of(
    views: int, seed: int, level: int, started_on: int, ranks: Ranks, device: torch.device, *, sharded: bool
) -> WholeSteps:
    """Return the steps of a stage.

    Args:
        views: number of training views.
        seed, level: of the run and the stage.
        started_on: number of ranks that the run was started on, which decides its sums.
        ranks: that train it now.
        device: of training.
        sharded: whether the ranks have different Gaussians.
    """
    if sharded:
        return ShardedSteps(views, seed, level, ranks.size, ranks, exact=False)
    if started_on == 1:
        return WholeSteps(views, seed, level)
    return SharedSteps(views, seed, level, shards_of(started_on), ranks, exact=device.type == "cpu")
