"""Limit sizes that files and options can ask for, because a few bytes can ask for more than any machine has.

The defaults exceed the needs of photos and clips; an environment variable sets another value.
"""

from __future__ import annotations

import os
import re
import threading
from dataclasses import dataclass

from lapgs_plugin.errors import UserInputError


@dataclass(frozen=True)
class Limit:
    """A limit that an environment variable can change.

    Attributes:
        variable: environment variable that sets another value.
        default: the limit if the variable is not set.
        unit: of the limit, for messages.
    """

    variable: str
    default: int
    unit: str

    @property
    def value(self) -> int:
        """The limit in force.

        Raises:
            UserInputError: the variable is not a positive whole number.
        """
        text = os.environ.get(self.variable, str(self.default))
        if not re.fullmatch(r"0*[1-9][0-9]{0,17}", text, re.ASCII):
            raise UserInputError(
                f"{self.variable} is {text!r}, expected a whole number of {self.unit} such as {self.default}"
            )
        return int(text)

    def check(self, amount: int, subject: str, advice: str = "", error: type[UserInputError] = UserInputError) -> None:
        """Check that an amount is within the limit.

        Args:
            amount: to check.
            subject: start of the message, such as "--size 99999x9 is 899,991 pixels".
            advice: an alternative to raising the limit, such as "choose a smaller --size".
            error: class to raise.

        Raises:
            UserInputError: as `error`: the amount is above the limit.
        """
        if amount > (limit := self.value):
            raise error(
                f"{subject}, expected at most {limit:,} {self.unit}; "
                f"{advice}{' or ' if advice else ''}raise the limit with the environment variable {self.variable}"
            )


PHOTO_PIXELS = Limit("LAPGS_MAX_PHOTO_PIXELS", 250_000_000, "pixels")
"""Largest image file, before resizing. Phone cameras have up to 200 million pixels."""

PHOTO_SIDE = Limit("LAPGS_MAX_PHOTO_SIDE", 65_536, "pixels a side")
"""Longest side of an image file, whose rows are read whole."""

VIEW_PIXELS = Limit("LAPGS_MAX_VIEW_PIXELS", 128_000_000, "pixels")
"""Largest image to train on or to render. It takes 12 bytes a pixel as float32."""

FRAMES = Limit("LAPGS_MAX_FRAMES", 100_000, "frames")
"""Longest camera path. An hour of video at 24 frames a second has 86,400 frames."""

_torch_threads = threading.Lock()

LONGEST_NAME = 255
"""Longest file name in bytes on common file systems."""

LONGEST_STEM = 230
"""Longest name in bytes that leaves room for suffixes, such as those of attempts, logs and temporary files."""


def use_one_torch_thread() -> None:
    """Run PyTorch's operations in the calling thread alone, for threads of a pool that would compete with PyTorch's.

    PyTorch's number is that of the calling thread and of threads that begin to use PyTorch later. Another thread
    restores it for these.
    """
    import torch  # not with this file, which all commands read

    with _torch_threads:
        others = torch.get_num_threads()  # as of any new thread; not asked now, it would be adopted later
        torch.set_num_threads(1)
        restoring = threading.Thread(target=torch.set_num_threads, args=(others,))
        restoring.start()
        restoring.join()


def usable_processors() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
