"""Looks at files before they are written, and writes several of them as one step: all or none."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from lapgs_plugin.errors import PatchError
from lapgs_plugin.patching.engine import FileChange, Target, pristine

_SUFFIX = ".lapgs"
_RANDOM = r"[a-z0-9_]{8}"
"""What `tempfile.mkstemp` puts between prefix and suffix."""
PATIENCE = 30.0
"""Seconds to wait for another process that writes to the same folders, which takes it far less than one."""
_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EBADF, errno.EINVAL)
"""What a file system without locks on folders answers."""


def read_only(changes: Iterable[FileChange]) -> list[Path]:
    """The files, and the folders they are replaced in, that cannot be written or are marked as not to be."""
    paths = {path.resolve() for change in changes for path in (change.path, change.path.resolve().parent)}
    return sorted(path for path in paths if not _writable(path))


def uncommitted(paths: Iterable[Path]) -> list[Path]:
    """The files that git has and that differ from their last commit in more than our own edits.

    Each file is looked up in the repository it belongs to, which may be a submodule. Files that git does not have, and
    all files where there is no git, are left out: there is nothing to compare them with.
    """
    return [path for path in paths if _differs_from_head(path)]


@contextmanager
def alone(targets: Iterable[Target]) -> Iterator[list[Path]]:
    """Keep other `lapgs patch` processes from these extensions, and remove what a killed one left.

    A temporary file is somebody's as long as its process holds the lock of its folder; that lock ends with the process,
    however it ends. Where folders cannot be locked (Windows, some network file systems) nothing is removed.

    Returns:
        The temporary files that could not be removed, in order.

    Raises:
        PatchError: another process holds one of the folders for longer than `PATIENCE`.
    """
    files = {path.resolve() for target in targets for path in _present(target)}
    folders = sorted({path.parent for path in files})
    with ExitStack() as locks:
        # In the same order everywhere, so that no two processes wait for each other.
        locked = [folder for folder in folders if locks.enter_context(_folder_lock(folder))]
        stuck = []
        for path in sorted(each for file in files if file.parent in locked for each in _temporaries(file)):
            try:
                path.unlink(missing_ok=True)
            except OSError:  # a read-only folder: said by the caller, as the rest of the command may still work
                stuck.append(path)
        yield stuck


def write_all(changes: Sequence[FileChange]) -> None:
    """Write every file, or none: each through a temporary file beside it, those already replaced put back on failure.

    Permissions are kept, links are followed.

    Raises:
        PatchError: a file could not be written, or is not what it was when the change was planned.
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
    # The mode is asked too: root may write everything, but a file marked read-only was marked so by somebody.
    return os.access(path, os.W_OK) and bool(path.stat().st_mode & (stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH))


def _present(target: Target) -> list[Path]:
    return [path for path in (target.folder / file for file in target.recipe.files) if path.is_file()]


def _temporaries(file: Path) -> list[Path]:
    """The files beside `file` that `_beside` made."""
    name = re.compile(re.escape(f".{file.name}.") + _RANDOM + re.escape(_SUFFIX))
    return [
        each for each in file.parent.iterdir() if name.fullmatch(each.name) and each.is_file() and not each.is_symlink()
    ]


@contextmanager
def _folder_lock(folder: Path) -> Iterator[bool]:
    """Hold the operating system's lock of a folder, which leaves no file behind; False where there is no such lock."""
    if sys.platform == "win32":
        yield False
        return
    import fcntl

    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise PatchError(f"{folder}: cannot be read: {error.strerror}; expected a folder this user may read") from error
    end = time.monotonic() + PATIENCE
    try:
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > end:
                    raise PatchError(
                        f"{folder}: another `lapgs patch` works on it; wait for it or stop it; nothing was changed"
                    ) from None
                time.sleep(0.05)
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                locked = False
                break
            else:
                locked = True
                break
        yield locked
    finally:
        os.close(descriptor)


def _beside(path: Path, data: bytes) -> Path:
    """A new file in the same folder with this content and the permissions of `path`."""
    target = path.resolve()
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=_SUFFIX)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        shutil.copymode(target, temporary)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return temporary


def _put_back(change: FileChange) -> bool:
    """Restore the content from before; True if the file has it."""
    try:
        if change.path.read_bytes() != change.before:
            _beside(change.path, change.before).replace(change.path.resolve())
    except OSError:
        return False
    return True


def _differs_from_head(path: Path) -> bool:
    committed = _git(path, "rev-parse", "--verify", "--quiet", f"HEAD:./{path.resolve().name}")
    if committed is None:
        return False
    # hash-object applies what git would do to the file on commit, such as turning CRLF into LF.
    current = _git(path, "hash-object", "--stdin", "--path", path.resolve().name, stdin=pristine(path.read_bytes()))
    return current is not None and current != committed


def _git(path: Path, *arguments: str, stdin: bytes = b"") -> str | None:
    """What git prints when asked from the file's folder, or None where it has no answer."""
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
    return result.stdout.decode().strip() if result.returncode == 0 else None
