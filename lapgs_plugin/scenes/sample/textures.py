"""Procedural patterns with hard edges, as functions of surface coordinates in metres.

Nothing here is filtered: every edge is a jump, at any magnification; the ray caster averages over pixels. Colours are
numbers in a palette, one byte each, so that laying one pattern over another costs next to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import OpenImageIO as oiio

from lapgs_plugin.errors import LapgsError
from lapgs_plugin.scenes.sample.shapes import Codes, Floats, Mask


def linear_rgb(color: str) -> Floats:
    """Linear RGB (3,) of a colour written as in CSS: "#d9a441"."""
    encoded = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def choose(mask: Mask, inside: Codes | int, outside: Codes | int) -> Codes:
    """Palette numbers (n,): `inside` where the mask (n,) holds, else `outside`."""
    # Several times faster than np.where, and exact: bytes wrap around.
    outside = np.asarray(outside, np.uint8)
    return outside + (np.asarray(inside, np.uint8) - outside) * mask.view(np.uint8)


def pick(colors: Sequence[int], number: Floats) -> Codes:
    """One of several successive palette numbers for each number (n,) in [0, 1)."""
    return (number * np.float32(len(colors))).astype(np.uint8) + np.uint8(colors[0])


def noise(i: Floats, j: Floats, salt: int) -> Floats:
    """A random number in [0, 1) for each cell (i, j) of whole numbers, the same on every machine."""
    a = i.astype(np.int32).view(np.uint32)
    b = j.astype(np.int32).view(np.uint32)
    h = a * np.uint32(0x9E3779B1) ^ b * np.uint32(0x85EBCA77) ^ np.uint32(salt * 0x27D4EB2F & 0xFFFFFFFF)
    h ^= h >> np.uint32(15)
    h *= np.uint32(0x2C1B3C6D)
    h ^= h >> np.uint32(12)
    h *= np.uint32(0x297A2D39)
    h ^= h >> np.uint32(15)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def fraction(u: Floats) -> Floats:
    """u modulo 1."""
    return u - np.floor(u)


def turns(u: Floats, v: Floats) -> Floats:
    """Direction of (u, v) in turns, from -0.5 to 0.5."""
    return np.arctan2(v, u) * np.float32(0.5 / np.pi)


def checks(u: Floats, v: Floats) -> Mask:
    """A chessboard of unit squares."""
    odd: Mask = (np.floor(u) + np.floor(v)).astype(np.int32) & 1 == 1
    return odd


def stripes(u: Floats, period: float, share: float = 0.5) -> Mask:
    """Bars that cover `share` of each period."""
    return fraction(u * np.float32(1 / period)) < np.float32(share)


def star(u: Floats, v: Floats, spokes: int) -> Mask:
    """A Siemens star around (0, 0): its frequency grows without limit towards the centre."""
    return stripes(turns(u, v), 1 / spokes)


def mesh(u: Floats, v: Floats, spacing: float, width: float) -> Mask:
    """Diagonal wires of a width, crossing like a chain-link fence."""
    half = np.float32(0.5**0.5)
    share = width / spacing
    return stripes((u + v) * half, spacing, share) | stripes((u - v) * half, spacing, share)


def chips(u: Floats, v: Floats, cell: float, salt: int) -> tuple[Mask, Floats]:
    """Terrazzo: in each cell one round chip; where they are, and a random number of each cell, (n,) each."""
    u, v = u * np.float32(1 / cell), v * np.float32(1 / cell)
    i, j = np.floor(u), np.floor(v)
    random = noise(i, j, salt)
    radius = np.float32(0.12) + np.float32(0.26) * random
    room = 1 - 2 * radius
    x = u - i - radius - room * noise(i, j, salt + 1)
    y = v - j - radius - room * fraction(random * 61)
    return x * x + y * y < radius * radius, random


def polar_tiles(u: Floats, v: Floats, ring: float, gap: float) -> tuple[Mask, Floats, Floats]:
    """Tiles in rings of a width around (0, 0): where the joints of a width are, ring and tile number, (n,) each."""
    r = np.sqrt(u * u + v * v)
    number: Floats = np.floor(r * np.float32(1 / ring))
    count = 6 * number + 6
    along: Floats = fraction(turns(u, v) + number * np.float32(0.19)) * count
    tile = np.floor(along)
    across = (along - tile) * r * np.float32(2 * np.pi) / count
    return (r - number * np.float32(ring) < np.float32(gap)) | (across < np.float32(gap)), number, tile


def bricks(u: Floats, v: Floats, length: float, height: float, gap: float) -> tuple[Mask, Floats, Floats]:
    """Rows of bricks, each shifted by half a brick: where the mortar is, row and brick number, (n,) each."""
    row = np.floor(v * np.float32(1 / height))
    shifted = u * np.float32(1 / length) + fraction(row * np.float32(0.5))
    brick = np.floor(shifted)
    mortar = (v - row * np.float32(height) < np.float32(gap)) | (shifted - brick < np.float32(gap / length))
    return mortar, row, brick


@dataclass(frozen=True)
class Print:
    """Text in black and white.

    Attributes:
        ink: (rows, columns), first row on top.
    """

    ink: Mask

    def __call__(self, u: Floats, v: Floats) -> Mask:
        """Ink at u from left to right and v from bottom to top, both in [0, 1] (n,); none outside."""
        rows, columns = self.ink.shape
        inside = (u >= 0) & (u < 1) & (v > 0) & (v <= 1)
        column = np.floor(u * np.float32(columns)).astype(np.int32)
        row = np.floor((1 - v) * np.float32(rows)).astype(np.int32)
        ink: Mask = self.ink.reshape(-1).take(row * columns + column, mode="clip")
        return ink & inside


def typeset(width: int, height: int, lines: Sequence[tuple[str, int]], font: str = "DroidSans-Bold") -> Print:
    """Centred lines of text, each with the size of its letters in pixels, spread over a sheet.

    Raises:
        LapgsError: OpenImageIO has been built without fonts.
    """
    sheet = oiio.ImageBuf(oiio.ImageSpec(width, height, 1, oiio.FLOAT))
    space = (height - sum(size for _, size in lines)) / (len(lines) + 1)
    y = 0.0
    for text, size in lines:
        y += space + size
        place = (width // 2, round(y - 0.12 * size))
        if not oiio.ImageBufAlgo.render_text(sheet, *place, text, size, font, (1.0,), "center"):
            raise LapgsError(
                f"OpenImageIO cannot print text ({sheet.geterror()}), expected one with FreeType and its own fonts; "
                "install the OpenImageIO wheel"
            )
    return Print(np.asarray(sheet.get_pixels(oiio.FLOAT))[:, :, 0] > 0.5)
