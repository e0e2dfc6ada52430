"""What stands in the sample scene: a still life of test patterns in a round library, in metres, z up.

The objects stand within 2.2 m of the z axis; the cameras (see `cameras.py`) look at them from about 4.6 m, where a
pixel of a 480x320 image covers 9 mm. Nearly every surface has detail of that size: what only the finest level can show.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lapgs_plugin.scenes.sample.shapes import (
    Ball,
    Box,
    Codes,
    Cone,
    Dome,
    Floats,
    Floor,
    Mask,
    Panel,
    Pose,
    Rod,
    Shape,
    Wall,
    dot,
)
from lapgs_plugin.scenes.sample.textures import (
    Print,
    bricks,
    checks,
    chips,
    choose,
    fraction,
    linear_rgb,
    mesh,
    noise,
    pick,
    polar_tiles,
    star,
    stripes,
    turns,
    typeset,
)

HALL_RADIUS = 6.5
WALL_HEIGHT = 3.3
BAYS = 10

PLINTH_HEIGHT = 0.22
COLUMN_TOP = 1.0
GLOBE_HEIGHT = 1.52
MAST_TOP = 2.4

_COLORS: list[str] = []


def _colors(*codes: str) -> tuple[int, ...]:
    """Enter colours into the palette; returns their numbers."""
    _COLORS.extend(codes)
    return tuple(range(len(_COLORS) - len(codes), len(_COLORS)))


INK, PAPER, WHITE, RED, TEAL, MUSTARD, NAVY = _colors(
    "#1d2433", "#f1ead8", "#f5f3ee", "#c8402f", "#1f7a80", "#dba13a", "#22355c"
)
BRASS, WOOD, IRON, STEEL, MORTAR, GREY = _colors("#c79a4b", "#8a5a33", "#2a2d33", "#c9ced2", "#cfc2ab", "#a9a49a")
LAND, HIGHLAND, SEA, DEEP_SEA = _colors("#5d8a4e", "#d8c08a", "#5fa7c4", "#1f5f96")
STONES = _colors("#b9a98e", "#a8977b", "#c7b89f", "#94856c", "#b39b7e")
CHIPS = _colors("#5f5a52", "#e6dcc8", "#8c3f33", "#3c5a5e", "#c9a35a")
CLAYS = _colors("#9c4f3a", "#b0614a", "#8a4534", "#a6583f")
GLASS = _colors("#8ec1de", "#a9d3e6", "#c9e4ee", "#79aed2", "#e8dcae", "#9fcfc0", "#e9eef0", "#d99a86")
NIGHT = _colors("#2c4470", "#263c66", "#20345b", "#1a2b50", "#152445", "#101c3a")
BOOKS = _colors(
    *("#7c2d2a", "#b5523b", "#d9a441", "#3f5d4a", "#23415f", "#5a6f8f", "#e3d7bd", "#4a3a5c", "#8a6a3f", "#2b2b33")
)
PALETTE: Floats = np.stack([linear_rgb(color) for color in _COLORS], axis=1)
"""Linear RGB of the palette's numbers, (3, colours)."""


@dataclass(frozen=True)
class World:
    """All shapes; every ray from inside the hall hits one of them."""

    shapes: tuple[Shape, ...]

    @cached_property
    def balls(self) -> tuple[Floats, Floats, NDArray[np.intp]]:
        """Balls that cover the bounded shapes: centres (3, b), radii (b,), and the index of each one's shape (b,)."""
        bounds = [(index, bound) for index, shape in enumerate(self.shapes) if (bound := shape.bounds())]
        counts = [centres.shape[1] for _, (centres, _) in bounds]
        return (
            np.concatenate([centres for _, (centres, _) in bounds], axis=1),
            np.repeat(np.array([radius for _, (_, radius) in bounds], np.float32), counts),
            np.repeat(np.array([index for index, _ in bounds]), counts),
        )

    @cached_property
    def unbounded(self) -> NDArray[np.intp]:
        """Indices of the shapes of the hall."""
        return np.array([index for index, shape in enumerate(self.shapes) if shape.bounds() is None])


def build_world(seed: int) -> World:
    """The scene; `seed` chooses stones, books, continents and how the small things are turned."""
    random = np.random.default_rng([seed, 1])
    salt = int(random.integers(1 << 16))
    return World((*_hall(salt), *_centrepiece(random), *_around(random)))


def _hall(salt: int) -> tuple[Shape, ...]:
    here = Pose.standing(0, 0, 0)
    dome_radius = float(np.hypot(HALL_RADIUS, WALL_HEIGHT))  # passes through the wall's upper edge
    motto = "blur and halve · double and blur · what remains is detail · add it back · "
    wall = _WallPaint(typeset(8192, 128, [(motto, 104)], "DroidSerif"), salt)

    def paint_floor(points: Floats, normals: Floats) -> Codes:
        joint, ring, tile = polar_tiles(points[0], points[1], ring=0.42, gap=0.018)
        chip, which = chips(points[0], points[1], cell=0.055, salt=salt + 1)
        stone = pick(STONES, noise(ring, tile, salt))
        return choose(joint, INK, choose(chip, pick(CHIPS, fraction(which * 37)), stone))

    def paint_dome(points: Floats, normals: Floats) -> Codes:
        along = turns(points[0], points[1]) * (2 * BAYS)
        rise = np.arcsin(np.clip(normals[2], -1, 1)) * np.float32(1 / 0.22)
        night = pick(NIGHT, np.clip((rise - 2) / 5, 0, np.float32(0.999)))
        shining, which = chips(along, rise, cell=0.25, salt=salt + 2)
        rib = (fraction(along) < 0.08) | (fraction(rise) < 0.06)
        return choose(rib, BRASS, choose(shining & (which < 0.25), PAPER, night))

    return Floor(here, paint_floor), Wall(here, wall, HALL_RADIUS), Dome(here, paint_dome, dome_radius, glows=True)


@dataclass(frozen=True)
class _WallPaint:
    """Bookshelves and stained glass between brick pillars, a line of text above."""

    motto: Print
    salt: int

    def __call__(self, points: Floats, normals: Floats) -> Codes:
        z = points[2]
        along = (turns(points[0], points[1]) + np.float32(0.5)) * BAYS  # in bays
        bay = np.floor(along)
        width = np.float32(2 * np.pi * HALL_RADIUS / BAYS)
        x = (along - bay - np.float32(0.5)) * width  # from the middle of the bay
        above = np.maximum(z - np.float32(1.75), 0)
        arch = np.sqrt(x * x + above * above)  # half the width of the arch through this point
        mortar, row, brick = bricks(along * width, z, length=0.36, height=0.14, gap=0.018)
        colors = choose(mortar, MORTAR, pick(CLAYS, noise(row, brick, self.salt + 3)))
        colors = choose((arch < 1.38) & (z > 0.45), PAPER, colors)
        view = choose(fraction(bay / 2) > 0, _glass(x, z, bay, self.salt), _books(x, z, bay, self.salt))
        colors = choose((arch < 1.3) & (z > 0.53), view, colors)
        colors = choose(z < 0.3, choose(stripes(along, 1 / 36, 0.3), INK, WOOD), colors)
        text = self.motto(fraction(along * np.float32(-2 / BAYS)), (z - np.float32(3.0)) / np.float32(0.26))
        return choose(z > 2.98, choose(text, INK, PAPER), colors)


def _books(x: Floats, z: Floats, bay: Floats, salt: int) -> Codes:
    """Shelves of books whose widths, heights and colours differ."""
    level = z * np.float32(1 / 0.4)
    shelf = np.floor(level)
    height = level - shelf  # 0 to 1 on the shelf
    shelf += bay * 16
    column = x * np.float32(1 / 0.105)
    cell = np.floor(column)
    edge = np.float32(0.3) + np.float32(0.4) * noise(cell, shelf, salt + 4)
    from_edge = column - cell - edge
    book = cell + (from_edge > 0)
    style = noise(book, shelf, salt + 5)
    band = (np.abs(height - np.float32(0.2)) < 0.02) | (np.abs(height - np.float32(0.65)) < 0.02)
    title = (np.abs(height - np.float32(0.42)) < 0.14) & (np.abs(from_edge) > 0.3) & stripes(z, 0.021)
    colors = choose((band & (style > 0.35)) | (title & (style < 0.5)), MUSTARD, pick(BOOKS, fraction(style * 71)))
    top = np.float32(0.68) + np.float32(0.26) * fraction(style * 29)
    colors = choose((height > top) | (np.abs(from_edge) < 0.05), INK, colors)
    return choose(height < 0.07, WOOD, colors)


def _glass(x: Floats, z: Floats, bay: Floats, salt: int) -> Codes:
    """Leaded diamonds, each of one colour, behind two bars."""
    scale = np.float32(0.5**0.5 / 0.2)
    u, v = (x + z) * scale, (x - z) * scale
    pane = pick(GLASS, noise(np.floor(u) + bay * 64, np.floor(v), salt + 6))
    lead = (fraction(u) < 0.1) | (fraction(v) < 0.1)
    bars = (np.abs(x) < 0.035) | (np.abs(z - np.float32(1.75)) < 0.035)
    return choose(bars | lead, IRON, pane)


def _centrepiece(random: np.random.Generator) -> tuple[Shape, ...]:
    """A plinth with a Siemens star; on it a column with a globe in a brass sphere, and a mast held by wires."""
    rim = typeset(8192, 256, [("LAPLACIAN PYRAMID  ·  GAUSSIAN SPLATS  ·  COARSE TO FINE  ·", 200)])

    def paint_plinth(points: Floats, normals: Floats) -> Codes:
        x, y, z = points
        text = rim(fraction(turns(x, y) * 2), (z - np.float32(0.02)) * np.float32(1 / (PLINTH_HEIGHT - 0.04)))
        r = np.sqrt(x * x + y * y)
        ring = (r > 0.97) | (r < 0.27) | (np.abs(r - np.float32(0.62)) < 0.012)
        top = choose(ring, RED, choose(star(x, y, spokes=80), INK, WHITE))
        return choose(normals[2] > 0.5, top, choose(text, MUSTARD, NAVY))

    def paint_column(points: Floats, normals: Floats) -> Codes:
        spiral = points[2] * np.float32(1 / 0.26) + turns(points[0], points[1])
        return choose(stripes(spiral, 1.0), TEAL, choose(stripes(spiral, 0.1, 0.4), RED, PAPER))

    def bands(longitude: Floats, latitude: Floats) -> Mask:
        turn, rise = longitude * np.float32(8 / np.pi), latitude * np.float32(8 / np.pi)
        return stripes(turn + rise, 1.0, 0.1) | stripes(turn - rise, 1.0, 0.1) | (np.abs(latitude) > 1.3)

    globe = Pose.standing(0, 0, GLOBE_HEIGHT)
    feet = [2 * np.pi * (i + 0.25) / 6 for i in range(6)]
    wires = [_wire((0, 0, MAST_TOP), (2.2 * float(np.cos(a)), 2.2 * float(np.sin(a)), 0), 0.006) for a in feet]
    return (
        Rod(Pose.standing(0, 0, 0), paint_plinth, 1.05, PLINTH_HEIGHT),
        Rod(Pose.standing(0, 0, PLINTH_HEIGHT), paint_column, 0.2, COLUMN_TOP - PLINTH_HEIGHT),
        Rod(Pose.standing(0, 0, COLUMN_TOP), _Plain(BRASS), 0.3, 0.05, gloss=0.3),
        Ball(globe, _GlobePaint.by_chance(random), 0.37, gloss=0.5),
        Ball(globe, _Plain(BRASS), 0.5, bands, gloss=0.3),
        Rod(Pose.standing(0, 0, GLOBE_HEIGHT + 0.48), _Spiral(RED, WHITE, 0.08), 0.02, MAST_TOP - GLOBE_HEIGHT - 0.48),
        *wires,
    )


@dataclass(frozen=True)
class _GlobePaint:
    """Continents with sharp coasts under a net of meridians and parallels."""

    waves: Floats  # (w, 3)
    phases: Floats  # (w,)

    @classmethod
    def by_chance(cls, random: np.random.Generator) -> _GlobePaint:
        waves = random.normal(size=(9, 3)) * np.geomspace(2.0, 9.0, 9)[:, None]
        return cls(waves.astype(np.float32), random.uniform(0, 2 * np.pi, 9).astype(np.float32))

    def __call__(self, points: Floats, normals: Floats) -> Codes:
        height = np.zeros_like(normals[0])
        for wave, phase in zip(self.waves, self.phases, strict=True):
            height += np.sin(dot(wave, normals) + phase) * np.float32(1 / np.linalg.norm(wave) ** 0.8)
        rise = np.arcsin(np.clip(normals[2], -1, 1))
        meridians = stripes(turns(normals[0], normals[1]), 1 / 24, 0.05) & (np.abs(rise) < 1.35)
        sea = choose(height > -0.18, SEA, DEEP_SEA)
        ground = choose(height > 0.1, choose(height > 0.55, HIGHLAND, LAND), sea)
        ground = choose(np.abs(height - np.float32(0.1)) < 0.03, PAPER, ground)
        return choose(meridians | stripes(rise, np.pi / 12, 0.05), INK, ground)


def _around(random: np.random.Generator) -> tuple[Shape, ...]:
    """What stands around the plinth, each turned a little by chance."""
    by_chance = [float(turn) for turn in random.uniform(-0.15, 0.15, 7)]
    return (
        Box(Pose.standing(1.4, 1.0, 0.4, 0.5 + by_chance[0]), _ChartPaint.create(0.8), (0.8, 0.8, 0.8)),
        Cone(Pose.standing(-1.5, 0.75, 0.0), _paint_chirp, 0.42, 1.15),
        Ball(Pose.standing(0.1, 1.65, 0.27), _paint_ball, 0.27, gloss=0.6),
        *_fence(0.35 + by_chance[1]),
        *_letter_blocks(by_chance[2:]),
        *_pencils(),
    )


@dataclass(frozen=True)
class _ChartPaint:
    """A cube that carries an eye chart, a Siemens star, random dots and chessboards on its sides."""

    chart: Print
    size: float

    @classmethod
    def create(cls, size: float) -> _ChartPaint:
        large = [("E", 300), ("F P", 190), ("T O Z", 130), ("L P E D", 92), ("P E C F D", 64), ("E D F C Z P", 46)]
        small = [("F E L O P Z D", 32), ("D E F P O T E C", 23), ("L E F O D P C T", 16), ("F D P L T C E O", 11)]
        return cls(typeset(1024, 1200, [*large, *small]), size)

    def __call__(self, points: Floats, normals: Floats) -> Codes:
        x, y, z = points * np.float32(1 / self.size)  # -0.5 to 0.5
        side = y * normals[0] - x * normals[1]
        chart = choose(self.chart(side + np.float32(0.5), z + np.float32(0.5)), INK, WHITE)
        target = choose(star(side, z, spokes=36) & (side * side + z * z < 0.21), INK, MUSTARD)
        dots = choose(noise(np.floor(side * 40), np.floor(z * 40), 5) < 0.5, INK, PAPER)
        scale = 10 * (1 + (side > 0)) * (1 + 3 * (z > 0))  # four sizes: 10 to 80 squares a side
        boards = choose(checks(side * scale, z * scale), RED, WHITE)
        colors = choose(stripes(np.maximum(np.abs(x), np.abs(y)), 0.07), TEAL, PAPER)
        colors = choose(normals[0] > 0.5, chart, choose(normals[0] < -0.5, dots, colors))
        colors = choose(normals[1] > 0.5, target, choose(normals[1] < -0.5, boards, colors))
        near_ends = sum((np.abs(axis) > 0.485).astype(np.uint8) for axis in (x, y, z))
        return choose(near_ends >= 2, NAVY, colors)


def _paint_chirp(points: Floats, normals: Floats) -> Codes:
    """Rings that become finer towards the tip, at z = 1.15."""
    phase = np.log1p(np.maximum(np.float32(1.15) - points[2], 0) * 12)
    return choose(stripes(phase, 0.17), NAVY, choose(stripes(phase, 0.68), WHITE, MUSTARD))


def _paint_ball(points: Floats, normals: Floats) -> Codes:
    rise = np.arcsin(np.clip(normals[2], -1, 1)) * np.float32(6 / np.pi)
    return choose(checks(turns(normals[0], normals[1]) * 12, rise), RED, WHITE)


def _fence(turn: float) -> tuple[Shape, ...]:
    """Chain link between two posts, under a rail."""
    x, y, half, height = -0.8, -1.7, 0.8, 0.85
    dx, dy = half * float(np.cos(turn)), half * float(np.sin(turn))

    def links(u: Floats, v: Floats) -> Mask:
        return mesh(u, v, spacing=0.1, width=0.012)

    left, right = (x - dx, y - dy), (x + dx, y + dy)
    posts = [Rod(Pose.standing(*end, 0.0), _Spiral(INK, MUSTARD, 0.12), 0.03, height + 0.08) for end in (left, right)]
    rail = _wire((*left, height), (*right, height), 0.016)
    return Panel(Pose.standing(x, y, 0.0, turn), _Plain(STEEL), 2 * half, height, links), *posts, rail


def _letter_blocks(by_chance: list[float]) -> tuple[Shape, ...]:
    """Toy blocks that spell the project's command and its field, three below and two above."""
    size, turn = 0.29, 0.62
    places = [(-0.36, 0.0), (0.0, 0.0), (0.36, 0.0), (-0.18, size), (0.18, size)]
    colors = [NAVY, RED, TEAL, MUSTARD, RED]
    blocks = []
    for letter, (along, z), color, extra in zip("PGSLA", places, colors, by_chance, strict=True):
        x, y = 1.15 + along * float(np.cos(turn)), -1.45 + along * float(np.sin(turn))
        pose = Pose.standing(x, y, z + size / 2, turn + extra)
        blocks.append(Box(pose, _BlockPaint(typeset(128, 128, [(letter, 108)]), size, color), (size,) * 3))
    return tuple(blocks)


@dataclass(frozen=True)
class _BlockPaint:
    """A letter on all sides, framed, on ruled paper."""

    letter: Print
    size: float
    color: int

    def __call__(self, points: Floats, normals: Floats) -> Codes:
        x, y, z = points * np.float32(1 / self.size)
        level = np.abs(normals[2])
        u = x * level + y * normals[0] - x * normals[1]
        v = y * level + z * (1 - level)
        ground = choose(stripes(v, 0.083, 0.3), GREY, PAPER)
        inside = np.maximum(np.abs(u), np.abs(v)) < 0.4
        half = np.float32(0.5)
        letter = self.letter(u * np.float32(1.2) + half, v * np.float32(1.2) + half)
        return choose(inside & ~letter, ground, self.color)


def _pencils() -> tuple[Shape, ...]:
    """Thin striped rods that lean and cross."""
    leaning = [((-1.0, 1.55, 0.0), (-1.42, 1.1, 0.95)), ((-1.15, 1.7, 0.0), (-1.6, 1.05, 0.9))]
    crossing = [((1.95, -0.15, 0.0), (1.6, 0.45, 1.15)), ((2.05, 0.2, 0.0), (1.55, 0.35, 1.2))]
    colors = [(RED, WHITE), (TEAL, PAPER), (MUSTARD, INK), (NAVY, WHITE)]
    return tuple(
        Rod(Pose.between(*ends), _Spiral(*pair, 0.06), 0.018, float(np.linalg.norm(np.subtract(*ends))))
        for ends, pair in zip([*leaning, *crossing], colors, strict=True)
    )


def _wire(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> Rod:
    return Rod(Pose.between(start, end), _Plain(IRON), radius, float(np.linalg.norm(np.subtract(end, start))))


@dataclass(frozen=True)
class _Plain:
    color: int

    def __call__(self, points: Floats, normals: Floats) -> Codes:
        return np.full(points.shape[1], self.color, np.uint8)


@dataclass(frozen=True)
class _Spiral:
    """Two colours that wind around the z axis."""

    first: int
    second: int
    period: float

    def __call__(self, points: Floats, normals: Floats) -> Codes:
        winding = points[2] * np.float32(1 / self.period) + turns(points[0], points[1])
        return choose(stripes(winding, 1.0), self.first, self.second)
