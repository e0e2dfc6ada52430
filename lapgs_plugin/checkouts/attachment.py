"""Replace symbols of other modules for a while: checked first, logged, and restored by identity."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType, TracebackType
from typing import Any

from lapgs_plugin.errors import UserInputError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Replacement:
    """Describe one symbol to replace.

    Attributes:
        owner: module or class that holds it.
        name: name of the attribute.
        make: returns the replacement, given the original.
        consumed_by: code that uses it, for the log.
        parameters: names of the original's first parameters; empty checks only that it exists.
    """

    owner: Any
    name: str
    make: Callable[[Any], Any]
    consumed_by: str
    parameters: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Full name of the symbol."""
        owner = self.owner
        owner_name = owner.__name__ if isinstance(owner, ModuleType) else f"{owner.__module__}.{owner.__qualname__}"
        return f"{owner_name}.{self.name}"


def of_class(kind: type, name: str, make: Callable[[Any], Any], consumer: str) -> list[Replacement]:
    """Return the replacement of a method where a class or its nearest base defines it, if there is one."""
    owner = next((base for base in kind.__mro__ if name in vars(base)), None)
    return [] if owner is None else [Replacement(owner, name, make, consumer)]


class Attachment:
    """Replace symbols inside a `with` block. All are verified before the first is replaced, and restored at the end.

    Args:
        replacements: replacements in order; they are undone in reverse.

    Raises:
        UserInputError: on entering, a symbol is missing or takes other parameters; the line names it.
    """

    def __init__(self, replacements: Sequence[Replacement]) -> None:
        self._replacements = tuple(replacements)
        self._originals: list[Any] = []

    def __enter__(self) -> Attachment:
        for replacement in self._replacements:
            _verify(replacement)
        logged: set[str] = set()  # the runner and an adapter may both replace a symbol
        try:
            for replacement in self._replacements:
                # The class's own entry: attribute access may return a bound object, which would not restore it.
                original = vars(replacement.owner)[replacement.name]
                self._originals.append(original)
                setattr(replacement.owner, replacement.name, replacement.make(original))
                if replacement.label not in logged:
                    logger.info("replaced %s; used by %s", replacement.label, replacement.consumed_by)
                    logged.add(replacement.label)
        except BaseException:
            self._restore()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()

    def _restore(self) -> None:
        for replacement in reversed(self._replacements[: len(self._originals)]):
            setattr(replacement.owner, replacement.name, self._originals.pop())


def _verify(replacement: Replacement) -> None:
    changed = "this checkout differs from the versions that this adapter was written for"
    if replacement.name not in vars(replacement.owner):
        raise UserInputError(
            f"{replacement.label} is missing, expected the symbol that {replacement.consumed_by} uses; {changed}: "
            "choose another with --backbone, or train with `lapgs run --off`"
        )
    if not replacement.parameters:
        return
    original = vars(replacement.owner)[replacement.name]
    try:
        parameters = tuple(inspect.signature(original).parameters)
    except (TypeError, ValueError):
        parameters = ()
    if parameters[: len(replacement.parameters)] != replacement.parameters:
        raise UserInputError(
            f"{replacement.label} takes ({', '.join(parameters)}), expected it to begin with "
            f"({', '.join(replacement.parameters)}); {changed}: choose another with --backbone, or train with "
            "`lapgs run --off`"
        )


_NOT_THERE = object()


@contextmanager
def replaced(namespace: dict[str, Any], values: Mapping[str, object]) -> Iterator[None]:
    """Set names to other values inside a `with` block, and restore them at its end."""
    former = {name: namespace.get(name, _NOT_THERE) for name in values}
    namespace.update(values)
    try:
        yield
    finally:
        for name, value in former.items():
            if value is _NOT_THERE:
                namespace.pop(name, None)
            else:
                namespace[name] = value
