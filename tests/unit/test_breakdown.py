"""The runtime breakdown: parts have the time spent in them, and add up to the whole."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lapgs_plugin.runs import profiling
from lapgs_plugin.runs.profiling import (
    PARTS,
    UNREAD_EVENTS,
    Breakdown,
    Clock,
    breakdown_on,
)


@dataclass
class LaggingClock:
    """Stand in for a GPU's clock: stamps are tickets, reached only after the work before them, in whole seconds.

    Attributes:
        now: time when the work given so far will be done.
        done: time up to which it is done.
        times: moment of each ticket.
        waits: number of waits.
        held: tickets given and not released.
    """

    now: int = 0
    done: int = 0
    times: list[int] = field(default_factory=list)
    waits: int = 0
    held: set[int] = field(default_factory=set)

    def stamp(self) -> int:
        self.times.append(self.now)
        self.held.add(len(self.times) - 1)
        return len(self.times) - 1

    def passed(self, stamp: int) -> bool:
        return self.times[stamp] <= self.done

    def between(self, begin: int, end: int) -> float:
        assert self.passed(end), "read before the work was done"
        return self.times[end] - self.times[begin]

    def wait(self) -> None:
        self.waits += 1
        self.done = self.now

    def release(self, stamp: int) -> None:
        self.held.remove(stamp)


steps = st.lists(
    st.tuples(st.sampled_from((*PARTS, None, "begin", "end")), st.integers(0, 50), st.integers(0, 60)), max_size=600
)


@settings(deadline=None, max_examples=60)
@given(steps=steps)
def test_every_second_belongs_to_the_part_that_was_marked_last(steps: list[tuple[str | None, int, int]]) -> None:
    clock = LaggingClock()
    breakdown = Breakdown(clock)
    breakdown.mark("other")
    expected = dict.fromkeys(PARTS, 0)
    current: str | None = "other"  # what a plain reading of the marks says
    outer: str | None = None
    regions: list[AbstractContextManager[None]] = []
    for part, work, done in steps:
        if part == "begin":
            regions.append(breakdown.within("densification"))
            regions[-1].__enter__()
            if len(regions) == 1:
                outer, current = current, "densification"
        elif part == "end":
            if regions:
                regions.pop().__exit__(None, None, None)
                current = current if regions else outer
        else:
            breakdown.pause() if part is None else breakdown.mark(part)
            current = current if regions else part
        if current is not None:
            expected[current] += work
        clock.now += work
        clock.done = min(clock.now, clock.done + done)
    assert clock.waits == 0
    while regions:
        regions.pop().__exit__(None, None, None)
    breakdown.pause()
    assert breakdown.seconds() == expected
    assert len(clock.held) == 1  # the last mark; all others were released


def test_marks_are_read_without_waiting_after_the_work() -> None:
    clock = LaggingClock()
    breakdown = Breakdown(clock)
    for _ in range(10 * UNREAD_EVENTS):
        breakdown.mark("forward")
        clock.now += 1
        clock.done = clock.now - 20  # the GPU is always a little behind
    assert clock.waits == 0
    assert len(clock.held) <= UNREAD_EVENTS


def test_parts_of_known_lengths(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0]
    monkeypatch.setattr(profiling, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    breakdown = Breakdown(Clock())
    for part, seconds in (("forward", 3), ("loss", 1), ("backward", 6), ("forward", 2)):
        breakdown.mark(part)
        now[0] += seconds
    with breakdown.within("densification"):
        breakdown.mark("forward")  # scores are rendered
        now[0] += 4
    breakdown.pause()
    now[0] += 5
    expected = {"forward": 5, "loss": 1, "backward": 6, "densification": 4, "optimizer": 0, "other": 0}
    assert breakdown.seconds() == expected


def test_an_earlier_measurement_is_continued() -> None:
    clock = LaggingClock()
    breakdown = Breakdown(clock, {"forward": 2.5, "other": 1.0})
    breakdown.mark("forward")
    clock.now = 4
    breakdown.pause()
    assert breakdown.seconds() == {**dict.fromkeys(PARTS, 0.0), "forward": 6.5, "other": 1.0}


def test_measuring_nothing() -> None:
    breakdown = Breakdown()
    breakdown.mark("forward")
    with breakdown.within("densification"):
        breakdown.pause()
    assert breakdown.seconds() == {}
    assert not breakdown.measures
    assert breakdown_on(torch.device("cpu")).measures


def test_an_unknown_part_is_our_own_mistake() -> None:
    with pytest.raises(AssertionError, match="rendering"):
        breakdown_on(torch.device("cpu")).mark("rendering")


@pytest.mark.gpu
def test_a_gpu_is_timed_without_waiting_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def spin(milliseconds: float) -> None:
        torch.cuda._sleep(round(milliseconds * cycles))

    def seconds(milliseconds: float) -> float:
        torch.cuda.synchronize()
        start = time.perf_counter()
        spin(milliseconds)
        torch.cuda.synchronize()
        return time.perf_counter() - start

    # A GPU's queue takes about a thousand commands before it makes the processor wait: few marks, read early.
    unread, rounds, bursts = 16, 40, 2
    monkeypatch.setattr("lapgs_plugin.runs.profiling.UNREAD_EVENTS", unread)
    lengths = {"forward": 2.0, "backward": 4.0, "optimizer": 1.0}  # milliseconds
    cycles = 1e6
    seconds(10.0)
    cycles *= 0.1 / seconds(100.0)  # of the GPU's clock in a millisecond
    breakdown = breakdown_on(torch.device("cuda"))
    told = 0.0
    for _ in range(bursts):  # the second with the events of the first
        start = time.perf_counter()
        for _ in range(rounds):
            for part, length in lengths.items():
                breakdown.mark(part)
                spin(length)
        breakdown.pause()
        told += time.perf_counter() - start
        torch.cuda.synchronize()
    measured = breakdown.seconds()
    # To mark and launch took 0.7 ms of a round's 7 on the slowest processor seen; waits for the oldest of the unread
    # events would take told to all but their share, 1 - 16/120.
    assert told < 0.5 * sum(measured.values())
    for part, length in lengths.items():
        assert measured[part] == pytest.approx(1e-3 * length * rounds * bursts, rel=0.1), part
    assert measured["loss"] == measured["densification"] == measured["other"] == 0.0
