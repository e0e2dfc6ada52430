"""Parse image sizes: the paper's 1k, 2k and 4k settings, a width in pixels, or a fraction of the full size.

Images are never enlarged: an image that is smaller than the setting keeps its size. The exception is the spelling
"3dgs:" with the value of a 3DGS codebase's option -r. It gives the same images as these codebases, to the byte, so that
runs trained by them can be measured.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction

from lapgs_plugin.errors import UserInputError

PAPER_WIDTH = 1600
"""Width of the paper's 1K setting, to which 3DGS codebases shrink large photos by default."""

MIN_WIDTH = 16
"""Smallest width: `--resolution 4` more likely means a quarter."""

BACKBONE_PREFIX = "3dgs:"
"""Prefix of the value of a 3DGS codebase's option -r."""

BACKBONE_DIVISORS = (1, 2, 4, 8)
"""Values of -r that divide both sides. Other positive values are widths; -1 means at most `PAPER_WIDTH`."""

ACCEPTED = (
    "1k, 2k, 4k, full, a width in pixels such as 800, a fraction of the full size such as 1/4 or 0.25, "
    "or 3dgs: and the -r of a 3DGS codebase, such as 3dgs:-1"
)


@dataclass(frozen=True)
class Resolution:
    """Compute the training size of an image from its full size.

    The width decides, also for portrait images, as in the paper and in 3DGS.

    Attributes:
        text: the setting as the user wrote it.
        width: width to shrink to in pixels; None to use `fraction`.
        midpoint: shrink only to the mean of the full width and `width`.
        fraction: share of the full width and height, in (0, 1]; used if `width` is None.
        backbone: value of a 3DGS codebase's -r, which replaces the other fields; None for our own settings.
    """

    text: str
    width: int | None = None
    midpoint: bool = False
    fraction: Fraction = Fraction(1)
    backbone: int | None = None

    def size_for(self, width: int, height: int) -> tuple[int, int]:
        """Return the training size (width, height) of an image of `width` x `height` pixels.

        Sides are rounded as in 3DGS: to the nearest integer for a fraction, downwards for the height that follows from
        a width. Unlike in 3DGS, division is exact, so a width of 1600 never becomes 1599. With `backbone` the size is
        that of the 3DGS codebase, also if it is larger than the image.

        >>> parse_resolution("1k").size_for(3118, 2078)
        (1600, 1066)
        """
        if self.backbone is not None:
            return _backbone_size(self.backbone, width, height)
        if self.width is None:
            return max(1, round(width * self.fraction)), max(1, round(height * self.fraction))
        if self.width >= width:
            return width, height
        target = (width + self.width) // 2 if self.midpoint else self.width
        return target, max(1, height * target // width)

    def falls_short(self, width: int) -> bool:
        """Return whether an image of `width` pixels keeps its size because the setting asks for a larger one."""
        return self.width is not None and self.width > width


def parse_resolution(text: str) -> Resolution:
    """Parse "1k", "2k", "4k", "full", a width such as "800", a fraction such as "1/4" or "0.25", or "3dgs:-1".

    1k is width 1600, 4k the full size and 2k the mean of the two widths, as in the paper. 3dgs:N is the size for -r N
    in a 3DGS codebase.

    Raises:
        UserInputError: the text is none of these.
    """
    setting = text.strip().lower()
    if setting == "1k":
        return Resolution(text, width=PAPER_WIDTH)
    if setting == "2k":
        return Resolution(text, width=PAPER_WIDTH, midpoint=True)
    if setting in ("4k", "full"):
        return Resolution(text)
    if setting.startswith(BACKBONE_PREFIX):
        return _from_backbone(text, setting.removeprefix(BACKBONE_PREFIX))
    if re.fullmatch(r"[0-9]{1,9}", setting):
        return _from_width(text, int(setting))
    if re.fullmatch(r"[0-9]{1,9}/[0-9]{1,9}|[0-9]{0,9}\.[0-9]{1,9}", setting):
        return _from_fraction(text, setting)
    raise UserInputError(f"--resolution {text!r}: expected {ACCEPTED}")


def parse_size(text: str) -> tuple[int, int]:
    """Parse a value of --size such as "480x320" into width and height.

    Raises:
        UserInputError: the text has another form.
    """
    match = re.fullmatch(r"([0-9]{1,9})x([0-9]{1,9})", text.strip().lower())
    if match is None:
        raise UserInputError(f"--size {text!r}: expected WIDTHxHEIGHT in pixels, such as 480x320")
    return int(match[1]), int(match[2])


def _from_width(text: str, width: int) -> Resolution:
    if width < MIN_WIDTH:
        hint = f"; for a fraction of the full size write 1/{width}" if width > 1 else ""
        raise UserInputError(f"--resolution {text!r}: expected a width of at least {MIN_WIDTH} pixels{hint}")
    return Resolution(text, width=width)


def _from_fraction(text: str, setting: str) -> Resolution:
    try:
        fraction = Fraction(setting)
    except ZeroDivisionError as error:
        raise UserInputError(f"--resolution {text!r}: division by zero, expected {ACCEPTED}") from error
    if not 0 < fraction <= 1:
        raise UserInputError(f"--resolution {text!r}: expected a fraction above 0 and at most 1, images only shrink")
    return Resolution(text, fraction=fraction)


def _from_backbone(text: str, value: str) -> Resolution:
    if not re.fullmatch(r"-1|0*[1-9][0-9]{0,8}", value):
        raise UserInputError(f"--resolution {text!r}: expected -1, 1, 2, 4, 8 or a width in pixels after 3dgs:")
    return Resolution(text, backbone=int(value))


def _backbone_size(value: int, width: int, height: int) -> tuple[int, int]:
    """Return the size for -r `value` in 3DGS codebases, with their float arithmetic: 1600 may become 1599.

    Sides are at least 1 pixel, where these codebases would stop at 0.
    """
    if value in BACKBONE_DIVISORS:
        return max(1, round(width / value)), max(1, round(height / value))
    if value == -1:
        value = min(width, PAPER_WIDTH)
    factor = width / value
    return max(1, int(width / factor)), max(1, int(height / factor))
