"""Read curves of quality over seconds: points, the Pareto front, and what a method reaches when. Imports no torch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean


@dataclass(frozen=True)
class Metric:
    """A measure of quality.

    Attributes:
        key: its column.
        title: its name with its unit.
        form: format of a value.
        sign: 1 if more is better, -1 if less is.
    """

    key: str
    title: str
    form: str
    sign: int = 1

    def is_better(self, one: float, other: float) -> bool:
        return self.sign * one > self.sign * other

    def text(self, value: float) -> str:
        return self.form.format(value)


METRICS = (
    Metric("psnr_fit", "PSNR after the colour fit (dB)", "{:.2f}"),
    Metric("psnr", "PSNR (dB)", "{:.2f}"),
    Metric("ssim", "SSIM", "{:.4f}"),
    Metric("lpips", "LPIPS, less is better", "{:.4f}", sign=-1),
)


@dataclass(frozen=True)
class Point:
    """The mean over seeds of a method's runs with one budget.

    Attributes:
        method: its name.
        budget: seconds that the runs should take.
        seconds: seconds that they took.
        values: quality by `Metric.key`; one that was not measured is missing.
    """

    method: str
    budget: float
    seconds: float
    values: Mapping[str, float]


@dataclass(frozen=True)
class Ratio:
    """When a method reaches the best quality of one field.

    Attributes:
        method: its name.
        seconds: of the method's first point that reaches it; None if none does.
        ratio: these seconds by those of one field's best point; None if no point reaches it.
    """

    method: str
    seconds: float | None
    ratio: float | None


def mean_points(rows: Iterable[Mapping[str, float | str]]) -> list[Point]:
    """Return the points of rows with `method`, `budget`, `seconds` and the metrics, by method and rising budget.

    A metric that a row lacks is missing in its point.
    """
    groups: dict[tuple[str, float], list[Mapping[str, float | str]]] = {}
    for row in rows:
        groups.setdefault((str(row["method"]), float(row["budget"])), []).append(row)
    methods = list(dict.fromkeys(method for method, _ in groups))
    return [
        Point(
            method,
            budget,
            fmean(float(row["seconds"]) for row in groups[method, budget]),
            {
                metric.key: fmean(float(row[metric.key]) for row in groups[method, budget])
                for metric in METRICS
                if all(metric.key in row for row in groups[method, budget])
            },
        )
        for method, budget in sorted(groups, key=lambda key: (methods.index(key[0]), key[1]))
    ]


def measured(points: Iterable[Point], metric: Metric) -> list[Point]:
    """Return the points that have a metric."""
    return [point for point in points if metric.key in point.values]


def pareto_front(points: Sequence[Point], metric: Metric) -> list[Point]:
    """Return the points that no other point beats in seconds and quality, by rising seconds.

    A point beats another if it is no slower and no worse, and faster or better. Equal points are all on the front.
    """
    having = measured(points, metric)
    ordered = sorted(having, key=lambda point: (point.seconds, -metric.sign * point.values[metric.key]))
    front: list[Point] = []
    for point in ordered:
        same = bool(front) and front[-1].seconds == point.seconds
        last = front[-1].values[metric.key] if front else None
        value = point.values[metric.key]
        if last is None or metric.is_better(value, last) or (same and value == last):
            front.append(point)
    return front


def best_within(points: Sequence[Point], metric: Metric, seconds: float) -> Point | None:
    """Return the best point that took at most so many seconds, the fastest of equal ones; None without one."""
    front = [point for point in pareto_front(points, metric) if point.seconds <= seconds]
    if not front:
        return None
    best = front[-1].values[metric.key]
    return next(point for point in front if point.values[metric.key] == best)


def time_ratios(points: Sequence[Point], metric: Metric, baseline: str) -> tuple[Point, list[Ratio]] | None:
    """Return one method's best point, and when each other method is first as good; None if it was not measured.

    Only measured points count, nothing is interpolated between them.
    """
    best = best_within([point for point in points if point.method == baseline], metric, float("inf"))
    if best is None:
        return None
    others = dict.fromkeys(point.method for point in measured(points, metric) if point.method != baseline)
    return best, [_ratio(points, metric, method, best) for method in others]


def _ratio(points: Sequence[Point], metric: Metric, method: str, best: Point) -> Ratio:
    aim = best.values[metric.key]
    reaching = [
        point.seconds
        for point in measured(points, metric)
        if point.method == method and not metric.is_better(aim, point.values[metric.key])
    ]
    seconds = min(reaching, default=None)
    return Ratio(method, seconds, None if seconds is None or not best.seconds else seconds / best.seconds)
