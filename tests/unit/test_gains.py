"""Lengths of stages by views that are set aside: curves whose best length is known."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.training.gains import DECAY_FROM, LEAST_GAIN, StageGains, views_to_set_aside
from lapgs_plugin.training.planning import make_plan
from lapgs_plugin.training.quality import set_aside_to_stop
from lapgs_plugin.training.settings import Densification, TrainSettings

Curve = Callable[[int], list[float]]


def trained(gains: StageGains, curve: Curve, step: int = 1, done: int = 0) -> int:
    """Return the iterations of a stage whose views have the PSNR of a curve, in steps of so many iterations."""
    while done < gains.planned:
        done = min(done + step, gains.planned)
        if gains.is_due(done):
            gains.note(done, curve(done))
    return done


def flat_after(iteration: int) -> Curve:
    """Return views that gain 3 dB for each doubling, up to an iteration."""
    return lambda done: [level + 3.0 * math.log2(min(done, iteration)) for level in (5.0, 8.0, 20.0)]


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 3_000), st.integers(1, 8))
def test_views_that_go_on_gaining_get_all_iterations_in_one_schedule(most: int, step: int) -> None:
    gains, planned = StageGains(most, most), set()

    def curve(done: int) -> list[float]:
        planned.add(gains.planned)
        return flat_after(most)(done)

    assert trained(gains, curve, step) == most
    assert planned <= {most}


@settings(deadline=None, max_examples=20)
@given(st.integers(3_000, 6_000), st.sampled_from([1, 3, 8]))
def test_a_stage_ends_soon_after_its_views_stopped_gaining(end: int, step: int) -> None:
    gains = StageGains(30_000, 30_000)
    length = trained(gains, flat_after(end), step)
    assert gains.decided is not None
    assert end < gains.decided < 2.3 * end  # half of the iterations so far count; 2.14 was the worst
    assert length == math.ceil(gains.decided / DECAY_FROM)
    assert gains.expected is not None
    assert gains.expected < LEAST_GAIN


def test_one_view_that_gets_worse_does_not_decide() -> None:
    gains = StageGains(8_000, 8_000)
    assert trained(gains, lambda done: [20.0 - done / 500, *flat_after(8_000)(done)]) == 8_000


def test_views_that_get_worse_end_a_stage() -> None:
    gains = StageGains(30_000, 30_000)
    assert trained(gains, lambda done: [20.0 - math.log(done)] * 4) < 7_000  # of these, an eighth at least before


def test_one_measurement_that_is_low_does_not_decide() -> None:
    """A third of the views' gains so far is lost once, between measurements that show none of it."""
    gains, lows = StageGains(8_000, 8_000), [0]

    def curve(done: int) -> list[float]:
        low = lows[0] == 0 and done > 2_000
        lows[0] += low
        return [psnr - 5.0 * low for psnr in flat_after(8_000)(done)]

    assert trained(gains, curve) == 8_000
    assert lows == [1]


def test_what_was_measured_and_decided_continues() -> None:
    whole = StageGains(9_000, 9_000)
    length = trained(whole, flat_after(1_500))
    for stop in (10, 1_200, 2_000, length - 1):
        part = StageGains(9_000, 9_000)
        done = 0
        while done < stop:
            done += 1
            if part.is_due(done):
                part.note(done, flat_after(1_500)(done))
        again = StageGains(9_000, **part.state())
        assert trained(again, flat_after(1_500), done=stop) == length
        assert again == whole


@pytest.mark.parametrize(("photos", "aside"), [(10, 3), (39, 3), (40, 4), (300, 8)])
def test_views_that_are_set_aside_are_spread(photos: int, aside: int) -> None:
    assert views_to_set_aside(photos) == aside
    chosen = set_aside_to_stop(list(range(photos)))
    assert len(set(chosen)) == aside
    gaps = [after - before for before, after in zip([-1, *chosen], [*chosen, photos], strict=True)]
    assert max(gaps[1:-1]) - min(gaps[1:-1]) <= 1


def test_too_few_photos_are_refused() -> None:
    stops_early = TrainSettings(stop="auto")
    make_plan((56, 40), stops_early, 10)
    with pytest.raises(UserInputError, match=r"--stop auto: .* the scene has 9 of them, expected at least 10"):
        make_plan((56, 40), stops_early, 9)


def test_settings_that_need_a_known_length_are_refused() -> None:
    with pytest.raises(UserInputError, match=r"--densify-until 500 with --stop auto: .* leave one out"):
        TrainSettings(stop="auto", densification=Densification(until=500))
    with pytest.raises(UserInputError, match="--keep best with --stop auto: both set training views aside"):
        TrainSettings(stop="auto", keep="best")
    with pytest.raises(UserInputError, match="--protocol paper"):
        TrainSettings(stop="auto", protocol="paper")
