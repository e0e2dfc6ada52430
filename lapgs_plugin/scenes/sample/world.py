"""Paint and place the objects of the sample scene: a still life of test patterns in a round hall.

Lengths are metres, z is up. The objects stand within 2.2 m of the z axis; the cameras (`cameras.py`) look at them from
about 4.6 m, where a pixel of a 480x320 image covers 9 mm. Every edge is a jump at any magnification: the image filter
is in `raycast.py`. Patterns repeat at octaves, so that every level of a pyramid has a frequency of its own.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from lapgs_plugin.scenes.sample.solids import Codes, Floats, Paint, Solid, ball, box, dot, rod

HALL_RADIUS, HALL_HEIGHT = 6.5, 5.2
BAYS = 12
PLINTH_RADIUS, PLINTH_HEIGHT = 1.05, 0.22
RING = (0.93, 1.0)
"""Inner and outer radius of the red ring on the plinth."""
GLOBE_CENTRE, GLOBE_RADIUS = (0.0, 0.0, 1.42), 0.42
COLUMN_RADIUS, COLUMN_TOP = 0.16, 1.0

INK, PAPER, RED, TEAL, MUSTARD, NAVY, WOOD, IRON, PLASTER, CEILING, LAND, HIGHLAND, SEA, DEEP_SEA, STONE = range(15)
CLAY, BOOK = STONE + 4, STONE + 8  # four stones, four clays, six books
_ENCODED = np.frombuffer(
    bytes.fromhex(
        "1d2433 f3ecdc c8402f 1f7a80 dba13a 22355c 7a4d2c 33363d cdb796 9db4c4 5d8a4e d8c08a 5fa7c4 2a6ba0"
        "b7a78d ab9b81 c2b39a a3927a b98a6c c29678 ae7f62 bd9073 7c2d2a b5523b 3f5d4a 23415f 5a6f8f e3d7bd"
    ),
    np.uint8,
).reshape(-1, 3)
PALETTE: Floats = (((_ENCODED.T / 255.0 + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""Linear RGB of the palette's colours, (3, colours)."""

CUBES = (
    *((1.4, 1.0, 0.0, 0.8, NAVY, 0.5), (-1.5, 0.7, 0.0, 0.5, RED, 0.2), (-1.5, 0.7, 0.5, 0.3, MUSTARD, 0.9)),
    *((0.9, -1.5, 0.0, 0.36, TEAL, 0.6), (1.35, -1.2, 0.0, 0.36, RED, 0.3), (1.12, -1.35, 0.36, 0.36, NAVY, 0.5)),
)
"""Centre x and y, bottom, side, colour and turn."""
PENCILS = (
    *(((-0.7, -1.7, 0.0), (-1.5, -1.2, 1.0), RED, PAPER), ((-1.4, -1.8, 0.0), (-0.9, -1.2, 1.1), TEAL, MUSTARD)),
    *(((-0.4, 1.7, 0.0), (0.3, 1.5, 1.2), NAVY, PAPER), ((0.4, 1.8, 0.0), (-0.1, 1.4, 1.2), RED, MUSTARD)),
)
"""Ends and colours."""


def build_world(seed: int) -> tuple[Solid, ...]:
    """Return the solids of the scene, the hall first. `seed` chooses stones, books, continents and turns."""
    random = np.random.default_rng([seed, 1])
    salt = int(random.integers(1 << 16))
    hall = rod((0, 0, 0), (0, 0, HALL_HEIGHT), HALL_RADIUS, partial(_hall, salt), room=True)
    return (hall, *_centrepiece(random), *_around(random))


def where(mask: NDArray[np.bool_], inside: Codes | int, outside: Codes | int) -> Codes:
    """Return palette indices: `inside` where the mask holds, else `outside`."""
    return np.where(mask, np.asarray(inside, np.uint8), np.asarray(outside, np.uint8))


def _noise(i: Floats, j: Floats, salt: int) -> Floats:
    """Return a random number in [0, 1) for each cell (i, j), the same on every machine."""
    a, b = i.astype(np.int32).view(np.uint32), j.astype(np.int32).view(np.uint32)
    h = a * np.uint32(0x9E3779B1) ^ b * np.uint32(0x85EBCA77) ^ np.uint32(salt * 0x27D4EB2F & 0xFFFFFFFF)
    for shift, factor in ((15, 0x2C1B3C6D), (12, 0x297A2D39), (15, 1)):
        h = (h ^ h >> np.uint32(shift)) * np.uint32(factor)
    return (h >> np.uint32(8)).astype(np.float32) * 2.0**-24


def _fraction(u: Floats) -> Floats:
    return u - np.floor(u)


def _turns(u: Floats, v: Floats) -> Floats:
    """Return the direction of (u, v) in turns, from -0.5 to 0.5."""
    return np.arctan2(v, u) * np.float32(0.5 / np.pi)


def _stripes(u: Floats, period: float, share: float = 0.5) -> NDArray[np.bool_]:
    return _fraction(u / period) < share


def _checks(u: Floats, v: Floats) -> NDArray[np.bool_]:
    odd: NDArray[np.bool_] = (np.floor(u) + np.floor(v)).astype(np.int32) & 1 == 1
    return odd


@cache
def _sheet(text: str) -> NDArray[np.bool_]:
    """Return a sheet that a line of text fills from end to end, (height, width)."""
    font = ImageFont.load_default(150)
    image = Image.new("L", (round(font.getlength(text)), 192))
    ImageDraw.Draw(image).text((0, 96), text, 255, font, anchor="lm")
    return np.asarray(image) > 127


def _spiral(first: int, second: int, period: float) -> Paint:
    """Paint two colours that wind around the z axis."""
    return lambda p, _: where(_stripes(p[2] / period + _turns(p[0], p[1]), 1.0), first, second)


def _hall(salt: int, points: Floats, normals: Floats) -> Codes:
    """Paint a tiled floor, and a wall whose bays alternate between books and stripes of doubling frequency."""
    z = points[2] + HALL_HEIGHT / 2
    colors = _wall(points, z, salt)
    colors = where(normals[2] < -0.5, _floor(points[0], points[1], salt), colors)
    return where(normals[2] > 0.5, CEILING, colors)


def _floor(x: Floats, y: Floats, salt: int) -> Codes:
    """Paint square stone tiles with small squares at their corners."""
    u, v = x / 0.45, y / 0.45
    stone = np.uint8(STONE) + (4 * _noise(np.floor(u), np.floor(v), salt)).astype(np.uint8)
    du, dv = np.abs(u - np.round(u)), np.abs(v - np.round(v))
    joint = np.minimum(du, dv) < 0.02
    inlay = where(_noise(np.round(u), np.round(v), salt + 1) < 0.3, RED, NAVY)
    return where(du + dv < 0.18, inlay, where(joint, INK, stone))


def _wall(points: Floats, z: Floats, salt: int) -> Codes:
    """Paint bricks, and an arch in each bay."""
    along = (_turns(points[0], points[1]) + 0.5) * BAYS
    bay = np.floor(along)
    width = 2 * np.pi * HALL_RADIUS / BAYS
    x = (along - bay - 0.5) * width  # from the middle of the bay
    arch = np.hypot(x, np.maximum(z - 2.0, 0))  # half the width of the arch through this point
    row = np.floor(z / 0.2)
    brick = (along - bay) * 7 + _fraction(row * 0.5)
    mortar = (_fraction(z / 0.2) < 0.1) | (_fraction(brick) < 0.05)
    clay = np.uint8(CLAY) + (4 * _noise(row, np.floor(brick) + bay * 16, salt + 3)).astype(np.uint8)
    colors = where((arch < 1.32) & (z > 0.42), PAPER, where(mortar, PLASTER, clay))
    octave = np.exp2(np.floor(bay / 2))  # 1 to 32
    fringe = _fraction(x * octave / 2.4) < 0.5
    stripes = where(fringe, np.uint8(TEAL) + (bay % 4 / 2).astype(np.uint8) * np.uint8(NAVY - TEAL), PAPER)
    colors = where((arch < 1.2) & (z > 0.54), where(bay % 2 > 0, stripes, _books(x, z, bay, salt)), colors)
    colors = where(z < 0.3, where(_stripes(along, 1 / 24, 0.2), INK, WOOD), colors)
    return where(
        z >= 3.9, PLASTER, where((z > 3.5) & (z < 3.8), where(_checks(along * 48, z * 10), TEAL, PAPER), colors)
    )


def _books(x: Floats, z: Floats, bay: Floats, salt: int) -> Codes:
    """Paint shelves of books of different widths, heights and colours."""
    level, column = z / 0.42, x / 0.13
    shelf, cell = np.floor(level), np.floor(column)
    height, row = level - shelf, shelf + bay * 16
    off = column - cell - 0.3 - 0.4 * _noise(cell, row, salt + 4)  # from the edge in this cell
    style = _noise(cell + (off > 0), row, salt + 5)
    band = (np.abs(height - 0.2) < 0.025) | (np.abs(height - 0.6) < 0.025)
    book = np.uint8(BOOK) + (6 * _fraction(style * 71)).astype(np.uint8)
    gap = (height > 0.68 + 0.26 * _fraction(style * 29)) | (np.abs(off) < 0.05)
    return where(height < 0.08, WOOD, where(gap, INK, where(band & (style > 0.4), MUSTARD, book)))


def _centrepiece(random: np.random.Generator) -> tuple[Solid, ...]:
    """Return a plinth with a Siemens star, a globe on a column, and balls whose checks double in frequency."""
    pearls = []
    for index in range(8):
        angle, finer = 2 * np.pi * index / 8, 2.0 ** (index % 4 + 1)
        centre = (0.72 * float(np.cos(angle)), 0.72 * float(np.sin(angle)), PLINTH_HEIGHT + 0.13)
        pearls.append(ball(centre, 0.13, partial(_checked_ball, finer, (RED, TEAL)[index // 4])))
    feet = [2 * np.pi * (i + 0.25) / 6 for i in range(6)]
    mast = (0.0, 0.0, 2.5)
    wires = [
        rod((2.2 * float(np.cos(a)), 2.2 * float(np.sin(a)), 0), mast, 0.007, _spiral(IRON, IRON, 1.0)) for a in feet
    ]
    return (
        rod((0, 0, 0), (0, 0, PLINTH_HEIGHT), PLINTH_RADIUS, _plinth),
        rod((0, 0, PLINTH_HEIGHT), (0, 0, COLUMN_TOP), COLUMN_RADIUS, _spiral(TEAL, PAPER, 0.26)),
        ball(GLOBE_CENTRE, GLOBE_RADIUS, _globe_paint(random)),
        rod((0, 0, GLOBE_CENTRE[2] + GLOBE_RADIUS - 0.01), mast, 0.025, _spiral(RED, PAPER, 0.1)),
        *pearls,
        *wires,
    )


def _plinth(points: Floats, normals: Floats) -> Codes:
    x, y, z = points
    text = "LAPLACIAN PYRAMID \u00b7 GAUSSIAN SPLATS \u00b7 COARSE TO FINE \u00b7 "
    sheet = _sheet(text)
    height, width = sheet.shape
    row, column = np.floor((0.5 - z / PLINTH_HEIGHT) * height), np.floor(_fraction(_turns(x, y) * 2) * width)
    rim = where(sheet.take((row * width + column).astype(np.int32), mode="clip"), MUSTARD, NAVY)
    r = np.hypot(x, y)
    star = where(_stripes(_turns(x, y), 1 / 48), INK, PAPER)
    top = where((r > RING[0]) & (r < RING[1]), RED, where((r < RING[0]) & (r > 0.24), star, PAPER))
    return where(normals[2] > 0.5, top, rim)


def _checked_ball(finer: float, color: int, points: Floats, normals: Floats) -> Codes:
    """Paint checks: `finer` from pole to pole and twice as many around."""
    rise = np.arcsin(np.clip(normals[2], -1, 1)) * (finer / np.pi)
    return where(_checks(_turns(normals[0], normals[1]) * (2 * finer), rise), color, PAPER)


def _globe_paint(random: np.random.Generator) -> Paint:
    """Paint continents under a net of meridians and parallels."""
    waves = random.normal(size=(9, 3)) * np.geomspace(2.0, 9.0, 9)[:, None]
    weights, phases = 1 / np.linalg.norm(waves, axis=1) ** 0.8, random.uniform(0, 2 * np.pi, 9)
    series = list(zip(*(array.astype(np.float32) for array in (waves, weights, phases)), strict=True))

    def paint(points: Floats, normals: Floats) -> Codes:
        height = sum((np.sin(dot(wave, normals) + phase) * weight for wave, weight, phase in series), 0)
        rise = np.arcsin(np.clip(normals[2], -1, 1))
        meridians = _stripes(_turns(normals[0], normals[1]), 1 / 24, 0.05) & (np.abs(rise) < 1.35)
        ground = where(height > 0.1, where(height > 0.55, HIGHLAND, LAND), where(height > -0.18, SEA, DEEP_SEA))
        return where(
            meridians | _stripes(rise, np.pi / 12, 0.05),
            INK,
            where(np.abs(height - 0.1) < 0.03, PAPER, ground),
        )

    return paint


def _around(random: np.random.Generator) -> tuple[Solid, ...]:
    """Return cubes with test charts and thin rods that lean and cross."""
    cubes = []
    for x, y, z, size, color, turn in CUBES:
        cubes.append(
            box((x, y, z + size / 2), (size,) * 3, partial(_chart, size, color), turn + random.uniform(-0.2, 0.2))
        )
    return (*cubes, *(rod(start, end, 0.022, _spiral(first, second, 0.09)) for start, end, first, second in PENCILS))


def _chart(size: float, color: int, points: Floats, normals: Floats) -> Codes:
    """Paint chessboards of four frequencies, rings that grow finer, random dots, a star and a frame on a cube."""
    x, y, z = points / size  # -0.5 to 0.5
    side = y * normals[0] - x * normals[1]
    scale = np.exp2(2 + (side > 0) + 2 * (z > 0)).astype(np.float32)  # 4 to 32 squares a side
    boards = where(_checks(side * scale, z * scale), color, PAPER)
    r = np.hypot(side, z)
    rings = where(_stripes(r * r, 1 / 24) & (r < 0.45), INK, MUSTARD)
    star = where(_stripes(_turns(side, z), 1 / 32) & (r < 0.45), INK, PAPER)
    dots = where(_noise(np.floor(side * 16), np.floor(z * 16), 5) < 0.5, INK, PAPER)
    colors = where(_stripes(np.maximum(np.abs(x), np.abs(y)), 0.1), TEAL, PAPER)
    for normal, positive, negative in ((normals[0], boards, dots), (normals[1], rings, star)):
        colors = where(normal > 0.5, positive, where(normal < -0.5, negative, colors))
    near_ends = sum((np.abs(axis) > 0.47).astype(np.uint8) for axis in (x, y, z))
    return where(near_ends >= 2, color, colors)
