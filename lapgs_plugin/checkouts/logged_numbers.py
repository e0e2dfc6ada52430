"""Let a training function read the numbers that it only logs when it shows them. Imports no torch, executes nothing.

Loops of the family read their loss in every iteration, `0.4 * loss.item() + 0.6 * ema`, and show it in every tenth. The
read waits until the GPU has done everything that it was given. So does `torch.cuda.synchronize()` before a time is
read from events.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import TypeGuard

from lapgs_plugin.checkouts.rewriting import Change, call
from lapgs_plugin.checkouts.syntax import called_methods, called_names

ARITHMETIC = (ast.Add, ast.Sub, ast.Mult, ast.Div)
SHOWING = {"format", "add_scalar", "set_postfix"}
"""Methods that show numbers."""
HARMLESS = ("no_grad()", "inference_mode()")
"""Decorators of functions that are followed."""
CLOCKS = {"time", "time_ns", "perf_counter", "perf_counter_ns", "monotonic", "monotonic_ns", "process_time"}
"""Functions that read a clock of the processor."""

READ = "_lapgs_read"
"""Name of the function that takes the place of `x.item()`."""
ELAPSED = "_lapgs_elapsed"
"""Name of the function that takes the place of `a.elapsed_time(b)` where the number may be late."""
ELAPSED_NOW = "_lapgs_elapsed_now"
"""Name of the function that takes the place of `a.elapsed_time(b)` where the number is needed at once."""
RECORD = "_lapgs_record"
"""Name of the function that takes the place of `a.record()`."""
NUMBER = "_lapgs_number"
"""Name of the function that waits for a number."""


class LateNumbers(Change):
    """Change a training function so that it goes on while the GPU computes numbers that it logs.

    `x.item()` becomes `READ(x)` and `a.elapsed_time(b)` becomes `ELAPSED(a, b)` where the number is added, multiplied,
    formatted, or given to a function of the script that does the same. They return late numbers, which are waited for
    when they are formatted; wherever else a variable with such a number is used, it becomes `NUMBER(variable)`.

    Events of late times are made anew by each `a.record()`. `torch.cuda.synchronize()` right before a time of events is
    left out in a loop unless that reads a clock of the processor; times that are not late wait for their end,
    `ELAPSED_NOW(a, b)`.

    Args:
        function: the training function, for `visit`, which changes it.
        script: its module, for functions that are given numbers.

    Attributes:
        changes: number of reads that are late.
    """

    def __init__(self, function: ast.FunctionDef, script: ast.Module) -> None:
        functions = {node.name: node for node in script.body if isinstance(node, ast.FunctionDef)}
        nodes = list(ast.walk(function))
        uses, events = _Uses(function, functions), _local_events(nodes)
        self._late: set[ast.AST] = set()
        self._waited_for: set[ast.AST] = set()
        for node in nodes:
            if _is_read(node, events) and (waiting := uses.waiting([node])) is not None and node not in waiting:
                self._late.add(node)
                self._waited_for |= waiting
        self._timed = {name for read in self._late for name in _events(read)}
        loops = [node for node in nodes if isinstance(node, (ast.For, ast.While))]
        inside = [node for loop in loops for node in ast.walk(loop)]
        reads_clock = not CLOCKS.isdisjoint({*called_names(inside), *called_methods(inside)})
        self._waits = set() if reads_clock else {wait for node in inside for wait in _waits_for_times(node)}
        self.changes = len(self._late)

    def visit(self, node: ast.AST) -> ast.AST:
        """Return the node, or what takes its place."""
        replacement = self._instead_of(node)
        if node in self._waited_for:
            assert isinstance(replacement, ast.expr), "a variable, or what is computed with it"
            replacement = call(NUMBER, replacement)
        return replacement if replacement is node else ast.fix_missing_locations(ast.copy_location(replacement, node))

    def _instead_of(self, node: ast.AST) -> ast.AST:
        self.generic_visit(node)
        match node:
            case ast.Expr(value=value) if value in self._waits:
                return ast.Pass()
            case ast.Expr(value=ast.Call(ast.Attribute(ast.Name(id=event), "record"), args, keywords)):
                record = call(RECORD, ast.Name(event, ast.Load()), *args)
                record.keywords = keywords
                return ast.Assign([ast.Name(event, ast.Store())], record) if event in self._timed else node
            case ast.Call(func=ast.Attribute(value, "item")) if node in self._late:
                return call(READ, value)
            case ast.Call(func=ast.Attribute(value, "elapsed_time"), args=args, keywords=[]):
                return call(ELAPSED if node in self._late else ELAPSED_NOW, value, *args)
        return node


class _Uses:
    """Follow numbers through a function.

    Args:
        function: the function.
        others: functions of its script by name.
        followed: functions and parameters that are being followed.
    """

    def __init__(
        self,
        function: ast.FunctionDef,
        others: dict[str, ast.FunctionDef],
        followed: frozenset[tuple[str, str]] = frozenset(),
    ) -> None:
        self._nodes, self._others, self._followed = list(ast.walk(function)), others, followed
        self._parents = {child: node for node in self._nodes for child in ast.iter_child_nodes(node)}

    def waiting(self, numbers: Iterable[ast.expr] = (), names: Iterable[str] = ()) -> set[ast.AST] | None:
        """Return the expressions by which numbers, or those of variables, get to where they cannot be late.

        None if they get into variables that others see, or that are changed by other operators in place.
        """
        unfit = _shared(self._nodes) | _changed_otherwise(self._nodes)
        known, waiting = set(names), set[ast.AST]()
        if known & unfit:
            return None
        open_numbers = [*numbers, *(number for name in known for number in self._loads(name))]
        while open_numbers:
            number = open_numbers.pop()
            while _computes(self._parents[number], number):
                number = self._parents[number]  # type: ignore[assignment]  # an expression, as it computes
            if (name := self._variable(number)) is not None:
                if name in unfit:
                    return None
                if name not in known:
                    known.add(name)
                    open_numbers += self._loads(name)
            elif not self._is_shown(number):
                waiting.add(number)
        return waiting

    def _loads(self, name: str) -> list[ast.expr]:
        names = (node for node in self._nodes if isinstance(node, ast.Name) and node.id == name)
        return [node for node in names if isinstance(node.ctx, ast.Load)]

    def _variable(self, number: ast.expr) -> str | None:
        """Return the variable that is set to a number or changed by it."""
        match self._parents[number]:
            case ast.Assign(targets=[ast.Name(id=name)]):
                return name
            case ast.AugAssign(target=ast.Name(id=name), op=operation) if isinstance(operation, ARITHMETIC):
                return name
        return None

    def _is_shown(self, number: ast.expr) -> bool:
        """Return whether a number is formatted, or given to what shows it."""
        parent = self._parents[number]
        if isinstance(parent, (ast.FormattedValue, ast.Expr)):
            return True
        if isinstance(parent, ast.Dict):
            call = self._parents[parent]
            return isinstance(call, ast.Call) and _method(call) == "set_postfix"
        name = parent.arg if isinstance(parent, ast.keyword) else None
        call = self._parents[parent] if isinstance(parent, ast.keyword) else parent
        if not isinstance(call, ast.Call) or number is call.func:
            return False
        if isinstance(call.func, ast.Name):
            return call.func.id == "print" or self._is_shown_by(call, call.func.id, number, name)
        return _method(call) in SHOWING

    def _is_shown_by(self, call: ast.Call, function: str, number: ast.expr, keyword: str | None) -> bool:
        """Return whether another function of the script does no more with an argument than show it."""
        other = self._others.get(function)
        starred = any(isinstance(argument, ast.Starred) for argument in call.args)
        if other is None or starred or not all(ast.unparse(node).endswith(HARMLESS) for node in other.decorator_list):
            return False
        places = [argument.arg for argument in (*other.args.posonlyargs, *other.args.args)]
        if keyword is None:
            position = call.args.index(number)
            keyword = places[position] if position < len(places) else None
        elif keyword not in (*places, *(argument.arg for argument in other.args.kwonlyargs)):
            return False
        if keyword is None or (function, keyword) in self._followed:
            return False
        followed = self._followed | {(function, keyword)}
        return _Uses(other, self._others, followed).waiting(names=[keyword]) == set()


def _computes(parent: ast.AST, node: ast.AST) -> bool:
    match parent:
        case ast.IfExp(test=test):
            return node is not test
        case ast.UnaryOp(op=ast.USub()):
            return True
    return isinstance(parent, ast.BinOp) and isinstance(parent.op, ARITHMETIC)


def _is_read(node: ast.AST, events: set[str]) -> TypeGuard[ast.Call]:
    match node:
        case ast.Call(func=ast.Attribute(attr="item"), args=[], keywords=[]):
            return True
        case ast.Call(func=ast.Attribute(attr="elapsed_time")):
            return {*_events(node)} <= events and len(_events(node)) > 0
    return False


def _method(call: ast.AST) -> str:
    return call.func.attr if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) else ""


def _shared(nodes: Iterable[ast.AST]) -> set[str]:
    """Return the variables that a function shares with others."""
    return {name for node in nodes if isinstance(node, (ast.Global, ast.Nonlocal)) for name in node.names}


def _changed_otherwise(nodes: Iterable[ast.AST]) -> set[str]:
    """Return the variables that are changed in place by operators that late numbers do not have, such as `**=`."""
    changes = (node for node in nodes if isinstance(node, ast.AugAssign) and not isinstance(node.op, ARITHMETIC))
    return {change.target.id for change in changes if isinstance(change.target, ast.Name)}


def _local_events(nodes: Sequence[ast.AST]) -> set[str]:
    """Return the variables of a function that it only sets to new events, records and reads times of."""
    names = [node for node in nodes if isinstance(node, ast.Name)]
    loaded = Counter(node.id for node in names if isinstance(node.ctx, ast.Load))
    stored = Counter(node.id for node in names if not isinstance(node.ctx, ast.Load))
    recorded = Counter(name for node in nodes if (name := _new_event(node)) is not None)
    used = Counter(name for node in nodes for name in _events(node))
    return {name for name in recorded if (stored[name], loaded[name]) == (recorded[name], used[name])} - _shared(nodes)


def _events(node: ast.AST) -> tuple[str, ...]:
    """Return the variables of events that are recorded, or of which the time between is asked for."""
    match node:
        case ast.Expr(value=ast.Call(func=ast.Attribute(ast.Name(id=event), "record"))):
            return (event,)
        case ast.Call(func=ast.Attribute(ast.Name(id=start), "elapsed_time"), args=[ast.Name(id=end)], keywords=[]):
            return start, end
    return ()


def _new_event(node: ast.AST) -> str | None:
    match node:
        case ast.Assign(targets=[ast.Name(id=name)], value=ast.Call(func=function)):
            return name if ast.unparse(function).split(".")[-1] == "Event" else None
    return None


def _waits_for_times(node: ast.AST) -> list[ast.expr]:
    """Return the calls of `torch.cuda.synchronize()` in a block that are right before a time of events."""
    waits = []
    for block in (getattr(node, name, None) for name in ("body", "orelse", "finalbody")):
        statements = block if isinstance(block, list) else []  # a lambda's body is an expression
        for statement, following in pairwise(statements):
            times = "elapsed_time" in called_methods(ast.walk(following))
            if times and isinstance(statement, ast.Expr) and ast.unparse(statement) == "torch.cuda.synchronize()":
                waits.append(statement.value)
    return waits
