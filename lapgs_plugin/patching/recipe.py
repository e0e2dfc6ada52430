"""Read recipes from `patches/*.toml`: how a CUDA extension is recognised, and the edits for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from typing_extensions import NotRequired

from lapgs_plugin.errors import PatchError
from lapgs_plugin.patching.tokens import occurrences, tokenize
from lapgs_plugin.untrusted import Strict, read_toml, shortened


class _Place(Strict):
    file: str
    find: NotRequired[str]
    function: NotRequired[str]


class _EditEntry(Strict):
    set: str
    name: str
    file: str
    find: str
    function: NotRequired[str]
    before: NotRequired[str]
    replace: NotRequired[str]
    unless: NotRequired[Any]  # `_edit` checks it


class _CheckEntry(Strict):
    set: str
    find: str
    times: int
    because: str
    places: list[_Place]


class _File(Strict):
    """Type the contents of a recipe's file; patches/README.md explains the entries."""

    name: str
    title: str
    present: list[_Place]
    absent: NotRequired[list[_Place]]
    extends: NotRequired[str]
    reinstall: NotRequired[str]
    opt_in: NotRequired[list[str]]
    edit: NotRequired[list[_EditEntry]]
    check: NotRequired[list[_CheckEntry]]


@dataclass(frozen=True)
class Anchor:
    """Name a place in the sources of an extension.

    Attributes:
        file: path below the extension's folder, with forward slashes.
        find: tokens at the place; formatting and comments do not matter. Empty if the file only has to exist.
        function: function whose definition is searched; None for the whole file.
    """

    file: str
    find: str
    function: str | None = None


@dataclass(frozen=True)
class Edit:
    """Describe one small change at a place that must be unique.

    Attributes:
        set: the set of edits that it belongs to, such as "signed-color".
        name: unique name in its set.
        anchor: the place.
        put: text to insert before the anchor's tokens, or to replace them with.
        replaces: whether the tokens are replaced.
        unless: directives; the edit is not needed if the file has one of them outside of any condition.
    """

    set: str
    name: str
    anchor: Anchor
    put: str
    replaces: bool
    unless: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Name in messages and in the blocks of a file."""
        return f"{self.set}/{self.name}"


@dataclass(frozen=True)
class Check:
    """Require that tokens occur exactly `times` times, without which the set's edits would be wrong.

    Attributes:
        because: reason, which ends the message when the check fails.
    """

    set: str
    anchor: Anchor
    times: int
    because: str


@dataclass(frozen=True)
class Recipe:
    """Describe one extension and the edits for it.

    Attributes:
        name: stem of its file in `patches/`.
        title: name in messages.
        present, absent: places that its folder must and must not have to be recognised.
        reinstall: command that builds and installs it again; `{folder}` stands for its folder.
        edits, checks: edits and checks in the order of the file, inherited ones first.
        opt_in: sets that change ordinary calls; applying "all" leaves them out.
    """

    name: str
    title: str
    present: tuple[Anchor, ...]
    absent: tuple[Anchor, ...]
    reinstall: str
    edits: tuple[Edit, ...]
    checks: tuple[Check, ...]
    opt_in: tuple[str, ...] = ()

    @property
    def sets(self) -> tuple[str, ...]:
        """Sets of edits for this extension."""
        return tuple(dict.fromkeys(edit.set for edit in self.edits))

    @property
    def default_sets(self) -> tuple[str, ...]:
        """Sets that are applied when none is named."""
        return tuple(name for name in self.sets if name not in self.opt_in)

    @property
    def files(self) -> tuple[str, ...]:
        """Files of its edits and checks."""
        anchors = [edit.anchor for edit in self.edits] + [check.anchor for check in self.checks]
        return tuple(dict.fromkeys(anchor.file for anchor in anchors))

    def recognises(self, folder: Path) -> bool:
        """Return whether `folder` has the sources of this extension."""
        return all(_stands(anchor, folder) for anchor in self.present) and not any(
            _stands(anchor, folder) for anchor in self.absent
        )


def patches_folder() -> Path:
    """Return the folder of the TOML files: in the installed package, otherwise at the top of the repository."""
    installed = Path(__file__).parents[1] / "patches"
    return installed if installed.is_dir() else Path(__file__).parents[2] / "patches"


def load_recipes(folder: Path | None = None) -> tuple[Recipe, ...]:
    """Return all recipes in `folder`, sorted by name.

    Args:
        folder: folder of the TOML files; None for those that come with this package.

    Raises:
        PatchError: a file is not a recipe.
    """
    paths = sorted((folder or patches_folder()).glob("*.toml"))
    tables = {path.stem: _read(path) for path in paths}
    return tuple(_recipe(name, tables) for name in tables)


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
    if not path.is_file():
        return False
    tokens = tokenize(read_source(path)) if anchor.find else []
    return not anchor.find or bool(occurrences(tokens, anchor.find, range(len(tokens))))


def _read(path: Path) -> dict[str, Any]:
    table: dict[str, Any] = read_toml(path, _File, error=PatchError, advice="patches/README.md says what it holds")
    if table["name"] != path.stem:
        raise PatchError(f"{path}: its name is {shortened(table['name'])}, expected that of the file; correct it")
    return table


def _recipe(name: str, tables: dict[str, dict[str, Any]], heirs: tuple[str, ...] = ()) -> Recipe:
    """Return a recipe with its inherited edits and checks; `heirs` are the recipes that inherit from it."""
    table = tables[name]
    parent = table.get("extends")
    if parent in (name, *heirs):
        raise PatchError(
            f"patches/{name}.toml: extends {shortened(parent)}, which extends it; expected one without a circle"
        )
    if parent is not None and parent not in tables:
        raise PatchError(f"patches/{name}.toml: extends {shortened(parent)}, expected one of {sorted(tables)}")
    base = _recipe(parent, tables, (name, *heirs)) if parent is not None else Recipe(name, "", (), (), "", (), ())
    try:
        return replace(
            base,
            name=name,
            title=table["title"],
            present=tuple(_place(item) for item in table["present"]),
            absent=tuple(_place(item) for item in table.get("absent", ())),
            reinstall=table.get("reinstall", base.reinstall),
            edits=_inherited(base.edits, [_edit(item) for item in table.get("edit", ())]),
            checks=base.checks + tuple(check for item in table.get("check", ()) for check in _checks(item)),
            opt_in=base.opt_in + tuple(table.get("opt_in", ())),
        )
    except ValueError as error:
        raise PatchError(f"patches/{name}.toml: {error}; patches/README.md says what an entry holds") from error


def _inherited(base: Sequence[Edit], own: Sequence[Edit]) -> tuple[Edit, ...]:
    """Return the edits of both; its own edit replaces an inherited one with the same label."""
    return tuple({edit.label: edit for edit in (*base, *own)}.values())


def _place(item: dict[str, str]) -> Anchor:
    return Anchor(item["file"], item.get("find", ""))


def _edit(item: dict[str, Any]) -> Edit:
    anchor = _anchor(item["file"], item["find"], item.get("function"))
    kinds = item.keys() - {"set", "name", "file", "find", "function", "unless"}
    if kinds not in ({"before"}, {"replace"}):
        raise ValueError(f"edit {item['name']!r}: expected either `before` or `replace`, got {sorted(kinds)}")
    (kind,) = kinds
    put = item[kind].strip("\n")
    if not put.isascii():
        raise ValueError(f"edit {item['name']!r}: expected ASCII, the same in every encoding a source may have")
    unless = item.get("unless", [])
    if not (isinstance(unless, list) and all(isinstance(text, str) and text.startswith("#") for text in unless)):
        raise ValueError(f"edit {item['name']!r}: unless = {unless!r}, expected a list of directives that start with #")
    return Edit(item["set"], item["name"], anchor, put, kind == "replace", tuple(unless))


def _anchor(file: str, find: str, function: str | None) -> Anchor:
    if not tokenize(find):
        raise ValueError(f"{file}: find = {find!r} has nothing to find")
    return Anchor(file, find, function)


def _checks(item: dict[str, Any]) -> list[Check]:
    return [
        Check(item["set"], _anchor(place["file"], item["find"], place.get("function")), item["times"], item["because"])
        for place in item["places"]
    ]
