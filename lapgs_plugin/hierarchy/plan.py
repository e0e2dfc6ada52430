"""What is trained when: the stages of a hierarchy. Pure Python, no torch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from fractions import Fraction

from lapgs_plugin.errors import UserInputError

REFERENCE_ITERATIONS = 30_000
"""Iterations of a run that 3DGS's published schedule is made for; shorter runs shrink its constants in proportion."""
REFERENCE_DENSIFY_FROM = 500
"""First densification in that schedule."""

MIN_LEVEL_SIDE = 16
"""Smallest side, in pixels, of a level that is trained: SSIM's window is 11 wide, and a tile 16."""

MOST_LEVELS = 24
"""Images of a hierarchy with more would have over a hundred million pixels a side."""

DEFAULT_SPLITS: dict[int, tuple[Fraction, ...]] = {
    1: (Fraction(1),),
    2: (Fraction(1, 2), Fraction(1, 2)),
    3: (Fraction(1, 3), Fraction(1, 6), Fraction(1, 2)),
    4: (Fraction(1, 3), Fraction(1, 6), Fraction(1, 6), Fraction(1, 3)),
}
"""Share of the iterations of each stage, coarsest first.

Three and four levels are split as in the paper. Its main tables split two levels 1/3, 2/3; its ablation finds halves
better, which is what is taken here.
"""

NESTED_DENSIFY_SHARE = 2 / 3
NESTED_DENSIFY_LEAST = 4000
"""A stage that continues the coarser level's field densifies for this share of the iterations in which it otherwise
would, but for at least as many as the second says, or for all where there are fewer. It has its surfaces, and what it
adds late in a long run costs more time than it is worth; in a short one it is what is missing (fox, 3,000 iterations:
0.4 dB)."""


class Hierarchy(str, Enum):
    """What the field of a level is for, if not of the coarsest."""

    NESTED = "nested"
    """The whole image: the coarser level's field, trained on at the finer size."""
    LAPLACIAN = "laplacian"
    """A signed residual, added to what the coarser fields make: the paper's."""


DEFAULT_HIERARCHY = Hierarchy.LAPLACIAN
"""Default of every command: the paper's method."""


def level_size(size: tuple[int, int], level: int) -> tuple[int, int]:
    """Size (width, height) of a pyramid level: halved `level` times, odd sizes rounded up.

    >>> level_size((1063, 533), 1)
    (532, 267)
    """
    width, height = size
    for _ in range(level):
        width, height = (width + 1) // 2, (height + 1) // 2
    return width, height


@dataclass(frozen=True)
class Stage:
    """One stage of the schedule: which level is trained, at what size, for how long.

    Attributes:
        level: pyramid level; 0 is full resolution, `levels - 1` the coarsest.
        image_size: (width, height) in pixels of this level for an image of the plan's size.
        iterations: optimizer steps of this stage, at least 1.
        signed: True for a residual (raw SH value, zero background), False for the base and where levels are nested.
    """

    level: int
    image_size: tuple[int, int]
    iterations: int
    signed: bool


@dataclass(frozen=True)
class StagePlan:
    """The stages in training order, coarsest first; contiguous and validated.

    Attributes:
        stages: one a level.
        hierarchy: what the fields after the first are for. Where nothing else is said they are residuals, which is what
            a loop of one's own composes (examples/); our commands always say.

    Raises:
        UserInputError: the stages do not run from the coarsest level down to 0, one is too small to train, or one is
            signed that should not be or the reverse.
    """

    stages: tuple[Stage, ...]
    hierarchy: Hierarchy = Hierarchy.LAPLACIAN

    def __post_init__(self) -> None:
        levels = [stage.level for stage in self.stages]
        if levels != list(range(len(levels) - 1, -1, -1)):
            raise UserInputError(f"a plan's levels must run from the coarsest to 0 without gaps, got {levels}")
        for stage in self.stages:
            if stage.iterations < 1:
                raise UserInputError(
                    f"level {stage.level} would train for {stage.iterations} iterations, expected at least 1; "
                    "raise --iterations or change --split"
                )
            if stage.signed != (self.hierarchy is Hierarchy.LAPLACIAN and stage.level != len(levels) - 1):
                raise UserInputError(
                    "exactly the coarsest level is unsigned (the base), all others are residuals; of nested levels all "
                    "are unsigned"
                )
            _require_side(stage.level, len(levels), stage.image_size)

    @property
    def levels(self) -> int:
        return len(self.stages)

    @property
    def iterations(self) -> int:
        return sum(stage.iterations for stage in self.stages)

    def __iter__(self) -> Iterator[Stage]:
        return iter(self.stages)

    def __getitem__(self, level: int) -> Stage:
        """The stage that trains `level`."""
        return self.stages[self.levels - 1 - level]

    @classmethod
    def create(
        cls,
        image_size: tuple[int, int],
        iterations: int,
        levels: int = 2,
        split: Sequence[Fraction] | None = None,
        hierarchy: Hierarchy = Hierarchy.LAPLACIAN,
    ) -> StagePlan:
        """A plan for `levels` levels whose stages share `iterations` as `split` says.

        Args:
            image_size: (width, height) of level 0; with views of several sizes, the smallest.
            iterations: total optimizer steps, at least one a level.
            levels: number of levels L, at least 1.
            split: share of each stage, coarsest first, summing to 1; None takes `DEFAULT_SPLITS`, and for more than
                four levels thirds at both ends with the middle shared evenly.
            hierarchy: what the fields after the first are for.
        """
        if levels < 1:
            raise UserInputError(f"--levels {levels}: expected at least 1")
        # First, as what follows takes time and memory for every level.
        _require_side(levels - 1, levels, level_size(image_size, min(levels - 1, max(image_size).bit_length())))
        if iterations < levels:
            raise UserInputError(f"--iterations {iterations}: expected at least one for each of the {levels} levels")
        if split is None:
            middle = (Fraction(1, 3 * max(levels - 2, 1)),) * (levels - 2)
            split = DEFAULT_SPLITS.get(levels, (Fraction(1, 3), *middle, Fraction(1, 3)))
        if len(split) != levels:
            raise UserInputError(
                f"--split has {len(split)} shares, expected {levels}, one for each of the --levels, coarsest first"
            )
        if any(share <= 0 for share in split) or sum(split) != 1:
            raise UserInputError(
                f"--split {','.join(map(str, split))}: expected positive shares that sum to 1, such as 1/3,2/3"
            )
        ends = [round(iterations * sum(split[: i + 1], Fraction(0))) for i in range(levels)]
        counts = [end - start for start, end in zip([0, *ends[:-1]], ends, strict=True)]
        adds = hierarchy is Hierarchy.LAPLACIAN
        return cls(
            tuple(
                Stage(level, level_size(image_size, level), count, signed=adds and level != levels - 1)
                for level, count in zip(range(levels - 1, -1, -1), counts, strict=True)
            ),
            hierarchy,
        )


def _require_side(level: int, levels: int, size: tuple[int, int]) -> None:
    """Raise a UserInputError about a level that is too small to train."""
    if level > 0 and min(size) < MIN_LEVEL_SIDE:
        raise UserInputError(
            f"level {level} of {levels} would be {size[0]}x{size[1]} pixels, expected at least {MIN_LEVEL_SIDE} on "
            "each side; use fewer --levels or a larger --resolution"
        )


def continues_field(stage: Stage, levels: int) -> bool:
    """Return whether a stage, one of `levels`, continues training the previous level's field."""
    return not stage.signed and stage.level < levels - 1


def nested_densify_until(until: int) -> int:
    """The last iteration in which a field that goes on densifies, where its stage otherwise would until `until`.

    >>> nested_densify_until(7500), nested_densify_until(5000), nested_densify_until(750)
    (5000, 4000, 750)
    """
    return min(until, max(round(NESTED_DENSIFY_SHARE * until), NESTED_DENSIFY_LEAST))
