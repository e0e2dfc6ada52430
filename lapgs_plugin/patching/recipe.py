"""Read recipes from `patches/*.toml`: how a CUDA extension is recognised, and the edits for it."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from lapgs_plugin.errors import PatchError
from lapgs_plugin.files import is_file, shipped
from lapgs_plugin.patching.tokens import occurrences, tokenize
from lapgs_plugin.untrusted import STRICT, read_toml, shortened


@dataclass(frozen=True)
class Anchor:
    """Locate tokens in the sources of an extension.

    Attributes:
        file: path below the extension's folder, with forward slashes.
        find: the tokens; formatting and comments do not matter. Empty if the file only has to exist.
        function: function whose definition is searched; None for the whole file.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    file: str
    find: str = ""
    function: str | None = None


@dataclass(frozen=True)
class Edit:
    """Describe one small change, `[[edit]]` in a file. Its tokens must occur once.

    Attributes:
        set: the set of edits that it belongs to, such as "signed-color".
        name: unique name in its set.
        file, find, function: see `Anchor`.
        before: text to insert before the tokens.
        replace: text to replace the tokens with, instead of `before`.
        unless: directives that make the edit needless where the file has one outside of any condition.

    Raises:
        ValueError: a value is not usable.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    set: str
    name: str
    file: str
    find: str
    function: str | None = None
    before: str | None = None
    replace: str | None = None
    unless: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _require_tokens(self.find)
        for name in (self.set, self.name):
            if not re.fullmatch(r"[\w-]+", name, re.ASCII):  # others would not be found again in the blocks of a file
                raise ValueError(f"{shortened(name)} is no name of a set or an edit, expected letters, digits, _ and -")
        if (self.before is None) == (self.replace is None):
            raise ValueError(f"{self.name!r} has both or none, expected either `before` or `replace`")
        if not self.put.isascii():
            raise ValueError(f"{self.name!r} puts in {shortened(self.put)}, expected ASCII, the same in every encoding")
        if not all(text.startswith("#") for text in self.unless):
            raise ValueError(f"{self.name!r} has unless = {self.unless!r}, expected directives that start with #")

    @property
    def anchor(self) -> Anchor:
        """The location of its tokens."""
        return Anchor(self.file, self.find, self.function)

    @property
    def put(self) -> str:
        """Text to put in."""
        return (self.before or self.replace or "").strip("\n")

    @property
    def label(self) -> str:
        """Name in messages and in the blocks of a file."""
        return f"{self.set}/{self.name}"


@dataclass(frozen=True)
class Check:
    """Require that tokens occur exactly `times` times in each of some places, or the set's edits would be wrong.

    Attributes:
        places: anchors without tokens.
        because: reason, which ends the message when the check fails.

    Raises:
        ValueError: there are no tokens.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    set: str
    find: str
    times: int
    because: str
    places: tuple[Anchor, ...]

    def __post_init__(self) -> None:
        _require_tokens(self.find)

    @property
    def anchors(self) -> list[Anchor]:
        """The places with the tokens."""
        return [replace(anchor, find=self.find) for anchor in self.places]


def _require_tokens(find: str) -> None:
    if not tokenize(find):
        raise ValueError(f"find = {find!r} has nothing to find")


@dataclass(frozen=True)
class Recipe:
    """Describe one extension and the edits for it: the content of a file; `lapgs help patches` explains the entries.

    Attributes:
        name: stem of its file.
        title: name in messages.
        present, absent: anchors that its folder must and must not have to be recognised.
        extends: name of the recipe that it inherits from.
        reinstall: command that builds and installs it again; `{folder}` stands for its folder.
        opt_in: sets that change ordinary calls; applying "all" leaves them out.
        edit, check: edits and checks in the order of the file, inherited ones first.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    name: str
    title: str
    present: tuple[Anchor, ...]
    absent: tuple[Anchor, ...] = ()
    extends: str | None = None
    reinstall: str = ""
    opt_in: tuple[str, ...] = ()
    edit: tuple[Edit, ...] = ()
    check: tuple[Check, ...] = ()

    @property
    def sets(self) -> tuple[str, ...]:
        """Sets of edits for this extension."""
        return tuple(dict.fromkeys(edit.set for edit in self.edit))

    @property
    def default_sets(self) -> tuple[str, ...]:
        """Sets that are applied when none is named."""
        return tuple(name for name in self.sets if name not in self.opt_in)

    @property
    def files(self) -> tuple[str, ...]:
        """Files of its edits and checks."""
        checked = [anchor.file for check in self.check for anchor in check.places]
        return tuple(dict.fromkeys([*(edit.file for edit in self.edit), *checked]))

    def recognises(self, folder: Path) -> bool:
        """Return whether `folder` has the sources of this extension."""
        return all(_stands(anchor, folder) for anchor in self.present) and not any(
            _stands(anchor, folder) for anchor in self.absent
        )


def load_recipes(folder: Path | None = None) -> tuple[Recipe, ...]:
    """Return all recipes in `folder`, sorted by name.

    Args:
        folder: folder of the TOML files; None for those that come with this package.

    Raises:
        PatchError: a file is not a recipe.
    """
    paths = sorted((folder or shipped("patches")).glob("*.toml"))
    own = {path.stem: _read(path) for path in paths}
    return tuple(_with_inherited(name, own) for name in own)


def read_source(path: Path) -> str:
    """Return the text of a source file, one character a byte.

    Raises:
        PatchError: it cannot be read.
    """
    try:
        return path.read_bytes().decode("latin-1")
    except OSError as error:
        raise PatchError(f"{path}: cannot be read: {error.strerror}; expected a file this user may read") from error


def _stands(anchor: Anchor, folder: Path) -> bool:
    path = folder / anchor.file
    if not is_file(path):  # a folder that this user may not search, such as lost+found, has none
        return False
    tokens = tokenize(read_source(path)) if anchor.find else []
    return not anchor.find or bool(occurrences(tokens, anchor.find, range(len(tokens))))


def _read(path: Path) -> Recipe:
    recipe: Recipe = read_toml(path, Recipe, error=PatchError, advice="`lapgs help patches` says what it holds")
    if recipe.name != path.stem:
        raise PatchError(f"{path}: its name is {shortened(recipe.name)}, expected that of the file; correct it")
    return recipe


def _with_inherited(name: str, recipes: dict[str, Recipe], heirs: tuple[str, ...] = ()) -> Recipe:
    """Return a recipe with its inherited edits and checks; `heirs` are the recipes that inherit from it."""
    own = recipes[name]
    if own.extends is None:
        return own
    if own.extends in (name, *heirs):
        raise PatchError(
            f"{name}.toml: extends {shortened(own.extends)}, which extends it; expected one without a circle"
        )
    if own.extends not in recipes:
        raise PatchError(f"{name}.toml: extends {shortened(own.extends)}, expected one of {sorted(recipes)}")
    base = _with_inherited(own.extends, recipes, (name, *heirs))
    edits = {edit.label: edit for edit in (*base.edit, *own.edit)}  # its own replaces one with the same label
    return replace(
        own,
        reinstall=own.reinstall or base.reinstall,
        opt_in=base.opt_in + own.opt_in,
        edit=tuple(edits.values()),
        check=base.check + own.check,
    )
