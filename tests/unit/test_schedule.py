"""Test what is found in training functions and changed in them, by calling the functions."""

from __future__ import annotations

import ast
from collections.abc import Callable
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

from lapgs_plugin.checkouts.schedule import Schedule
from lapgs_plugin.hierarchy.plan import Hierarchy, Stage, StagePlan
from lapgs_plugin.runner.preparation import between_events

LOOP = """
def training(opt, args, testing_iterations, seen, unused=None):
    first_iter = 0
    for each in testing_iterations:
        pass
    for iteration in range(first_iter + 1, opt.iterations + 1):
        if iteration % 1000 == 0:
            seen.oneupSHdegree(iteration)
        if iteration in testing_iterations:
            seen.report(iteration)
        if iteration % 10 == 0:
            print(end="")
        if iteration < opt.densify_until_iter:
            if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                seen.densify(iteration)
            if iteration % opt.opacity_reset_interval == 0 or (opt.white and iteration == opt.densify_from_iter):
                seen.reset_opacity(iteration)
        if iteration % 3000 == 0 and 15_000 < iteration < 30_000:
            seen.prune_late(iteration)
        if (iteration >= opt.prune_from) and (iteration < opt.prune_until) and not iteration % opt.prune_interval:
            seen.prune_hard(iteration)
        if iteration % opt.culling == 0:
            seen.simplify(iteration)
        if iteration == 15_500 or iteration in [18_000, 500]:
            seen.unlock(iteration)
        if iteration == GLOBAL.late:
            seen.once(iteration)
        if iteration == args["late"] or iteration == MORE["late"]:
            seen.twice(iteration)
        if iteration in args["prune_iterations"] or iteration in MORE["reset_iterations"]:
            seen.pruned(iteration)
        if iteration == opt.iterations:
            seen.close(iteration)
"""

OPT = {
    "iterations": 30_000, "densify_until_iter": 15_000, "densify_from_iter": 500, "densification_interval": 100,
    "opacity_reset_interval": 3000, "white": False, "prune_from": 6000, "prune_until": 30_000, "prune_interval": 3000,
    "culling": 5000,
}  # fmt: skip


ARGS: dict[str, Any] = {"late": 24_000, "prune_iterations": [500, 16_000, 24_000]}
MORE: dict[str, Any] = {"late": 22_000, "reset_iterations": [18_000]}


class Seen:
    """Note the iterations at which each method is called."""

    def __init__(self) -> None:
        self.at: dict[str, list[int]] = {}

    def __getattr__(self, name: str) -> Callable[[int], None]:
        return self.at.setdefault(name, []).append


class Window:
    """A stage of `iterations` of 30,000."""

    total = 30_000

    def __init__(self, iterations: int) -> None:
        self._iterations = iterations

    def scaled(self, iterations: int) -> int:
        return round(Fraction(iterations * self._iterations, self.total))


def trained(stage: int | None, **opt: Any) -> tuple[dict[str, list[int]], list[str]]:
    """Run the loop, as it is or for a stage of so many iterations; return calls by name, and what was changed."""
    tree = ast.parse(LOOP)
    namespace: dict[str, Any] = {"GLOBAL": SimpleNamespace(late=20_000), "MORE": MORE}
    exec(compile(tree, "train.py", "exec"), namespace)
    function, seen = namespace["training"], Seen()
    own = SimpleNamespace(**{**OPT, **opt})
    values = {"opt": own, "args": ARGS, "testing_iterations": [7], "seen": seen, "unused": None}
    if stage is None:
        function(**values)
        return seen.at, []
    definition = tree.body[0]
    assert isinstance(definition, ast.FunctionDef)
    window = Window(stage)
    of_stage = SimpleNamespace(
        **{**vars(own), "iterations": stage, "densify_until_iter": window.scaled(own.densify_until_iter)}
    )
    changed = Schedule(definition).for_stage({**namespace, **values}, {**values, "opt": of_stage}, window)
    changed.function(function)(**changed.arguments({**values, "opt": of_stage}))
    assert (vars(own), namespace["GLOBAL"].late) == ({**OPT, **opt}, 20_000), "the script's own options stay"
    assert (ARGS["late"], MORE["reset_iterations"]) == (24_000, [18_000]), "these too"
    assert namespace["training"] is function
    return seen.at, changed.notes


def test_late_events_keep_their_share_and_all_else_its_count() -> None:
    whole, _ = trained(None)
    half, notes = trained(15_000)
    for name in ("prune_late", "prune_hard", "once", "twice"):
        assert half[name] == [i // 2 for i in whole[name]], name
        assert len(half[name]) > 0
    assert half["pruned"] == [500, 8000, 9000, 12_000], "no report, whose list would count over the whole run"
    assert half["unlock"] == [500, 7750, 9000], "an early iteration is warm-up"
    assert half["oneupSHdegree"] == list(range(1000, 15_001, 1000))
    assert half["densify"] == list(range(600, 7500, 100))
    assert half["reset_opacity"] == [3000, 6000]
    assert half["report"] == [7], "lists are mapped by the adapter"
    assert half["close"] == [15_000]
    assert {"3000 -> 1500", "15500 -> 7750", "opt.prune_interval -> 1500", "GLOBAL.late -> 10000"} <= set(notes)


def test_what_begins_later_is_on_from_the_first_iteration() -> None:
    """Not what begins after the run's end, and nothing happens that does so at a period or at one iteration."""
    source = """
def training(opt, seen):
    kick_on = 100
    for iteration in range(1, opt.iterations + 1):
        weight = opt.weight if iteration >= opt.normals_from else 0
        if 700 < iteration:
            seen.geometry(iteration)
        if iteration > kick_on and iteration < opt.until:
            seen.depths(iteration)
        if iteration > opt.never:
            seen.never(iteration)
        if iteration > 500 and iteration % 100 == 0 or iteration == 600:
            seen.densify(iteration)
        seen.weights(weight)
"""
    tree, namespace = ast.parse(source), dict[str, Any]()
    exec(compile(tree, "train.py", "exec"), namespace)
    opt = SimpleNamespace(iterations=1000, weight=5, normals_from=400, until=300, never=1001)
    definition, seen = tree.body[0], Seen()
    assert isinstance(definition, ast.FunctionDef)
    later = Schedule(definition).begun({"opt": opt}, 1000)
    values = later.arguments({"opt": opt, "seen": seen})
    values["opt"].iterations = 1
    later.function(namespace["training"])(**values)
    assert seen.at == {"geometry": [1], "depths": [1], "weights": [5]}
    assert opt.normals_from == 400, "the script's own options stay"


def test_a_rare_harmful_event_leaves_the_last_tenth_of_a_stage_alone() -> None:
    """A period of 5000 would simplify in the last iteration of a stage of 15,000, not in the last tenth of 16,800."""
    moved, notes = trained(15_000)
    assert moved["simplify"] == [5000, 10_000, 13_500]
    assert "simplify at 15000 -> 13500" in notes
    kept, notes = trained(16_800)
    assert kept["simplify"] == [5000, 10_000, 15_000]
    assert not any("simplify" in note for note in notes)
    # Hard pruning every 3000 until the end, and every 1500 until the end of half as many iterations, ends before both.
    assert moved["prune_hard"][-1] == 13_500


def test_a_level_does_not_end_right_after_a_rare_harmful_event() -> None:
    definition = ast.parse(LOOP).body[0]
    assert isinstance(definition, ast.FunctionDef)
    schedule, variables = Schedule(definition), {"opt": SimpleNamespace(**OPT)}
    ends = {end: schedule.before_harm(end, variables, 30_000) for end in (200, 8000, 9000, 9299, 9300, 12_000, 15_000)}
    # Opacities are reset, or Gaussians pruned, every 3000 iterations, and simplified every 5000.
    assert ends == {200: 200, 8000: 8000, 9000: 8999, 9299: 8999, 9300: 9300, 12_000: 11_999, 15_000: 14_999}


def test_the_ends_of_several_nested_levels_move_and_no_iteration_is_lost() -> None:
    definition = ast.parse(LOOP).body[0]
    assert isinstance(definition, ast.FunctionDef)
    stages = tuple(Stage(level, (64, 64), 9000, signed=False) for level in (2, 1, 0))
    plan = StagePlan(stages, Hierarchy.NESTED)
    moved = between_events(plan, Schedule(definition), {"opt": SimpleNamespace(**OPT)})
    assert [stage.iterations for stage in moved] == [8999, 9000, 9001]  # opacities and Gaussians go at 9000 and 18,000


def test_a_stage_as_long_as_the_run_changes_nothing_but_its_last_tenth() -> None:
    as_it_is, _ = trained(None)
    whole, notes = trained(30_000)
    assert notes == ["simplify at 30000 -> 27000"]
    assert whole == {**as_it_is, "simplify": [*range(5000, 30_000, 5000), 27_000]}


def test_events_are_listed_with_the_values_of_their_options() -> None:
    definition = ast.parse(LOOP).body[0]
    assert isinstance(definition, ast.FunctionDef)
    lines = Schedule(definition).describe({"opt": SimpleNamespace(**OPT), "testing_iterations": [7]})
    assert lines[:5] == [
        "line 7: iteration % 1000 == 0 (oneupSHdegree)",
        "line 9: iteration in [7] (report)",
        "line 13: iteration < 15000 (densify, reset_opacity)",
        "line 14: iteration > 500 and iteration % 100 == 0 (densify)",
        "line 16: iteration % 3000 == 0 (reset_opacity)",
    ]
    assert "line 26: iteration == GLOBAL.late (once)" in lines
    assert not any("print" in line or "close" in line for line in lines)
    of_no_list = Schedule(definition).describe({"testing_iterations": []})
    assert len(of_no_list) == len(lines) - 1, "nothing is reported"


def test_functions_without_a_loop_have_no_events() -> None:
    definition = ast.parse("def training(opt):\n    while opt.more():\n        opt.step()\n").body[0]
    assert isinstance(definition, ast.FunctionDef)
    assert Schedule(definition).events == []
