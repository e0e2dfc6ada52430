"""Charts as geometry: numbers in, coordinates and labels out. The report's template turns them into SVG."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

CHARACTER_WIDTH, LINE_HEIGHT = 7.5, 14.0
"""Of a label, about."""
TICKS, INSET_TICKS = 5, 3
HEADROOM = 1.04
INSET_POINTS = 3
"""Points that a line must have at the start for an inset to show more than the chart does."""
LEAST_SPAN = 0.02
"""Of an axis, as a share of its largest value: a line that is all but flat needs no labels of six digits."""
BAR_STEP = 30.0


@dataclass(frozen=True)
class Frame:
    """The size of a chart and the margins around its plot, in the chart's own units."""

    width: float
    height: float
    left: float
    right: float
    top: float
    bottom: float

    @property
    def plot_width(self) -> float:
        return self.width - self.left - self.right

    @property
    def plot_height(self) -> float:
        return self.height - self.top - self.bottom

    def x(self, share: float) -> float:
        """From 0 at the left end of the plot to 1 at its right end."""
        return round(self.left + self.plot_width * share, 1)

    def y(self, share: float) -> float:
        """From 0 at the bottom of the plot to 1 at its top."""
        return round(self.height - self.bottom - self.plot_height * share, 1)


WHOLE = Frame(420, 260, left=50, right=14, top=22, bottom=42)
"""Narrow enough that a phone shows the labels at a readable size."""
INSET = Frame(200, 112, left=42, right=10, top=8, bottom=20)
"""Drawn inside another chart, in the corner that curves which rise and flatten out leave free."""
INSET_AT = WHOLE.width - WHOLE.right - INSET.width, WHOLE.height - WHOLE.bottom - INSET.height - 6
"""Of its upper left corner."""


@dataclass(frozen=True)
class Series:
    """One line.

    Attributes:
        kind: the line's style.
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
class Move:
    """From one point to another, such as from a backbone alone to the backbone with a hierarchy.

    Attributes:
        kind: the arrow's style.
        label: said where the arrow is pointed at.
        start, end: (x, y) in data units.
    """

    kind: str
    label: str
    start: tuple[float, float]
    end: tuple[float, float]


@dataclass(frozen=True)
class Bar:
    """One bar of parts that add up.

    Attributes:
        label: beside it.
        parts: name and value of each, in their order.
    """

    label: str
    parts: Sequence[tuple[str, float]]

    @property
    def total(self) -> float:
        return math.fsum(value for _, value in self.parts)


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
class Arrow:
    """A move in chart units; its end is short of the point by the length of an arrow head."""

    kind: str
    label: str
    start: tuple[float, float]
    end: tuple[float, float]


@dataclass(frozen=True)
class Chart:
    """A drawn chart of lines or of arrows.

    Attributes:
        title, x_label: texts.
        frame: its size.
        lines, arrows: in drawing order.
        x_ticks, y_ticks: from the origin on.
        marks: at their place.
        inset: the start of the lines, larger, at `INSET_AT`.
    """

    title: str
    x_label: str
    frame: Frame
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    lines: tuple[Line, ...] = ()
    arrows: tuple[Arrow, ...] = ()
    marks: tuple[PlacedMark, ...] = ()
    inset: Chart | None = None


@dataclass(frozen=True)
class Segment:
    """A part of a bar in chart units.

    Attributes:
        name: of the part.
        x, width: its place.
        text: its value, for whoever points at it.
        shown: what is written on it, "" where there is no room.
    """

    name: str
    x: float
    width: float
    text: str
    shown: str


@dataclass(frozen=True)
class PlacedBar:
    """A bar in chart units: where it is, its parts, and where its total is written."""

    label: str
    y: float
    segments: tuple[Segment, ...]
    total: str
    end: float


@dataclass(frozen=True)
class BarChart:
    """Bars below each other on one scale.

    Attributes:
        title: text.
        frame: its size.
        bars: from the top.
        names: of all parts, in the order of the first bar that has them.
    """

    title: str
    frame: Frame
    bars: tuple[PlacedBar, ...]
    names: tuple[str, ...]


def draw(
    title: str,
    x_label: str,
    series: Sequence[Series],
    *,
    marks: Sequence[Mark] = (),
    from_zero: bool = True,
    format_x: Callable[[float], str] = "{:g}".format,
    format_y: Callable[[float], str] = "{:g}".format,
    inset_until: float | None = None,
    frame: Frame = WHOLE,
) -> Chart:
    """Place lines, ticks and marks.

    Args:
        series: at least one, none of them empty.
        from_zero: start the y axis at 0; otherwise just below the smallest value.
        format_x, format_y: text of a tick.
        inset_until: also draw what lies before this x as a chart of its own, if that has points enough.
        frame: size of the chart.
    """
    xs = [x for line in series for x, _ in line.points]
    ys = [y for line in series for _, y in line.points]
    count = TICKS if frame is WHOLE else INSET_TICKS
    right, highest = max(xs) or 1.0, max(ys)
    y_ticks = _ticks(0.0 if from_zero else min(ys), highest * HEADROOM if from_zero else highest, count)
    inset = None if inset_until is None else _start(x_label, series, inset_until, format_x, format_y)
    if inset is not None:
        y_ticks = _above_inset(series, right, y_ticks)
    bottom, top = y_ticks[0], y_ticks[-1]
    lines = []
    for line in series:
        placed = [(frame.x(x / right), frame.y((y - bottom) / (top - bottom))) for x, y in line.points]
        lines.append(Line(line.kind, " ".join(f"{x},{y}" for x, y in placed), placed[-1]))
    return Chart(
        title,
        x_label,
        frame,
        x_ticks=_x_ticks(right, count, format_x, frame),
        y_ticks=tuple(Tick(frame.y((y - bottom) / (top - bottom)), format_y(y)) for y in y_ticks),
        lines=tuple(lines),
        marks=_place_marks([(frame.x(mark.x / right), mark.label) for mark in marks], frame),
        inset=inset,
    )


def _start(
    x_label: str,
    series: Sequence[Series],
    until: float,
    format_x: Callable[[float], str],
    format_y: Callable[[float], str],
) -> Chart | None:
    """What lies before `until`."""
    begins = [Series(line.kind, [point for point in line.points if point[0] <= until]) for line in series]
    begins = [line for line in begins if len(line.points) > 1]
    if not any(len(line.points) >= INSET_POINTS for line in begins):
        return None
    return draw("the start", x_label, begins, from_zero=False, format_x=format_x, format_y=format_y, frame=INSET)


def _above_inset(series: Sequence[Series], right: float, ticks: list[float]) -> list[float]:
    """Ticks of a y axis that begins so low that no line runs behind the inset."""
    begin = right * (INSET_AT[0] - WHOLE.left) / WHOLE.plot_width
    behind = [
        y
        for line in series
        for (x, y), (after, _) in zip(line.points, [*line.points[1:], line.points[-1]], strict=True)
        if max(x, after) >= begin
    ]
    room = (WHOLE.height - WHOLE.bottom - INSET_AT[1] + 6) / WHOLE.plot_height
    for _ in range(TICKS):  # rounder ticks may lift the upper end again
        bottom, top = ticks[0], ticks[-1]
        if not behind or min(behind) - bottom >= room * (top - bottom):
            break
        ticks = _ticks((min(behind) - room * top) / (1 - room), top, TICKS)
    return ticks


def draw_moves(
    title: str,
    x_label: str,
    moves: Sequence[Move],
    *,
    format_x: Callable[[float], str] = "{:g}".format,
    format_y: Callable[[float], str] = "{:g}".format,
    head: float = 4.0,
) -> Chart:
    """Place arrows on axes that begin at 0.

    Args:
        moves: at least one.
        format_x, format_y: text of a tick.
        head: chart units by which an arrow ends before its point, so that its head ends at it.
    """
    points = [point for move in moves for point in (move.start, move.end)]
    right = max(x for x, _ in points) * HEADROOM or 1.0
    y_ticks = _ticks(0.0, max(y for _, y in points) * HEADROOM, TICKS)
    top = y_ticks[-1]

    def place(point: tuple[float, float]) -> tuple[float, float]:
        return WHOLE.x(point[0] / right), WHOLE.y(point[1] / top)

    arrows = []
    for move in moves:
        start, end = place(move.start), place(move.end)
        length = math.dist(start, end)
        share = max(0.0, 1.0 - head / length) if length else 1.0
        tip = (start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1]))
        arrows.append(Arrow(move.kind, move.label, start, (round(tip[0], 1), round(tip[1], 1))))
    return Chart(
        title,
        x_label,
        WHOLE,
        x_ticks=_x_ticks(right, TICKS, format_x, WHOLE),
        y_ticks=tuple(Tick(WHOLE.y(y / top), format_y(y)) for y in y_ticks),
        arrows=tuple(arrows),
    )


def draw_bars(title: str, bars: Sequence[Bar], *, format_value: Callable[[float], str] = "{:g}".format) -> BarChart:
    """Place bars, each with its label above it and its total at its end.

    Args:
        bars: at least one.
        format_value: text of a part or a total.
    """
    step = BAR_STEP + LINE_HEIGHT
    frame = Frame(WHOLE.width, step * len(bars), left=0, right=62, top=0, bottom=0)
    longest = max(bar.total for bar in bars) or 1.0
    placed = []
    for row, bar in enumerate(bars):
        segments, before = [], 0.0
        for name, value in bar.parts:
            width = frame.plot_width * value / longest
            text = format_value(value)
            shown = text if width > CHARACTER_WIDTH * len(text) else ""
            segments.append(Segment(name, frame.x(before / longest), round(width, 1), text, shown))
            before += value
        y = step * row + LINE_HEIGHT + 4
        placed.append(PlacedBar(bar.label, y, tuple(segments), format_value(bar.total), frame.x(before / longest)))
    names = dict.fromkeys(name for bar in bars for name, _ in bar.parts)
    return BarChart(title, frame, tuple(placed), tuple(names))


def _place_marks(marks: Sequence[tuple[float, str]], frame: Frame) -> tuple[PlacedMark, ...]:
    """Marks by increasing x, each label in the first row that is free."""
    ends: list[float] = []
    placed = []
    for x, label in marks:
        row = next((row for row, end in enumerate(ends) if end <= x), len(ends))
        ends[row : row + 1] = [x + CHARACTER_WIDTH * (len(label) + 1)]
        placed.append(PlacedMark(x, label, frame.top - 8 + LINE_HEIGHT * row))
    return tuple(placed)


def _x_ticks(right: float, count: int, text: Callable[[float], str], frame: Frame) -> tuple[Tick, ...]:
    """From 0 to the last that lies in the plot."""
    return tuple(Tick(frame.x(x / right), text(x)) for x in _ticks(0.0, right, count) if x <= right * 1.001)


def _ticks(low: float, high: float, count: int) -> list[float]:
    """About `count` round numbers, steps of 1, 2 or 5 times a power of ten, the first at or below `low`, the last at
    or above `high`."""
    span = max(high - low, LEAST_SPAN * max(abs(high), 1e-6))
    power = 10.0 ** math.floor(math.log10(span / count))
    step = next(factor * power for factor in (1, 2, 5, 10) if span / (factor * power) <= count)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [index * step for index in range(first, max(last, first + 1) + 1)]
