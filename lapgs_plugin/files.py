"""Writing a folder so that a reader never meets half a file and no two processes write at once."""

from __future__ import annotations

import errno
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from lapgs_plugin.errors import RunFolderError

MANIFEST = "manifest.json"
"""Name of the file that makes a folder a run."""

BARE_RECORD = "lapgs_record.json"
"""Name of the file in which `lapgs run --off --record` notes what a script's own run took."""

PREVIEW = "preview.jpg"
"""Name of the picture of a run that the viewer begins with; here because it is read before torch is imported."""

LOCK = ".lock"
"""Name of the file that `FolderLock` locks."""

TEMPORARY_PATTERN = ".*.tmp"
"""Glob of the temporary names `atomic_write` uses beside its targets; what a killed process may leave."""


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path` and put it in `path`'s place when the block ends without an error.

    The contents reach the disk before the name does, so after a crash `path` holds either the old bytes or all of the
    new ones. When the block raises, the temporary file is removed and `path` is untouched.

    Raises:
        OSError: the folder cannot be written, or the disk is full.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make a rename survive a power cut; Windows has no such call and needs none."""
    if sys.platform == "win32":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def one_line_errors(path: Path, action: str = "written", *, training: bool = False) -> Iterator[None]:
    """Turn an OSError about a file of a run into a RunFolderError: one line that says what to do.

    Args:
        path: of the file.
        action: what cannot be done with it.
        training: whether a run is being trained, which continues with --resume once the disk has space.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            advice = "free some space and run the command again"
            if training:
                advice = "free some space and continue with --resume; what was finished before is unharmed"
        else:
            advice = "expected a folder this user may read and write"
        raise RunFolderError(f"{path} cannot be {action}: {error.strerror or error}; {advice}") from error


def require_manifest(folder: Path) -> None:
    """Check that there is a run in a folder, without reading it: quick enough to ask before anything is imported.

    Raises:
        RunFolderError: there is none.
    """
    with one_line_errors(folder, "read"):
        is_run = (folder / MANIFEST).is_file()
    if not is_run:
        what = f"has no {MANIFEST}" if folder.is_dir() else "does not exist"
        raise RunFolderError(f"{folder} {what}, so it is not a run; expected a folder written by `lapgs train -o`")


class FolderLock:
    """The right to write to a folder, held until `release` or the end of the process, however it ends.

    The operating system's lock on the folder's .lock decides, so that the file of a process that was killed, here or
    on another machine, never stands in the way; its text (process id and host) is only there for the message.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    @classmethod
    def acquire(cls, folder: Path) -> FolderLock:
        """Take the lock.

        Raises:
            RunFolderError: another process has it.
        """
        path = folder / LOCK
        with one_line_errors(path, training=True):
            stream = path.open("a+b")
            try:
                if not _lock_file(stream):
                    stream.seek(0)
                    holder = stream.read().decode(errors="replace").strip() or "another process"
                    raise RunFolderError(
                        f"{folder} is being written by {holder}; wait for it, stop it, or choose another folder"
                    )
                stream.truncate(0)
                stream.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
                stream.flush()
            except BaseException:
                stream.close()
                raise
        return cls(stream)

    def release(self) -> None:
        self._stream.truncate(0)
        self._stream.close()


_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK)
"""What a file system without locks answers (some network mounts): training must work there, unguarded."""


if sys.platform == "win32":
    import msvcrt

    def _lock_file(stream: BinaryIO) -> bool:
        stream.seek(1 << 30)  # Windows forbids reading what is locked, and the text must stay readable
        try:
            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True
else:
    import fcntl

    def _lock_file(stream: BinaryIO) -> bool:
        """Lock an open file without waiting; False when another process (or another open of it) has the lock."""
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        return True
