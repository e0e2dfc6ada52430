"""Limits on memory and time: a file or an option of a few bytes can ask for more than any machine has.

The defaults lie above what photos and clips need; an environment variable sets another value.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass

from lapgs_plugin.errors import UserInputError


@dataclass(frozen=True)
class Limit:
    """The largest accepted number of something.

    Attributes:
        variable: environment variable that sets another value.
        default: used unless it is set.
        unit: of both, for the message.
    """

    variable: str
    default: int
    unit: str

    @property
    def value(self) -> int:
        """The limit in force.

        Raises:
            UserInputError: the variable is set to something else than a positive whole number.
        """
        text = os.environ.get(self.variable, str(self.default))
        if not re.fullmatch(r"0*[1-9][0-9]{0,17}", text, re.ASCII):
            raise UserInputError(
                f"{self.variable} is {text!r}, expected a whole number of {self.unit} such as {self.default}"
            )
        return int(text)

    def check(self, amount: int, subject: str, advice: str = "", error: type[UserInputError] = UserInputError) -> None:
        """Refuse more than the limit.

        Args:
            amount: what is asked for.
            subject: start of the message, which says what asks for how much.
            advice: what to do besides raising the limit, such as "choose a smaller --size".
            error: what to raise.

        Raises:
            UserInputError: it is more.
        """
        if amount > (limit := self.value):
            raise error(
                f"{subject}, expected at most {limit:,} {self.unit}; "
                f"{advice}{' or ' if advice else ''}raise the limit with the environment variable {self.variable}"
            )


PHOTO_PIXELS = Limit("LAPGS_MAX_PHOTO_PIXELS", 250_000_000, "pixels")
"""Of an image file, before it is resized: phones have 200 million."""

PHOTO_SIDE = Limit("LAPGS_MAX_PHOTO_SIDE", 65_536, "pixels a side")
"""Of an image file: whole rows of it are in memory."""

VIEW_PIXELS = Limit("LAPGS_MAX_VIEW_PIXELS", 128_000_000, "pixels")
"""Of an image that is trained on or rendered, which is held as float32, 12 bytes a pixel."""

FRAMES = Limit("LAPGS_MAX_FRAMES", 100_000, "frames")
"""Of a camera path: an hour of video has 86,400 at 24 frames a second."""
