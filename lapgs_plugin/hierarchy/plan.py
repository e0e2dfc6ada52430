"""Plan the stages of a hierarchy: the level that each trains, its size, its iterations. Imports no torch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from fractions import Fraction

from lapgs_plugin.errors import UserInputError

REFERENCE_ITERATIONS = 30_000
"""Iterations of a run that 3DGS's published schedule is made for; shorter runs shrink its constants in proportion."""
REFERENCE_DENSIFY_FROM = 500
"""First densification in that schedule."""

MIN_LEVEL_SIDE = 16
"""Smallest side of a trained level in pixels: SSIM's window is 11 pixels wide, a tile 16."""

MOST_LEVELS = 24
"""Most levels of a hierarchy; with more, images would have over a hundred million pixels a side."""

DEFAULT_SPLITS: dict[int, tuple[Fraction, ...]] = {
    1: (Fraction(1),),
    2: (Fraction(1, 2), Fraction(1, 2)),
    3: (Fraction(1, 3), Fraction(1, 6), Fraction(1, 2)),
    4: (Fraction(1, 3), Fraction(1, 6), Fraction(1, 6), Fraction(1, 3)),
}
"""Share of each stage in the iterations, coarsest first, by number of levels.

For two levels the paper's ablation finds halves better than the 1/3, 2/3 of its main tables; three and four levels are
split as in the paper.
"""

NESTED_DENSIFY_SHARE = 2 / 3
"""Share of the usual iterations in which a stage densifies that continues the coarser level's field. Its surfaces exist
already, so late densification costs more time than it gains."""
NESTED_DENSIFY_LEAST = 4000
"""Least number of these iterations, or all of them if there are fewer: a short run needs its late densification."""


class Hierarchy(str, Enum):
    """Choose the image that the field of each level but the coarsest represents."""

    NESTED = "nested"
    """The whole image: the coarser level's field, trained further at the finer size."""
    LAPLACIAN = "laplacian"
    """A signed residual, added to the upsampled image of the coarser fields: the paper's."""

    @classmethod
    def _missing_(cls, value: object) -> Hierarchy:
        """Raise a UserInputError about a value that is none of them."""
        raise UserInputError(f"--hierarchy {value}: expected {' or '.join(each.value for each in cls)}")


DEFAULT_HIERARCHY = Hierarchy.LAPLACIAN
"""Default of every command: the paper's method."""


def level_size(size: tuple[int, int], level: int) -> tuple[int, int]:
    """Return the size of a pyramid level: that of level 0, halved `level` times, odd sizes rounded up.

    The sides are independent, so a size given height first is returned height first.

    >>> level_size((1063, 533), 1)
    (532, 267)

    Raises:
        UserInputError: a negative level.
    """
    if level < 0:
        raise UserInputError(f"level {level}: expected 0, the full size, or more")
    width, height = size
    for _ in range(level):
        width, height = (width + 1) // 2, (height + 1) // 2
    return width, height


@dataclass(frozen=True)
class Stage:
    """Describe one stage: the level that is trained, its size, its iterations.

    Attributes:
        level: pyramid level; 0 is full resolution, `levels - 1` the coarsest.
        image_size: (width, height) in pixels of this level for an image of the plan's size.
        iterations: of this stage, one for each view that it trains on; at least 1.
        signed: True for a residual (raw SH value, zero background), False for the base and for nested levels.
    """

    level: int
    image_size: tuple[int, int]
    iterations: int
    signed: bool


@dataclass(frozen=True)
class StagePlan:
    """List the stages of a run in training order, coarsest first.

    Attributes:
        stages: one per level.
        hierarchy: the kind of the fields after the first. Residuals are the default of custom training loops
            (examples/); our commands always pass it.

    Raises:
        UserInputError: the levels do not run from the coarsest down to 0, a stage has no iterations or is too small to
            train, or `signed` does not fit the hierarchy.
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
        """Number of levels L, one for each stage."""
        return len(self.stages)

    @property
    def iterations(self) -> int:
        """Iterations of all stages together."""
        return sum(stage.iterations for stage in self.stages)

    def lasting(self, level: int, iterations: int) -> StagePlan:
        """Return the plan whose stage of a level has so many iterations, and those of finer levels in proportion.

        >>> [stage.iterations for stage in StagePlan.create((64, 48), 900, 3).lasting(1, 300)]
        [300, 300, 900]
        """
        factor = Fraction(iterations, self[level].iterations)

        def length(stage: Stage) -> int:
            if stage.level == level:
                return iterations
            return stage.iterations if stage.level > level else max(1, round(stage.iterations * factor))

        return replace(self, stages=tuple(replace(stage, iterations=length(stage)) for stage in self))

    def iterations_before(self, level: int) -> int:
        """Return the iterations of all stages before that of a level."""
        return sum(stage.iterations for stage in self.stages if stage.level > level)

    def __iter__(self) -> Iterator[Stage]:
        return iter(self.stages)

    def __getitem__(self, level: int) -> Stage:
        """Return the stage that trains `level`.

        Raises:
            IndexError: there is none; a negative level does not count from the end.
        """
        if not 0 <= level < self.levels:
            raise IndexError(f"level {level}, expected 0 to {self.levels - 1}")
        return self.stages[self.levels - 1 - level]

    @classmethod
    def create(
        cls,
        image_size: tuple[int, int],
        iterations: int,
        levels: int = 2,
        split: Sequence[Fraction] | None = None,
        hierarchy: Hierarchy | str = Hierarchy.LAPLACIAN,
    ) -> StagePlan:
        """Make a plan of `levels` levels whose stages share `iterations` by `split`.

        Args:
            image_size: (width, height) of level 0; the smallest if views differ in size.
            iterations: of all stages, one for each view, at least one a level; a step may take several.
            levels: number of levels L, at least 1.
            split: share of each stage, coarsest first, summing to 1. None takes `DEFAULT_SPLITS`; with more than four
                levels, the first and last stage get a third each and the others share the rest evenly.
            hierarchy: the kind of the fields after the first, also by name: "laplacian" or "nested".

        Raises:
            UserInputError: an image without pixels, fewer iterations than levels, shares that are not one positive
                number per level or do not sum to 1, a level too small to train, or an unknown hierarchy.
        """
        hierarchy = Hierarchy(hierarchy)
        if len(image_size) != 2 or min(image_size) < 1:
            raise UserInputError(f"image size {tuple(image_size)}: expected (width, height) in pixels")
        if levels < 1:
            raise UserInputError(f"--levels {levels}: expected at least 1")
        # Checked first: the rest takes time and memory for every level.
        _require_side(levels - 1, levels, level_size(image_size, min(levels - 1, max(image_size).bit_length())))
        if iterations < levels:
            raise UserInputError(f"--iterations {iterations}: expected at least one for each of the {levels} levels")
        if split is None:
            middle = (Fraction(1, 3 * max(levels - 2, 1)),) * (levels - 2)
            split = DEFAULT_SPLITS.get(levels, (Fraction(1, 3), *middle, Fraction(1, 3)))
        require_shares(split, levels)
        ends = [round(iterations * sum(split[: i + 1], Fraction(0))) for i in range(levels)]
        counts = [end - start for start, end in zip([0, *ends[:-1]], ends, strict=True)]
        residuals = hierarchy is Hierarchy.LAPLACIAN
        return cls(
            tuple(
                Stage(level, level_size(image_size, level), count, signed=residuals and level != levels - 1)
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


def require_shares(split: Sequence[Fraction], levels: int) -> None:
    """Raise a UserInputError unless `split` has a positive share for each level, which sum to 1."""
    if len(split) != levels:
        raise UserInputError(
            f"--split has {len(split)} shares, expected {levels}, one for each of the --levels, coarsest first"
        )
    if any(share <= 0 for share in split) or sum(split) != 1:
        raise UserInputError(
            f"--split {','.join(map(str, split))}: expected positive shares that sum to 1, such as 1/3,2/3"
        )


def continues_field(stage: Stage, levels: int) -> bool:
    """Return whether a stage, one of `levels`, continues training the previous level's field."""
    return not stage.signed and stage.level < levels - 1


def nested_densify_until(until: int) -> int:
    """Return the last iteration of densification of a continued field, whose stage would otherwise densify to `until`.

    >>> nested_densify_until(7500), nested_densify_until(5000), nested_densify_until(750)
    (5000, 4000, 750)
    """
    return min(until, max(round(NESTED_DENSIFY_SHARE * until), NESTED_DENSIFY_LEAST))
