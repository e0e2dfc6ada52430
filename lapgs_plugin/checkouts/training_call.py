"""Hold a call of a script's training function, and the place of a stage in the run that the call was for.

Imports no torch.
"""

from __future__ import annotations

import copy
import inspect
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Stage

ROLES = {
    "dataset": ("source_path",),
    "opt": ("iterations", "densify_until_iter", "position_lr_init"),
    "pipe": ("convert_SHs_python", "compute_cov3D_python", "debug"),
}
"""Arguments of `training` by role, each with attributes of which it has one.

The first such argument has the role, one with all of the script's options only if there is no other.
"""

NEEDED = ("dataset", "opt")
"""Roles without which no call can be trained in levels."""

CHECKPOINTS = ("checkpoint", "start_checkpoint")
"""Parameters of `training` for a checkpoint to start from."""


def lacks_role(function: str, parameters: Iterable[str], role: str) -> str:
    """Return a clause that says that no argument of a call has a role of `NEEDED`."""
    return (
        f"{function}({', '.join(parameters)}) of the script has no argument with {ROLES[role][0]}, expected one as "
        f"{role} has in 3DGS"
    )


@dataclass(frozen=True)
class TrainingCall:
    """Hold a call of the script's `training` with its arguments by parameter name.

    Attributes:
        function: the script's `training`.
        values: its arguments.
        roles: parameter of each role of `ROLES` that some argument has.
    """

    function: Callable[..., Any]
    values: Mapping[str, Any]
    roles: Mapping[str, str]

    @classmethod
    def bind(cls, function: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> TrainingCall:
        """Return the call `function(*args, **kwargs)`, defaults included.

        Raises:
            UserInputError: no argument says which scene, or for how many iterations; or there are some without a name.
        """
        signature = inspect.signature(function)
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        values = dict(bound.arguments)
        for name, parameter in signature.parameters.items():
            if parameter.kind is parameter.VAR_KEYWORD:
                values |= values.pop(name)
            elif parameter.kind is parameter.VAR_POSITIONAL and (unnamed := values.pop(name)):
                raise UserInputError(
                    f"{function.__name__}() of the script got {len(unnamed)} argument(s) in *{name}, expected all by "
                    "name; `lapgs run --off` runs the script as it is"
                )
        names = sorted(values, key=lambda name: isinstance(values[name], Namespace))
        roles = {
            role: next((name for name in names if any(hasattr(values[name], a) for a in attributes)), None)
            for role, attributes in ROLES.items()
        }
        for role in NEEDED:
            if roles[role] is None:
                raise UserInputError(
                    f"{lacks_role(function.__name__, values, role)}; `lapgs run --off` runs the script as it is"
                )
        return cls(function, values, {role: name for role, name in roles.items() if name is not None})

    @property
    def dataset(self) -> Any:
        return self.values[self.roles["dataset"]]

    @property
    def opt(self) -> Any:
        return self.values[self.roles["opt"]]

    @property
    def pipe(self) -> Any:
        """Options of the pipeline, without attributes if the script has none."""
        return self.values[self.roles["pipe"]] if "pipe" in self.roles else SimpleNamespace()

    @property
    def checkpoint(self) -> Any:
        """Checkpoint to start from, if the script takes one."""
        return next((arguments[name] for arguments in self._named for name in CHECKPOINTS if name in arguments), None)

    @property
    def test_iterations(self) -> Sequence[int]:
        """Iterations after which the script measures its views."""
        lists = (iterations for arguments in self._named for iterations in _iteration_lists(arguments))
        return next((iterations for name, iterations in lists if name.startswith("test")), ())

    @property
    def variables(self) -> dict[str, Any]:
        """What the function sees by name: globals and arguments."""
        return {**inspect.unwrap(self.function).__globals__, **self.values}

    @property
    def _parsed(self) -> list[Namespace]:
        """The script's parsed options: those that the function sees as globals, and arguments."""
        variables = getattr(inspect.unwrap(self.function), "__globals__", {})
        return [value for value in (*variables.values(), *self.values.values()) if isinstance(value, Namespace)]

    @property
    def options(self) -> list[Any]:
        """The script's parsed options and the arguments, whatever they have; some are in it twice."""
        return [*self._parsed, *self.values.values()]

    @property
    def white_background(self) -> bool:
        return bool(getattr(self.dataset, "white_background", False))

    @property
    def _named(self) -> list[Mapping[str, Any]]:
        """Arguments by name; then the script's parsed options, where they are one of them."""
        return [self.values, *(vars(value) for value in self.values.values() if isinstance(value, Namespace))]

    def changed(self, **values: Any) -> TrainingCall:
        """Return the call with other values of some arguments, by role or parameter; absent ones are left out."""
        named = {self.roles.get(name, name): value for name, value in values.items()}
        known = {name: value for name, value in named.items() if name in self.values}
        return replace(self, values={**self.values, **known})

    def copied(self, *, parsed: bool = False) -> TrainingCall:
        """Return the call with copies of the arguments that have roles, and with `parsed` of all parsed options."""
        names = set(self.roles.values())
        if parsed:
            names |= {name for name, value in self.values.items() if isinstance(value, Namespace)}
        return replace(self, values={**self.values, **{name: copy.copy(self.values[name]) for name in names}})

    def listing(self, change: Callable[[Sequence[int]], list[int]]) -> TrainingCall:
        """Return the call with other lists of iterations: arguments, and parsed options among the arguments."""
        lists: dict[str, Any] = {name: change(iterations) for name, iterations in _iteration_lists(self.values)}
        for name, value in self.values.items():
            if isinstance(value, Namespace):
                lists[name] = Namespace(**{**vars(value), **{n: change(i) for n, i in _iteration_lists(vars(value))}})
        return replace(self, values={**self.values, **lists})

    def run(self) -> Any:
        """Make the call and return its result."""
        with self.own_folder():
            return self.function(**self.values)

    @contextmanager
    def own_folder(self) -> Iterator[None]:
        """Let all of the script's parsed options name this call's output folder, as its `dataset` does.

        Some forks read the folder from a global variable, or give all options to their scene.
        """
        kept = [(group, group.model_path) for group in self._parsed if hasattr(group, "model_path")]
        folder = getattr(self.dataset, "model_path", None)
        try:
            for group, _ in kept:
                group.model_path = folder
            yield
        finally:
            for group, before in reversed(kept):
                group.model_path = before


def _iteration_lists(values: Mapping[str, Any]) -> list[tuple[str, Sequence[int]]]:
    """Return the values that list iterations, with their names."""
    return [(n, value) for n, value in values.items() if n.endswith("iterations") and isinstance(value, (list, tuple))]


@dataclass(frozen=True)
class StageWindow:
    """Place a stage in the whole run.

    Attributes:
        stage: the stage.
        start: number of iterations before it.
        total: number of iterations of the whole run, as the user asked for.
        levels: number of levels of the whole run.
        residual_color_rate: factor on the SH learning rates of residual stages.
        threshold_factor: factor on densification thresholds in this stage.
    """

    stage: Stage
    start: int
    total: int
    levels: int
    residual_color_rate: float
    threshold_factor: float

    def scaled(self, iterations: int) -> int:
        """Return a number of iterations of the whole run's schedule as the same share of this stage."""
        return round(iterations * self.stage.iterations / self.total)

    def local(self, iterations: Iterable[int]) -> list[int]:
        """Return the iterations of the whole run that fall into this stage, counted from its beginning."""
        return [i - self.start for i in iterations if self.start < i <= self.start + self.stage.iterations]
