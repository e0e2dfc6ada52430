"""Measure the cost of a run: seconds besides the optimization, seconds by part of an iteration, and GPU memory."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

PARTS = ("forward", "loss", "backward", "densification", "optimizer", "other")
"""Parts of an iteration: rendering; composition and loss; backward pass; densification and pruning with the scores that
they need; optimizer steps; everything else."""

UNREAD_EVENTS = 256
"""Number of waiting events from which on those that the GPU has passed are read, to be used again."""


class Overhead(dict[str, float]):
    """Add up seconds by purpose, such as "pyramid" or "cache".

    Args:
        seconds: spent so far.
        settle: called when a timed block ends, before the clock is read; waits for a GPU that still works on it.
    """

    def __init__(self, seconds: Mapping[str, float] | None = None, settle: Callable[[], None] | None = None) -> None:
        super().__init__(seconds or {})
        self._settle = settle

    @contextmanager
    def timed(self, purpose: str) -> Iterator[None]:
        """Add the time spent inside to a purpose."""
        start = time.perf_counter()
        try:
            yield
        finally:
            if self._settle is not None:
                self._settle()
            self[purpose] = self.get(purpose, 0.0) + time.perf_counter() - start


class PeakMemory:
    """Measure the highest use of a GPU's memory since this was made, and how much of it were images.

    Call `note` before images are added or removed, because the peak until then contained them. The device's statistics
    are reset, here and by `note`; on a CPU nothing is measured.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._bytes: dict[str, int] = {}
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)

    def note(self, images: int) -> dict[str, int]:
        """Read the peak since the last call, during which `images` bytes of images were on the GPU.

        Returns:
            Bytes of the highest "peak" so far and of the "images" in it; empty on a CPU.
        """
        if self._device.type == "cuda":
            peak = torch.cuda.max_memory_allocated(self._device)
            if peak >= self._bytes.get("peak", 0):
                self._bytes = {"peak": peak, "images": images}
            torch.cuda.reset_peak_memory_stats(self._device)
        return dict(self._bytes)


class Clock:
    """Make time stamps of a processor's work, which is done when its call returns."""

    def stamp(self) -> Any:
        """Return this moment in the device's work."""
        return time.perf_counter()

    def passed(self, stamp: Any) -> bool:
        """Return whether the device has reached a moment; a GPU's work may lag behind."""
        return True

    def between(self, begin: Any, end: Any) -> float:
        """Return the seconds between two moments that were reached."""
        return float(end - begin)

    def wait(self) -> None:
        """Wait until every moment was reached."""

    def release(self, stamp: Any) -> None:
        """Take back a stamp that is not needed any more."""


class StreamClock(Clock):
    """Record events in a CUDA device's current stream without waiting: they time its work and the gaps in it."""

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


class Breakdown:
    """Measure the time of the parts of an iteration by marks at their boundaries.

    Each moment between two marks belongs to one part, so the parts add up to the whole.

    Args:
        clock: makes the marks; None measures nothing.
        seconds: by part, measured before a run was interrupted.
    """

    def __init__(self, clock: Clock | None = None, seconds: Mapping[str, float] | None = None) -> None:
        self.measures = clock is not None
        self._clock = clock or Clock()
        self._seconds = dict.fromkeys(PARTS, 0.0) | dict(seconds or {})
        self._marks: deque[tuple[str | None, Any]] = deque()
        self._within = False

    def mark(self, part: str) -> None:
        """Assign the time from here on to `part`, one of `PARTS`; has no effect inside `within`."""
        assert part in PARTS, part
        self._put(part)

    def pause(self) -> None:
        """Assign the time from here to the next mark to no part."""
        self._put(None)

    @contextmanager
    def within(self, part: str) -> Iterator[None]:
        """Assign all time inside to `part`, ignoring marks there, and time afterwards to the part before."""
        if self._within or not self._marks:
            yield  # the time belongs to the enclosing part, or comes before the first mark
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
        """Return seconds by part up to the last mark; empty when nothing is measured. Waits for a GPU."""
        if not self.measures:
            return {}
        self._clock.wait()
        self._read()
        return dict(self._seconds)

    def _put(self, part: str | None) -> None:
        if self._within or not self.measures:
            return
        self._marks.append((part, self._clock.stamp()))
        if len(self._marks) > UNREAD_EVENTS:
            self._read()

    def _read(self) -> None:
        """Add up the time between marks that were passed; the last one stays and begins the next time."""
        while len(self._marks) > 1 and self._clock.passed(self._marks[1][1]):
            part, begin = self._marks.popleft()
            if part is not None:
                self._seconds[part] += self._clock.between(begin, self._marks[0][1])
            self._clock.release(begin)


def breakdown_on(device: torch.device, seconds: Mapping[str, float] | None = None) -> Breakdown:
    """Return a breakdown that measures the work of a device; `seconds` as it takes them."""
    return Breakdown(clock_on(device), seconds)


def clock_on(device: torch.device) -> Clock:
    """Return the clock of a device's work."""
    return StreamClock(device) if device.type == "cuda" else Clock()
