"""Patch the rasterizer of a checkout: `lapgs patch`."""

from __future__ import annotations

import difflib
import io
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from lapgs_plugin.cli.output import say
from lapgs_plugin.errors import PatchError
from lapgs_plugin.files import is_file, is_folder
from lapgs_plugin.patching.engine import ALL_SETS, FileChange, Target, find_targets, plan_apply, plan_revert, status
from lapgs_plugin.patching.files import alone, read_only, uncommitted, write_all

app = typer.Typer(
    help="Patch a checkout's CUDA rasterizer: add signed colour, or make it build with a current CUDA.",
    no_args_is_help=True,
)


def _root(path: Path) -> Path:
    """Return the root of the checkout around a training script or a folder of such scripts; else the path."""
    from lapgs_plugin.checkouts.source import CheckoutSource, readable_sources

    if path.suffix == ".py" and is_file(path):
        return CheckoutSource.read(path).root
    if not is_folder(path):
        return path
    sources, _ = readable_sources(path)
    inside = [source.root for source in sources if path.absolute().is_relative_to(source.root)]
    return inside[0] if inside and inside[0] != path.absolute() else path


Checkout = Annotated[
    Path,
    typer.Argument(
        metavar="CHECKOUT",
        help="Checkout of a 3DGS codebase, a training script in it, or the folder of its rasterizer.",
        callback=_root,
    ),
]
SetName = Annotated[
    str,
    typer.Option(
        "--set",
        help="Edits to apply: signed-color (native rendering of residual fields), build-cuda13 (build with CUDA 12.8 "
        "to 13), or all for both. gradient-fixes and robustness, for some rasterizers, mend faults of ordinary "
        "training and are not part of all. See `lapgs help rasterizers`.",
    ),
]
AllowDirty = Annotated[bool, typer.Option("--allow-dirty", help="Also edit files with uncommitted changes.")]


@app.command("status")
def status_(checkout: Checkout, set_name: SetName = "all") -> None:
    """Show which edits are applied, which can be applied, and why others cannot."""
    targets = _targets(checkout, set_name)
    with _alone(targets):
        for target in targets:
            say(f"{target.folder}: {target.recipe.title}")
            for edits in status(target):
                if set_name not in (ALL_SETS, edits.set):
                    continue
                say(f"  {edits.set:14} {edits.state.value}")
                for problem in edits.problems:
                    say(f"    {problem}")
                if not edits.problems:
                    for path in read_only(plan_apply(target, [edits.set])):
                        say(f"    read-only: {path}")
            for path in uncommitted(target.paths.values()):
                say(f"  uncommitted changes: {path}")


@app.command("diff")
def diff(checkout: Checkout, set_name: SetName = "all") -> None:
    """Print the changes of `lapgs patch apply` as a unified diff."""
    changes = [change for _, change in _planned(plan_apply, _targets(checkout, set_name), set_name)]
    if not changes:
        say(f"{checkout}: nothing to apply, these edits are applied already: {set_name}", stderr=True)
    for change in changes:
        typer.echo(_unified(change, checkout), nl=False)


@app.command("apply")
def apply(checkout: Checkout, set_name: SetName = "all", allow_dirty: AllowDirty = False) -> None:
    """Apply the edits: all of them, or none if one does not fit.

    Reinstall the extension afterwards with the command that is printed.
    """
    targets = _targets(checkout, set_name)
    with _alone(targets):
        planned = _planned(plan_apply, targets, set_name)
        if planned:
            _write("patched", planned, allow_dirty)
        else:
            say(f"{checkout}: nothing to do, these edits are applied already: {set_name}")


@app.command("revert")
def revert(checkout: Checkout, set_name: SetName = "all") -> None:
    """Remove the edits; your own changes in the same files stay."""
    targets = _targets(checkout, set_name)
    with _alone(targets):
        planned = _planned(plan_revert, targets, set_name)
        if planned:
            _write("reverted", planned, allow_dirty=True)
        else:
            say(f"{checkout}: nothing to remove, none of these edits is applied: {set_name}")


@contextmanager
def _alone(targets: Sequence[Target]) -> Iterator[None]:
    """Lock out other `lapgs patch` processes, and remove files that a killed one left."""
    with alone(targets) as stuck:
        for path in stuck:
            say(f"a killed `lapgs patch` left {path}, which cannot be removed", stderr=True)
        yield


def _targets(checkout: Path, set_name: str) -> list[Target]:
    """Return the extensions in the checkout that have the wanted set of edits."""
    targets = find_targets(checkout)
    known = sorted({name for target in targets for name in target.recipe.sets})
    if set_name not in (ALL_SETS, *known):
        raise PatchError(f"--set {set_name}: expected one of {', '.join([*known, ALL_SETS])} for {checkout}")
    return [target for target in targets if set_name in (ALL_SETS, *target.recipe.sets)]


def _planned(
    plan: Callable[[Target, Collection[str]], tuple[FileChange, ...]], targets: Sequence[Target], set_name: str
) -> list[tuple[Target, FileChange]]:
    return [(target, change) for target in targets for change in plan(target, [set_name])]


def _write(verb: str, planned: Sequence[tuple[Target, FileChange]], allow_dirty: bool) -> None:
    """Write all changes, and print them with the commands that come next.

    Raises:
        PatchError: a file is read-only, or has uncommitted changes that are not allowed.
    """
    changes = [change for _, change in planned]
    if blocked := read_only(changes):
        raise PatchError(f"read-only: {_listed(blocked)}; make them writable first; nothing was changed")
    if not allow_dirty and (dirty := uncommitted(change.path for change in changes)):
        raise PatchError(
            f"uncommitted changes in {_listed(dirty)}; commit them first, or pass --allow-dirty (`lapgs patch revert` "
            "removes only the patch in either case); nothing was changed"
        )
    write_all(changes)
    for change in changes:
        say(f"{verb} {change.path}")
    say("Next, reinstall the changed extensions:")
    for command in dict.fromkeys(target.reinstall for target, _ in planned):
        say(f"  {command}")


def _listed(paths: Sequence[Path]) -> str:
    return ", ".join(map(str, paths))


def _unified(change: FileChange, checkout: Path) -> bytes:
    """Return a diff that `git apply` takes, in the encoding and with the line endings of the file."""
    name = change.path.relative_to(checkout).as_posix()
    before, after = (io.BytesIO(data).readlines() for data in (change.before, change.after))
    old, new = (os.fsencode(f"{side}/{name}") for side in "ab")
    lines = difflib.diff_bytes(difflib.unified_diff, before, after, old, new)
    return b"".join(line if line.endswith(b"\n") else line + b"\n\\ No newline at end of file\n" for line in lines)
