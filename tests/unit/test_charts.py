"""Charts: axes of round numbers that hold the data, and lines where the axes say."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lapgs_plugin.evaluation.charts import BOTTOM, HEIGHT, LEFT, RIGHT, TOP, WIDTH, Mark, Series, draw

values = st.floats(-1e7, 1e7, allow_nan=False).map(lambda value: round(value, 3))


@given(low=values, span=st.floats(1e-3, 1e7))
def test_ticks_are_round_few_and_enclose_the_data(low: float, span: float) -> None:
    high = low + span
    chart = draw("t", "x", [Series("run", [(0, low), (1, high)])], from_zero=False, format_y=repr)
    ticks = [float(tick.label) for tick in chart.y_ticks]
    assert 2 <= len(ticks) <= 8
    slack = 1e-6 * max(abs(low), abs(high), span)
    assert ticks[0] <= low + slack
    assert ticks[-1] >= high - slack
    steps = [b - a for a, b in pairwise(ticks)]
    digits = f"{steps[0]:e}".split("e")[0]
    assert float(digits) == pytest.approx(round(float(digits)), abs=1e-3)
    assert round(float(digits)) in (1, 2, 5, 10)
    assert steps == pytest.approx([steps[0]] * len(steps), rel=1e-6)


def test_points_lie_where_the_axes_say() -> None:
    chart = draw("t", "x", [Series("run", [(0, 0), (5, 40), (10, 100)])], marks=[Mark(5, "half")])
    top = float(chart.y_ticks[-1].label)
    points = [tuple(map(float, pair.split(","))) for pair in chart.lines[0].points.split()]
    height = HEIGHT - TOP - BOTTOM
    assert points[0] == (LEFT, HEIGHT - BOTTOM)
    assert points[1] == pytest.approx(((LEFT + WIDTH - RIGHT) / 2, HEIGHT - BOTTOM - height * 40 / top), abs=0.06)
    assert points[2] == pytest.approx((WIDTH - RIGHT, HEIGHT - BOTTOM - height * 100 / top), abs=0.06)
    assert chart.lines[0].last == points[2]
    assert chart.marks[0].at == pytest.approx(points[1][0])
    assert {tick.label: tick.at for tick in chart.x_ticks}["10"] == WIDTH - RIGHT


def test_labels_of_close_marks_stand_below_each_other() -> None:
    line = Series("run", [(0.0, 1.0), (100.0, 1.0)])
    chart = draw("t", "x", [line], marks=[Mark(0, "level 3"), Mark(50, "level 2"), Mark(55, "level 1")])
    first, second, third = chart.marks
    assert first.y == second.y < third.y


@pytest.mark.parametrize("points", [[(0.0, 0.0)], [(0.0, 3.0), (1.0, 3.0)], [(2.0, 0.0), (4.0, 0.0)]])
@pytest.mark.parametrize("from_zero", [True, False])
def test_flat_and_single_points_are_drawn(points: list[tuple[float, float]], from_zero: bool) -> None:
    chart = draw("t", "x", [Series("run", points)], from_zero=from_zero)
    for pair in chart.lines[0].points.split():
        x, y = map(float, pair.split(","))
        assert LEFT <= x <= WIDTH - RIGHT
        assert TOP - 0.1 <= y <= HEIGHT - BOTTOM + 0.1
