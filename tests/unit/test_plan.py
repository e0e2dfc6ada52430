"""Every split covers the iterations exactly, and every mistake is named."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import MIN_LEVEL_SIDE, Hierarchy, Stage, StagePlan, level_size
from lapgs_plugin.hierarchy.settings import HierarchySettings, parse_split
from lapgs_plugin.runner.settings import RunSettings


@given(st.integers(16, 5000), st.integers(16, 5000), st.integers(0, 8))
def test_level_size_is_the_ceiling_of_repeated_halving(width: int, height: int, level: int) -> None:
    expected = (-(-width // 2**level), -(-height // 2**level))  # ceil(ceil(n/2)/2) = ceil(n/4)
    assert level_size((width, height), level) == expected


@pytest.mark.parametrize("hierarchy", Hierarchy)
@pytest.mark.parametrize(
    ("levels", "counts"),
    [
        *((1, [30000]), (2, [15000, 15000]), (3, [10000, 5000, 15000]), (4, [10000, 5000, 5000, 10000])),
        *((5, [10000, 3333, 3334, 3333, 10000]), (6, [10000, 2500, 2500, 2500, 2500, 10000])),
    ],
)
def test_default_splits(levels: int, counts: list[int], hierarchy: Hierarchy) -> None:
    plan = StagePlan.create((1600, 1066), 30_000, levels, hierarchy=hierarchy)
    assert [stage.iterations for stage in plan] == counts
    assert [stage.level for stage in plan] == list(range(levels - 1, -1, -1))
    assert [stage.signed for stage in plan] == [False] + [hierarchy is Hierarchy.LAPLACIAN] * (levels - 1)


@pytest.mark.parametrize("hierarchy", Hierarchy)
def test_a_signed_level_where_none_belongs_is_refused(hierarchy: Hierarchy) -> None:
    stages = tuple(Stage(level, (100, 100), 10, hierarchy is Hierarchy.NESTED) for level in (1, 0))
    with pytest.raises(UserInputError, match="nested levels"):
        StagePlan(stages, hierarchy)


def test_hierarchies_by_name() -> None:
    kinds = [HierarchySettings(hierarchy=name).kind for name in ("laplacian", "nested")]
    assert kinds == [Hierarchy.LAPLACIAN, Hierarchy.NESTED]
    with pytest.raises(UserInputError, match="--hierarchy gaussian: expected nested or laplacian"):
        HierarchySettings(hierarchy="gaussian")


def test_stages_are_found_by_level() -> None:
    plan = StagePlan.create((101, 67), 100, 2)
    assert plan[0] == Stage(level=0, image_size=(101, 67), iterations=50, signed=True)
    assert plan[1] == Stage(level=1, image_size=(51, 34), iterations=50, signed=False)
    for level in (-1, 2):
        with pytest.raises(IndexError, match=f"level {level}, expected 0 to 1"):
            plan[level]


@given(
    st.integers(1, 6).flatmap(lambda n: st.lists(st.integers(1, 50), min_size=n, max_size=n)), st.integers(400, 100_000)
)
def test_any_split_covers_the_iterations(weights: list[int], iterations: int) -> None:
    split = [Fraction(w, sum(weights)) for w in weights]
    plan = StagePlan.create((1024, 1024), iterations, len(split), split)
    assert plan.iterations == iterations
    for stage, share in zip(plan, split, strict=True):
        assert abs(stage.iterations - iterations * share) <= 1


@pytest.mark.parametrize(
    ("options", "split"),
    [
        ({"hierarchy": "nested"}, "1/3,2/3"),
        ({"hierarchy": "nested", "levels": 3}, "1/6,1/6,2/3"),
        ({"hierarchy": "nested", "levels": 1}, "1"),
        ({"hierarchy": "nested", "split": "1/2,1/2"}, "1/2,1/2"),
        ({"hierarchy": "laplacian"}, "1/3,2/3"),
        ({"hierarchy": "laplacian", "levels": 3}, "1/3,1/6,1/2"),
        ({"protocol": "paper"}, "1/3,2/3"),
    ],
)
def test_the_finest_level_of_a_checkout_has_the_longer_part(options: dict[str, Any], split: str) -> None:
    assert RunSettings(**options).resolved()["split"] == split


@pytest.mark.parametrize(
    ("options", "small", "large"),
    [
        ({}, 0.5, 0.25),
        ({"joint": 0.75}, 0.75, 0.75),
        ({"hierarchy": "nested"}, 0.0, 0.0),
        ({"protocol": "paper"}, 0.0, 0.0),
    ],
)
def test_less_of_a_checkouts_stage_is_joint_where_photos_are_large(
    options: dict[str, Any], small: float, large: float
) -> None:
    settings = RunSettings(**options)
    assert settings.for_size((1280, 1080)).joint_share == settings.joint_share == small
    assert settings.for_size((1500, 1000)).joint_share == large


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"levels": 0}, "--levels 0"),
        ({"levels": 6}, f"at least {MIN_LEVEL_SIDE}"),
        ({"levels": 2, "split": [Fraction(1)]}, "--split has 1 shares, expected 2"),
        ({"levels": 2, "split": [Fraction(1, 2), Fraction(1, 3)]}, "sum to 1"),
        ({"levels": 2, "split": [Fraction(3, 2), Fraction(-1, 2)]}, "positive shares"),
        ({"levels": 3, "iterations": 2}, "--iterations 2"),
        ({"levels": 2, "split": [Fraction(1, 10**6), 1 - Fraction(1, 10**6)]}, "level 1 would train for 0 iterations"),
    ],
)
def test_bad_plans_say_what_is_wrong(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        StagePlan.create(**{"image_size": (400, 300), "iterations": 1000, **arguments})


def test_gaps_are_refused() -> None:
    with pytest.raises(UserInputError, match="without gaps"):
        StagePlan((Stage(2, (100, 100), 10, False), Stage(0, (400, 400), 10, True)))


def test_parse_split() -> None:
    assert parse_split("1/3, 2/3") == (Fraction(1, 3), Fraction(2, 3))
    assert parse_split("0.25,0.75") == (Fraction(1, 4), Fraction(3, 4))
    for split, message in (("1/3,1/3", "sum to 1"), ("1/3,1/3,1/3", "3 shares, expected 2")):
        with pytest.raises(UserInputError, match=message):
            HierarchySettings(split=split)  # before a scene is read
    for text in ("", "a,b", "1/0", "1/3;2/3", "1e999999999,1/2", "1E-999999999"):
        with pytest.raises(UserInputError, match="--split"):
            parse_split(text)


@pytest.mark.parametrize("share", [-0.1, 1.5, float("nan")])
def test_a_share_of_joint_training_is_from_0_to_1(share: float) -> None:
    with pytest.raises(UserInputError, match=f"--joint {share}: expected a share of each residual stage from 0 to 1"):
        HierarchySettings(joint=share)


def test_importing_the_package_and_the_plan_pulls_in_no_torch() -> None:
    code = "import sys, lapgs_plugin, lapgs_plugin.hierarchy.plan, lapgs_plugin.cli; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
