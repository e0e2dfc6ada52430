"""Where the time of iterations goes: seconds by part, from events on a GPU and from a clock on a CPU.

Boundaries are marked, and what lies between two of them belongs to one part: so the parts add up to the whole. On a GPU
a mark is an event in the stream of its work, recorded without waiting; events are read when the work has passed them.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Generic, TypeVar

import torch

PARTS = ("forward", "loss", "backward", "densification", "optimizer", "other")
"""Of an iteration: rendering; composition and loss; backward pass; densification and pruning with the scores they are
decided by; optimizer steps; everything else."""

UNREAD_EVENTS = 256
"""Events that may wait before those that the GPU has passed are read and used again."""

Stamp = TypeVar("Stamp")


class Breakdown:
    """Takes marks and forgets them: what is used when nothing is measured, at the price of an empty call a mark."""

    measures = False

    def mark(self, part: str) -> None:
        """From here on time belongs to `part`, one of `PARTS`; inside `within`, to what that says."""

    def pause(self) -> None:
        """From here on, to the next mark, time belongs to no part."""

    @contextmanager
    def within(self, part: str) -> Iterator[None]:
        """All time inside belongs to `part`, whatever is marked there; afterwards to the part before."""
        yield

    def seconds(self) -> dict[str, float]:
        """By part, up to the last mark; empty when nothing is measured. Waits for a GPU."""
        return {}


class Clock(ABC, Generic[Stamp]):
    """What marks are made with."""

    @abstractmethod
    def stamp(self) -> Stamp:
        """This moment."""

    @abstractmethod
    def passed(self, stamp: Stamp) -> bool:
        """Whether the moment has come; a GPU's work may be behind."""

    @abstractmethod
    def between(self, begin: Stamp, end: Stamp) -> float:
        """Seconds between two moments that have come."""

    @abstractmethod
    def wait(self) -> None:
        """Until every moment has come."""

    def release(self, stamp: Stamp) -> None:
        """Told of a stamp that is not needed any more."""


class ProcessorClock(Clock[float]):
    """`time.perf_counter`."""

    def stamp(self) -> float:
        return time.perf_counter()

    def passed(self, stamp: float) -> bool:
        return True

    def between(self, begin: float, end: float) -> float:
        return end - begin

    def wait(self) -> None:
        return


class StreamClock(Clock[torch.cuda.Event]):
    """Events in a CUDA device's current stream: the time of the work itself, and of the waits between it."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._free: list[torch.cuda.Event] = []

    def stamp(self) -> torch.cuda.Event:
        event = self._free.pop() if self._free else torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]  # torch's
        event.record(torch.cuda.current_stream(self._device))
        return event

    def passed(self, stamp: torch.cuda.Event) -> bool:
        return bool(stamp.query())  # type: ignore[no-untyped-call]  # torch's

    def between(self, begin: torch.cuda.Event, end: torch.cuda.Event) -> float:
        return float(begin.elapsed_time(end)) / 1e3

    def wait(self) -> None:
        torch.cuda.synchronize(self._device)

    def release(self, stamp: torch.cuda.Event) -> None:
        self._free.append(stamp)


class TimedBreakdown(Breakdown, Generic[Stamp]):
    """Measures.

    Args:
        clock: what marks are made with.
        seconds: by part, measured before, for what is being continued.
    """

    measures = True

    def __init__(self, clock: Clock[Stamp], seconds: Mapping[str, float] | None = None) -> None:
        self._clock = clock
        self._seconds = dict.fromkeys(PARTS, 0.0) | dict(seconds or {})
        self._marks: deque[tuple[str | None, Stamp]] = deque()
        self._within = False

    def mark(self, part: str) -> None:
        assert part in PARTS, part
        self._put(part)

    def pause(self) -> None:
        self._put(None)

    @contextmanager
    def within(self, part: str) -> Iterator[None]:
        if self._within or not self._marks:
            yield  # of what encloses it; or before the first mark
            return
        before = self._marks[-1][0]
        self.mark(part)
        self._within = True
        try:
            yield
        finally:
            self._within = False
            self._put(before)

    def seconds(self) -> dict[str, float]:
        self._clock.wait()
        self._read()
        return dict(self._seconds)

    def _put(self, part: str | None) -> None:
        if self._within:
            return
        self._marks.append((part, self._clock.stamp()))
        if len(self._marks) > UNREAD_EVENTS:
            self._read()

    def _read(self) -> None:
        """Add up what lies between marks that were passed; the last one stays, as the begin of what follows."""
        while len(self._marks) > 1 and self._clock.passed(self._marks[1][1]):
            part, begin = self._marks.popleft()
            if part is not None:
                self._seconds[part] += self._clock.between(begin, self._marks[0][1])
            self._clock.release(begin)


def breakdown_on(device: torch.device, seconds: Mapping[str, float] | None = None) -> Breakdown:
    """What measures the work of a device; `seconds` as in `TimedBreakdown`."""
    if device.type == "cuda":
        return TimedBreakdown(StreamClock(device), seconds)
    return TimedBreakdown(ProcessorClock(), seconds)
