"""Name the files of run folders, and tell and clear such folders.

    RUN/manifest.json              everything needed to render the run again
    RUN/view_cameras.json          cameras of the run's views where they are not those of its scene
    RUN/vignetting.json            brightness of the corners of views' photos in stops, where a camera darkens them
    RUN/level_<l>/point_cloud.ply  the field of each finished level, a standard 3DGS PLY
    RUN/level_<l>/optimizer.pt     its optimizer state, only while the next level may inherit it
    RUN/level_<l>/view_colors.json colour transforms of the training photos after that level, with --appearance
    RUN/level_<l>/view_grids.pt    bilateral grids of the training photos after that level, with --appearance bilateral
    RUN/level_<l>/view_poses.json  corrections of the training photos' poses after that level, if these are refined
    RUN/checkpoint.pt              state of an unfinished stage, the latest
    RUN/history.jsonl              one JSON object a logging tick
    RUN/run.toml                   the options of `lapgs train` that made the run
    RUN/tiles.json                 how the scene is divided, of a run with --tiles and of each of its tiles
    RUN/tile_<r>_<c>/              run of the tile in row r and column c
    RUN/jobs/                      which tiles workers of `lapgs bench tiles` have, and what the workers say
    RUN/tensorboard/               its event files, with --log tensorboard
    RUN/preview.jpg                an image that the viewer shows until it can render
    RUN/metrics.json, RUN/stability.json, RUN/renders/, RUN/export/, RUN/report.html   results of other commands

Every file but the history is written under a temporary name and renamed, and the manifest lists a level only after its
PLY is on the disk. So a run that is killed at any moment still opens, with the levels that were finished.

Joint training of level k also changes the finished fields. Their new versions are first written beside the old ones, to
point_cloud.with_level_<k>.ply. They count from the moment that the manifest lists level k; then they are renamed, by
the next process that opens the run for writing if this one is killed before. If level k is not listed they are removed.

Extending a finished run replaces files in the same way: new ones are written beside the old ones, to extended_<i>.NAME,
where i is the new number of iterations, and count from the moment that the manifest has this number.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.files import (
    LOCK,
    MANIFEST,
    PREVIEW,
    TEMPORARY_PATTERN,
    is_file,
    is_folder,
    one_line_errors,
    require_own_entries,
)
from lapgs_plugin.limits import LONGEST_NAME
from lapgs_plugin.untrusted import TEXT_BYTES, read_json

HISTORY, METRICS, CHECKPOINT = "history.jsonl", "metrics.json", "checkpoint.pt"
RENDERS, REPORT, STABILITY, EXPORT, CACHE = "renders", "report.html", "stability.json", "export", "cache"
RUN_CONFIG, TENSORBOARD = "run.toml", "tensorboard"
CAMERAS, VIGNETTING = "view_cameras.json", "vignetting.json"
TILES, TILE, TILE_LOG, JOBS = "tiles.json", "tile_{}_{}", "train.log", "jobs"
# Files of a level. Checkouts write theirs beside them, among these an exposure.json of another meaning.
PLY, OPTIMIZER, EXPOSURE, POSES = "point_cloud.ply", "optimizer.pt", "view_colors.json", "view_poses.json"
GRIDS = "view_grids.pt"
TRAINED_ALONG = "point_cloud.with_level_{}.ply"
"""The PLY of a finished field after joint training with a finer level, until it replaces `PLY`."""
FORGET_EXTENSION = "delete it to extend the run anew"
"""Advice about a checkpoint of an interrupted extension."""
EXTENDED = "extended_{}.{}"
"""A file of a run after its extension to a number of iterations, until it replaces the file of that name."""


def require_room(path: Path | str, overwrite: bool = False, since: int | None = None) -> None:
    """Check that `RunArchive.create` would accept the folder, before anything expensive is done. Writes nothing.

    Raises:
        RunFolderError: as `RunArchive.create`, except for problems that only writing shows.
    """
    folder = Path(path)
    with one_line_errors(folder, "read"):
        if folder.exists() and not folder.is_dir():
            raise RunFolderError(f"{folder} is a file, expected a folder for the run; choose another name")
    if is_run(folder):
        if not overwrite and has_begun(folder):
            raise RunFolderError(
                f"{folder} already holds a run; continue it with --resume (`lapgs train`, `lapgs run`) or replace "
                "it with --overwrite"
            )
        return
    with one_line_errors(folder, "read"):
        entries = list(folder.iterdir()) if folder.exists() else []
    # A run that was killed before its first manifest leaves these; whoever starts a tile's run opens its log before.
    others = [p for p in entries if p.name not in (LOCK, TILE_LOG) and not p.match(TEMPORARY_PATTERN)]
    with one_line_errors(folder, "read"):
        strangers = [p.name for p in others if since is None or _oldest(p) < since]
    if strangers:
        raise RunFolderError(
            f"{folder} is not empty and not a run (it holds {min(strangers)}); choose a new or empty folder"
        )


def require_place(folder: Path, option: str = "--out") -> None:
    """Refuse a folder for results that cannot be made or written, before the work is done. Leaves no file behind.

    Raises:
        UserInputError: it is a file or below one, it cannot be made, or it is not writable; names the option.
    """
    existing = str(folder)
    # Not Path.exists, which raises where a name is too long for the file system.
    while not os.path.lexists(existing):
        if len(os.fsencode(os.path.basename(existing))) > LONGEST_NAME:  # noqa: PTH119
            raise UserInputError(f"{option} {folder}: a name of more than {LONGEST_NAME} bytes; choose a shorter one")
        existing = os.path.dirname(existing) or os.curdir  # noqa: PTH120
    if not is_folder(Path(existing)):
        kind = "a file" if is_file(Path(existing)) else "no folder"  # such as a link that leads nowhere
        raise UserInputError(f"{option} {folder}: {existing} is {kind}; expected a folder, or a name for a new one")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise UserInputError(f"{option} {folder}: {existing} is not writable; choose another folder")
    new = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]
    try:
        folder.mkdir(parents=True, exist_ok=True)  # root may write everywhere, but makes no folder in /proc
    except OSError as error:
        raise UserInputError(f"{option} {folder} cannot be made: {error.strerror}; choose another folder") from error
    finally:
        with suppress(OSError):  # not made, or another process uses it already
            for path in new:
                path.rmdir()


def require_utf8(folder: Path, option: str) -> None:
    """Refuse a folder whose path cannot be kept in JSON.

    Raises:
        UserInputError: as `require_place`.
    """
    try:
        str(folder.absolute()).encode()
    except UnicodeEncodeError as error:
        raise UserInputError(f"{option} {folder}: not UTF-8, as paths are kept; choose another folder") from error


def _oldest(path: Path) -> int:
    """Return when a file, or the oldest file in a folder, was last written, in nanoseconds."""
    return min(entry.lstat().st_mtime_ns for entry in (path, *path.rglob("*")))


def exists(path: Path) -> bool:
    """Return whether there is a file, or a link, whatever that points to.

    Raises:
        RunFolderError: its folder cannot be read.
    """
    with one_line_errors(path, "read"):
        try:
            path.lstat()
        except (FileNotFoundError, NotADirectoryError):
            return False
    return True


def require_own_results(folder: Path) -> None:
    """Check that all that is written in a run folder is its own, see `files.require_own_entries`."""
    files = (LOCK, MANIFEST, PREVIEW, HISTORY, METRICS, CHECKPOINT, STABILITY, REPORT, RUN_CONFIG, CAMERAS, VIGNETTING)
    with one_line_errors(folder, "read"):
        parts = [path.name for pattern in ("level_*", TILE.format("*", "*")) for path in folder.glob(pattern)]
    require_own_entries(folder, (*files, TILES, JOBS, RENDERS, EXPORT, TENSORBOARD, CACHE, *parts))


def is_run(folder: Path) -> bool:
    """Return whether any version of this package wrote the manifest; other programs write a manifest.json, too.

    An unreadable one counts as ours if there is a history beside it.
    """
    with one_line_errors(folder, "read"):
        if not (folder / MANIFEST).is_file():
            return False
        try:
            values = read_json(folder / MANIFEST, dict[str, Any])
        except UserInputError:
            return (folder / HISTORY).is_file()
    return "lapgs_plugin" in str(values.get("created_by"))


def has_begun(folder: Path) -> bool:
    """Return whether a run has trained: has a finished level, a checkpoint or a history, or cannot be read.

    One that failed before its first iteration has none, and its folder can be taken again.
    """
    with one_line_errors(folder, "read"):
        history = folder / HISTORY
        if (folder / CHECKPOINT).exists() or (history.exists() and history.stat().st_size):
            return True
        try:
            return bool(read_json(folder / MANIFEST, dict[str, Any]).get("records"))
        except UserInputError:
            return True


def remove_results(folder: Path) -> None:
    """Remove the files of a previous run and nothing else."""
    remove_scratch(folder)
    for name in (HISTORY, METRICS, STABILITY, REPORT, PREVIEW, RUN_CONFIG, CAMERAS, VIGNETTING, TILES):
        (folder / name).unlink(missing_ok=True)
    for name in (RENDERS, EXPORT, TENSORBOARD, JOBS):
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    for level in folder.glob("level_*/"):
        for name in (PLY, OPTIMIZER, EXPOSURE, GRIDS, POSES):
            (level / name).unlink(missing_ok=True)
        for pattern in (TRAINED_ALONG.format("*"), EXTENDED.format("*", "*")):
            for waiting in level.glob(pattern):
                waiting.unlink()
        if not any(level.iterdir()):
            level.rmdir()
    for tile in folder.glob(f"{TILE.format('*', '*')}/"):
        (tile / TILE_LOG).unlink(missing_ok=True)
        if is_run(tile):
            remove_results(tile)
            for name in (CHECKPOINT, MANIFEST, LOCK):
                (tile / name).unlink(missing_ok=True)
        if not any(tile.iterdir()):
            tile.rmdir()


def remove_scratch(folder: Path) -> None:
    """Remove the scratch files of a killed run: temporary files, cached predictions, an incomplete line of history."""
    for pattern in (TEMPORARY_PATTERN, f"level_*/{TEMPORARY_PATTERN}"):
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)
    if (folder / CACHE).is_dir():
        shutil.rmtree(folder / CACHE)
    if (folder / HISTORY).exists():
        with (folder / HISTORY).open("r+b") as stream:
            start = max(0, stream.seek(0, os.SEEK_END) - TEXT_BYTES)
            stream.seek(start)
            if (end := stream.read().rfind(b"\n") + 1) or not start:  # no line is as long as this: reading says so
                stream.truncate(start + end)
