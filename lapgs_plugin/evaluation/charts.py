"""Line charts as geometry: numbers in, coordinates and labels out. The report's template turns them into SVG."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

WIDTH, HEIGHT = 420, 260
"""Of a chart in its own units: narrow enough that a phone shows the labels at a readable size."""
LEFT, RIGHT, TOP, BOTTOM = 50, 14, 22, 42
"""Margins around the plot, for labels."""
CHARACTER_WIDTH, LINE_HEIGHT = 7.5, 14.0
"""Of a label, about."""
TICKS = 5
HEADROOM = 1.04


@dataclass(frozen=True)
class Series:
    """One line.

    Attributes:
        kind: "run" or "baseline", the line's style.
        points: (x, y) in data units, by increasing x.
    """

    kind: str
    points: Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Mark:
    """A moment to point out: a vertical line at x with a word beside it."""

    x: float
    label: str


@dataclass(frozen=True)
class Tick:
    """Where a label of an axis stands, in chart units."""

    at: float
    label: str


@dataclass(frozen=True)
class PlacedMark:
    """A mark in chart units.

    Attributes:
        at: x of its line and of the start of its label.
        label: the word.
        y: baseline of its label; labels that would overlap stand below each other.
    """

    at: float
    label: str
    y: float


@dataclass(frozen=True)
class Line:
    """One line in chart units, as the value of an SVG polyline's "points"."""

    kind: str
    points: str
    last: tuple[float, float]


@dataclass(frozen=True)
class Chart:
    """A drawn chart.

    Attributes:
        title, x_label: texts.
        lines: in drawing order.
        x_ticks, y_ticks: from the origin on.
        marks: at their place.
    """

    title: str
    x_label: str
    lines: tuple[Line, ...]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    marks: tuple[PlacedMark, ...]


def draw(
    title: str,
    x_label: str,
    series: Sequence[Series],
    *,
    marks: Sequence[Mark] = (),
    from_zero: bool = True,
    format_x: Callable[[float], str] = "{:g}".format,
    format_y: Callable[[float], str] = "{:g}".format,
) -> Chart:
    """Place lines, ticks and marks.

    Args:
        series: at least one, none of them empty.
        from_zero: start the y axis at 0; otherwise just below the smallest value.
        format_x, format_y: text of a tick.
    """
    xs = [x for line in series for x, _ in line.points]
    ys = [y for line in series for _, y in line.points]
    right, highest = max(xs) or 1.0, max(ys)
    y_ticks = _ticks(0.0 if from_zero else min(ys), highest * HEADROOM if from_zero else highest)
    bottom, top = y_ticks[0], y_ticks[-1]

    def to_x(x: float) -> float:
        return round(LEFT + (WIDTH - LEFT - RIGHT) * x / right, 1)

    def to_y(y: float) -> float:
        return round(HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (y - bottom) / (top - bottom), 1)

    lines = []
    for line in series:
        placed = [(to_x(x), to_y(y)) for x, y in line.points]
        lines.append(Line(line.kind, " ".join(f"{x},{y}" for x, y in placed), placed[-1]))
    return Chart(
        title,
        x_label,
        tuple(lines),
        x_ticks=tuple(Tick(to_x(x), format_x(x)) for x in _ticks(0.0, right) if x <= right * 1.001),
        y_ticks=tuple(Tick(to_y(y), format_y(y)) for y in y_ticks),
        marks=_place_marks([(to_x(mark.x), mark.label) for mark in marks]),
    )


def _place_marks(marks: Sequence[tuple[float, str]]) -> tuple[PlacedMark, ...]:
    """Marks by increasing x, each label in the first row that is free."""
    ends: list[float] = []
    placed = []
    for x, label in marks:
        row = next((row for row, end in enumerate(ends) if end <= x), len(ends))
        ends[row : row + 1] = [x + CHARACTER_WIDTH * (len(label) + 1)]
        placed.append(PlacedMark(x, label, TOP - 8 + LINE_HEIGHT * row))
    return tuple(placed)


def _ticks(low: float, high: float) -> list[float]:
    """About `TICKS` round numbers, steps of 1, 2 or 5 times a power of ten, the first at or below `low`, the last at
    or above `high`."""
    span = max(high - low, 1e-9 * max(abs(high), 1.0))
    power = 10.0 ** math.floor(math.log10(span / TICKS))
    step = next(factor * power for factor in (1, 2, 5, 10) if span / (factor * power) <= TICKS)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [index * step for index in range(first, max(last, first + 1) + 1)]
