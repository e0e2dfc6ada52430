"""Readings of curves against their definitions, by brute force."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lapgs_bench.pareto.curves import METRICS, Metric, Point, best_within, mean_points, pareto_front, time_ratios

METHODS = ("one field", "nested", "laplacian")
METRIC = st.sampled_from(METRICS)
QUALITIES = st.dictionaries(st.sampled_from([metric.key for metric in METRICS]), st.integers(0, 6).map(float))
POINTS = st.lists(
    st.builds(Point, st.sampled_from(METHODS), st.integers(1, 9).map(float), st.integers(1, 9).map(float), QUALITIES),
    max_size=12,
)
"""Small whole numbers, so that there are equal seconds and equal qualities."""


def beats(one: Point, other: Point, metric: Metric) -> bool:
    gain = metric.sign * (one.values[metric.key] - other.values[metric.key])
    saved = other.seconds - one.seconds
    return gain >= 0 and saved >= 0 and (gain > 0 or saved > 0)


@given(points=POINTS, metric=METRIC)
def test_the_front_is_what_no_point_beats(points: list[Point], metric: Metric) -> None:
    having = [point for point in points if metric.key in point.values]
    unbeaten = [point for point in having if not any(beats(other, point, metric) for other in having)]
    front = pareto_front(points, metric)
    assert sorted(map(id, front)) == sorted(map(id, unbeaten))
    assert all(one.seconds <= other.seconds for one, other in pairwise(front))


@given(points=POINTS, metric=METRIC)
def test_more_seconds_never_read_worse(points: list[Point], metric: Metric) -> None:
    readings = [best_within(points, metric, seconds) for seconds in range(11)]
    values = [reading.values[metric.key] for reading in readings if reading is not None]
    assert all(not metric.is_better(before, after) for before, after in pairwise(values))
    assert len(values) == sum(
        any(metric.key in point.values and point.seconds <= seconds for point in points) for seconds in range(11)
    )


@given(points=POINTS, metric=METRIC)
def test_the_ratio_is_of_the_first_point_that_is_as_good(points: list[Point], metric: Metric) -> None:
    reading = time_ratios(points, metric, "one field")
    own = [p for p in points if p.method == "one field" and metric.key in p.values]
    if not own:
        assert reading is None
        return
    assert reading is not None
    best, ratios = reading
    aim = max(metric.sign * point.values[metric.key] for point in own)
    assert metric.sign * best.values[metric.key] == aim
    assert best.seconds == min(p.seconds for p in own if metric.sign * p.values[metric.key] == aim)
    assert {one.method for one in ratios} == {p.method for p in points if metric.key in p.values} - {"one field"}
    for one in ratios:
        reaching = [
            point.seconds
            for point in points
            if point.method == one.method
            and metric.key in point.values
            and metric.sign * point.values[metric.key] >= aim
        ]
        assert one.seconds == (min(reaching) if reaching else None)
        assert one.ratio == (min(reaching) / best.seconds if reaching else None)


def test_points_are_means_over_seeds() -> None:
    rows: list[dict[str, float | str]] = [
        {"method": "nested", "budget": 4.0, "seconds": 4.5, "psnr": 30.0, "ssim": 0.5},
        {"method": "one field", "budget": 2.0, "seconds": 2.0, "psnr": 20.0},
        {"method": "nested", "budget": 2.0, "seconds": 2.0, "psnr": 24.0},
        {"method": "nested", "budget": 4.0, "seconds": 3.5, "psnr": 31.0},
    ]
    points = mean_points(rows)
    assert [(point.method, point.budget) for point in points] == [("nested", 2.0), ("nested", 4.0), ("one field", 2.0)]
    assert points[1].seconds == pytest.approx(4.0)
    assert points[1].values == {"psnr": pytest.approx(30.5)}  # one seed has no SSIM
