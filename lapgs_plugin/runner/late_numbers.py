"""Let a checkout's loop run ahead of the GPU: numbers that it only logs are read when they are shown."""

from __future__ import annotations

import ast
import inspect
import logging
import numbers
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import Tensor

from lapgs_plugin.checkouts.logged_numbers import ELAPSED, ELAPSED_NOW, NUMBER, READ, RECORD, LateNumbers
from lapgs_plugin.checkouts.rewriting import rewritten
from lapgs_plugin.checkouts.syntax import parsed

logger = logging.getLogger(__name__)

MOST_PENDING = 100
"""Numbers that may depend on one another before the first of them is waited for."""


def _methods(compute: Callable[[Any, Any], Any]) -> tuple[Callable[[Any, Any], Any], Callable[[Any, Any], Any]]:
    """Return the two methods of an operator: of a late number with another one, and of another one with it."""
    return lambda late, other: _computed(compute, late, other), lambda late, other: _computed(compute, other, late)


class LateNumber:
    """Stand for a number that a GPU computes. It is waited for when it is converted or formatted.

    Args:
        read: returns the number, waiting for it.
        pending: how many numbers it is computed from that nobody has waited for.

    Attributes:
        pending: as given, until it is waited for.
    """

    __slots__ = ("_read", "_value", "pending")

    def __init__(self, read: Callable[[], float], pending: int = 1) -> None:
        self._read: Callable[[], float] | None = read
        self._value, self.pending = 0.0, pending

    def __float__(self) -> float:
        if self._read is not None:
            self._value, self._read, self.pending = self._read(), None, 0
        return self._value

    def __format__(self, specification: str) -> str:
        return format(float(self), specification)

    def __repr__(self) -> str:
        return repr(float(self))

    def __neg__(self) -> Any:
        return -1.0 * self

    __add__, __radd__ = _methods(operator.add)
    __sub__, __rsub__ = _methods(operator.sub)
    __mul__, __rmul__ = _methods(operator.mul)
    __truediv__, __rtruediv__ = _methods(operator.truediv)


numbers.Real.register(LateNumber)  # loggers and progress bars ask for a number before they convert it


def _computed(compute: Callable[[Any, Any], Any], first: Any, second: Any) -> Any:
    """Return a result of two numbers of which one is late: late itself, unless the other is no number."""
    pending = sum(value.pending for value in (first, second) if isinstance(value, LateNumber))
    both = all(isinstance(value, (int, float, LateNumber)) for value in (first, second))
    if not both or pending > MOST_PENDING:
        return compute(number(first), number(second))
    return LateNumber(lambda: compute(number(first), number(second)), pending + 1)


def number(value: Any) -> Any:
    """Return a late number as a float, waiting for it; return any other value unchanged."""
    return float(value) if isinstance(value, LateNumber) else value


def read(tensor: Any) -> Any:
    """Return the number in a tensor, late."""
    if not isinstance(tensor, Tensor) or tensor.numel() != 1 or not tensor.is_floating_point():
        return tensor.item()
    return LateNumber(tensor.detach().clone().item)  # a copy, as the loop may change the tensor


def elapsed(start: Any, end: Any) -> Any:
    """Return the milliseconds between two events, late."""
    return LateNumber(lambda: elapsed_now(start, end))


def elapsed_now(start: Any, end: Any) -> Any:
    """Return the milliseconds between two events, waiting for the second."""
    end.synchronize()
    return start.elapsed_time(end)


def recorded(event: Any, *stream: Any, **named: Any) -> Any:
    """Return a new event like this one, recorded: the present one may be that of a late number."""
    copy = type(event)(enable_timing=True)
    copy.record(*stream, **named)
    return copy


NAMES: dict[str, Callable[..., Any]] = {
    READ: read, ELAPSED: elapsed, ELAPSED_NOW: elapsed_now, RECORD: recorded, NUMBER: number,
}  # fmt: skip


def reading_late(training: Callable[..., Any]) -> Callable[..., Any]:
    """Return a script's training function, changed so that it does not wait for numbers that it only logs."""

    def late(tree: ast.FunctionDef) -> LateNumbers:
        change = LateNumbers(tree, parsed(Path(inspect.getfile(training))))
        if change.changes:
            logger.info("%d numbers that %s only logs are read when they are shown", change.changes, training.__name__)
        return change

    return rewritten(training, late, NAMES)
