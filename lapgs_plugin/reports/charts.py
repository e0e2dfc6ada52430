"""Lay out charts: turn numbers into coordinates and labels. The report's template turns these into SVG."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

VARIANT_COLORS = ("#c2571a", "#1767c2", "#2c8a4a", "#8a4fa3", "#a8324f", "#7a6a1f", "#2c8a86", "#5c6670")
"""Colours of the styles variant-0, variant-1, ... of lines and arrows."""
PART_COLORS = (
    *("#2f6fb0", "#2c8a86", "#8a4fa3", "#b3622a", "#a33d55", "#4d7f2c", "#7a6a1f", "#6b747d", "#4a4f9c", "#8a5a44"),
)
"""Colours of the parts of bars."""
CHARACTER_WIDTH = 7.5
"""Approximate width of a character of a label in chart units."""
LINE_HEIGHT = 14.0
"""Height of a line of labels in chart units."""
TICKS, INSET_TICKS = 5, 3
HEADROOM = 1.04
INSET_POINTS = 3
"""Fewest points at the start of a line for an inset."""
FEW_POINTS = 20
"""Most points of a line whose points are marked. Between so few points a line is no measurement."""
LEAST_SPAN = 0.02
"""Least span of an axis as a share of its largest value, so that labels of a flat line stay short."""
BAR_STEP = 30.0
ARROW_HEAD = 4.0
"""Length of an arrow's head in chart units, by which its line is shorter."""


def count_text(value: float) -> str:
    """Format a number for an axis: 1.5k, 20k, 1.2M."""
    for size, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{number_text(value / size)}{suffix}"
    return f"{value:g}"


def number_text(value: float) -> str:
    """Format a number with three significant digits, or all digits before its point."""
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"


def seconds_text(value: float) -> str:
    """Format seconds."""
    return f"{number_text(value)} s"


@dataclass(frozen=True)
class Frame:
    """The size of a chart and the margins around its plot, in chart units."""

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
        """Place a share of the plot's width, 0 at the left."""
        return round(self.left + self.plot_width * share, 1)

    def y(self, share: float) -> float:
        """Place a share of the plot's height, 0 at the bottom."""
        return round(self.height - self.bottom - self.plot_height * share, 1)


WHOLE = Frame(420, 260, left=50, right=14, top=22, bottom=42)
"""Frame of a whole chart, narrow enough that a phone shows readable labels."""
INSET = Frame(200, 112, left=42, right=10, top=8, bottom=20)
"""Frame of an inset, in the corner that rising and flattening curves leave free."""
INSET_AT = WHOLE.width - WHOLE.right - INSET.width, WHOLE.height - WHOLE.bottom - INSET.height - 6
"""Upper left corner of the inset."""


@dataclass(frozen=True)
class Series:
    """One line.

    Attributes:
        kind: style of the line.
        points: (x, y) by increasing x, in data units, or in chart units when drawn.
    """

    kind: str
    points: Sequence[tuple[float, float]]

    @property
    def dots(self) -> Sequence[tuple[float, float]]:
        """The points to mark: all when they are few, else the last."""
        return self.points if len(self.points) <= FEW_POINTS else self.points[-1:]


@dataclass(frozen=True)
class Mark:
    """A vertical line at x with a label."""

    x: float
    label: str


@dataclass(frozen=True)
class Arrow:
    """An arrow between two points, such as from a baseline to a hierarchy.

    Attributes:
        kind: style of the arrow.
        label: tooltip.
        start, end: (x, y) in data units, or in chart units when drawn; the drawn end leaves room for the head.
    """

    kind: str
    label: str
    start: tuple[float, float]
    end: tuple[float, float]


@dataclass(frozen=True)
class Bar:
    """A bar of parts that add up.

    Attributes:
        label: text above the bar.
        parts: name and value of each part, in order.
    """

    label: str
    parts: Sequence[tuple[str, float]]

    @property
    def total(self) -> float:
        return math.fsum(value for _, value in self.parts)


@dataclass(frozen=True)
class Tick:
    """A label of an axis, in chart units."""

    at: float
    label: str


@dataclass(frozen=True)
class PlacedMark:
    """A mark in chart units.

    Attributes:
        at: x of the line and of the start of the label.
        label: text.
        y: baseline of the label; overlapping labels are stacked.
    """

    at: float
    label: str
    y: float


@dataclass(frozen=True)
class Chart:
    """A drawn chart of lines or of arrows.

    Attributes:
        title, x_label: texts.
        frame: its size.
        lines, arrows: in drawing order.
        x_ticks, y_ticks: from the origin on.
        marks: placed marks.
        inset: the start of the lines, enlarged, at `INSET_AT`.
    """

    title: str
    x_label: str
    frame: Frame
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    lines: tuple[Series, ...] = ()
    arrows: tuple[Arrow, ...] = ()
    marks: tuple[PlacedMark, ...] = ()
    inset: Chart | None = None


@dataclass(frozen=True)
class Segment:
    """A part of a bar in chart units.

    Attributes:
        name: of the part.
        x, width: position and length.
        text: value, as a tooltip.
        shown: value written on the bar, "" when there is no room.
    """

    name: str
    x: float
    width: float
    text: str
    shown: str


@dataclass(frozen=True)
class PlacedBar:
    """A bar in chart units; `end` is the position of its total."""

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
        names: of all parts, in the order of their first bars.
    """

    title: str
    frame: Frame
    bars: tuple[PlacedBar, ...]
    names: tuple[str, ...]


def draw_lines(
    title: str,
    x_label: str,
    series: Sequence[Series],
    *,
    marks: Sequence[Mark] = (),
    from_zero: bool = True,
    text: Callable[[float], str] = count_text,
    inset_until: float | None = None,
    frame: Frame = WHOLE,
) -> Chart:
    """Lay out a chart of lines.

    Args:
        series: at least one; none is empty.
        from_zero: start the y axis at 0; otherwise just below the smallest value.
        text: formats a tick's value.
        inset_until: also draw the part before this x as an inset, if it has enough points.
        frame: size of the chart.
    """
    xs = [x for line in series for x, _ in line.points]
    ys = [y for line in series for _, y in line.points]
    count = TICKS if frame is WHOLE else INSET_TICKS
    right, highest = max(xs) or 1.0, max(ys)
    y_ticks = _ticks(0.0 if from_zero else min(ys), highest * HEADROOM if from_zero else highest, count)
    inset = None if inset_until is None else _start(x_label, series, inset_until, text)
    if inset is not None:
        y_ticks = _clear_inset(series, right, y_ticks)
    bottom, top = y_ticks[0], y_ticks[-1]
    lines = [
        Series(line.kind, [(frame.x(x / right), frame.y((y - bottom) / (top - bottom))) for x, y in line.points])
        for line in series
    ]
    return Chart(
        title,
        x_label,
        frame,
        x_ticks=_x_ticks(right, count, text, frame),
        y_ticks=tuple(Tick(frame.y((y - bottom) / (top - bottom)), text(y)) for y in y_ticks),
        lines=tuple(lines),
        marks=_place_marks([(frame.x(mark.x / right), mark.label) for mark in marks], frame),
        inset=inset,
    )


def _start(x_label: str, series: Sequence[Series], until: float, text: Callable[[float], str]) -> Chart | None:
    """Draw the part before `until` as an inset; None if it has too few points."""
    begins = [Series(line.kind, [point for point in line.points if point[0] <= until]) for line in series]
    begins = [line for line in begins if len(line.points) > 1]
    if not any(len(line.points) >= INSET_POINTS for line in begins):
        return None
    return draw_lines("the start", x_label, begins, from_zero=False, text=text, frame=INSET)


def _clear_inset(series: Sequence[Series], right: float, ticks: list[float]) -> list[float]:
    """Extend the y axis downwards until no line runs behind the inset."""
    begin = right * (INSET_AT[0] - WHOLE.left) / WHOLE.plot_width
    behind = [
        y
        for line in series
        for (x, y), (after, _) in zip(line.points, [*line.points[1:], line.points[-1]], strict=True)
        if max(x, after) >= begin
    ]
    room = (WHOLE.height - WHOLE.bottom - INSET_AT[1] + 6) / WHOLE.plot_height
    for _ in range(TICKS):  # rounder ticks may raise the upper end again
        bottom, top = ticks[0], ticks[-1]
        if not behind or min(behind) - bottom >= room * (top - bottom):
            break
        ticks = _ticks((min(behind) - room * top) / (1 - room), top, TICKS)
    return ticks


def draw_arrows(title: str, x_label: str, arrows: Sequence[Arrow], text: Callable[[float], str] = count_text) -> Chart:
    """Lay out a chart of arrows, with both axes from 0.

    Args:
        arrows: at least one.
        text: formats a tick's value.
    """
    points = [point for arrow in arrows for point in (arrow.start, arrow.end)]
    right = max(x for x, _ in points) * HEADROOM or 1.0
    y_ticks = _ticks(0.0, max(y for _, y in points) * HEADROOM, TICKS)
    top = y_ticks[-1]

    def to_chart(point: tuple[float, float]) -> tuple[float, float]:
        return WHOLE.x(point[0] / right), WHOLE.y(point[1] / top)

    placed = []
    for arrow in arrows:
        start, end = to_chart(arrow.start), to_chart(arrow.end)
        length = math.dist(start, end)
        share = max(0.0, 1.0 - ARROW_HEAD / length) if length else 1.0
        tip = (start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1]))
        placed.append(Arrow(arrow.kind, arrow.label, start, (round(tip[0], 1), round(tip[1], 1))))
    return Chart(
        title,
        x_label,
        WHOLE,
        x_ticks=_x_ticks(right, TICKS, text, WHOLE),
        y_ticks=tuple(Tick(WHOLE.y(y / top), text(y)) for y in y_ticks),
        arrows=tuple(placed),
    )


def draw_bars(title: str, bars: Sequence[Bar], text: Callable[[float], str]) -> BarChart:
    """Lay out bars, each with its label above it and its total at its end.

    Args:
        bars: at least one.
        text: formats a part or a total.
    """
    step = BAR_STEP + LINE_HEIGHT
    frame = Frame(WHOLE.width, step * len(bars), left=0, right=62, top=0, bottom=0)
    longest = max(bar.total for bar in bars) or 1.0
    placed = []
    for row, bar in enumerate(bars):
        segments, before = [], 0.0
        for name, value in bar.parts:
            width = frame.plot_width * value / longest
            words = text(value)
            shown = words if width > CHARACTER_WIDTH * len(words) else ""
            segments.append(Segment(name, frame.x(before / longest), round(width, 1), words, shown))
            before += value
        y = step * row + LINE_HEIGHT + 4
        placed.append(PlacedBar(bar.label, y, tuple(segments), text(bar.total), frame.x(before / longest)))
    names = dict.fromkeys(name for bar in bars for name, _ in bar.parts)
    return BarChart(title, frame, tuple(placed), tuple(names))


def _place_marks(marks: Sequence[tuple[float, str]], frame: Frame) -> tuple[PlacedMark, ...]:
    """Place marks by increasing x, each label in the first free row."""
    ends: list[float] = []
    placed = []
    for x, label in marks:
        row = next((row for row, end in enumerate(ends) if end <= x), len(ends))
        ends[row : row + 1] = [x + CHARACTER_WIDTH * (len(label) + 1)]
        placed.append(PlacedMark(x, label, frame.top - 8 + LINE_HEIGHT * row))
    return tuple(placed)


def _x_ticks(right: float, count: int, text: Callable[[float], str], frame: Frame) -> tuple[Tick, ...]:
    """Place ticks from 0 to the last one in the plot."""
    return tuple(Tick(frame.x(x / right), text(x)) for x in _ticks(0.0, right, count) if x <= right * 1.001)


def _ticks(low: float, high: float, count: int) -> list[float]:
    """Return about `count` round numbers whose range covers `low` to `high`, in steps of {1, 2, 5} * 10^n."""
    span = max(high - low, LEAST_SPAN * max(abs(high), 1e-6))
    power = 10.0 ** math.floor(math.log10(span / count))
    step = next(factor * power for factor in (1, 2, 5, 10) if span / (factor * power) <= count)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [index * step for index in range(first, max(last, first + 1) + 1)]
