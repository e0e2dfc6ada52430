"""Look up implementations by name: those of this package, and those that other packages register as entry points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from lapgs_plugin.errors import UserInputError

T = TypeVar("T")


class Registry(Generic[T]):
    """Hold the implementations that a user chooses from by name.

    Args:
        option: option that chooses one, such as "--supervision", for messages.
        group: entry point group through which other packages add theirs.
        kind: class that every entry must be an instance of, or a subclass of with `classes`.
        own: this package's implementations by name, in the order of help texts; an `EntryPoint` is loaded when it is
            looked up. Other packages cannot take these names.
        classes: whether entries are classes.
    """

    def __init__(
        self, option: str, group: str, kind: type[Any], own: Mapping[str, T | EntryPoint], *, classes: bool = False
    ) -> None:
        self._option, self.group, self._kind, self._classes = option, group, kind, classes
        self._own = dict(own)

    @cached_property
    def _found(self) -> Mapping[str, EntryPoint]:
        """Entry points of other packages by name."""
        entries = sorted(entry_points(group=self.group), key=lambda entry: (entry.name, entry.value))
        return {entry.name: entry for entry in entries if entry.name not in self._own}

    def __iter__(self) -> Iterator[str]:
        """Iterate over all names, this package's first."""
        return iter((*self._own, *self._found))

    def __getitem__(self, name: str) -> T:
        """Return the implementation called `name`.

        Raises:
            UserInputError: there is none, or an installed package's cannot be loaded; the line names it.
        """
        found = self._own[name] if name in self._own else self._found.get(name)
        if found is None:
            known = list(self)
            expected = " or ".join(known) if len(known) == 2 else ", ".join(known)
            raise UserInputError(f"{self._option} {name}: expected {expected}")
        return self._loaded(found) if isinstance(found, EntryPoint) else found

    def _loaded(self, entry: EntryPoint) -> T:
        label, advice = f"{self._option} {entry.name}: {entry.value}", "fix or uninstall the package that brings it"
        try:
            loaded = entry.load()
        except Exception as error:  # whatever an import does wrong, the user must learn which package it was
            raise UserInputError(f"{label} cannot be loaded: {type(error).__name__}: {error}; {advice}") from error
        is_class = isinstance(loaded, type)
        if self._classes and not (is_class and issubclass(loaded, self._kind)):
            found = loaded.__name__ if is_class else f"a {type(loaded).__name__}"
            raise UserInputError(f"{label} is {found}, expected a subclass of {self._kind.__name__}; {advice}")
        if not self._classes and not isinstance(loaded, self._kind):
            raise UserInputError(f"{label} is a {type(loaded).__name__}, expected a {self._kind.__name__}; {advice}")
        result: T = loaded
        return result
