"""End a stage when training views that are set aside stop gaining: `--stop auto`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import fmean, median
from typing import Any

from lapgs_plugin.runs.manifest import DecidedLength

LEAST_PHOTOS = 10
"""Fewest training views of which some can be set aside."""
PHOTOS_OF_ONE = 10
"""One of so many training views is set aside, within the next two bounds."""
FEWEST_ASIDE = 3
"""Fewest views that are set aside."""
MOST_ASIDE = 8
"""Most views that are set aside."""

DECAY_FROM = 0.6
"""Share of a stage's iterations after which its length was decided, if that is less than its most. The rest is its
decay. Of its most iterations it is the last share at which a shorter length can be decided."""
LEAST_SHARE = 1 / 8
"""Share of its most iterations before which a stage's length is not decided: at first, views differ in their gains."""
LOOK_SHARE = 1 / 8
"""Share of the iterations so far between two measurements."""
WINDOW = 0.5
"""Share of the iterations so far, the last ones, whose measurements count."""
LEAST_LOOKS = 5
"""Fewest measurements from which gains are extrapolated."""
MORE = 4 / 3
"""Factor on the iterations so far up to which gains are extrapolated."""
LEAST_GAIN = 0.05
"""Decibels that views should gain by then for a stage to go on."""


def views_to_set_aside(photos: int) -> int:
    """Return how many of so many training views are set aside.

    >>> [views_to_set_aside(photos) for photos in (10, 43, 112, 255)]
    [3, 4, 8, 8]
    """
    return min(MOST_ASIDE, max(FEWEST_ASIDE, photos // PHOTOS_OF_ONE))


@dataclass
class StageGains:
    """Plan the iterations of a stage by the PSNR of views that are set aside.

    A stage begins as one of its most iterations. When views stop gaining, a length is planned of which `DECAY_FROM` is
    over: rates, which follow the share of the planned iterations that is done, fall to their ends in the rest. A stage
    whose views go on gaining has the schedule of its most iterations throughout.

    A gain is extrapolated as linear in the logarithm of the iteration, by least squares, for each view by itself. The
    median over the views decides, if it is little twice in a row: one measurement differs from the next.

    Attributes:
        most: iterations of the stage.
        planned: iterations, as long as nothing else is decided.
        looks: iteration and PSNR of each view in dB of all measurements.
        decided: iteration after which the plan was decided; None before.
        expected: gain in dB within the next third of the iterations, as of the last measurement; None if too few are
            there.
    """

    most: int
    planned: int
    looks: list[tuple[int, list[float]]] = field(default_factory=list)
    decided: int | None = None
    expected: float | None = None

    def is_due(self, iteration: int) -> bool:
        """Return whether the views are to be measured after an iteration."""
        return self.decided is None and iteration >= self._next_look

    def note(self, iteration: int, psnrs: Sequence[float]) -> None:
        """Note the PSNR of the views after an iteration, and plan the stage anew."""
        self.looks.append((iteration, list(psnrs)))
        before, self.expected = self.expected, self._extrapolated()
        ends = math.ceil(iteration / DECAY_FROM)
        if ends >= self.most:
            self.decided = iteration
        elif iteration >= LEAST_SHARE * self.most and _is_little(before) and _is_little(self.expected):
            self.planned, self.decided = ends, iteration

    @property
    def length(self) -> DecidedLength | None:
        """Why the stage has `planned` iterations; None before that is decided."""
        if self.decided is None:
            return None
        return DecidedLength(self.most, self.decided, len(self.looks[-1][1]), self.expected)

    def state(self) -> dict[str, Any]:
        """Return everything that was measured and decided."""
        return {
            "planned": self.planned,
            "looks": [(iteration, list(psnrs)) for iteration, psnrs in self.looks],
            "decided": self.decided,
            "expected": self.expected,
        }

    @property
    def _next_look(self) -> int:
        """The first iteration after which the views are measured again."""
        if not self.looks:
            return max(1, math.ceil((1.0 - WINDOW) * LEAST_SHARE * self.most))
        last = self.looks[-1][0]
        return last + math.ceil(LOOK_SHARE * last)

    def _extrapolated(self) -> float | None:
        """Return the median of the views' gains up to `MORE` times the iterations so far; None if few were measured."""
        last = self.looks[-1][0]
        looks = [(math.log(iteration), psnrs) for iteration, psnrs in self.looks if iteration >= (1.0 - WINDOW) * last]
        if len(looks) < LEAST_LOOKS:
            return None
        centre = fmean(time for time, _ in looks)
        spread = sum((time - centre) ** 2 for time, _ in looks)
        slopes = [
            sum((time - centre) * psnrs[view] for time, psnrs in looks) / spread for view in range(len(looks[0][1]))
        ]
        return math.log(MORE) * median(slopes)


def _is_little(gain: float | None) -> bool:
    return gain is not None and gain < LEAST_GAIN
