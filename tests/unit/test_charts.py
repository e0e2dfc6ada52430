"""Test charts: axes have round numbers and hold the data, and lines lie where the axes say."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lapgs_plugin.reports.charts import (
    INSET,
    INSET_AT,
    WHOLE,
    Arrow,
    Bar,
    Frame,
    Mark,
    Series,
    draw_arrows,
    draw_bars,
    draw_lines,
    number_text,
)

LEFT, RIGHT, TOP, BOTTOM = WHOLE.left, WHOLE.right, WHOLE.top, WHOLE.bottom
WIDTH, HEIGHT = WHOLE.width, WHOLE.height

values = st.floats(-1e7, 1e7, allow_nan=False).map(lambda value: round(value, 3))


@given(low=values, span=st.floats(1e-3, 1e7))
def test_ticks_are_round_few_and_enclose_the_data(low: float, span: float) -> None:
    high = low + span
    chart = draw_lines("t", "x", [Series("run", [(0, low), (1, high)])], from_zero=False, text=repr)
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


@pytest.mark.parametrize(("points", "dots"), [(1, 1), (2, 2), (20, 20), (21, 1)])
def test_few_points_are_marked_and_else_the_last(points: int, dots: int) -> None:
    (line,) = draw_lines("t", "x", [Series("run", [(x, x * x) for x in range(points)])]).lines
    assert line.dots == line.points[-dots:]


def test_points_lie_where_the_axes_say() -> None:
    chart = draw_lines("t", "x", [Series("run", [(0, 0), (5, 40), (10, 100)])], marks=[Mark(5, "half")])
    top = float(chart.y_ticks[-1].label)
    points = chart.lines[0].points
    height = HEIGHT - TOP - BOTTOM
    assert points[0] == (LEFT, HEIGHT - BOTTOM)
    # 0.033 seen.
    assert points[1] == pytest.approx(((LEFT + WIDTH - RIGHT) / 2, HEIGHT - BOTTOM - height * 40 / top), abs=0.06)
    assert points[2] == pytest.approx((WIDTH - RIGHT, HEIGHT - BOTTOM - height * 100 / top), abs=0.06)  # 0.033 seen
    assert chart.marks[0].at == pytest.approx(points[1][0])
    assert {tick.label: tick.at for tick in chart.x_ticks}["10"] == WIDTH - RIGHT


def test_labels_of_close_marks_stand_below_each_other() -> None:
    line = Series("run", [(0.0, 1.0), (100.0, 1.0)])
    chart = draw_lines("t", "x", [line], marks=[Mark(0, "level 3"), Mark(50, "level 2"), Mark(55, "level 1")])
    first, second, third = chart.marks
    assert first.y == second.y < third.y


@pytest.mark.parametrize("points", [[(0.0, 0.0)], [(0.0, 3.0), (1.0, 3.0)], [(2.0, 0.0), (4.0, 0.0)]])
@pytest.mark.parametrize("from_zero", [True, False])
def test_flat_and_single_points_are_drawn(points: list[tuple[float, float]], from_zero: bool) -> None:
    chart = draw_lines("t", "x", [Series("run", points)], from_zero=from_zero)
    for x, y in chart.lines[0].points:
        assert LEFT <= x <= WIDTH - RIGHT
        assert TOP - 0.1 <= y <= HEIGHT - BOTTOM + 0.1


def in_data(point: tuple[float, float], right: float, bottom: float, top: float, frame: Frame) -> tuple[float, float]:
    """Convert chart units back to data units."""
    x, y = point
    return (
        right * (x - frame.left) / (frame.width - frame.left - frame.right),
        bottom + (top - bottom) * (frame.height - frame.bottom - y) / (frame.height - frame.top - frame.bottom),
    )


def test_an_inset_holds_the_start_and_nothing_else() -> None:
    rising = [(float(x), 30.0 - 20.0 / (1 + x)) for x in range(0, 101, 2)]
    chart = draw_lines("t", "x", [Series("run", rising), Series("late", [(50, 10), (90, 20)])], inset_until=10.0)
    assert len(chart.lines) == 2
    assert chart.inset is not None
    (line,) = chart.inset.lines
    ticks = [float(tick.label) for tick in chart.inset.y_ticks]
    drawn = [in_data(point, 10.0, ticks[0], ticks[-1], INSET) for point in line.points]
    assert drawn == [pytest.approx(point, abs=0.1) for point in rising[:6]]
    assert chart.inset.inset is None
    assert draw_lines("t", "x", [Series("run", rising[::10])], inset_until=30.0).inset is None  # two points say no more


curves = st.lists(
    st.lists(st.tuples(st.floats(0.0, 100.0), st.floats(5.0, 40.0)), min_size=4, max_size=30), min_size=1, max_size=3
)


@settings(deadline=None)
@given(curves=curves)
def test_nothing_runs_behind_an_inset(curves: list[list[tuple[float, float]]]) -> None:
    longest = max(x for curve in curves for x, _ in curve)
    series = [Series("run", sorted(curve)) for curve in curves]
    chart = draw_lines("t", "x", series, from_zero=False, inset_until=0.3 * longest)
    if chart.inset is None:
        return
    for line in chart.lines:
        for (x0, y0), (x1, y1) in pairwise(line.points):
            for share in (0.0, 0.25, 0.5, 0.75, 1.0):
                x, y = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
                assert x < INSET_AT[0] - 0.1 or y < INSET_AT[1]  # y counts downwards


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.0, "0"), (0.01234, "0.0123"), (12.34, "12.3"), (999.4, "999"), (999.7, "1,000"), (1234.5, "1,234")],
)
def test_numbers_have_three_digits_or_all_before_the_point(value: float, expected: str) -> None:
    assert number_text(value) == expected


coordinates = st.tuples(st.floats(0.0, 1e6), st.floats(0.0, 1e4))


@settings(deadline=None)
@given(ends=st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=6))
def test_arrows_begin_and_point_where_the_axes_say(
    ends: list[tuple[tuple[float, float], tuple[float, float]]],
) -> None:
    chart = draw_arrows("t", "x", [Arrow("run", "m", *pair) for pair in ends], repr)
    right = max(x for pair in ends for x, _ in pair) * 1.04 or 1.0
    top = float(chart.y_ticks[-1].label)
    for arrow, (start, end) in zip(chart.arrows, ends, strict=True):
        begins, points_at = (
            (WHOLE.left + (WIDTH - LEFT - RIGHT) * x / right, HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * y / top)
            for x, y in (start, end)
        )
        assert arrow.start == pytest.approx(begins, abs=0.06)  # 0.05 seen
        length = math.dist(begins, points_at)
        short = math.dist(arrow.end, points_at)
        assert short == pytest.approx(min(4.0, length), abs=0.3)  # 0.1 seen
        assert math.dist(begins, arrow.end) == pytest.approx(max(0.0, length - 4.0), abs=0.3)  # on the way to it


amounts = st.lists(st.tuples(st.sampled_from("abcdef"), st.floats(0.0, 1e5)), max_size=6, unique_by=lambda p: p[0])


@settings(deadline=None)
@given(bars=st.lists(amounts, min_size=1, max_size=5))
def test_bars_share_a_scale_and_their_parts_lie_end_to_end(bars: list[list[tuple[str, float]]]) -> None:
    chart = draw_bars("t", [Bar(f"bar {i}", parts) for i, parts in enumerate(bars)], repr)
    longest = max(math.fsum(value for _, value in parts) for parts in bars) or 1.0
    width = chart.frame.width - chart.frame.right
    assert [bar.label for bar in chart.bars] == [f"bar {i}" for i in range(len(bars))]
    for bar, parts in zip(chart.bars, bars, strict=True):
        at = 0.0
        for segment, (name, value) in zip(bar.segments, parts, strict=True):
            assert (segment.name, segment.text) == (name, repr(value))
            assert segment.x == pytest.approx(at, abs=0.06)  # 0.05 seen
            assert segment.width == pytest.approx(width * value / longest, abs=0.06)  # 0.05 seen
            assert segment.shown in ("", segment.text)
            at += width * value / longest
        assert bar.end == pytest.approx(at, abs=0.06)  # 0.049 seen
        assert 0 < bar.y < chart.frame.height
    assert set(chart.names) == {name for parts in bars for name, _ in parts}
