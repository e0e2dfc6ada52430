"""Write scene folders: only complete ones, and never over other files."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pycolmap

from lapgs_plugin.errors import LapgsError, SceneError, UserInputError
from lapgs_plugin.scenes.colmap_model import read_model

SCENE_ENTRIES = frozenset({"images", "masks", "sparse"})
"""Entries of a scene folder. A folder with any other entry is never overwritten."""


def check_output(out: Path, overwrite: bool, work: str | None = None) -> None:
    """Check that a scene may be written to a folder.

    Args:
        out: the folder, which may be missing.
        overwrite: allow a folder that holds a scene.
        work: name of an entry that is allowed too: unfinished work of the same command.

    Raises:
        UserInputError: `out` is a file, holds a scene without `overwrite`, or holds anything else.
    """
    if not os.path.lexists(out):  # not Path.exists, which raises where a name is too long for the file system
        return
    if not out.is_dir():
        raise UserInputError(f"{out}: a file, expected a folder or a new name")
    entries = {entry.name for entry in out.iterdir()} - {work}
    if foreign := sorted(entries - SCENE_ENTRIES):
        raise UserInputError(
            f"{out}: it holds {foreign[0]}, expected an empty or new folder; choose another or remove it yourself"
        )
    if entries and not overwrite:
        raise UserInputError(f"{out}: the folder already holds a scene; choose another or replace it with --overwrite")


@contextmanager
def fresh_scene(out: Path, overwrite: bool) -> Iterator[Path]:
    """Make a folder that replaces `out` when the block ends, and is removed if it fails; then `out` stays.

    Raises:
        UserInputError: as `check_output`.
        LapgsError: the disk is full or the folder cannot be written.
    """
    out = out.absolute()
    check_output(out, overwrite)
    partial, replaced = out.with_name(f"{out.name}.partial"), out.with_name(f"{out.name}.replaced")
    with writing_explained(out):
        try:
            # Without `out` the scene that it had is in `replaced`: a call was killed between the two renames.
            for leftover in (partial, replaced) if out.exists() else (partial,):
                if leftover.exists():
                    shutil.rmtree(leftover)
            partial.mkdir(parents=True)
            yield partial
            if out.exists():
                out.rename(replaced)
            partial.rename(out)
            shutil.rmtree(replaced, ignore_errors=True)
        except BaseException:
            if replaced.exists() and not out.exists():
                replaced.rename(out)
            shutil.rmtree(partial, ignore_errors=True)
            raise


@contextmanager
def writing_explained(out: Path) -> Iterator[None]:
    """Turn an error of the file system or of SQLite during writing into a LapgsError."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise LapgsError(
            f"{out}: the scene cannot be written ({reason}); check free space and permissions, then run the command "
            "again"
        ) from error


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a model as COLMAP's binary files into a new folder.

    Raises:
        LapgsError: the disk is full.
    """
    folder.mkdir(parents=True)
    model.write_binary(folder)
    check_written(folder)


def check_written(folder: Path) -> None:
    """Check a model that pycolmap wrote, because pycolmap does not report a full disk.

    Raises:
        LapgsError: a file is incomplete.
    """
    refusal = LapgsError(f"{folder}: the model is incomplete; check free space, then run the command again")
    try:
        damaged = read_model(folder).warnings
    except SceneError as error:
        raise refusal from error
    if damaged:
        raise refusal
