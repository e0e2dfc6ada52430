"""Every variant of the 3DGS family against the oracle in that variant's rules."""

from __future__ import annotations

from dataclasses import replace

import pytest

from lapgs_plugin.evaluation.conformance import Subject, check, conformance_cases
from lapgs_plugin.evaluation.variants import variant_subjects
from lapgs_plugin.family import VARIANTS

SUBJECTS = {subject.name: subject for subject in variant_subjects("cpu")}
SHORT = ("no_gaussians", "ragged_size", "specks", "giants", "degree_2_coloured")


def problems(subject: Subject, names: tuple[str, ...]) -> list[str]:
    cases = [case for case in conformance_cases() if case.name in names]
    assert len(cases) == len(names)
    return [f"{each.case}: {problem}" for each in check(subject, cases) for problem in each.problems]


@pytest.mark.parametrize("name", SUBJECTS)
def test_a_variant_renders_by_its_own_rules(name: str) -> None:
    assert problems(SUBJECTS[name], SHORT) == []


def test_variants_are_checked_with_each_option_that_changes_an_image() -> None:
    rules = "mult", "antialiasing", "exact_antialiasing", "blur"
    kinds = {tuple(getattr(subject.semantics, name) for name in rules) for subject in SUBJECTS.values()}
    assert kinds == {
        (None, False, False, 0.3),
        (0.5, False, False, 0.3),
        (None, True, False, 0.3),
        (None, True, True, 0.1),
    }
    left_out = {name for name in VARIANTS if not any(label.split(",")[0] == name for label in SUBJECTS)}
    assert left_out == {"2dgs", "faster-gs"}, "one renders no Gaussians, the other has no class"


@pytest.mark.parametrize("rule", [{"mult": 0.8}, {"antialiasing": False}, {"exact_antialiasing": False}, {"blur": 0.3}])
def test_other_rules_fail(rule: dict[str, float]) -> None:
    """Each rule changes an image or a gradient enough to be seen."""
    (changed,) = rule
    subject = next(
        subject for subject in SUBJECTS.values() if getattr(subject.semantics, changed) not in (None, False, 0.3)
    )
    wrong = replace(subject, semantics=replace(subject.semantics, **rule))
    assert any("is off" in line for line in problems(wrong, ("degree_2_coloured", "specks", "crowd")))


@pytest.mark.slow
@pytest.mark.parametrize("name", SUBJECTS)
def test_all_cases(name: str) -> None:
    assert problems(SUBJECTS[name], tuple(case.name for case in conformance_cases())) == []


@pytest.mark.gpu
def test_all_cases_on_a_gpu() -> None:
    names = tuple(case.name for case in conformance_cases())
    assert {subject.name: problems(subject, names) for subject in variant_subjects("cuda")} == {
        subject.name: [] for subject in variant_subjects("cuda")
    }
