"""Measure views during stages: notice that held-out ones get worse, and set training views aside to keep the best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from torch import Tensor

from lapgs_plugin.training.gains import views_to_set_aside
from lapgs_plugin.training.settings import enough_iterations

SAMPLES_OF_A_STAGE = 5
"""How often a stage measures some held-out views."""
SAMPLED_VIEWS = 8
"""Most views of such a measurement."""
SAMPLES_TO_KEEP_BEST = 10
"""How often a stage measures the views that were set aside, to keep the best state."""
LEAST_GAIN = 0.01
"""Decibels by which an earlier state must be better than the last one to be archived instead of it."""
LEAST_VIEWS = 12
"""Fewest training views of which some can be set aside."""
FEW_VIEWS = 24
"""A run on fewer training views than that, with more than `enough_iterations`, may fit them alone."""
FALL = 0.5
"""Decibels below the best measurement that count as getting worse."""

View = TypeVar("View")


def spread_views(views: Sequence[View], most: int) -> list[View]:
    """Return at most so many of some views, evenly spread, always the same ones.

    >>> spread_views("abcdefgh", 3)
    ['b', 'e', 'g']
    """
    count = min(most, len(views))
    return [views[int((index + 0.5) * len(views) / count)] for index in range(count)]


def set_aside(views: Sequence[View]) -> list[View]:
    """Return the training views that choose the best state: one of 16, but two at least and eight at most."""
    return spread_views(views, min(SAMPLED_VIEWS, max(2, len(views) // 16)))


def set_aside_to_stop(views: Sequence[View]) -> list[View]:
    """Return the training views that decide when a stage ends."""
    return spread_views(views, views_to_set_aside(len(views)))


def copied(state: Any) -> Any:
    """Return a state of tensors and containers of them with every tensor copied to the CPU."""
    if isinstance(state, Tensor):
        return state.detach().to("cpu", copy=True)
    return {key: copied(value) for key, value in state.items()} if isinstance(state, dict) else state


def few_views_line(views: int, iterations: int, held_out: bool) -> str | None:
    """Return a line for a user whose photos are few for the iterations of a run; None if they are enough.

    Args:
        views: that are trained on.
        iterations: of all stages.
        held_out: whether other views are measured during the run.
    """
    passes = iterations // views
    if views >= FEW_VIEWS or iterations <= enough_iterations(views):
        return None
    keep = " or --keep best" if views >= LEAST_VIEWS else ""
    shows = "the held-out PSNR" if held_out else "--eval"
    return (
        f"{views} training views are few for {iterations:,} iterations, {passes:,} passes over them: new views may get "
        f"worse late in the run; {shows} shows it, and fewer --iterations{keep} may help"
    )


@dataclass
class QualityWatch:
    """Compare the measurements of a run with each other, those since it was last resumed.

    Attributes:
        best: highest PSNR in dB of the run so far.
        warned: whether a line was shown; one is enough.
    """

    best: float = -math.inf
    warned: bool = False
    _level: int | None = None
    _loss: float = math.inf
    _was_worse: bool = False

    def falls(self, level: int, psnr: float, loss: float) -> bool:
        """Note a measurement, and return whether it makes two in a row that are worse although the training loss fell.

        Losses are compared within a level alone, because finer images have other losses. One measurement proves
        nothing, because density control may just have changed the field.

        Args:
            level: of the stage.
            psnr: of some held-out views, in dB.
            loss: smoothed training loss.
        """
        learned = level == self._level and loss < self._loss
        self._level, self._loss, self.best = level, loss, max(self.best, psnr)
        worse, before = learned and psnr < self.best - FALL, self._was_worse
        self._was_worse = worse
        if not (worse and before) or self.warned:
            return False
        self.warned = True
        return True
