"""Fit the length of a stage into the seconds that a run may take. Imports no torch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Stage

UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}
"""Seconds of the units of --time."""
LOOK_SHARE = 0.01
"""Share of a stage's seconds between two looks at its rate."""
RATE_SHARE = 0.2
"""Share of the seconds since the stage began, the last ones, whose rate is taken for that of the rest."""
TOLERANCE = 0.01
"""Relative change of the planned length from which on the plan changes."""
COARSER_COST = 0.35
"""Time that a view takes to train on, by that of one of twice the sides with the Gaussians of its level: 0.27 to 0.42
on four scenes (H200). So a level's share of the seconds is not that of the iterations, which `--split` is about."""
GAUSSIAN_BYTES = 248
"""Of a Gaussian in a PLY of SH degree 3."""
WRITTEN_BYTES = 4e8
"""Bytes of PLY files that are archived a second; 8e8 seen on one host with a GPU."""
END_SECONDS = 1.0
"""What a command takes to end after its last level is archived, as Python and CUDA do; 1 to 1.5 seen."""
LEAST_LEFT = 1 / 3
"""Least time for training, by what was spent before: photos of levels, exposure and kernels come next, and took that
long on hosts where reading took 11 s."""


def cost_of(stages: Iterable[Stage]) -> float:
    """Return the time that stages take together, in that of an iteration at full size.

    >>> round(cost_of([Stage(1, (400, 267), 3000), Stage(0, (800, 533), 1000, signed=True)]))
    2050
    """
    return sum(stage.iterations * COARSER_COST**stage.level for stage in stages)


def seconds_to_archive(gaussians: int) -> float:
    """Estimate how long it takes to write so many Gaussians, and to end."""
    return END_SECONDS + gaussians * GAUSSIAN_BYTES / WRITTEN_BYTES


def parse_duration(text: str) -> float:
    """Return the seconds of a duration such as 20s, 2m or 1.5h.

    >>> parse_duration("20s"), parse_duration("1.5m")
    (20.0, 90.0)

    Raises:
        UserInputError: it has no unit, is not a number, or is not positive and finite.
    """
    number, unit = text[:-1], text[-1:]
    try:
        seconds = float(number) * UNITS[unit]
    except (KeyError, ValueError) as error:
        raise UserInputError(
            f"--time {text}: expected a number with its unit, seconds, minutes or hours, such as 20s, 2m or 1h"
        ) from error
    if not 0.0 < seconds < math.inf:
        raise UserInputError(f"--time {text}: expected a time above 0, such as 20s or 2m")
    return seconds


def require_time_left(text: str, spent: float, least: float = 0.0) -> None:
    """Raise a UserInputError if seconds that were spent leave too little of a duration for training.

    Args:
        text: the duration.
        spent: seconds.
        least: share of these that has to be left.
    """
    if spent * (1 + least) >= parse_duration(text):
        raise UserInputError(
            f"--time {text}: reading the scene and compiling took {spent:.1f} s, so that too little is left for "
            f"training; give {math.ceil(2 * spent)}s or more"
        )


@dataclass
class StageBudget:
    """Plan the iterations of a stage by its rate so far, so that it ends in time.

    The rate is that of the clock, so that whatever is done between iterations counts.

    Attributes:
        clock: returns seconds.
        run_ends: when the run should end, by the clock.
        planned: iterations of the stage.
        share: of the seconds that are left when the stage starts, that it has.
        reserve: seconds that are kept for what follows the iterations of this stage and of finer ones.
        afterwards: views to render after the last iteration, each in about the time of an iteration.
        ends: when the stage should end, with its last measurement; `start` decides it if it is not given.
    """

    clock: Callable[[], float]
    run_ends: float
    planned: int
    share: float = 1.0
    reserve: float = 0.0
    afterwards: int = 0
    ends: float = math.nan
    _marks: list[tuple[float, int]] = field(default_factory=list, init=False)  # seconds and iterations at each look

    def start(self, done: int) -> None:
        """Start to measure the rate, before the first iteration or after `done` ones of a continued stage."""
        now = self.clock()
        if math.isnan(self.ends):  # photos are read by now, so that no stage alone pays for that
            self.ends = now + self.share * max(0.0, self.run_ends - self.reserve - now)
        self._marks = [(now, done)]

    def length(self, iteration: int) -> int:
        """Return the stage's length in iterations, as planned after one of them."""
        now, (began, _), (looked, _) = self.clock(), self._marks[0], self._marks[-1]
        if now >= self.ends:
            self.planned = iteration
        elif now - looked >= LOOK_SHARE * (self.ends - began) or iteration >= self.planned:
            self._marks.append((now, iteration))
            rate = self._rate(now - RATE_SHARE * (now - began))
            left = round(rate * (self.ends - now)) - self.afterwards
            if now - began < (self.ends - began) / 2:
                left = max(1, left)  # the first iterations may be slow
            if left <= 0 or abs(iteration + left - self.planned) > TOLERANCE * self.planned:
                self.planned = iteration + max(0, left)
        return self.planned

    def state(self) -> dict[str, float]:
        """Return everything that the clock has decided, and the seconds that are left."""
        now = self.clock()
        return {"planned": self.planned, "stage_seconds": self.ends - now, "run_seconds": self.run_ends - now}

    def _rate(self, since: float) -> float:
        """Return the iterations a second from the last look at or before a time until now."""
        seconds, iteration = [mark for mark in self._marks if mark[0] <= since][-1]
        now, done = self._marks[-1]
        return (done - iteration) / (now - seconds)
