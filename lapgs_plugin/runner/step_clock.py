"""Tell a training loop of a checkout when an iteration begins, and leave saving out of its time."""

from __future__ import annotations

import ast
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

from torch.optim.optimizer import Optimizer, register_optimizer_step_post_hook, register_optimizer_step_pre_hook

from lapgs_plugin.checkouts.attachment import Replacement, of_class
from lapgs_plugin.checkouts.profile import Profile
from lapgs_plugin.stages.record import LoopRecord

CLOCK = "update_learning_rate"
"""Method of the family's models that loops call at the start of each iteration."""


class TimedLoop(ABC):
    """Count the iterations of a training loop: of a stage, or of a checkout's own run.

    Args:
        record: measurements of the loop.

    Attributes:
        record: as given.
        gaussians: the checkout's model that is trained; None before its scene is made.
    """

    def __init__(self, record: LoopRecord) -> None:
        self.record = record
        self.gaussians: Any = None

    @property
    def iteration(self) -> int:
        """Running iteration, from 1; 0 before the first."""
        return self.record.counts.iteration

    @property
    @abstractmethod
    def has_more(self) -> bool:
        """Whether the running call of `training` has iterations after this one."""

    @abstractmethod
    def iteration_begins(self, gaussians: Any) -> None:
        """Do everything that comes before the next iteration, and count it."""

    def trains(self, gaussians: Any) -> bool:
        """Return whether a model is the scene's: some forks train more models beside it."""
        return self.gaussians is None or self.gaussians is gaussians

    def is_stepped_by(self, optimizer: Optimizer) -> bool:
        """Return whether an optimizer steps the positions of the model."""
        stepped = (parameter for group in optimizer.param_groups for parameter in group["params"])
        return self.gaussians is not None and any(parameter is self.gaussians._xyz for parameter in stepped)


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


def timing_replacements(profile: Profile, running: Callable[[], TimedLoop | None]) -> list[Replacement]:
    """Return the replacements by which the running loop is timed.

    Args:
        profile: the checkout's.
        running: returns the running loop; None between stages.
    """

    def make_clock(original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def update_learning_rate(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
            if (loop := running()) is not None and loop.trains(gaussians):
                loop.iteration_begins(gaussians)  # the argument is ignored: some loops do not pass the iteration
            return original(gaussians, *args, **kwargs)

        return update_learning_rate

    def make_save(original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def save(scene: Any, *args: Any, **kwargs: Any) -> Any:
            if (loop := running()) is None:
                return original(scene, *args, **kwargs)
            with loop.record.outside("saving"):
                return original(scene, *args, **kwargs)

        return save

    clock = of_class(profile.model, CLOCK, make_clock, "training() at the start of every iteration")
    return [
        *(clock if has_clock(profile) else ()),
        *of_class(profile.scene, "save", make_save, "training() at --save_iterations"),
    ]


@contextmanager
def counting_steps(profile: Profile, running: Callable[[], TimedLoop | None]) -> Iterator[None]:
    """Begin an iteration after each step of the running loop's positions, unless the loop calls the method `CLOCK`.

    The first begins before the first step. So the loop may leave out the step of the last iteration.

    Args:
        profile: the checkout's.
        running: returns the running loop; None between stages.
    """
    if has_clock(profile):
        yield
        return

    def before(optimizer: Optimizer, *_: Any) -> None:
        loop = running()
        if loop is not None and loop.iteration == 0 and loop.is_stepped_by(optimizer):
            loop.iteration_begins(loop.gaussians)

    def after(optimizer: Optimizer, *_: Any) -> None:
        loop = running()
        if loop is not None and loop.has_more and loop.is_stepped_by(optimizer):
            loop.iteration_begins(loop.gaussians)

    handles = register_optimizer_step_pre_hook(before), register_optimizer_step_post_hook(after)
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()
