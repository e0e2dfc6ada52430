"""Define the errors that users can cause. Our own bugs are `assert`s."""

from __future__ import annotations

import difflib
import unicodedata
from collections.abc import Iterator, Set
from contextlib import contextmanager
from importlib.util import find_spec
from typing import ClassVar

LONGEST_LINE = 1_200
"""Most characters of a message; the middle of longer ones is left out."""


def printable(text: str) -> str:
    r"""Escape text for a terminal: names from files may hold control sequences, newlines or reversed writing.

    >>> printable("a\n\x1b[2J")
    'a\\n\\x1b[2J'
    """
    return "".join(
        char if char.isprintable() or unicodedata.category(char) == "Zs" else char.encode("unicode_escape").decode()
        for char in text
    )


def printable_lines(text: str) -> str:
    """Escape each line of a text for a terminal, as `printable`."""
    return "\n".join(map(printable, text.split("\n")))


def one_line(text: str) -> str:
    """Return text as one printable line. Very long text loses its middle: the file and the advice are at its ends."""
    line = printable(text)
    if len(line) > LONGEST_LINE:
        line = f"{line[: LONGEST_LINE // 2]} ... {line[-LONGEST_LINE // 2 :]}"
    return line


def counted(number: int, thing: str) -> str:
    """Return a number with the counted thing, in the plural unless it is one.

    >>> counted(1, "photo"), counted(0, "photo")
    ('1 photo', '0 photos')
    """
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def nearest(name: str, known: Set[str], otherwise: str = "") -> str:
    """Suggest the nearest known name; without a near one return `otherwise`, or list all names.

    >>> nearest("iteratons", {"iterations", "seed"}), nearest("x", {"iterations", "seed"})
    ('did you mean iterations?', 'expected one of iterations, seed')
    """
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]}?" if close else otherwise or f"expected one of {', '.join(sorted(known))}"


def joined(text: object) -> str:
    """Return the lines of another program's message as one."""
    return " ".join(str(text).split()) or "no reason given"


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or the name of its type if it has none."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def typed_line(error: BaseException) -> str:
    """Return the type of an error and the first line of its message."""
    return f"{type(error).__name__}: {(str(error).splitlines() or ['no message'])[0]}"


class LapgsError(Exception):
    """An error that one line explains; the command line prints it and exits with `exit_code`.

    The message holds the mistake, the value received, the expectation and the next step. It is always one
    printable line; an error about several mistakes has a line for each.
    """

    exit_code: ClassVar[int] = 2

    def __init__(self, *lines: str) -> None:
        super().__init__("\n".join(map(one_line, lines)))


class UserInputError(LapgsError, ValueError):
    """An argument, file or scene cannot be used as given."""


class SceneError(UserInputError):
    """A scene folder, its sparse model or one of its images cannot be used."""


class FieldError(UserInputError):
    """A Gaussian field or its PLY file cannot be used."""


class RunFolderError(UserInputError):
    """A run folder cannot be read, written or resumed."""


class PatchError(UserInputError):
    """A checkout's sources cannot be patched or reverted as asked."""


class TrainingDivergedError(LapgsError):
    """Training produced NaN or inf; finished levels are kept."""


class DeviceMemoryError(LapgsError):
    """A GPU has no memory left; finished levels and the last checkpoint are kept."""


class TrainingStoppedError(LapgsError):
    """The user asked to stop; a checkpoint is in the run folder."""

    exit_code = 130  # what shells report after Ctrl-C


class MissingExtraError(LapgsError, ImportError):
    """An optional dependency is not installed; the message names the extra that brings it."""


@contextmanager
def errors_about(file: object) -> Iterator[None]:
    """Begin the messages of errors in a block with a file, for values that the user did not type.

    Raises:
        UserInputError: the block raised it, or a kind of it.
    """
    try:
        yield
    except UserInputError as error:
        raise type(error)(f"{file}: {error}") from error


def require_extra(module: str, extra: str, subject: str, otherwise: str = "") -> None:
    """Check that the package of an extra is installed, without importing it.

    Args:
        module: of the package.
        extra: of lapgs_plugin that brings it.
        subject: of the message: the file, command or option that needs it.
        otherwise: alternative without it.

    Raises:
        MissingExtraError: it is not installed.
    """
    if find_spec(module) is None:
        package, instead = module.replace("_", "-"), f"; or {otherwise}" if otherwise else ""
        raise MissingExtraError(f"{subject} needs {package}: pip install 'lapgs_plugin[{extra}]'{instead}")
