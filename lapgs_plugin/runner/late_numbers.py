"""Let a checkout's loop run ahead of the GPU: numbers that it only logs are read when they are shown."""

from __future__ import annotations

import inspect
import logging
import numbers
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import Tensor

from lapgs_plugin.checkouts.logged_numbers import ELAPSED, ELAPSED_NOW, NUMBER, READ, RECORD, LateNumbers
from lapgs_plugin.checkouts.rewriting import made_again, tree_of
from lapgs_plugin.checkouts.syntax import parsed

logger = logging.getLogger(__name__)

MOST_PENDING = 100
"""Numbers that may depend on one another before the first of them is waited for."""


class LateNumber:
    """Stand for a number that a GPU computes. It is waited for when it is converted or formatted.

    Args:
        read: returns the number, waiting for it.
        pending: how many numbers it is computed from that nobody has waited for.
    """

    __slots__ = ("_pending", "_read", "_value")

    def __init__(self, read: Callable[[], float], pending: int = 1) -> None:
        self._read: Callable[[], float] | None = read
        self._value, self._pending = 0.0, pending

    def __float__(self) -> float:
        if self._read is not None:
            self._value, self._read, self._pending = self._read(), None, 0
        return self._value

    def __format__(self, specification: str) -> str:
        return format(float(self), specification)

    def __repr__(self) -> str:
        return repr(float(self))

    def __neg__(self) -> Any:
        return -1.0 * self

    def __add__(self, other: Any) -> Any:
        return _computed(operator.add, self, other)

    def __radd__(self, other: Any) -> Any:
        return _computed(operator.add, other, self)

    def __sub__(self, other: Any) -> Any:
        return _computed(operator.sub, self, other)

    def __rsub__(self, other: Any) -> Any:
        return _computed(operator.sub, other, self)

    def __mul__(self, other: Any) -> Any:
        return _computed(operator.mul, self, other)

    def __rmul__(self, other: Any) -> Any:
        return _computed(operator.mul, other, self)

    def __truediv__(self, other: Any) -> Any:
        return _computed(operator.truediv, self, other)

    def __rtruediv__(self, other: Any) -> Any:
        return _computed(operator.truediv, other, self)

    @property
    def pending(self) -> int:
        return self._pending


numbers.Real.register(LateNumber)  # loggers and progress bars ask for a number before they convert it


def _computed(compute: Callable[[Any, Any], Any], first: Any, second: Any) -> Any:
    """Return what is computed of two numbers, of which one is late; at once if the other is something else."""
    pending = sum(each.pending for each in (first, second) if isinstance(each, LateNumber))
    both = all(isinstance(each, (int, float, LateNumber)) for each in (first, second))
    if not both or pending > MOST_PENDING:
        return compute(number(first), number(second))
    return LateNumber(lambda: compute(number(first), number(second)), pending + 1)


def number(value: Any) -> Any:
    """Return a late number once it is there, and everything else as it is."""
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
    made = type(event)(enable_timing=True)
    made.record(*stream, **named)
    return made


NAMES: dict[str, Callable[..., Any]] = {
    READ: read, ELAPSED: elapsed, ELAPSED_NOW: elapsed_now, RECORD: recorded, NUMBER: number,
}  # fmt: skip


def reading_late(training: Callable[..., Any]) -> Callable[..., Any]:
    """Return a script's training function, which waits for the GPU no more where it reads what it only logs."""
    tree = tree_of(training)
    if tree is None:
        return training
    late = LateNumbers(tree, parsed(Path(inspect.getfile(training))))
    if not late.found:
        return training
    late.visit(tree)
    logger.info("%d numbers that %s only logs are read when they are shown", late.found, training.__name__)
    return made_again(training, tree, NAMES)
