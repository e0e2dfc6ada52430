"""Schedules of the built-in trainer: closed forms of 3DGS's published constants."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Hierarchy, StagePlan
from lapgs_plugin.ops.adam import ONE_VIEW, StepScale
from lapgs_plugin.training.planning import make_plan, require_pruning, unpruned_levels
from lapgs_plugin.training.schedule import StageSchedule, views_per_step
from lapgs_plugin.training.settings import Densification, LearningRates, TrainSettings
from lapgs_plugin.training.strategies import Gradients, Mcmc, Multiview
from lapgs_plugin.training.views import view_index


def heuristics(**values: Any) -> TrainSettings:
    """Return settings whose strategy, if none is given, is that of 3DGS."""
    density = values.pop("densification", Densification())
    if density.strategy == "auto":
        density = replace(density, strategy="3dgs", options=None)
    return TrainSettings(**values, densification=density)


def schedules(**values: Any) -> list[StageSchedule]:
    """Return the schedules of a base and its residuals."""
    if values.get("levels", 2) == 2:
        values.setdefault("split", "1/2,1/2")
    settings = heuristics(hierarchy="laplacian", **values)
    plan = StagePlan.create((1600, 1066), settings.iterations, settings.levels, settings.shares, settings.kind)
    return [StageSchedule.create(settings, stage) for stage in plan]


def steps(schedule: StageSchedule) -> list[int]:
    """Return the iterations after which the optimizers step."""
    found = [0]
    while found[-1] < schedule.iterations:
        found.append(found[-1] + schedule.views_of_step(found[-1]))
    return found[1:]


def test_a_single_stage_of_30000_has_the_published_constants() -> None:
    (schedule,) = schedules(levels=1)
    assert (schedule.densify_start, schedule.densify_until) == (500, 15_000)
    assert (schedule.densify_every, schedule.reset_every, schedule.sh_every) == (100, 3000, 1000)
    assert schedule.means_learning_rate(0) == pytest.approx(1.6e-4)
    assert schedule.means_learning_rate(15_000) == pytest.approx(1.6e-5)  # log-linear: the geometric mean half way
    assert schedule.means_learning_rate(30_000) == pytest.approx(1.6e-6)
    assert [schedule.active_sh_degree(i) for i in (1, 999, 1000, 2999, 3000, 30_000)] == [0, 0, 1, 2, 3, 3]


@given(st.integers(1, 30_000), st.floats(0.01, 1.0))
def test_rates_are_constant_until_the_decay_and_fall_in_it(iterations: int, decay: float) -> None:
    (schedule,) = schedules(levels=1, iterations=iterations, decay=decay)
    rates = [schedule.means_learning_rate(i) for i in range(iterations + 1)]
    assert 0 <= schedule.decay_from < iterations
    assert iterations - schedule.decay_from == pytest.approx(decay * iterations, abs=1.0)
    assert set(rates[: schedule.decay_from]) <= {rates[0]}
    assert all(later < earlier for earlier, later in itertools.pairwise(rates[schedule.decay_from :]))
    assert (rates[0], rates[-1]) == pytest.approx((1.6e-4, 1.6e-6))


@pytest.mark.parametrize("protocol", ["default", "paper"])
def test_rates_fall_from_the_first_iteration_on_unless_a_decay_is_given(protocol: str) -> None:
    settings = TrainSettings(protocol=protocol)
    for stage in StagePlan.create((1600, 1066), 30_000, 2, settings.shares, settings.kind):
        schedule, n = StageSchedule.create(settings, stage), stage.iterations
        expected = [1.6e-4 * 100 ** (-i / n) for i in (0, 1, n // 2, n)]
        assert [schedule.means_learning_rate(i) for i in (0, 1, n // 2, n)] == pytest.approx(expected)


@pytest.mark.parametrize(("decay", "until", "ends"), [(1.0, None, 25_000), (0.2, None, 25_000), (0.2, 7000, 7000)])
def test_mcmc_refines_for_five_sixths_of_a_stage(decay: float, until: int | None, ends: int) -> None:
    settings = TrainSettings(levels=1, decay=decay, densification=Densification(strategy="mcmc", until=until))
    (stage,) = StagePlan.create((1600, 1066), 30_000, 1)
    assert StageSchedule.create(settings, stage).densify_until == ends


@given(
    st.sampled_from(["3dgs", "mcmc"]),
    st.sampled_from([1.0, 0.2]),
    st.lists(st.integers(10, 60_000), min_size=2, max_size=6),
    st.floats(0.0, 1.0),
)
def test_at_a_share_of_a_stage_it_does_not_matter_how_its_length_came_about(
    strategy: str, decay: float, lengths: list[int], share: float
) -> None:
    """With --time the length changes while the stage trains: the last one counts, as if it had been planned."""
    first, *_, last = lengths
    control = Densification(strategy=strategy)
    settings = TrainSettings(levels=1, iterations=first, decay=decay, densification=control)
    plan = StagePlan.create((1600, 1066), first, 1)
    for length in lengths[1:]:
        plan = plan.lasting(0, length)
        settings = settings.lasting(plan.iterations)
    timed = StageSchedule.create(settings, plan[0])
    planned = TrainSettings(levels=1, iterations=last, decay=decay, densification=control)
    assert timed == StageSchedule.create(planned, StagePlan.create((1600, 1066), last, 1)[0])
    iteration = round(share * last)
    decayed = max(0.0, share - (1.0 - decay)) / decay
    # An iteration is at most half an iteration away from the share, and so is the beginning of the decay.
    apart = 100.0 ** (1.0 / (max(1, round(decay * last)) - 0.5))
    expected = 1.6e-4 * 100.0**-decayed
    assert expected / apart <= timed.means_learning_rate(iteration) * 1.0000001
    assert timed.means_learning_rate(iteration) <= expected * apart * 1.0000001


def test_a_stage_scales_when_densification_ends_and_keeps_the_rest() -> None:
    base, residual = schedules(levels=2, split="1/3,2/3")
    assert (base.densify_until, residual.densify_until) == (5000, 10_000)
    assert base.reset_every == 3000
    for schedule in (base, residual):
        assert (schedule.densify_start, schedule.densify_every) == (500, 100)
        assert schedule.means_learning_rate(schedule.iterations) == pytest.approx(1.6e-6)


def test_given_constants_are_kept_in_short_runs() -> None:
    chosen = Densification(start=7, until=600, every=11, reset_every=13)
    base, residual = schedules(iterations=900, split="1/3,2/3", densification=chosen, sh_every=5)
    assert (base.densify_until, residual.densify_until) == (200, 400)
    for schedule in (base, residual):
        assert (schedule.densify_start, schedule.densify_every, schedule.reset_every) == (7, 11, 13)
        assert schedule.active_sh_degree(14) == 2


def test_late_in_a_stage_eight_views_make_a_step() -> None:
    base, residual = schedules(iterations=30_000)
    for schedule in (base, residual):
        assert (schedule.accumulate_from, schedule.accumulate_views) == (11_251, 8)
        stepping = steps(schedule)
        assert stepping[:11_250] == list(range(1, 11_251))
        assert stepping[11_250:11_253] == [11_258, 11_266, 11_274]
        assert stepping[-1] == 15_000
    assert schedules(iterations=3000)[1].accumulate_views == 8
    assert schedules(iterations=2560)[1].accumulate_views == 8  # 40 steps of the last 320 iterations
    assert schedules(iterations=2550)[1].accumulate_views == 1
    assert schedules(iterations=2550, split="1/2,1/2", accumulate_views=4)[1].accumulate_views == 4
    assert all(schedule.accumulate_views == 1 for schedule in schedules(accumulate_views=1))


def test_pruning_waits_for_the_end_of_densification() -> None:
    def prunes(levels: int = 1, **densification: Any) -> list[int | None]:
        found = schedules(levels=levels, densification=Densification(**densification))
        return [schedule.prunes_after for schedule in found]

    assert prunes() == [15_000]
    assert prunes(levels=2) == [7500, 7500]
    assert prunes(until=25_001) == [25_001]
    assert prunes(until=30_000) == [None]
    assert prunes(until=500) == prunes(until=0) == [None]


@given(st.integers(1, 400), st.integers(0, 10), st.integers(0, 3), st.integers(0, 5))
def test_every_view_is_seen_once_an_epoch(count: int, seed: int, level: int, epoch: int) -> None:
    seen = Counter(view_index(epoch * count + i + 1, count, seed, level) for i in range(count))
    assert seen == Counter(range(count))


@given(st.integers(0, 2**32 - 1), st.integers(0, 20), st.integers(0, 100_000))
def test_every_seed_orders_views(seed: int, level: int, epoch: int) -> None:
    """Dates such as 20240101 once gave the generator more than 64 bits."""
    assert sorted(view_index(epoch * 3 + i + 1, 3, seed, level) for i in range(3)) == [0, 1, 2]


@pytest.mark.parametrize(("until", "begins"), [(None, 22_501), (22_000, 22_501), (25_000, 25_001), (29_679, 29_680)])
def test_views_are_gathered_once_nothing_densifies_any_more(until: int | None, begins: int) -> None:
    """A refinement in between would lose gradients that wait for those of other views."""
    (schedule,) = schedules(levels=1, densification=Densification(until=until))
    stepping = steps(schedule)
    assert stepping[: begins - 1] == list(range(1, begins))
    assert stepping[begins - 1] == begins + 7
    assert [schedule.gathers(i) for i in (begins - 1, begins)] == [False, True]


@pytest.mark.parametrize("until", [29_681, 30_000, 40_000])
def test_a_stage_that_densifies_to_its_end_gathers_nothing(until: int) -> None:
    """The rest is too short for 40 steps of 8 views."""
    (schedule,) = schedules(levels=1, densification=Densification(until=until))
    assert steps(schedule) == list(range(1, 30_001))


@pytest.mark.parametrize("views", [2, 3, 8, 250])
@pytest.mark.parametrize("strategy", ["3dgs", "mcmc"])
def test_steps_for_several_views_end_where_something_is_due(views: int, strategy: str) -> None:
    density = Densification(until=3333, every=70, reset_every=None if strategy == "mcmc" else 1100, strategy=strategy)
    settings = TrainSettings(iterations=6000, densification=density, accumulate_views=5)
    (stage,) = StagePlan.create((1600, 1066), 6000, 1)
    schedule = StageSchedule.create(settings, stage, views=views)
    stepping = steps(schedule)
    lengths = [end - begin for begin, end in zip([0, *stepping], stepping, strict=False)]
    early = [length for end, length in zip(stepping, lengths, strict=True) if end <= 4500]
    assert max(early) == views, "at 250 after densification alone"
    assert len(early) < 1.5 * 4500 / views or views > 70
    due = {*range(70, 3333, 70), 3332, 3333, 4500, 6000}
    due |= {1100, 2200, 3300} if strategy == "3dgs" else set()
    assert due <= set(stepping)
    assert all(length == 5 for end, length in zip(stepping, lengths, strict=True) if end > 4500)
    # A resumed run takes the steps that an uninterrupted one takes: they are a function of where one ended.
    assert all(schedule.views_of_step(end - length) == length for end, length in zip(stepping, lengths, strict=True))


def test_how_many_views_a_step_takes() -> None:
    plan = StagePlan.create((978, 545), 30_000, 2)

    def views(asked: int | None, training: int = 219, batches: bool = True) -> list[int]:
        return [
            views_per_step(
                TrainSettings(views_per_step="auto" if asked is None else str(asked)), stage, training, batches
            )
            for stage in plan
        ]

    assert views(1) == [1, 1]
    assert views(3) == [3, 3]
    assert views(None) == [8, 8]  # 133k and 533k pixels of four million
    assert views(None, training=5) == [5, 5]

    def of_short(size: tuple[int, int], iterations: int) -> list[int]:
        stages = StagePlan.create(size, iterations, 2)
        return [views_per_step(TrainSettings(), stage, 219, batches=True) for stage in stages]

    assert of_short((978, 545), 9000) == [8, 5], "two megapixels are 15 and 3 of them, and 900 steps allow 5"
    assert of_short((978, 545), 3600) == [6, 3], "300 steps allow 6"
    assert of_short((978, 545), 500) == [1, 1]
    assert of_short((1062, 1894), 3600) == [4, 2], "more than two megapixels together take longer"
    assert of_short((3093, 2312), 3600) == [2, 1]
    assert views(None, batches=False) == [1, 1]
    (large,) = StagePlan.create((3429, 3390), 30_000, 1)
    assert views_per_step(TrainSettings(views_per_step="auto"), large, 45, batches=True) == 1


@pytest.mark.parametrize("views", [1, 2, 8])
def test_the_root_of_the_views_scales_steps(views: int) -> None:
    scale = StepScale.of(views)
    assert scale.rate == pytest.approx(math.sqrt(views))
    assert scale.gradient == pytest.approx(1 / math.sqrt(views))
    assert scale.views == views
    if views == 1:
        assert scale == ONE_VIEW


def test_opacities_are_never_reset_where_that_is_asked_for() -> None:
    for schedule in schedules(densification=Densification(reset_every=0)):
        assert not any(i % schedule.reset_every == 0 for i in range(1, schedule.iterations + 1))


@pytest.mark.parametrize(("given", "resets"), [(None, []), (0, []), (4000, [4000, 8000, 12_000])])
def test_a_residual_resets_no_opacities_unless_told_otherwise(given: int | None, resets: list[int]) -> None:
    base, residual = schedules(densification=Densification(reset_every=given))
    assert [i for i in range(1, residual.iterations + 1) if i % residual.reset_every == 0] == resets
    assert [i for i in range(1, 5000) if i % base.reset_every == 0] == ([] if given == 0 else [given or 3000])


@pytest.mark.parametrize(
    ("given", "views", "first"), [(None, 8, 1.0), (None, 128, 4.0), (None, 900, 8.0), (3.0, 9, 3.0)]
)
def test_the_rate_of_higher_harmonics_follows_the_views_and_falls(
    given: float | None, views: int, first: float
) -> None:
    settings = TrainSettings(hierarchy="laplacian", sh_rate_factor=given)
    plan = StagePlan.create((1600, 1066), 30_000, 2, settings.shares, settings.kind)
    base, residual = (StageSchedule.create(settings, stage, training_views=views) for stage in plan)
    assert (base.sh_rest_factor_at(0), base.sh_rest_factor_at(15_000)) == (first, 1.0)
    assert base.sh_rest_factor_at(7500) == pytest.approx(first**0.5)  # half way: the geometric mean
    assert {residual.sh_rest_factor_at(i) for i in (1, 7500, 15_000)} == {1.0}


PAPER = {
    **{"hierarchy": "laplacian", "split": "1/3,2/3", "inherit": "xyz", "supervision": "reconstructed", "joint": 0.0},
    **{"residual_color_rate": 1.0, "residual_resets": True, "residual_threshold": 1.0, "coarse_threshold": 1.0},
    **{"prune": 0.0, "accumulate_views": 1, "views_per_step": "1", "sh_rate_factor": 1.0},
}


def test_the_papers_protocol_is_the_papers_settings_and_nothing_else() -> None:
    paper = TrainSettings(protocol="paper")
    assert {name: getattr(paper, name) for name in PAPER} == PAPER
    assert [stage.iterations for stage in StagePlan.create((800, 533), 30_000, 2, paper.shares, paper.kind)] == [
        10_000,
        20_000,
    ]
    assert TrainSettings(protocol="paper", levels=3).shares == TrainSettings(levels=3).shares
    assert TrainSettings(protocol="paper", inherit="xyz", iterations=99).iterations == 99
    others: dict[str, Any] = {
        **{"hierarchy": "nested", "split": "1/2,1/2", "inherit": "geometry", "supervision": "gt_laplacian"},
        **{"joint": 0.5, "residual_color_rate": 4.0, "residual_threshold": 2.0, "coarse_threshold": 2.0, "prune": 0.1},
        **{"accumulate_views": 4, "views_per_step": "8", "sh_rate_factor": 8.0},
    }
    for name, value in others.items():
        shown = name.replace("_", "-")
        with pytest.raises(UserInputError, match=f"--{shown} {value} with --protocol paper"):
            TrainSettings(protocol="paper", **{name: value})
    with pytest.raises(UserInputError, match="--protocol papers: expected default or paper"):
        TrainSettings(protocol="papers")


@pytest.mark.parametrize(
    ("values", "unpruned"),
    [
        ({}, []),
        ({"until": 29_998}, []),
        ({"until": 30_000}, [1, 0]),
        ({"until": 400}, [1, 0]),  # before the first
        ({"base_share": 1.0}, [1]),
        ({"until": 30_000, "base_share": 0.5}, [0]),
    ],
)
def test_pruning_without_an_end_of_densification_is_an_error(values: dict[str, Any], unpruned: list[int]) -> None:
    density = Densification(strategy="3dgs", options=Gradients(), **values)
    settings = TrainSettings(prune=0.01, densification=density)
    plan = make_plan((64, 48), settings)
    assert unpruned_levels(plan, settings) == unpruned
    assert unpruned_levels(plan, replace(settings, prune=0.0)) == []
    if len(unpruned) < 2:
        require_pruning(plan, settings)
        return
    with pytest.raises(
        UserInputError, match=r"--prune 0.01: .* at no level .*; leave --prune out, or change"
    ) as caught:
        require_pruning(plan, settings)
    assert "\n" not in str(caught.value)


def test_a_base_may_densify_longer() -> None:
    for share, until in ((None, 7500), (0.8, 12_000), (0.0, 0)):
        base, residual = schedules(densification=Densification(base_share=share))
        assert (base.densify_until, residual.densify_until) == (until, 7500)


def test_residuals_of_mcmc_have_defaults_of_their_own_and_keep_what_is_given() -> None:
    def chosen(**values: Any) -> tuple[float, float]:
        settings = TrainSettings(**values)
        assert settings.rates.residual_sh == settings.learning_rates.sh * settings.color_factor
        return settings.joint_share, settings.color_factor

    mcmc, heuristics_of_3dgs = (0.5, 1.0), (0.25, 4.0)
    assert chosen(iterations=30_000) == mcmc
    assert chosen(iterations=3_000) == heuristics_of_3dgs
    assert chosen(iterations=30_000, joint=0.1, residual_color_rate=2.0) == (0.1, 2.0)
    assert chosen(iterations=30_000, protocol="paper") == (0.0, 1.0)
    assert TrainSettings(iterations=30_000, hierarchy="nested").joint_share == 0.0
    manifest = TrainSettings(iterations=30_000).for_manifest()["settings"]
    assert (manifest["joint"], manifest["residual_color_rate"]) == mcmc, "a resumed run keeps them if they change"


def test_a_base_may_have_fewer_harmonics() -> None:
    base, residual = schedules(base_sh_degree=1)
    assert [schedule.active_sh_degree(9000) for schedule in (base, residual)] == [1, 3]


def test_thresholds_and_limits_of_stages() -> None:
    density = Densification(strategy="multiview")
    settings = TrainSettings(levels=3, hierarchy="laplacian", residual_threshold=1.5, densification=density)
    plan = StagePlan.create((1600, 1066), 30_000, 3, hierarchy=Hierarchy.LAPLACIAN)
    strategies: Any = [settings.strategy_of(stage, 10**9) for stage in plan]
    assert [one.grow_grad2d for one in strategies] == pytest.approx([2e-4, 3e-4, 3e-4])
    assert [one.split_absgrad2d for one in strategies] == pytest.approx([8e-4, 12e-4, 12e-4])
    mcmc = Densification(strategy="mcmc", options=Mcmc(cap_max=9, base_cap_max=5))
    capped = replace(settings, residual_threshold=1.0, densification=mcmc)
    assert [capped.strategy_of(stage, 10**9) for stage in plan] == [
        Mcmc(opacity_regularization=weight, cap_max=cap, base_cap_max=5)
        for cap, weight in ((5, None), (9, 0.001), (9, 0.001))
    ]


def test_epochs_levels_and_seeds_differ_in_order() -> None:
    def order(seed: int, level: int, epoch: int) -> list[int]:
        return [view_index(epoch * 50 + i + 1, 50, seed, level) for i in range(50)]

    orders = [order(0, 0, 0), order(1, 0, 0), order(0, 1, 0), order(0, 0, 1)]
    assert all(orders[i] != orders[j] for i in range(4) for j in range(i))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sh_degree": 4}, "--sh-degree 4"),
        ({"inherit": "0.0"}, "above 0 and at most 1"),
        ({"inherit": "xyz:1.5"}, "above 0 and at most 1"),
        ({"inherit": "nan"}, "above 0 and at most 1"),
        ({"prune": 1.0}, "--prune 1.0: expected a share from 0"),
        ({"prune": math.nan}, "--prune nan"),
        ({"prune": 0.01, "densification": Densification(strategy="mcmc")}, "--prune with --strategy mcmc"),
        (
            {"densification": Densification(reset_every=9, strategy="mcmc")},
            "--opacity-reset-every with --strategy mcmc",
        ),
        (
            {"coarse_threshold": 2.0, "densification": Densification(reset_every=9, strategy="mcmc")},
            "--coarse-threshold, --opacity-reset-every with --strategy mcmc",
        ),
        ({"densification": Densification(options=Mcmc(cap_max=7))}, "--strategy auto with options of Mcmc"),
        (
            {"densification": Densification(strategy="mcmc", options=Mcmc(cap_max=0))},
            "--cap-max 0: expected at least 1",
        ),
        (
            {"densification": Densification(strategy="multiview", options=Multiview(error_threshold=1.0))},
            "--error-threshold 1.0: expected a share",
        ),
        (
            {"densification": Densification(strategy="multiview", options=Multiview(absgrad=True))},
            "--absgrad with --strategy multiview",
        ),
        (
            {"hierarchy": "laplacian", "residual_threshold": 2.0, "densification": Densification(strategy="mcmc")},
            "--residual-threshold with --strategy mcmc",
        ),
        ({"hierarchy": "laplacian", "residual_threshold": 0.0}, "--residual-threshold 0"),
        ({"coarse_threshold": 0.0}, "--coarse-threshold 0.0: expected a positive factor"),
        ({"coarse_threshold": math.inf}, "--coarse-threshold inf: expected a positive factor"),
        ({"residual_color_rate": 0.0}, "--residual-color-rate 0.0: expected a positive factor"),
        ({"split": "half,half"}, "--split 'half,half': expected fractions"),
        ({"accumulate_views": -1}, "--accumulate-views -1: expected at least 1"),
        ({"hierarchy": "nested", "residual_threshold": 2.0}, "--residual-threshold 2.0: is about residuals"),
        (
            {"densification": Densification(strategy="3dgs", options=Gradients(grow_grad2d=-1.0))},
            "--densify-threshold -1.0: expected a positive gradient",
        ),
        ({"densification": Densification(base_share=1.5)}, "--base-densify-share 1.5: expected a share"),
        ({"densification": Densification(base_share=0.5), "levels": 1}, "one level has no base"),
        ({"sh_rate_factor": 1e300}, "--sh-rate-factor 1e.300: expected a positive factor of at most 1e.30"),
        ({"learning_rates": LearningRates(scales=0.0)}, "scales 0.0: expected a positive learning rate"),
        ({"hierarchy": "laplacian", "base_sh_degree": 4}, "--base-sh-degree 4: expected 0 to --sh-degree, 3"),
        ({"hierarchy": "laplacian", "base_sh_degree": 1, "inherit": "full"}, "with --inherit full"),
        ({"hierarchy": "laplacian", "base_sh_degree": 1, "levels": 1}, "one level has no base"),
        ({"hierarchy": "nested", "base_sh_degree": 1}, "--base-sh-degree 1: is about residuals"),
        ({"densification": Densification(reset_every=-1)}, "--opacity-reset-every -1: .* or 0 for never"),
        ({"inherit": "most"}, "--inherit 'most': expected geometry"),
        ({"decay": 0.0}, "--decay 0.0: expected a share of each stage above 0 and at most 1"),
        ({"decay": 1.5}, "--decay 1.5: expected"),
        ({"decay": 0.5, "protocol": "paper"}, "--decay 0.5 with --protocol paper: the paper has 1.0"),
        ({"views_per_step": "0"}, "--views-per-step 0: expected auto, or at least 1"),
        ({"seed": -1}, "--seed -1: expected 0 to 4294967295"),
        ({"seed": 2**32}, "--seed 4294967296"),
    ],
)
def test_bad_settings_say_what_is_expected(values: dict[str, Any], message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        TrainSettings(**values)


def test_a_nested_field_keeps_its_sh_degree() -> None:
    stage = StagePlan.create((1600, 1066), 30_000, hierarchy=Hierarchy.NESTED)[0]
    schedule = StageSchedule.create(heuristics(hierarchy="nested"), stage, before=1500)
    assert [schedule.active_sh_degree(i) for i in (1, 499, 500, 1499, 1500)] == [1, 1, 2, 2, 3]


@pytest.mark.parametrize(("given", "resets"), [(None, []), (4000, [4000, 8000, 12_000])])
def test_a_nested_field_keeps_its_opacities_unless_told_otherwise(given: int | None, resets: list[int]) -> None:
    settings = heuristics(hierarchy="nested", densification=Densification(reset_every=given))
    base, finer = StagePlan.create((1600, 1066), 30_000, hierarchy=Hierarchy.NESTED)
    schedule = StageSchedule.create(settings, finer, before=base.iterations)
    assert [i for i in range(1, finer.iterations + 1) if i % schedule.reset_every == 0] == resets
    assert StageSchedule.create(settings, base).reset_every == (given or 3000)


@pytest.mark.parametrize(("iterations", "until"), [(30_000, 5000), (20_000, 4000), (7000, 1750)])
def test_a_nested_field_densifies_for_a_third_of_a_long_stage(iterations: int, until: int) -> None:
    base, finer = StagePlan.create((1600, 1066), iterations, hierarchy=Hierarchy.NESTED)
    settings = heuristics(iterations=iterations, hierarchy="nested")
    assert StageSchedule.create(settings, base).densify_until == iterations // 4
    assert StageSchedule.create(settings, finer, before=base.iterations).densify_until == until


@pytest.mark.parametrize(
    ("hierarchy", "given", "factors"),
    [
        ("laplacian", None, [1, 1, 1]),
        ("nested", None, [4, 2, 1]),
        ("nested", 1.0, [1, 1, 1]),
        ("laplacian", 3.0, [9, 3, 1]),
    ],
)
def test_coarse_levels_densify_less(hierarchy: str, given: float | None, factors: list[int]) -> None:
    settings = heuristics(levels=3, hierarchy=hierarchy, coarse_threshold=given)
    plan = StagePlan.create((1600, 1066), 30_000, 3, hierarchy=Hierarchy(hierarchy))
    thresholds = [settings.strategy_of(stage, 10**9).grow_grad2d for stage in plan]
    assert thresholds == pytest.approx([2e-4 * factor for factor in factors])
