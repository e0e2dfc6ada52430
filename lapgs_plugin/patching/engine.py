"""Plan the changes of a patch: pure functions from the files of an extension to their new contents.

The new content depends only on the file without edits and on the sets of edits to apply. Applying reverts first, so it
is idempotent and replaces edits of an older version.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from lapgs_plugin.errors import PatchError
from lapgs_plugin.files import as_pip_argument, is_folder
from lapgs_plugin.patching.blocks import find_blocks, insertion, replacement, stray_marker, without_blocks
from lapgs_plugin.patching.recipe import Anchor, Check, Edit, Recipe, load_recipes, read_source
from lapgs_plugin.patching.tokens import Token, definitions, occurrences, tokenize, unconditional

ALL_SETS = "all"
"""Name for all sets in the sources, to revert, or for all of the recipe that are not opt-in, to apply."""

DEPTH = 4
"""Depth of folders below a checkout at which extensions are searched, enough for a checkout inside another one."""

_SKIPPED_FOLDERS = frozenset({"build", "dist", "third_party", "node_modules"})


@dataclass(frozen=True)
class Target:
    """Locate the sources of an extension in a checkout."""

    recipe: Recipe
    folder: Path

    @property
    def paths(self) -> dict[str, Path]:
        """Sources that the recipe needs by their names in it, without missing ones."""
        paths = {file: self.folder / file for file in self.recipe.files}
        return {file: path for file, path in paths.items() if path.is_file()}

    @property
    def reinstall(self) -> str:
        """The command that builds and installs it again."""
        return self.recipe.reinstall.replace("{folder}", as_pip_argument(self.folder))  # ${NAMES} of shells stay


@dataclass(frozen=True)
class FileChange:
    """Hold the content of a file before and after a change."""

    path: Path
    before: bytes
    after: bytes


class State(Enum):
    """Name the states of a set of edits in an extension's sources."""

    APPLIED = "applied"
    NOT_APPLIED = "not applied"
    NOT_NEEDED = "not needed: the sources have it already"
    INCOMPLETE = "incomplete or of another version: apply again"
    IMPOSSIBLE = "cannot be applied"


@dataclass(frozen=True)
class SetStatus:
    """Hold the state of a set of edits, and the problems that prevent applying it."""

    set: str
    state: State
    problems: tuple[str, ...] = ()


def find_targets(checkout: Path) -> tuple[Target, ...]:
    """Return the known extensions in a checkout, each once: the folder itself, or folders up to `DEPTH` levels below.

    Args:
        checkout: a backbone's repository, or the folder of one extension.

    Raises:
        PatchError: `checkout` is not a folder or has no known extension.
    """
    if not is_folder(checkout):
        raise PatchError(f"{checkout}: no such folder, expected a backbone's checkout or its rasterizer's folder")
    recipes = load_recipes()
    folders = [checkout, *sorted(_subfolders(checkout))]
    targets = [Target(recipe, folder) for folder in folders for recipe in recipes if recipe.recognises(folder)]
    if not targets:
        known = ", ".join(recipe.name for recipe in recipes)
        raise PatchError(
            f"{checkout}: no rasterizer that is known in this folder (known: {known}); are its submodules checked out? "
            "`lapgs help patches` says how to add one"
        )
    # A link to another folder of the checkout is no second rasterizer to build.
    unique = {(target.recipe.name, target.folder.resolve()): target for target in reversed(targets)}
    return tuple(reversed(unique.values()))


def plan_apply(target: Target, sets: Collection[str]) -> tuple[FileChange, ...]:
    """Return the changes that apply these sets and renew the sets that are applied already.

    Raises:
        PatchError: an edit does not fit the sources; the message names file, line and expected code.
    """
    changes, problems = _try_apply(target, sets)
    _refuse(target, problems, "; a rasterizer that differs needs a recipe of its own, see `lapgs help patches`")
    return changes


def plan_revert(target: Target, sets: Collection[str]) -> tuple[FileChange, ...]:
    """Return the changes that revert these sets.

    Raises:
        PatchError: a block was changed after it was written.
    """
    sources = _read(target)
    sets = _present_sets(sources.values()) if ALL_SETS in sets else frozenset(sets)
    _refuse(target, [problem for file, source in sources.items() for problem in _damage(file, source, sets)])
    after = {file: without_blocks(source, sets) for file, source in sources.items()}
    return _changes(target, sources, after)


def status(target: Target) -> tuple[SetStatus, ...]:
    """Return the state of each set of edits."""
    present = _present_sets(_read(target).values())
    statuses = []
    for name in target.recipe.sets:
        changes, problems = _try_apply(target, [name])
        if problems:
            state = State.IMPOSSIBLE
        elif name not in present:
            puts = any(_blocks(change.after, name) for change in changes)
            state = State.NOT_APPLIED if puts else State.NOT_NEEDED
        else:
            current = all(_blocks(change.before, name) == _blocks(change.after, name) for change in changes)
            state = State.APPLIED if current else State.INCOMPLETE
        statuses.append(SetStatus(name, state, tuple(problems)))
    return tuple(statuses)


def pristine(data: bytes) -> bytes:
    """Return a file's content without any edits."""
    source = data.decode("latin-1")
    return without_blocks(source, {block.set for block in find_blocks(source)}).encode("latin-1")


def _subfolders(checkout: Path) -> Iterable[Path]:
    for folder, names, _ in os.walk(checkout):
        names[:] = [name for name in names if not name.startswith(".") and name not in _SKIPPED_FOLDERS]
        yield from (Path(folder, name) for name in names)
        if len(Path(folder).relative_to(checkout).parts) == DEPTH - 1:
            names.clear()


def _read(target: Target) -> dict[str, str]:
    return {file: read_source(path) for file, path in target.paths.items()}


def _present_sets(sources: Iterable[str]) -> frozenset[str]:
    return frozenset(block.set for source in sources for block in find_blocks(source))


def _blocks(data: bytes, set_name: str) -> list[bytes]:
    return [data[block.start : block.end] for block in find_blocks(data.decode("latin-1")) if block.set == set_name]


def _try_apply(target: Target, sets: Collection[str]) -> tuple[tuple[FileChange, ...], list[str]]:
    recipe, sources = target.recipe, _read(target)
    wanted = frozenset(recipe.default_sets if ALL_SETS in sets else sets) | _present_sets(sources.values())
    problems = [
        f"{name} is not among its sets of edits ({', '.join(recipe.sets)}); if another version of lapgs applied it, "
        "take it out with `lapgs patch revert`"
        for name in sorted(wanted - {*recipe.sets})
    ]
    after = {}
    for file in recipe.files:
        edits = [edit for edit in recipe.edit if edit.file == file and edit.set in wanted]
        of_sets = [(anchor, check) for check in recipe.check if check.set in wanted for anchor in check.anchors]
        checks = [(anchor, check) for anchor, check in of_sets if anchor.file == file]
        if file not in sources:
            problems += [f"{file}: expected this file"] if edits or checks else []
            continue
        source = sources[file]
        damage = _damage(file, source, wanted)
        text, mismatches = (source, []) if damage else _edited(without_blocks(source, wanted), edits, checks)
        problems += [*damage, *mismatches]
        after[file] = text
    return _changes(target, sources, after) if not problems else (), problems


def _changes(target: Target, before: dict[str, str], after: dict[str, str]) -> tuple[FileChange, ...]:
    return tuple(
        FileChange(target.folder / file, before[file].encode("latin-1"), text.encode("latin-1"))
        for file, text in after.items()
        if text != before[file]
    )


def _refuse(target: Target, problems: Sequence[str], advice: str = "") -> None:
    if problems:
        more = f" (and {len(problems) - 1} more, see `lapgs patch status`)" if len(problems) > 1 else ""
        raise PatchError(f"{target.folder} ({target.recipe.title}): {problems[0]}{more}; nothing was changed{advice}")


def _damage(file: str, source: str, sets: Collection[str]) -> list[str]:
    problems = [
        f"{file}:{_line(source, block.start)}: the block {block.set}/{block.name} is not as lapgs wrote it; move your "
        "change out of it, or take the file back from git"
        for block in find_blocks(source)
        if block.set in sets and not block.intact
    ]
    stray = stray_marker(source)
    if stray is not None:
        problems.append(f"{file}:{_line(source, stray)}: half a lapgs block; take the file back from git")
    return problems


def _edited(source: str, edits: Sequence[Edit], checks: Sequence[tuple[Anchor, Check]]) -> tuple[str, list[str]]:
    """Return the source with the edits applied, and the problems; with problems the text is not complete."""
    tokens = tokenize(source)
    problems = []
    for anchor, check in checks:
        _, problem = _locate(source, tokens, anchor, check.times)
        if problem is not None:
            problems.append(f"{problem}: {check.because}")
    pieces: list[tuple[int, int, str]] = []  # start, end, text in place of source[start:end]
    for edit in edits:
        if any(unconditional(tokens, directive) for directive in edit.unless):
            continue
        match, problem = _locate(source, tokens, edit.anchor, 1)
        if match is None or problem is not None:
            problems.append(f"{problem} (edit {edit.label})")
            continue
        start, end = tokens[match.start].start, tokens[match.stop - 1].end
        if edit.replace is not None:
            pieces.append((start, end, replacement(source, start, end, edit.label, edit.put)))
        else:
            at, text = insertion(source, start, edit.label, edit.put)
            pieces.append((at, at, text))
    return (source, problems) if problems else (_assembled(source, pieces), [])


def _assembled(source: str, pieces: list[tuple[int, int, str]]) -> str:
    """Return the source with all pieces in place; pieces at the same place keep their order."""
    out, position = [], 0
    for start, end, text in sorted(pieces, key=lambda piece: piece[:2]):
        assert start >= position, "two edits of a recipe overlap"
        out += [source[position:start], text]
        position = end
    result = "".join([*out, source[position:]])
    assert without_blocks(result, _present_sets([result])) == without_blocks(source, _present_sets([result]))
    return result


def _locate(source: str, tokens: list[Token], anchor: Anchor, times: int) -> tuple[range | None, str | None]:
    """Return the first occurrence of an anchor's tokens, and the problem if there are not `times` of them."""
    span = range(len(tokens))
    line = 1
    if anchor.function is not None:
        bodies = definitions(tokens, anchor.function)
        if len(bodies) != 1:
            return None, f"{anchor.file}: expected one definition of {anchor.function}, found {len(bodies)}"
        span = bodies[0]
        line = _line(source, tokens[span.start].start)
    matches = occurrences(tokens, anchor.find, span)
    if len(matches) != times:
        scope = f"in {anchor.function} " if anchor.function else ""
        return None, (
            f"{anchor.file}:{line}: expected `{anchor.find}` {_times(times)} {scope}but found it "
            f"{_times(len(matches))}; this is not the code that the edit was written for"
        )
    return (matches[0] if matches else None), None


def _times(count: int) -> str:
    return {0: "nowhere", 1: "once", 2: "twice"}.get(count, f"{count} times")


def _line(source: str, at: int) -> int:
    return source.count("\n", 0, at) + 1
