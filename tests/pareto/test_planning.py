"""The length of a run, from a budget and from runs that took what a known machine takes."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from lapgs_bench.pareto.running import FARTHEST, LEAST, planned_iterations


def run_of(iterations: int, start: float, rate: float) -> dict[str, Any]:
    """A run on a machine that takes `start` seconds, and `rate` for each iteration."""
    return {"iterations": iterations, "train_seconds": start + rate * iterations}


@given(
    counts=st.lists(st.integers(100, 400), min_size=2, max_size=4, unique=True),
    rate=st.floats(1e-3, 1.0),
    start=st.floats(0.0, 10.0),
    longer=st.floats(1.1, 3.0),
)
def test_two_runs_tell_start_and_rate(counts: list[int], rate: float, start: float, longer: float) -> None:
    runs = [run_of(count, start, rate) for count in counts]
    budget = longer * runs[-1]["train_seconds"]
    iterations = planned_iterations(budget, runs)
    proportional = budget * counts[-1] / runs[-1]["train_seconds"]
    assume(iterations < round(FARTHEST * proportional))  # bounded: two noisy runs must not plan a run without end
    assert start + rate * iterations == pytest.approx(budget, abs=0.51 * rate + 1e-6)  # rounded to an iteration


@given(budget=st.floats(0.01, 1e4), count=st.integers(20, 10_000), rate=st.floats(1e-4, 1.0))
def test_one_run_tells_a_rate(budget: float, count: int, rate: float) -> None:
    iterations = planned_iterations(budget, [run_of(count, 0.0, rate)])
    assert iterations == LEAST or iterations * rate == pytest.approx(budget, abs=0.51 * rate)


def test_runs_that_contradict_each_other_are_taken_as_proportional() -> None:
    """The longer run took less time, as on a machine that others use."""
    runs = [run_of(100, 5.0, 0.1), run_of(200, 0.0, 0.05)]
    assert planned_iterations(20.0, runs) == 400
