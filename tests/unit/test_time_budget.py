"""Durations of --time, and stages whose length the clock decides."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.training.time_budget import (
    COARSER_COST,
    StageBudget,
    cost_of,
    parse_duration,
    require_time_left,
    seconds_to_archive,
)


@pytest.mark.parametrize(
    ("text", "seconds"), [("20s", 20.0), ("0.5s", 0.5), ("2m", 120.0), ("1.5m", 90.0), ("1h", 3600.0)]
)
def test_a_duration_has_a_unit(text: str, seconds: float) -> None:
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["5", "0", "", "s", "2 minutes", "20S", "1m30s", "fast", "2d"])
def test_other_texts_are_no_durations(text: str) -> None:
    with pytest.raises(UserInputError, match=rf"--time {text}: expected a number with its unit, .* such as 20s"):
        parse_duration(text)


@pytest.mark.parametrize("text", ["0s", "-5s", "nans", "infm", "1e400h"])
def test_a_duration_is_positive_and_finite(text: str) -> None:
    with pytest.raises(UserInputError, match=f"--time {text}: expected a time above 0"):
        parse_duration(text)


@pytest.mark.parametrize(("least", "enough", "too_much"), [(0.0, 3.9, 4.1), (1 / 3, 2.9, 3.1)])
def test_a_time_shorter_than_reading_the_scene_leaves_nothing(least: float, enough: float, too_much: float) -> None:
    require_time_left("4s", enough, least)
    longer = math.ceil(2 * too_much)
    with pytest.raises(UserInputError, match=rf"--time 4s: reading .* took {too_much} s, .*; give {longer}s or more"):
        require_time_left("4s", too_much, least)
    require_time_left(f"{longer}s", too_much, least)


class Clock:
    """A clock that is set by hand."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def __call__(self) -> float:
        return self.seconds


def trained(budget: StageBudget, clock: Clock, cost: Callable[[int], float], done: int = 0) -> int:
    """Return the iterations of a stage whose iterations take `cost` seconds each."""
    budget.start(done)
    while done < budget.planned:
        done += 1
        clock.seconds += cost(done)
        budget.length(done)
    return done


costs = st.sampled_from(
    [
        lambda i: 0.01,
        lambda i: 0.01 * (1 + min(i, 3000) / 1000),  # Gaussians are added
        lambda i: 0.02 if i < 1000 else 0.03,  # coarser fields are trained jointly
        lambda i: 1.0 if i == 1 else 0.01,  # something is compiled
        lambda i: 0.01 + (0.3 if i % 200 == 0 else 0.0),  # views are measured
    ]
)


@settings(deadline=None, max_examples=50)
@given(costs, st.floats(30.0, 300.0), st.integers(1, 100_000), st.integers(0, 30))
def test_a_stage_ends_in_time_however_it_was_planned(
    cost: Callable[[int], float], seconds: float, planned: int, afterwards: int
) -> None:
    clock = Clock(7.0)
    budget = StageBudget(clock, 7.0 + seconds, planned, afterwards=afterwards)
    assert trained(budget, clock, cost) == budget.planned
    clock.seconds += afterwards * min(cost(budget.planned), cost(budget.planned + 1))
    assert clock.seconds - 7.0 == pytest.approx(seconds, rel=0.03)  # the worst was 2.3 %


@settings(deadline=None, max_examples=50)
@given(st.floats(0.01, 0.1), st.floats(30.0, 300.0))
def test_at_an_even_rate_the_first_plan_holds(cost: float, seconds: float) -> None:
    """So the progress, from which rates follow, is the share of the seconds that are over."""
    clock = Clock(0.0)
    budget, plans = StageBudget(clock, seconds, 10**6), set()
    budget.start(0)
    done = 0
    while done < budget.planned:
        done += 1
        clock.seconds += cost
        budget.length(done)
        plans.add(budget.planned)
        if len(plans) == 2:  # after the first look
            assert done / budget.planned == pytest.approx(clock.seconds / seconds, abs=0.02)
    assert len(plans) <= 2
    assert done == pytest.approx(seconds / cost, rel=0.02, abs=1)


def test_a_continued_stage_has_the_seconds_that_are_left() -> None:
    clock = Clock(100.0)
    budget = StageBudget(clock, 170.0, 5000, ends=140.0)
    budget.start(0)
    for done in range(1, 1001):
        clock.seconds += 0.01
        budget.length(done)
    state = budget.state()
    assert state == {"planned": 4000, "stage_seconds": pytest.approx(30.0), "run_seconds": pytest.approx(60.0)}
    later = Clock(5000.0)
    seconds = state["run_seconds"], state["stage_seconds"]
    again = StageBudget(later, 5000.0 + seconds[0], int(state["planned"]), ends=5000.0 + seconds[1])
    assert trained(again, later, lambda i: 0.01, done=1000) == pytest.approx(4000, rel=0.01)


def test_levels_share_the_seconds_so_that_they_share_the_iterations() -> None:
    """Whose images of half the size take less time, and what is read and written beside them does not count."""
    clock, plan = Clock(0.0), StagePlan.create((512, 512), 10_000, 3)
    trained_on = []
    for index, stage in enumerate(plan):
        clock.seconds += 2.0  # photos are read
        share = cost_of([stage]) / cost_of(list(plan)[index:])
        reserve = seconds_to_archive(1_000_000 * (3 - index))
        budget = StageBudget(clock, 100.0, stage.iterations, share, reserve)
        trained_on.append(trained(budget, clock, lambda i, level=stage.level: 0.01 * COARSER_COST**level))  # type: ignore[misc]
        clock.seconds += seconds_to_archive(1_000_000) - seconds_to_archive(0)
    clock.seconds += seconds_to_archive(0)
    assert clock.seconds == pytest.approx(100.0, rel=0.01)
    shares = [count / sum(trained_on) for count in trained_on]
    assert shares == pytest.approx([stage.iterations / plan.iterations for stage in plan], abs=0.02)


@pytest.mark.parametrize(("first", "iterations"), [(0.01, 700), (2.0, 500)])
def test_views_to_measure_afterwards_take_their_part_of_the_seconds(first: float, iterations: int) -> None:
    """Of ten seconds three; that a slow first iteration leaves none of them is not concluded from it alone."""
    clock = Clock(0.0)
    budget = StageBudget(clock, 10.0, 1000, afterwards=300)
    assert trained(budget, clock, lambda i: first if i == 1 else 0.01) == pytest.approx(iterations, rel=0.03)


def test_a_stage_without_time_ends_after_its_first_step() -> None:
    clock = Clock(0.0)
    assert trained(StageBudget(clock, 10.0, 1000, reserve=11.0), clock, lambda i: 0.01) == 1


@given(st.integers(1, 4), st.integers(1, 50_000), st.data())
def test_a_longer_stage_makes_the_later_ones_longer(levels: int, iterations: int, data: st.DataObject) -> None:
    plan = StagePlan.create((512, 512), 10_000, levels)
    level = data.draw(st.integers(0, levels - 1))
    longer = plan.lasting(level, iterations)
    assert longer[level].iterations == iterations
    for stage in plan:
        factor = 1.0 if stage.level > level else iterations / plan[level].iterations
        assert longer[stage.level].iterations == pytest.approx(stage.iterations * factor, abs=1)
