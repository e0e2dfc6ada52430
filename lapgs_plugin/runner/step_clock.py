"""Tell a stage when an iteration of a checkout's loop begins, and leave saving out of its time."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

from torch.optim.optimizer import Optimizer, register_optimizer_step_post_hook, register_optimizer_step_pre_hook

from lapgs_plugin.checkouts.attachment import Replacement, of_class
from lapgs_plugin.checkouts.profile import Profile

CLOCK = "update_learning_rate"
"""Method of the family's models that loops call at the start of each iteration."""


def has_clock(profile: Profile) -> bool:
    """Return whether a checkout's loop calls `CLOCK` in every iteration, before its backward pass.

    Some call it at an iteration's end, some not while they warm up.
    """
    calls = [node for node in ast.walk(profile.source.training) if isinstance(node, ast.Call)]
    methods = [(call.func.attr, call.lineno) for call in calls if isinstance(call.func, ast.Attribute)]
    first = dict(sorted(methods, key=lambda method: -method[1]))
    early = first.get(CLOCK, 0) < first["backward"]
    return hasattr(profile.model, CLOCK) and early and _surely_calls_clock(profile.source.training.body)


def _surely_calls_clock(statements: Iterable[ast.stmt]) -> bool:
    """Return whether these statements call `CLOCK` whichever way their branches take; loops are taken to run."""
    return any(map(_calls_clock, statements))


def _calls_clock(statement: ast.stmt) -> bool:
    if isinstance(statement, ast.If):
        return _surely_calls_clock(statement.body) and _surely_calls_clock(statement.orelse)
    if isinstance(statement, (ast.For, ast.While, ast.With, ast.Try)):
        return _surely_calls_clock(statement.body)
    return any(isinstance(node, ast.Attribute) and node.attr == CLOCK for node in ast.walk(statement))


def steps_positions(optimizer: Optimizer, gaussians: Any) -> bool:
    """Return whether an optimizer steps the positions of a checkout's model, which is None before its scene is made."""
    if gaussians is None:
        return False
    return any(each is gaussians._xyz for group in optimizer.param_groups for each in group["params"])


def timing_replacements(profile: Profile, running: Callable[[], Any]) -> list[Replacement]:
    """Return the replacements by which the running stage, or a recorder, is timed.

    Args:
        profile: the checkout's.
        running: returns what runs; None between stages.
    """

    def make_clock(original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def update_learning_rate(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
            if (stage := running()) is not None and is_trained(stage, gaussians):
                stage.iteration_begins(gaussians)  # whatever the argument: some loops do not pass the iteration
            return original(gaussians, *args, **kwargs)

        return update_learning_rate

    def make_save(original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def save(scene: Any, *args: Any, **kwargs: Any) -> Any:
            if (stage := running()) is None:
                return original(scene, *args, **kwargs)
            with stage.record.outside("saving"):
                return original(scene, *args, **kwargs)

        return save

    clock = of_class(profile.model, CLOCK, make_clock, "training() at the start of every iteration")
    return [
        *(clock if has_clock(profile) else ()),
        *of_class(profile.scene, "save", make_save, "training() at --save_iterations"),
    ]


def is_trained(stage: Any, gaussians: Any) -> bool:
    """Return whether a model is that of the scene, which a stage archives: some forks train more models beside it."""
    return stage.gaussians is None or stage.gaussians is gaussians


@contextmanager
def counting_steps(profile: Profile, running: Callable[[], Any]) -> Iterator[None]:
    """Begin an iteration after each step of the running stage's positions, unless the loop calls the method `CLOCK`.

    The first begins before the first step. So the loop may leave out the step of the last iteration.

    Args:
        profile: the checkout's.
        running: returns the running stage, that of the dry run, or a recorder; None between stages.
    """
    if has_clock(profile):
        yield
        return

    def stage_of(optimizer: Optimizer) -> Any:
        stage = running()
        return stage if stage is not None and steps_positions(optimizer, stage.gaussians) else None

    def before(optimizer: Optimizer, *_: Any) -> None:
        stage = stage_of(optimizer)
        if stage is not None and stage.iteration == 0:
            stage.iteration_begins(stage.gaussians)

    def after(optimizer: Optimizer, *_: Any) -> None:
        stage = stage_of(optimizer)
        if stage is not None and stage.has_more:
            stage.iteration_begins(stage.gaussians)

    handles = register_optimizer_step_pre_hook(before), register_optimizer_step_post_hook(after)
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()
