"""`lapgs patch`: teach a checkout's rasterizer signed colour, make it build with a current CUDA, and take that back."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from lapgs_plugin.patching import FileChange, Target

app = typer.Typer(
    help="Patch a backbone's rasterizer: signed colour, and what a current CUDA needs to build it.",
    no_args_is_help=True,
)

Checkout = Annotated[
    Path, typer.Argument(help="The backbone's checkout, or the folder of its rasterizer alone.", show_default=False)
]
SetName = Annotated[
    str,
    typer.Option(
        "--set",
        help="Which edits: signed-color (residual fields rendered natively), build-cuda13 (build with CUDA 12.8 to "
        "13), or all of them. Not among all, as they change ordinary training too: gradient-fixes and robustness, "
        "where there are any; patches/README.md says what they mend.",
    ),
]
AllowDirty = Annotated[
    bool, typer.Option("--allow-dirty", help="Also edit files that have changes of yours not yet committed.")
]


@app.command("status")
def status_(checkout: Checkout, set_name: SetName = "all") -> None:
    """Say which edits are in, which can be put in, and what stands in the way."""
    from lapgs_plugin.patching import plan_apply, read_only, status, uncommitted

    chosen = _targets(checkout, set_name, opt_in=True)
    with _alone(chosen):
        for target, sets in chosen:
            typer.echo(f"{target.folder}: {target.recipe.title}")
            for found in status(target):
                if found.set not in sets:
                    continue
                typer.echo(f"  {found.set:14} {found.state.value}")
                for problem in found.problems:
                    typer.echo(f"    {problem}")
                if not found.problems:
                    for path in read_only(plan_apply(target, [found.set])):
                        typer.echo(f"    read-only: {path}")
            for path in uncommitted(_files(target)):
                typer.echo(f"  has changes that are not committed: {path}")


@app.command("diff")
def diff(checkout: Checkout, set_name: SetName = "all") -> None:
    """Print what `apply` would change, as a unified diff, and change nothing."""
    changes = [change for _, change in _planned(_targets(checkout, set_name, opt_in=False))]
    if not changes:
        typer.echo(f"{checkout}: nothing to apply, these edits are in: {set_name}", err=True)
    for change in changes:
        typer.echo(_unified(change, checkout), nl=False)


@app.command("apply")
def apply(checkout: Checkout, set_name: SetName = "all", allow_dirty: AllowDirty = False) -> None:
    """Put the edits in: all of them, or none if one does not fit. Then reinstall the extension, as it says."""
    from lapgs_plugin.errors import PatchError
    from lapgs_plugin.patching import uncommitted, write_all

    chosen = _targets(checkout, set_name, opt_in=False)
    with _alone(chosen):
        planned = _planned(chosen)
        if not planned:
            typer.echo(f"{checkout}: nothing to do, these edits are in: {set_name}")
            return
        changes = [change for _, change in planned]
        _refuse_read_only(changes)
        dirty = [] if allow_dirty else uncommitted(change.path for change in changes)
        if dirty:
            raise PatchError(
                f"changes that are not committed in {_listed(dirty)}; commit them first, or pass --allow-dirty "
                "(`lapgs patch revert` takes out only the patch either way); nothing was changed"
            )
        write_all(changes)
    _report("patched", planned)


@app.command("revert")
def revert(checkout: Checkout, set_name: SetName = "all") -> None:
    """Take the edits out again; what you changed elsewhere in the same files stays."""
    from lapgs_plugin.patching import plan_revert, write_all

    chosen = _targets(checkout, set_name, opt_in=True)
    with _alone(chosen):
        planned = [(target, change) for target, sets in chosen for change in plan_revert(target, sets)]
        if not planned:
            typer.echo(f"{checkout}: nothing to take out, none of these edits is in: {set_name}")
            return
        changes = [change for _, change in planned]
        _refuse_read_only(changes)
        write_all(changes)
    _report("reverted", planned)


@contextmanager
def _alone(chosen: Sequence[tuple[Target, Collection[str]]]) -> Iterator[None]:
    """Keep other `lapgs patch` processes away while this one works, and tidy up after one that was killed."""
    from lapgs_plugin.patching import alone

    with alone(target for target, _ in chosen) as stuck:
        for path in stuck:
            typer.echo(f"left by a `lapgs patch` that was killed, and cannot be removed: {path}", err=True)
        yield


def _targets(checkout: Path, set_name: str, *, opt_in: bool) -> list[tuple[Target, tuple[str, ...]]]:
    """The extensions in the checkout that take the wanted edits, each with the sets that are meant.

    Args:
        checkout: see the commands.
        set_name: see the commands.
        opt_in: whether all sets are also those that have to be asked for.
    """
    from lapgs_plugin.errors import PatchError
    from lapgs_plugin.patching import ALL_SETS, find_targets

    targets = find_targets(checkout)
    known = sorted({name for target in targets for name in target.recipe.sets})
    if set_name not in (ALL_SETS, *known):
        raise PatchError(f"--set {set_name}: expected one of {', '.join([*known, ALL_SETS])} for {checkout}")
    chosen = []
    for target in targets:
        everything = target.recipe.sets if opt_in else target.recipe.default_sets
        sets = everything if set_name == ALL_SETS else tuple(name for name in target.recipe.sets if name == set_name)
        if sets:
            chosen.append((target, sets))
    return chosen


def _planned(chosen: Sequence[tuple[Target, Collection[str]]]) -> list[tuple[Target, FileChange]]:
    from lapgs_plugin.patching import plan_apply

    return [(target, change) for target, sets in chosen for change in plan_apply(target, sets)]


def _files(target: Target) -> list[Path]:
    return [path for path in (target.folder / file for file in target.recipe.files) if path.is_file()]


def _refuse_read_only(changes: Sequence[FileChange]) -> None:
    from lapgs_plugin.errors import PatchError
    from lapgs_plugin.patching import read_only

    blocked = read_only(changes)
    if blocked:
        raise PatchError(f"read-only: {_listed(blocked)}; make them writable first; nothing was changed")


def _report(verb: str, planned: Sequence[tuple[Target, FileChange]]) -> None:
    for _, change in planned:
        typer.echo(f"{verb} {change.path}")
    commands = [target.recipe.reinstall.format(folder=target.folder) for target, _ in planned]
    typer.echo("One thing is left to do, build and install again what changed:")
    for command in dict.fromkeys(commands):
        typer.echo(f"  {command}")


def _listed(paths: Sequence[Path]) -> str:
    return ", ".join(map(str, paths))


def _unified(change: FileChange, checkout: Path) -> str:
    name = change.path.relative_to(checkout).as_posix()
    before, after = (data.decode("utf-8", "replace").split("\n") for data in (change.before, change.after))
    return "".join(f"{line}\n" for line in difflib.unified_diff(before, after, f"a/{name}", f"b/{name}", lineterm=""))
