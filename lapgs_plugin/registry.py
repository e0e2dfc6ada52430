"""Look up implementations by name: those of this package, and those that other packages register as entry points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from lapgs_plugin.errors import UserInputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")

HOOKS = "lapgs_plugin.hooks"
"""Entry point group whose members are StageHook classes, created without arguments for every run."""

ALL = "all"
"""Choice of every entry point."""

NONE = "none"
"""Choice of no entry point."""


def chosen_entries(option: str, group: str, chosen: str) -> list[EntryPoint]:
    """Return entry points of a group, sorted by name.

    Args:
        option: that chooses them, for the message.
        group: their group.
        chosen: "all", "none", or names separated by commas.

    Raises:
        UserInputError: no installed package registers a chosen name.
    """
    from importlib.metadata import entry_points  # takes longer to import than the rest of this package's options

    entries = sorted(entry_points(group=group), key=lambda entry: (entry.name, entry.value))
    if chosen in (ALL, NONE):
        return entries if chosen == ALL else []
    names, known = [name.strip() for name in chosen.split(",")], {entry.name for entry in entries}
    if unknown := [name for name in names if name not in known]:
        expected = ", ".join([ALL, NONE, *sorted(known)])
        raise UserInputError(
            f"{option} {chosen}: no installed package registers {unknown[0]!r}; expected {expected}, or several names "
            "separated by commas"
        )
    return [entry for entry in entries if entry.name in names]


class Registry(Generic[T]):
    """Hold the implementations that a user chooses from by name.

    Args:
        option: option that chooses one, such as "--supervision", for messages.
        group: entry point group through which other packages add theirs.
        kind: class that every entry must be an instance of, or a subclass of with `classes`.
        own: this package's implementations by name, in the order of help texts; a text "module:name" is imported when
            it is looked up. Other packages cannot take these names.
        classes: whether entries are classes.
    """

    def __init__(
        self, option: str, group: str, kind: type[Any], own: Mapping[str, T | str], *, classes: bool = False
    ) -> None:
        self._option, self.group, self._kind, self._classes = option, group, kind, classes
        self._own = dict(own)

    @cached_property
    def entries(self) -> Mapping[str, EntryPoint]:
        """Entry points of other packages by name."""
        entries = chosen_entries(self._option, self.group, ALL)
        return {entry.name: entry for entry in entries if entry.name not in self._own}

    def __iter__(self) -> Iterator[str]:
        """Iterate over all names, this package's first."""
        return iter((*self._own, *self.entries))

    def __getitem__(self, name: str) -> T:
        """Return the implementation called `name`.

        Raises:
            UserInputError: there is none, or an installed package's cannot be loaded; the line names it.
        """
        if name in self._own:
            own = self._own[name]
            return self._loaded(name, own, lambda: resolve_name(own)) if isinstance(own, str) else own
        if name not in self.entries:
            known = list(self)
            expected = " or ".join(known) if len(known) == 2 else ", ".join(known)
            raise UserInputError(f"{self._option} {name}: expected {expected}")
        return self._loaded(name, self.entries[name].value, self.entries[name].load)

    def _loaded(self, name: str, source: str, load: Callable[[], Any]) -> T:
        label, advice = f"{self._option} {name}: {source}", "fix or uninstall the package that brings it"
        try:
            loaded = load()
        except Exception as error:  # whatever an import does wrong, the user must learn which package it was
            raise UserInputError(f"{label} cannot be loaded: {type(error).__name__}: {error}; {advice}") from error
        is_class = isinstance(loaded, type)
        if self._classes and not (is_class and issubclass(loaded, self._kind)):
            received = loaded.__name__ if is_class else f"a {type(loaded).__name__}"
            raise UserInputError(f"{label} is {received}, expected a subclass of {self._kind.__name__}; {advice}")
        if not self._classes and not isinstance(loaded, self._kind):
            received = f"the class {loaded.__name__}" if is_class else f"a {type(loaded).__name__}"
            raise UserInputError(f"{label} is {received}, expected an instance of {self._kind.__name__}; {advice}")
        result: T = loaded
        return result
