"""Resolution settings against the paper's definitions and 3DGS's rounding."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.scenes.resolution import parse_resolution
from tests.refusals import refuses

sides = st.integers(16, 20_000)
settings_text = st.one_of(
    st.sampled_from(["1k", "2k", "4k", "full", "1K", " Full "]),
    st.integers(16, 9000).map(str),
    st.builds(lambda n, d: f"{min(n, d)}/{max(n, d)}", st.integers(1, 64), st.integers(1, 64)),
    st.integers(1, 100).map(lambda n: f"{n / 100:.2f}"),
)


@pytest.mark.parametrize(
    ("text", "size", "expected"),
    [
        ("1k", (3118, 2078), (1600, 1066)),  # bonsai of Mip-NeRF 360, as 3DGS shrinks it
        ("1k", (5187, 3361), (1600, 1036)),  # garden: 1036.7, and 3DGS cuts heights that follow from a width
        ("2k", (5187, 3361), (3393, 2198)),  # midpoint 3393.5
        ("4k", (5187, 3361), (5187, 3361)),
        ("full", (5187, 3361), (5187, 3361)),
        ("1k", (2078, 3118), (1600, 2400)),  # portrait: the width decides
        ("1k", (1601, 900), (1600, 899)),  # 3DGS's own division makes this 1599 wide
        ("1k", (1062, 1894), (1062, 1894)),  # never larger
        ("2k", (1062, 1894), (1062, 1894)),
        ("800", (1600, 1067), (800, 533)),
        ("1/4", (1062, 1894), (266, 474)),  # 265.5 and 473.5 to the even neighbour, as Python's round does
        ("0.25", (1062, 1894), (266, 474)),
        (".5", (101, 51), (50, 26)),
        ("1/1", (7, 5), (7, 5)),
        ("1/64", (40, 20), (1, 1)),  # never empty
    ],
)
def test_sizes(text: str, size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert parse_resolution(text).size_for(*size) == expected


@given(settings_text, sides, sides)
def test_never_larger_and_same_shape(text: str, width: int, height: int) -> None:
    new_width, new_height = parse_resolution(text).size_for(width, height)
    assert 1 <= new_width <= width
    assert 1 <= new_height <= height
    if new_height > 1:
        # Each side within one pixel of the exact shape: a half from the width, one from the height's cut.
        assert abs(new_height - Fraction(height, width) * new_width) <= 1 + Fraction(height, width)


@given(st.integers(1601, 20_000), sides)
def test_2k_lies_between_1k_and_full(width: int, height: int) -> None:
    small, middle = (parse_resolution(text).size_for(width, height)[0] for text in ("1k", "2k"))
    assert small == 1600
    assert 0 <= Fraction(1600 + width, 2) - middle < 1


@given(st.integers(16, 9000), sides)
def test_says_when_an_image_is_too_small(asked: int, width: int) -> None:
    rule = parse_resolution(str(asked))
    assert rule.falls_short(width) == (asked > width)
    assert not parse_resolution("1/2").falls_short(width)


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("", "1k, 2k, 4k, full"),
        ("3k", "1k, 2k, 4k, full"),
        ("-800", "1k, 2k, 4k, full"),
        ("1e3", "1k, 2k, 4k, full"),
        ("800x600", "1k, 2k, 4k, full"),
        ("nan", "1k, 2k, 4k, full"),
        ("1/4/2", "1k, 2k, 4k, full"),
        ("٣", "1k, 2k, 4k, full"),
        ("9" * 5000, "1k, 2k, 4k, full"),
        ("4", "write 1/4"),
        ("1", "at least 16"),
        ("0", "at least 16"),
        ("1/0", "division by zero"),
        ("0/4", "above 0 and at most 1"),
        ("4/1", "above 0 and at most 1"),
        ("1.5", "above 0 and at most 1"),
    ],
)
def test_wrong_text_is_one_line_with_what_is_accepted(text: str, hint: str) -> None:
    line = refuses(UserInputError, "--resolution", parse_resolution, text)
    assert hint in line
    assert "\n" not in line


@given(st.text(max_size=12))
def test_any_text_parses_or_is_refused(text: str) -> None:
    try:
        rule = parse_resolution(text)
    except UserInputError:
        return
    assert min(rule.size_for(640, 480)) >= 1
