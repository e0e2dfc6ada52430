"""Notice that held-out views get worse while the training loss falls, and say what helps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

SAMPLES_OF_A_STAGE = 5
"""How often a stage measures some held-out views."""
SAMPLED_VIEWS = 8
"""Most views of such a measurement."""
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


@dataclass
class QualityWatch:
    """Compare the measurements of a run with each other.

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
