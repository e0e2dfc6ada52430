"""Write files atomically, lock folders, and turn errors of the file system into one line.

Nothing is written through a link inside a folder that this package writes: `require_own`, `require_own_entries`. The
rule for reading is `untrusted.require_regular`.
"""

from __future__ import annotations

import errno
import os
import shlex
import socket
import stat
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from lapgs_plugin.errors import LapgsError, RunFolderError, joined

MANIFEST = "manifest.json"
"""File that makes a folder a run."""

BARE_RECORD = "lapgs_record.json"
"""File in which `lapgs run --off --record` writes time and memory of a script's own run."""

PREVIEW = "preview.jpg"
"""Picture of a run that the viewer shows first; named here because it is read before torch is imported."""

LOCK = ".lock"
"""File that `FolderLock` locks."""

LOCK_POLL_SECONDS = 0.05
"""Time between two attempts to lock something."""

LFS_POINTER = b"version https://git-lfs.github.com/spec/"
"""First bytes of the text in place of a file that Git LFS keeps elsewhere."""

TEMPORARY_PATTERN = ".*.tmp"
"""Glob of the temporary files of `atomic_write`, which a killed process may leave."""


def as_pip_argument(folder: Path) -> str:
    """Return a folder as an argument of `pip install` in a shell. A name without a slash is a package to download.

    >>> as_pip_argument(Path("rasterizer")), as_pip_argument(Path("/code/my rasterizer"))
    ('./rasterizer', "'/code/my rasterizer'")
    """
    return shlex.quote(os.path.join(".", folder))  # noqa: PTH118


def shipped(name: str) -> Path:
    """Return a folder that comes with the package: inside it where it is installed, else at the top of the repository.

    Args:
        name: "docs" or "patches", see `setup.py`.
    """
    installed = Path(__file__).parent / name
    return installed if installed.is_dir() else Path(__file__).parents[1] / name


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`, and rename it to `path` when the block ends without an error.

    The contents are on the disk before the rename: after a crash `path` holds either the old bytes or all new ones.
    When the block raises, the temporary file is removed and `path` is unchanged.

    Raises:
        OSError: the folder cannot be written, or the disk is full.
    """
    if not path.parent.is_dir():  # opening would name the temporary file
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path.parent))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.unlink(missing_ok=True)
        with temporary.open("xb") as stream:  # never through a link
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


@contextmanager
def whole_file(path: Path, kind: str) -> Iterator[Path]:
    """Yield a name beside `path` to write a file under, and rename the file when the block ends without an error.

    For programs that write files by name. Missing folders are made. Unlike `atomic_write` it may lose the file in a
    power cut.

    Args:
        path: of the file.
        kind: of the file, such as "image", for the message.

    Raises:
        LapgsError: the block raised an OSError.
    """
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.unfinished{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished.unlink(missing_ok=True)  # a link would be followed
        yield unfinished
        unfinished.replace(path)
    except OSError as error:
        reason = joined(error)[-300:]
        raise LapgsError(
            f"{path}: the {kind} cannot be written ({reason}); check free space and permissions"
        ) from error
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Make a rename survive a power cut. Windows has no such call and needs none."""
    if sys.platform == "win32":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def one_line_errors(path: Path, action: str = "written", *, training: bool = False) -> Iterator[None]:
    """Turn an OSError about a file into a RunFolderError with advice.

    Args:
        path: of the file.
        action: participle for the message, as in "cannot be written".
        training: whether a run is being trained, which --resume can continue.

    Raises:
        RunFolderError: the block raised an OSError.
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


def write_text(path: Path, text: str, *, training: bool = False) -> None:
    """Write a text file, whole or not at all.

    Raises:
        RunFolderError: see `one_line_errors`.
    """
    with one_line_errors(path, training=training), atomic_write(path) as stream:
        stream.write(text.encode(errors="backslashreplace"))  # names that are no UTF-8


def is_file(path: Path) -> bool:
    """Return whether a file exists; False also for names that the file system does not allow."""
    return os.path.isfile(path)  # noqa: PTH113  # Path.is_file raises for these names


def is_folder(path: Path) -> bool:
    """Return whether a folder exists; False also for names that the file system does not allow."""
    return os.path.isdir(path)  # noqa: PTH112  # Path.is_dir raises for these names


def require_own(path: Path) -> None:
    """Check that a path to write to is missing, a file or a folder, so that nothing is written through a link.

    Raises:
        RunFolderError: it is a link, a pipe, a socket or a device, or its folder cannot be read.
    """
    with one_line_errors(path, "read"):
        try:
            mode = path.lstat().st_mode
        except FileNotFoundError:
            return
    if stat.S_ISLNK(mode):
        raise RunFolderError(
            f"{path} is a link, through which nothing is written; remove it, or put what it points to in its place"
        )
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise RunFolderError(f"{path} is a pipe, socket or device, expected a file or a folder; remove it")


def require_own_entries(folder: Path, names: Iterable[str]) -> None:
    """Check entries of a folder, and everything in them, with `require_own`. The folder itself may be a link."""
    for name in names:
        require_own(folder / name)
        for parent, folders, files in os.walk(folder / name):
            for inner in (*folders, *files):
                require_own(Path(parent, inner))


def refuse_lfs_pointer(file: Path, kind: type[LapgsError]) -> None:
    """Raise an error of this kind if a file is the short text that Git leaves in its place without Git LFS."""
    with file.open("rb") as stream:
        if stream.read(len(LFS_POINTER)) == LFS_POINTER:
            raise kind(f"{file}: a pointer of Git LFS, not the file itself; fetch it with `git lfs pull`")


def require_manifest(folder: Path) -> None:
    """Check that a folder holds a run, without reading it or importing anything heavy.

    Raises:
        RunFolderError: there is none.
    """
    with one_line_errors(folder, "read"):
        is_run = (folder / MANIFEST).is_file()
    if not is_run:
        state = f"has no {MANIFEST}" if folder.is_dir() else "is a file" if folder.exists() else "does not exist"
        raise RunFolderError(
            f"{folder} {state}, so it is not a run; expected a folder of `lapgs train` or "
            "`lapgs run`; of a model that was trained without them `lapgs import-run` makes one"
        )


def lock(descriptor: int, patience: float = 0.0) -> bool | None:
    """Lock an open file or folder until it is closed.

    Args:
        descriptor: of the file or folder.
        patience: seconds to wait for another process that has the lock.

    Returns:
        False if another process, or another open of it, still has the lock; None where the file system has no locks.
    """
    end = time.monotonic() + patience
    while (locked := _try_lock(descriptor)) is False and time.monotonic() < end:
        time.sleep(LOCK_POLL_SECONDS)
    return locked


class FolderLock:
    """An exclusive lock on a folder, held until `release` or the end of the process.

    It is the operating system's lock on the folder's .lock file, so a file that a killed process left never blocks
    another one. The file's text (process id and host) is only used in messages.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    @classmethod
    def acquire(cls, folder: Path, patience: float = 0.0) -> FolderLock:
        """Lock a folder, after waiting up to `patience` seconds for another process.

        Raises:
            RunFolderError: another process has it.
        """
        path = folder / LOCK
        require_own(path)
        with one_line_errors(path, training=True):
            stream = path.open("a+b")
            try:
                if lock(stream.fileno(), patience) is False:
                    stream.seek(0)
                    holder = stream.read(1_000).decode(errors="replace").strip() or "another process"
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


_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EBADF, errno.EINVAL)
"""Errors of file systems without locks, or without locks of folders, such as some network mounts."""


if sys.platform == "win32":
    import msvcrt

    def _try_lock(descriptor: int) -> bool | None:
        os.lseek(descriptor, 1 << 30, os.SEEK_SET)  # beyond the text: Windows forbids reading locked bytes
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True
else:
    import fcntl

    def _try_lock(descriptor: int) -> bool | None:
        """Lock an open file or folder as `lock`, without waiting."""
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            return None
        return True
