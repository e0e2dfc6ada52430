"""Check files before they are written, and write several of them: all or none."""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from lapgs_plugin.errors import PatchError
from lapgs_plugin.files import lock
from lapgs_plugin.patching.engine import FileChange, Target, pristine

_SUFFIX = ".lapgs"
_RANDOM = r"[a-z0-9_]{8}"
"""Text that `tempfile.mkstemp` puts between prefix and suffix."""
PATIENCE = 30.0
"""Seconds to wait for another process that writes to the same folders."""


def read_only(changes: Iterable[FileChange]) -> list[Path]:
    """Return the files, and their folders, that cannot be written or are marked read-only."""
    paths = {path.resolve() for change in changes for path in (change.path, change.path.resolve().parent)}
    return sorted(path for path in paths if not _writable(path))


def uncommitted(paths: Iterable[Path]) -> list[Path]:
    """Return the files that differ from their last commit in git in more than our own edits, committed or not.

    Each file is looked up in the repository that it belongs to, which may be a submodule. Files that git does not
    track, and all files without git, are left out.
    """
    return [path for path in paths if _differs_from_head(path)]


@contextmanager
def alone(targets: Iterable[Target]) -> Iterator[list[Path]]:
    """Keep other `lapgs patch` processes from these extensions, and remove temporary files of killed ones.

    A process holds the lock of a folder while it has temporary files there; the lock ends with the process. Where
    folders cannot be locked (Windows, some network file systems) no temporary files are removed.

    Returns:
        Temporary files that could not be removed, sorted.

    Raises:
        PatchError: another process holds one of the folders for longer than `PATIENCE`.
    """
    files = {path.resolve() for target in targets for path in target.paths.values()}
    folders = sorted({path.parent for path in files})
    with ExitStack() as locks:
        # The same order in every process prevents deadlocks.
        locked = [folder for folder in folders if locks.enter_context(_folder_lock(folder))]
        stuck = []
        for path in sorted(temporary for file in files if file.parent in locked for temporary in _temporaries(file)):
            try:
                path.unlink(missing_ok=True)
            except OSError:  # a read-only folder: the caller reports it, and the command may still work
                stuck.append(path)
        yield stuck


def write_all(changes: Sequence[FileChange]) -> None:
    """Write every file through a temporary file beside it; on failure restore the files written so far.

    Permissions are kept, and the owner where this user may set it; links are followed.

    Raises:
        PatchError: a file could not be written, or was changed after the change was planned.
    """
    staged: list[tuple[FileChange, Path]] = []
    replaced: list[FileChange] = []
    try:
        for change in changes:
            if change.path.read_bytes() != change.before:
                raise PatchError(f"{change.path}: changed by another program at this moment; nothing was changed")
            staged.append((change, _beside(change.path, change.after)))
        for change, temporary in staged:
            replaced.append(change)
            temporary.replace(change.path.resolve())
    except BaseException as error:
        lost = [change.path for change in replaced if not _put_back(change)]
        for _, temporary in staged:
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            outcome = f"not put back: {', '.join(map(str, lost))}" if lost else "nothing was changed"
            raise PatchError(f"could not write {error.filename or 'a file'}: {error.strerror}; {outcome}") from error
        raise


def _writable(path: Path) -> bool:
    # The mode counts, too: root may write everything, but somebody marked the file read-only.
    return os.access(path, os.W_OK) and bool(path.stat().st_mode & (stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH))


def _temporaries(file: Path) -> list[Path]:
    """Return the files beside `file` that `_beside` made."""
    name = re.compile(re.escape(f".{file.name}.") + _RANDOM + re.escape(_SUFFIX))
    beside = (path for path in file.parent.iterdir() if name.fullmatch(path.name))
    return [path for path in beside if path.is_file() and not path.is_symlink()]


@contextmanager
def _folder_lock(folder: Path) -> Iterator[bool]:
    """Hold the operating system's lock of a folder, which needs no file; yield False where there is no such lock."""
    if sys.platform == "win32":
        yield False
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise PatchError(f"{folder}: cannot be read: {error.strerror}; expected a folder this user may read") from error
    try:
        if (locked := lock(descriptor, PATIENCE)) is False:
            raise PatchError(
                f"{folder}: another `lapgs patch` works on it; wait for it or stop it; nothing was changed"
            )
        yield locked is True
    finally:
        os.close(descriptor)


def _beside(path: Path, data: bytes) -> Path:
    """Write a new file in the same folder with the owner and permissions of `path`, and return its path."""
    target = path.resolve()
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=_SUFFIX)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        if sys.platform != "win32":
            with suppress(OSError):  # only root may; in a container it writes to checkouts of others
                os.chown(temporary, target.stat().st_uid, target.stat().st_gid)
        shutil.copymode(target, temporary)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return temporary


def _put_back(change: FileChange) -> bool:
    """Restore the content from before the change, and return whether the file has it."""
    try:
        if change.path.read_bytes() != change.before:
            _beside(change.path, change.before).replace(change.path.resolve())
    except OSError:
        return False
    return True


def _differs_from_head(path: Path) -> bool:
    name = path.resolve().name
    committed, current = _git(path, "cat-file", "blob", f"HEAD:./{name}"), path.read_bytes()
    if committed is None:
        return False
    before, after = pristine(committed), pristine(current)
    if before == after:  # git, too, leaves CRLF as they are in files that were committed with them
        return False
    # With a path hash-object applies git's conversions on commit, such as CRLF to LF.
    converted = _git(path, "hash-object", "--stdin", "--path", name, stdin=after)
    return converted is not None and converted != _git(path, "hash-object", "--stdin", stdin=before)


def _git(path: Path, *arguments: str, stdin: bytes = b"") -> bytes | None:
    """Return the output of a git command in the file's folder, or None if it fails."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    try:
        result = subprocess.run(
            ["git", *arguments],
            cwd=path.resolve().parent,
            env=environment,
            input=stdin,
            capture_output=True,
            check=False,
        )
    except OSError:
        return None
    return result.stdout if result.returncode == 0 else None
