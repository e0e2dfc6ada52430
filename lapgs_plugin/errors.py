"""Errors a user can cause, told apart from our own bugs (which are `assert`s)."""

from __future__ import annotations

import unicodedata
from typing import ClassVar

LONGEST_LINE = 1_200
"""Characters of a message; more than that are left out of its middle."""


def printable(text: str) -> str:
    r"""Make text safe for a terminal: names from files may hold escape sequences, newlines or reversed writing.

    >>> printable("a\n\x1b[2J")
    'a\\n\\x1b[2J'
    """
    return "".join(
        char if char.isprintable() or unicodedata.category(char) == "Zs" else char.encode("unicode_escape").decode()
        for char in text
    )


class LapgsError(Exception):
    """Something went wrong that one clear line explains; the command line prints it and exits with `exit_code`.

    The message says what was wrong, the value received, what was expected and what to do next. It is one printable
    line, whatever names it quotes.
    """

    exit_code: ClassVar[int] = 2

    def __init__(self, message: str = "") -> None:
        line = printable(message)
        if len(line) > LONGEST_LINE:  # it quotes a long value; file and advice stand at its ends
            line = f"{line[: LONGEST_LINE // 2]} ... {line[-LONGEST_LINE // 2 :]}"
        super().__init__(line)


class UserInputError(LapgsError, ValueError):
    """An argument, file or scene is not usable as given."""


class SceneError(UserInputError):
    """A scene folder, its sparse model or one of its images is not usable."""


class FieldError(UserInputError):
    """A Gaussian field or its PLY file is not usable."""


class RunFolderError(UserInputError):
    """A run folder cannot be read, written or resumed."""


class TrainingDivergedError(LapgsError):
    """Training produced NaN or inf; the last good archive is kept."""


class DeviceMemoryError(LapgsError):
    """A GPU has no memory left; finished levels and the last checkpoint are kept."""


class TrainingStoppedError(LapgsError):
    """The user asked to stop; a checkpoint is in the run folder."""

    exit_code = 130  # what shells report after Ctrl-C


class MissingExtraError(LapgsError, ImportError):
    """An optional dependency is not installed; the message names the extra that brings it."""


class PatchError(UserInputError):
    """A checkout's sources cannot be patched or reverted as asked."""
