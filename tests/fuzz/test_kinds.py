"""Damaged files of every kind: a result, or one line that names the file; never a traceback, never much memory.

The short version draws the same cases each time. The long one draws others each time and prints its seed. What fails is
kept for `python -m tests.fuzz.campaign --replay`. And the harness finds what it is there to find.

One file, because a file's tests run in one process: another would make the whole files and start a reader again.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.fuzz.campaign import campaign
from tests.fuzz.harness import MOST_SECONDS, MOST_WAITING, Case, Fuzzer, Kind, judged
from tests.fuzz.kinds import BY_NAME, KINDS
from tests.fuzz.mutations import as_json, as_namespace, as_toml, damaged_tree
from tests.fuzz.worker import STOPPED

CASES = 8
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
    failures = campaign(replace(fuzzer, slow=True), list(KINDS), MANY_CASES, seed)
    assert not failures


# ----------------------------------------------------------------------------------------------------------- harness

SOON = 0.3
"""Seconds of patience with a case that hangs."""
HOW = {
    "raise": "traceback",
    "exit": "exit code 1",
    "abort": "ended the process",
    "sleep": f"took more than {SOON:g} s",
    "compute": f"took more than {SOON:g} s",
    "grow": "more than 1.5 GB",
    "ask": "more than 1.5 GB",
    "nameless": "names no file",
}


def misbehaving(how: str) -> Case:
    kind = Kind("field", "ascii/field.ply", lambda data, random: data, [("misbehave", how)])
    return Case(kind, b"ply", kind.commands[0])


@pytest.mark.parametrize(
    ("message", "what"),
    [
        ("field.ply is\ndamaged", "no single line of text"),
        ("field.ply \x1b[2J", "no single line of text"),
        ("", "no single line of text"),
        ("field.ply " + "x" * 2000, "a line of more than 1500 characters"),
    ],
)
def test_a_message_is_a_line_of_text(message: str, what: str) -> None:
    answer = {"message": message, "trace": "", "highest": 0, "starved": False, "code": 2, "printed": "", "shown": ""}
    problem = judged(answer, misbehaving("nothing"), Path("case"), Path("templates"))
    assert problem is not None
    assert problem.what == what


@pytest.mark.parametrize("how", ["raise", "exit", "nameless"])
def test_every_broken_rule_is_told(fuzzer: Fuzzer, how: str) -> None:
    problem = fuzzer.problem(misbehaving(how))
    assert problem is not None
    assert problem.what.startswith(HOW[how])


def test_a_file_outside_that_a_command_writes_through_a_link_is_told(fuzzer: Fuzzer) -> None:
    kind = Kind("links", "ascii", lambda data, random: data, [("misbehave", "follow")], layout=True)
    problem = fuzzer.problem(Case(kind, b'[["outside", "field.ply"]]', kind.commands[0]))
    assert problem is not None
    assert problem.what == "wrote through a link"
    assert fuzzer.problem(Case(kind, b"[]", kind.commands[0])) is None


def test_control_characters_in_what_a_command_prints_are_told() -> None:
    answer = {"message": "", "trace": "", "highest": 0, "starved": False, "code": 0, "printed": ""}
    for shown, what in (("made out\n", None), ("made \x1b[2J\n", "control characters in its output")):
        problem = judged({**answer, "shown": shown}, misbehaving("nothing"), Path("case"), Path("templates"))
        assert (problem and problem.what) == what


def test_a_process_that_ends_hangs_or_grows_is_told_and_started_again(
    fuzzer: Fuzzer, monkeypatch: pytest.MonkeyPatch
) -> None:
    for how in ("sleep", "compute", "abort", "grow", "ask"):
        monkeypatch.setattr(fuzzer.reader, "waits", SOON if how == "sleep" else MOST_WAITING)
        monkeypatch.setattr(fuzzer.reader, "patience", SOON if how == "compute" else MOST_SECONDS)
        problem = fuzzer.problem(misbehaving(how))
        assert problem is not None
        assert problem.what.startswith(HOW[how])
    assert fuzzer.problem(misbehaving("nothing")) is None


def test_what_failed_is_kept_and_can_be_tried_again(fuzzer: Fuzzer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LAPGS_FUZZ_KEEP", str(fuzzer.scratch / "kept"))
    with pytest.raises(AssertionError, match=r"scale_0[\s\S]*campaign --replay") as caught:
        fuzzer.require_good(misbehaving("raise"))
    kept = fuzzer.scratch / "kept" / str(caught.value).rpartition("/")[2]
    assert kept.read_bytes() == b"ply"


def test_the_same_numbers_make_the_same_damage(fuzzer: Fuzzer) -> None:
    for kind in KINDS:
        first, second = (fuzzer.draw(kind, Random(5)) for _ in range(2))
        assert first.command == second.command
        if kind.name != "store":  # SQLite counts changes
            assert first.content == second.content


@pytest.mark.parametrize("emit", [as_json, as_toml, as_namespace])
def test_damage_changes_most_trees(emit: object) -> None:
    tree = {"a": [1, 2, {"b": "text"}], "c": None if emit is as_json else 1.5, "d": {"e": True}}
    before = str(tree)
    changed = sum(repr(damaged_tree(tree, Random(seed))) != before for seed in range(200))
    assert changed > 180
    assert str(tree) == before


def test_every_kind_is_damaged(fuzzer: Fuzzer) -> None:
    for kind in BY_NAME.values():
        whole = fuzzer.whole(kind)
        assert sum(fuzzer.draw(kind, Random(seed)).content != whole for seed in range(4)) >= 2, kind.name
