"""Find in a training function's syntax tree what its loop does at which iteration, and change that for a stage.

A loop compares its variable with options, arguments and numbers: `iteration < opt.densify_until_iter`,
`iteration % 3000 == 0 and iteration > 15_000`, `iteration in testing_iterations`. Imports no torch.
"""

from __future__ import annotations

import ast
import builtins
import copy
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

from lapgs_plugin.checkouts.rewriting import recompiled, tree_of
from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall

RARE = 10
"""An iteration after 1/RARE of a run is late, and an event whose period is at least that is rare. Earlier iterations
are warm-up, and shorter periods suit a stage of any length: both stay as they are."""

HARMFUL = re.compile("prun|densif|simpl|reinit|reset", re.IGNORECASE)
"""Names of functions after which Gaussians need iterations to recover."""

LOGGING = 100
"""Largest period at which loops only print."""

KEPT = ("iterations", "densify_until_iter", "densify_from_iter", "densification_interval", "opacity_reset_interval")
"""Options of the family that every adapter sets for a stage."""

SPREAD = ("densify_until_iter",)
"""Those of them that keep their share of the iterations."""

LIBRARIES = ("torch", "np", "numpy", "math", "random", "os", "time", "sys", "F", "logging", "wandb")
"""Modules whose functions say nothing about what an event does."""

FLIPPED = {ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE}
"""The operator of a comparison whose sides change places."""

Position = tuple[int, int, int | None, int | None]
"""Where an expression stands in its source: its first and last line and column."""


@dataclass(frozen=True)
class Operand:
    """Hold what the loop's variable is compared with.

    Attributes:
        written: the expression.
        periodic: whether the variable is divided by it: `iteration % written`.
        operator: of the comparison, with the variable on its left.
        comparison: the whole comparison.
        node: the option or number that it stands for: itself, or the value of a local variable.
    """

    written: ast.expr
    periodic: bool
    operator: type[ast.cmpop]
    comparison: ast.expr
    node: ast.expr

    @property
    def text(self) -> str:
        return ast.unparse(self.node)

    @property
    def option(self) -> tuple[str, str] | None:
        return _option(self.node)

    @property
    def name(self) -> str:
        """Last part of an option's name; empty for a number."""
        return "" if self.option is None else self.option[1] or self.option[0]

    @property
    def is_list(self) -> bool:
        return self.operator in (ast.In, ast.NotIn)

    @property
    def is_event_list(self) -> bool:
        """Whether it is an option that lists iterations for an event, not for a report or a checkpoint."""
        return self.is_list and HARMFUL.search(self.name) is not None

    @property
    def is_bound(self) -> bool:
        """Whether it is an iteration at which something begins, ends or happens."""
        return not self.periodic and not self.is_list

    @property
    def listed(self) -> list[Operand]:
        """Elements of a list that is written out."""
        written = self.is_list and isinstance(self.node, (ast.List, ast.Tuple, ast.Set))
        elements = self.node.elts if written else []  # type: ignore[attr-defined]  # as just checked
        return [Operand(element, False, ast.Eq, self.comparison, element) for element in elements]

    def value(self, variables: Mapping[str, Any]) -> Any:
        """Return its value, None if that is known inside of the loop only."""
        if self.option is not None:
            holder, name = variables.get(self.option[0]), self.option[1]
            if isinstance(holder, Mapping) and name:
                return holder.get(name)
            return getattr(holder, name, None) if name else holder
        try:
            return ast.literal_eval(self.node)
        except ValueError:
            return None

    def number(self, variables: Mapping[str, Any]) -> int | None:
        """Return its value if that is a whole number."""
        value = self.value(variables)
        if isinstance(value, float) and value.is_integer():
            return int(value)
        return value if isinstance(value, int) and not isinstance(value, bool) else None


@dataclass(frozen=True)
class Event:
    """Describe what a loop does under a condition on its variable.

    Attributes:
        test: the condition; of one with `or`, one of its alternatives.
        operands: what the variable is compared with there.
        around: the same of the conditions around it.
        calls: names of the functions that are called if it holds.
    """

    test: ast.expr
    operands: tuple[Operand, ...]
    around: tuple[Operand, ...]
    calls: tuple[str, ...]

    def resolved(self, variables: Mapping[str, ast.expr]) -> Event:
        """Return the event with the values of local variables, by name, in place of the variables."""

        def resolve(operands: tuple[Operand, ...]) -> tuple[Operand, ...]:
            return tuple(replace(one, node=variables.get(ast.unparse(one.written), one.node)) for one in operands)

        return replace(self, operands=resolve(self.operands), around=resolve(self.around))

    @property
    def period(self) -> Operand | None:
        return next((operand for operand in self.operands if operand.periodic), None)

    @property
    def matters(self) -> bool:
        """Whether it is more than logging or the end of the loop."""
        if all(operand.name == "iterations" for operand in self.operands):
            return False
        numbers = (operand.number({}) or 0 for operand in (*self.operands, *self.listed))
        return bool(self.calls) or max(numbers) > LOGGING

    def never(self, variables: Mapping[str, Any]) -> bool:
        """Return whether it happens at the iterations of a list, which is empty."""
        return any(operand.is_list and operand.value(variables) in ([], ()) for operand in self.operands)

    @property
    def listed(self) -> tuple[Operand, ...]:
        """Iterations in lists that are written out."""
        return tuple(element for operand in self.operands for element in operand.listed)

    def last(self, end: int, number: Callable[[Operand], int | None]) -> int:
        """Return the last iteration, up to `end`, at which it happens by its period; 0 if there is none."""
        period = None if self.period is None else number(self.period)
        for bound in (*self.operands, *self.around):
            upper = bound.is_bound and bound.operator in (ast.Lt, ast.LtE)
            if upper and (value := number(bound)) is not None:
                end = min(end, value - (bound.operator is ast.Lt))
        return end // period * period if period else 0

    @property
    def harmful(self) -> bool:
        """Whether Gaussians need iterations to recover from it."""
        return any(HARMFUL.search(name) for name in self.calls)

    def describe(self, variables: Mapping[str, Any]) -> str:
        """Return one line: the condition, with the values of options that are known, and the functions it calls."""
        known = {
            _position_of(operand.written): operand.value(variables)
            for operand in self.operands
            if operand.option is not None or operand.node is not operand.written
        }
        rewriter = _Rewriter({written: value for written, value in known.items() if value is not None})
        test = rewriter.visit(copy.deepcopy(self.test))
        return f"line {self.test.lineno}: {ast.unparse(test)}" + f" ({', '.join(self.calls)})" * bool(self.calls)


class Schedule:
    """Hold the events of a training function.

    Args:
        function: its syntax tree.

    Attributes:
        events: in the order of the source; empty if no loop counts iterations.
    """

    def __init__(self, function: ast.FunctionDef) -> None:
        self._function = function
        loop, self._variable = _iteration_loop(function)
        variables = _constants(function)
        events = () if loop is None else _events(loop.body, self._variable, ())
        self.events = [event.resolved(variables) for event in events]

    def describe(self, variables: Mapping[str, Any] | None = None) -> list[str]:
        """Return a line for each event that calls something, or has a number of its own, and can happen.

        Args:
            variables: those that the function sees, by name; options of others have no value.
        """
        known = variables or {}
        return [event.describe(known) for event in self.events if event.matters and not event.never(known)]

    def before_harm(self, end: int, variables: Mapping[str, Any], total: int) -> int:
        """Return `end`, or the iteration before a rare harmful event that comes there or shortly before.

        Densification, rare in the shortest runs alone, leaves a field that can be archived.

        Args:
            end: iteration after which a field is archived.
            variables: those that the function sees, by name.
            total: iterations of the run.
        """

        def number(operand: Operand) -> int | None:
            return operand.number(variables)

        for event in self.events:
            damages = event.harmful and not any("densif" in name.lower() for name in event.calls)
            if event.period is not None and damages and (number(event.period) or 0) >= total / RARE:
                last = event.last(end, number)
                end = last - 1 if last and end - last < total / RARE**2 else end
        return end

    def begun(self, variables: Mapping[str, Any], total: int) -> StageSchedule:
        """Return what changes so that whatever begins later in a run, such as a loss, is on from its first iteration.

        Args:
            variables: those that the function sees, by name.
            total: iterations of the run.
        """
        changed = StageSchedule(self._function, self._variable)
        for operand in (operand for event in self.events for operand in event.operands):
            number = operand.number(variables) if operand.operator in (ast.Gt, ast.GtE) and operand.is_bound else None
            if number is not None and 0 < number < total:
                changed.set(operand, number, 0)
        return changed

    def for_stage(
        self, whole: Mapping[str, Any], stage: Mapping[str, Any], window: StageWindow, keep: Collection[str] = ()
    ) -> StageSchedule:
        """Return what changes in a stage of its own length.

        Late bounds, and lists such as `--prune_iterations`, keep their share of the iterations; so does the period of
        rare events between such bounds. Where a rare event of `HARMFUL` functions would fall into the last tenth of the
        stage, it comes at that tenth's start.

        Args:
            whole: variables that the function sees in the whole run, by name: its arguments and globals.
            stage: the same in the stage; options of `KEPT` are set already.
            window: place of the stage.
            keep: names of other options that stay.
        """
        changed = StageSchedule(self._function, self._variable)
        periods = {event.period.name for event in self.events if event.period is not None} - {""}
        keep = {*keep, *KEPT, *periods}
        late = window.total / RARE
        for event in self.events:
            for operand in event.operands:
                if operand.is_event_list and operand.name not in keep and (events := operand.value(whole)):
                    changed.set_list(operand, events, [window.scaled(i) if i > late else i for i in events])
            operands = [*(operand for operand in event.operands if operand.is_bound), *event.listed]
            bounds = [(operand, number) for operand in operands if (number := operand.number(whole) or 0) > late]
            for bound, number in bounds:
                if bound.name not in keep:
                    changed.set(bound, number, window.scaled(number))
            spread = any(bound.name not in keep or bound.name in SPREAD for bound, _ in bounds)
            period = None if event.period is None else event.period.number(whole)
            if event.period is None or period is None or period < late:
                continue
            if spread and event.period.name not in KEPT:
                changed.set(event.period, period, max(1, window.scaled(period)))
            if event.harmful:
                changed.keep_clear(event, {**whole, **stage}, window.scaled(window.total))
        return changed


@dataclass
class StageSchedule:
    """Hold what differs between a stage's call of a training function and the script's.

    Attributes:
        options: values by variable and attribute.
        notes: every change in words.
    """

    _function: ast.FunctionDef
    _variable: str  # of its loop
    options: dict[tuple[str, str], Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    _numbers: dict[Position, int] = field(default_factory=dict)
    _moved: dict[Position, int] = field(default_factory=dict)

    def set(self, operand: Operand, before: int, after: int) -> None:
        """Give an operand another value."""
        if before == after or operand.option in self.options:
            return
        if operand.option is None:
            self._numbers[_position_of(operand.node)] = after
        else:
            self.options[operand.option] = after
        self.notes.append(f"{operand.text if operand.option else before} -> {after}")

    def set_list(self, operand: Operand, before: Sequence[int], after: list[int]) -> None:
        """Give an option that lists iterations other ones, whatever the adapter has made of it."""
        assert operand.option is not None, "as it has a name"
        if operand.option not in self.options and after != list(before):
            self.notes.append(f"{operand.text} -> {after}")
        self.options[operand.option] = after

    def keep_clear(self, event: Event, variables: Mapping[str, Any], end: int) -> None:
        """Move an event out of the last tenth of a stage that ends at iteration `end`."""

        def now(operand: Operand) -> int | None:
            if operand.option in self.options:
                return int(self.options[operand.option])
            return self._numbers.get(_position_of(operand.node), operand.number(variables))

        assert event.period is not None
        last, start = event.last(end, now), end - end // RARE
        if last > start:
            self._moved[_position_of(event.period.comparison)] = start
            self.notes.append(f"{', '.join(event.calls)} at {last} -> {start}")

    def applied_to(self, call: TrainingCall) -> TrainingCall:
        """Return a call with the options and numbers that changed."""
        return replace(call, values=self.arguments(call.values), function=self.function(call.function))

    def arguments(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return a function's arguments with the options that changed; objects that hold them are copied."""
        result = dict(values)
        for (variable, attribute), value in self.options.items():
            if variable not in result:
                continue
            if not attribute:
                result[variable] = value
                continue
            if result[variable] is values[variable]:
                result[variable] = copy.copy(values[variable])
            if isinstance(result[variable], dict):
                result[variable][attribute] = value
            else:
                setattr(result[variable], attribute, value)
        return result

    def function(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return a training function with the numbers that changed, compiled from the tree; the file stays as it is.

        Args:
            original: the function of the tree, whose globals are used.
        """
        arguments = {argument.arg for argument in ast.walk(self._function.args) if isinstance(argument, ast.arg)}
        elsewhere = {
            option: tuple(value) if isinstance(value, list) else value
            for option, value in self.options.items()
            if option[0] not in arguments
        }
        if not (self._numbers or self._moved or elsewhere):
            return original
        tree = tree_of(original) or copy.deepcopy(self._function)  # if it was changed before
        rewriter = _Rewriter(self._numbers, self._moved, elsewhere, self._variable)
        return recompiled(original, rewriter.visit(tree))


@dataclass
class _Rewriter(ast.NodeTransformer):
    """Replace numbers and options by numbers, and add the iteration of a moved event to its comparison."""

    numbers: Mapping[Position, Any]
    moved: Mapping[Position, int] = field(default_factory=dict)
    options: Mapping[tuple[str, str], Any] = field(default_factory=dict)
    variable: str = ""

    def visit(self, node: ast.AST) -> Any:
        if not isinstance(node, ast.expr):
            return self.generic_visit(node)
        position = _position_of(node)
        if position in self.numbers and not isinstance(node, ast.Compare):
            return ast.copy_location(ast.Constant(self.numbers[position]), node)
        option = _option(node)
        if option is not None and option in self.options and isinstance(getattr(node, "ctx", None), ast.Load):
            return ast.copy_location(ast.Constant(self.options[option]), node)
        visited = cast("ast.expr", self.generic_visit(node))
        if position in self.moved and isinstance(node, (ast.Compare, ast.UnaryOp)):
            at = self.moved[position]
            texts = f"{self.variable} < {at}", f"{self.variable} == {at}"
            before, then = (ast.parse(text, mode="eval").body for text in texts)
            either = ast.BoolOp(ast.Or(), [ast.BoolOp(ast.And(), [visited, before]), then])
            return ast.copy_location(either, node)
        return visited


def _option(node: ast.expr) -> tuple[str, str] | None:
    """Return (variable, name) of `opt.iterations` or `opt["iterations"]`; the name of a variable itself is empty."""
    if isinstance(node, ast.Name):
        return node.id, ""
    if isinstance(node, (ast.Attribute, ast.Subscript)) and isinstance(node.value, ast.Name):
        name = node.attr if isinstance(node, ast.Attribute) else getattr(node.slice, "value", None)
        return (node.value.id, name) if isinstance(name, str) else None
    return None


def _position_of(node: ast.expr) -> Position:
    return node.lineno, node.col_offset, node.end_lineno, node.end_col_offset


def _iteration_loop(function: ast.FunctionDef) -> tuple[ast.For | None, str]:
    """Return the longest loop over a range, and its variable; None and no name without any."""
    loops = [
        (node, node.target.id)
        for node in ast.walk(function)
        if isinstance(node, ast.For) and isinstance(node.target, ast.Name) and "range" in _names(node.iter)
    ]
    return max(loops, key=lambda loop: sum(1 for _ in ast.walk(loop[0])), default=(None, ""))


def _constants(function: ast.FunctionDef) -> dict[str, ast.expr]:
    """Return the values of local variables that are set once, to an option, an argument or a number."""
    stored = [node.id for node in ast.walk(function) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)]
    constants: dict[str, ast.expr] = {}
    for node in ast.walk(function):
        if not (isinstance(node, ast.Assign) and len(node.targets) == 1 and isinstance(node.targets[0], ast.Name)):
            continue
        option = _option(node.value)
        known = isinstance(node.value, ast.Constant) if option is None else option[0] not in stored
        if known and stored.count(node.targets[0].id) == 1:
            constants[node.targets[0].id] = node.value
    return constants


def _names(node: ast.AST) -> set[str]:
    return {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}


def _events(body: Iterable[ast.AST], variable: str, around: tuple[Operand, ...]) -> Iterator[Event]:
    """Yield the events of statements."""
    for node in body:
        if isinstance(node, (ast.If, ast.While)):
            calls = tuple(dict.fromkeys(_calls(node.body)))
            alternatives = _alternatives(node.test)
            for test in alternatives:
                if operands := tuple(_operands(test, variable)):
                    yield Event(test, operands, around, calls)
            inside = tuple(_operands(node.test, variable)) if len(alternatives) == 1 else ()
            yield from _events(node.body, variable, around + inside)
            yield from _events(node.orelse, variable, around)
        elif isinstance(node, (ast.stmt, ast.ExceptHandler, ast.match_case)) and hasattr(node, "body"):
            yield from _events(ast.iter_child_nodes(node), variable, around)
        elif operands := tuple(_operands(node, variable)):
            yield from (Event(operand.comparison, (operand,), around, ()) for operand in operands)


def _alternatives(test: ast.expr) -> list[ast.expr]:
    if isinstance(test, ast.BoolOp) and isinstance(test.op, ast.Or):
        return [alternative for value in test.values for alternative in _alternatives(value)]
    return [test]


def _operands(expression: ast.AST, variable: str) -> Iterator[Operand]:
    """Yield what a variable is compared with in an expression."""
    for node in ast.walk(expression):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            for left, operator, right in zip(sides, node.ops, sides[1:], strict=False):
                kind = type(operator)
                if variable in _names(left):
                    yield _operand(left, right, kind, variable, node)
                elif variable in _names(right) and kind not in (ast.In, ast.NotIn):
                    yield _operand(right, left, FLIPPED.get(kind, kind), variable, node)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not) and _divides(node.operand, variable):
            yield _operand(node.operand, node.operand, ast.Eq, variable, node)


def _operand(
    side: ast.expr, other: ast.expr, operator: type[ast.cmpop], variable: str, comparison: ast.expr
) -> Operand:
    for node in ast.walk(side):
        if isinstance(node, ast.BinOp) and _divides(node, variable):
            return Operand(node.right, True, operator, comparison, node.right)
    return Operand(other, False, operator, comparison, other)


def _divides(node: ast.expr, variable: str) -> bool:
    return isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mod) and variable in _names(node.left)


def _calls(body: Iterable[ast.stmt]) -> Iterator[str]:
    """Yield the names of functions that statements call, and of methods of variables: `gaussians.prune`."""
    for node in (part for statement in body for part in ast.walk(statement)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not hasattr(builtins, node.func.id):
            yield node.func.id
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            owner = node.func.value
            if isinstance(owner, ast.Name) and owner.id not in LIBRARIES and not owner.id.startswith("progress"):
                yield node.func.attr
