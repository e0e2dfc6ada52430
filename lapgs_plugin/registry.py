"""Look up implementations by name: those of this package, and those that other packages register as entry points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, Generic, TypeVar

from lapgs_plugin.errors import UserInputError

T = TypeVar("T")


class Registry(Generic[T]):
    """Hold what goes by a name on the command line.

    Args:
        option: that names it, such as "--supervision", for messages.
        group: entry point group through which other packages add theirs.
        kind: class that every entry must be an instance of, or a subclass of where `kind` is a metaclass.
        own: what this package brings, by name, in the order of help texts.
    """

    def __init__(self, option: str, group: str, kind: Any, own: Mapping[str, T]) -> None:
        self._option, self.group, self._kind = option, group, kind
        self._own = dict(own)

    @cached_property
    def _found(self) -> Mapping[str, Any]:
        """Entry points by name; names of this package cannot be taken."""
        from importlib.metadata import entry_points  # takes longer to import than the rest of this package's options

        entries = sorted(entry_points(group=self.group), key=lambda entry: (entry.name, entry.value))
        return {entry.name: entry for entry in entries if entry.name not in self._own}

    def __iter__(self) -> Iterator[str]:
        """Names, this package's first."""
        return iter((*self._own, *self._found))

    def __getitem__(self, name: str) -> T:
        """Return what is called `name`.

        Raises:
            UserInputError: there is none, or an installed package's cannot be loaded; the line names it.
        """
        if name in self._own:
            return self._own[name]
        if name not in self._found:
            known = list(self)
            expected = " or ".join(known) if len(known) == 2 else ", ".join(known)
            raise UserInputError(f"{self._option} {name}: expected {expected}")
        entry = self._found[name]
        try:
            loaded = entry.load()
        except Exception as error:  # whatever an import does wrong, the user must learn which package it was
            raise UserInputError(
                f"{self._option} {name}: {entry.value} cannot be loaded: {type(error).__name__}: {error}; fix or "
                "uninstall the package that brings it"
            ) from error
        if not isinstance(loaded, self._kind):
            raise UserInputError(
                f"{self._option} {name}: {entry.value} is a {type(loaded).__name__}, expected a {self._kind.__name__}; "
                "fix or uninstall the package that brings it"
            )
        result: T = loaded
        return result
