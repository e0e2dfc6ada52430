"""Let a checkout's loop run ahead of the GPU: numbers that it only logs are read when they are shown."""

from __future__ import annotations

import ast
import inspect
import logging
import numbers
import operator
import threading
import weakref
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.logged_numbers import ELAPSED, ELAPSED_NOW, NUMBER, READ, RECORD, LateNumbers
from lapgs_plugin.checkouts.rewriting import rewritten
from lapgs_plugin.checkouts.syntax import parsed

logger = logging.getLogger(__name__)

MOST_PENDING = 100
"""Numbers that may depend on one another before the first of them is waited for."""

READ_TOGETHER = 64
"""Most numbers that are copied from a device at once."""


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


_KINDS = LateNumber, float, int


def _computed(compute: Callable[[Any, Any], Any], first: Any, second: Any) -> Any:
    """Return a result of two numbers of which one is late: late itself, unless the other is no number."""
    if not (isinstance(first, _KINDS) and isinstance(second, _KINDS)):
        return compute(number(first), number(second))
    pending = (first.pending if isinstance(first, LateNumber) else 0) + (
        second.pending if isinstance(second, LateNumber) else 0
    )
    if pending > MOST_PENDING:
        return compute(number(first), number(second))
    return LateNumber(lambda: compute(number(first), number(second)), pending + 1)


def number(value: Any) -> Any:
    """Return a late number as a float, waiting for it; return any other value unchanged."""
    return float(value) if isinstance(value, LateNumber) else value


class _Copies:
    """Copy numbers on their device into one tensor, to read them together.

    Args:
        memory: tensors (`READ_TOGETHER`,) and their elements, of which one tensor is used until the numbers are read.
        like: a tensor of the kind of the numbers.
    """

    def __init__(self, memory: list[tuple[Tensor, tuple[Tensor, ...]]], like: Tensor) -> None:
        self._memory, self._count = memory, 0
        self._numbers, self._elements = memory.pop() if memory else _new_memory(like)
        self._values: list[float] | None = None
        self._results: dict[int, tuple[weakref.ref[Tensor], int, LateNumber]] = {}

    def add(self, tensor: Tensor) -> LateNumber | None:
        """Return the number in a tensor, which may change afterwards; None after a read, or without an element left."""
        if self._values is not None or self._count == READ_TOGETHER:
            return None
        # Compiled code may write to other tensors without a new version.
        is_result = tensor.requires_grad and not tensor.is_leaf
        if is_result and (known := self._results.get(id(tensor))) is not None:
            reference, version, late = known
            if reference() is tensor and version == tensor._version:
                return late  # loops read their loss twice
        source = tensor.detach() if torch.is_grad_enabled() else tensor
        self._elements[self._count].copy_(source if source.ndim == 0 else source.reshape(()))
        late = LateNumber(partial(self._read, self._count))
        self._count += 1
        if is_result:
            self._results[id(tensor)] = weakref.ref(tensor), tensor._version, late
        return late

    def _read(self, index: int) -> float:
        with _lock:
            if self._values is None:
                self._values = self._numbers.tolist()
                self._memory.append((self._numbers, self._elements))
                self._results.clear()
        return self._values[index]


def _new_memory(like: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Return a tensor on the device of another, and its elements."""
    with torch.inference_mode(False):  # it is written to in other modes, too
        numbers = like.new_empty(READ_TOGETHER)
        return numbers, numbers.unbind()


_lock = threading.Lock()
_memory: dict[tuple[torch.device, torch.dtype], list[tuple[Tensor, tuple[Tensor, ...]]]] = {}
_copies: dict[tuple[torch.device, torch.dtype], _Copies] = {}


def read(tensor: Any) -> Any:
    """Return the number in a tensor, late."""
    if not isinstance(tensor, Tensor) or tensor.numel() != 1 or not tensor.is_floating_point():
        return tensor.item()
    kind = tensor.device, tensor.dtype
    with _lock:
        copies = _copies.get(kind)
        if copies is not None and (late := copies.add(tensor)) is not None:
            return late
        copies = _copies[kind] = _Copies(_memory.setdefault(kind, []), tensor)
        return copies.add(tensor)


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
