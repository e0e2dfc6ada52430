"""Damaged files of every kind: a result, or one line that names the file; never a traceback, never much memory.

The short version draws the same cases each time. The long one draws others each time and prints its seed. What fails is
kept for `python -m tests.fuzz.campaign --replay`.
"""

from __future__ import annotations

import time
from dataclasses import replace
from random import Random

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.fuzz.campaign import campaign
from tests.fuzz.harness import Case, Fuzzer, Kind
from tests.fuzz.kinds import KINDS
from tests.fuzz.worker import STOPPED

CASES = 12
"""Of each kind in `make test`."""
MANY_CASES = 6_000


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_whole_files_are_read(fuzzer: Fuzzer, kind: Kind) -> None:
    content = b"[]" if kind.layout else fuzzer.whole(kind)
    for command in dict.fromkeys(kind.commands):
        answer = fuzzer.answer(Case(kind, content, command))
        assert isinstance(answer, dict), answer
        assert answer["code"] in (0, STOPPED), answer


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
@settings(
    max_examples=CASES,
    derandomize=True,
    database=None,
    deadline=None,
    phases=[Phase.generate],  # what fails is kept as a file; making it smaller would take hundreds of cases more
    suppress_health_check=list(HealthCheck),
)
@given(random=st.randoms(use_true_random=True))
def test_damaged_files_are_refused_in_a_line(fuzzer: Fuzzer, kind: Kind, random: Random) -> None:
    fuzzer.require_good(fuzzer.draw(kind, random))


@pytest.mark.slow
def test_a_long_campaign(fuzzer: Fuzzer) -> None:
    seed = time.time_ns() % 2**32
    print(f"seed {seed}")
    found = campaign(replace(fuzzer, slow=True), list(KINDS), MANY_CASES, seed)
    assert not found
