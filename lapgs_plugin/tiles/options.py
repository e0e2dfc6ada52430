"""Declare the options of tiles. Imports no torch."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.settings import AUTO, BILATERAL
from lapgs_plugin.options import option, option_values
from lapgs_plugin.scenes.options import SceneOptions
from lapgs_plugin.training.settings import BEST, TrainSettings

PANEL = "Tiles"
MOST_TILES = 1024


@dataclass(frozen=True)
class TileOptions:
    """Choose whether a run is trained as tiles, or is one of another run's tiles.

    Raises:
        UserInputError: a value cannot be read, or two options contradict each other.
    """

    tiles: str | None = option(
        None,
        "Train the coarser levels once, then the finest one in tiles of the scene's ground, one after the other or on "
        "--gpus at the same time, and merge them into one run: RxC, rows and columns, the longer side of the scene cut "
        "into columns; auto, by the number of photos. With --hierarchy nested; see `lapgs help scale`.",
        panel=PANEL,
        metavar="RxC",
    )
    tile: str | None = option(
        None,
        "Train only this tile, R,C counted from 0, of the run in --base, with the options of that run.",
        panel=PANEL,
        metavar="R,C",
    )
    base: Path | None = option(None, "Run with --tiles whose coarser levels are finished.", panel=PANEL)

    only_base: bool = option(
        False,
        "End after the coarser levels of --tiles and print the command of each tile on a line, on stdout, for "
        "a queue or other machines; --resume trains those that are missing and merges all. `lapgs bench tiles` does "
        "both on Slurm or Ray.",
        panel=PANEL,
    )

    def __post_init__(self) -> None:
        if self.only_base and self.tiles is None:
            raise UserInputError("--only-base without --tiles: give both, or leave it out")
        if self.tiles is not None:
            _ = self.shape
            if self.tile is not None:
                raise UserInputError(f"--tiles {self.tiles} with --tile {self.tile}: give one of them")
        if self.tile is not None:
            _ = self.place
        if (self.tile is None) != (self.base is None):
            given, other = ("--base", "--tile R,C") if self.tile is None else ("--tile", "--base RUN")
            raise UserInputError(f"{given} without {other}: give both")

    @property
    def asked(self) -> str | None:
        """The option that asks for tiles, for messages; None without."""
        return "--tiles" if self.tiles is not None else "--tile" if self.tile is not None else None

    @property
    def shape(self) -> tuple[int, int] | None:
        """Rows and columns; None for auto."""
        assert self.tiles is not None
        if self.tiles == AUTO:
            return None
        match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", self.tiles)
        rows, columns = (int(match[1]), int(match[2])) if match else (0, 0)
        if not 1 <= rows * columns <= MOST_TILES:
            raise UserInputError(
                f"--tiles {self.tiles}: expected auto or RxC, rows and columns from 1 on and at most {MOST_TILES} "
                "tiles, such as 2x3"
            )
        return rows, columns

    @property
    def place(self) -> tuple[int, int]:
        """Row and column of the tile."""
        assert self.tile is not None
        match = re.fullmatch(r"([0-9]{1,4}),([0-9]{1,4})", self.tile)
        if match is None:
            raise UserInputError(f"--tile {self.tile}: expected R,C, row and column from 0 on, such as 0,1")
        return int(match[1]), int(match[2])


def require_tileable(settings: TrainSettings) -> None:
    """Refuse settings that tiles do not have.

    Raises:
        UserInputError: one level, residuals, or something that tiles would have to agree on while they train.
    """
    if settings.levels == 1:
        raise UserInputError("--tiles with --levels 1: tiles share a coarser level; give --levels 2 or more")
    if not settings.nested:
        raise UserInputError(
            "--tiles with --hierarchy laplacian: residuals need their base to be trained along, and tiles share one "
            "that stays as it is; add --hierarchy nested"
        )
    if settings.time is not None:
        raise UserInputError(f"--time {settings.time} with --tiles: is the length of one run; give --iterations")
    if settings.stops_early:
        raise UserInputError("--stop auto with --tiles: a tile sees parts of its views; give --iterations alone")
    if settings.distorted:
        raise UserInputError("--distorted with --tiles: what views see of a tile is that of pinholes; leave one out")
    if settings.refine_poses:
        raise UserInputError("--refine-poses with --tiles: tiles would move the same cameras apart; leave one out")
    if settings.appearance == BILATERAL:
        raise UserInputError("--appearance bilateral with --tiles: grids would drift apart; give auto, affine or none")
    if settings.keep == BEST:
        raise UserInputError("--keep best with --tiles: a tile sees parts of its views; leave it out")


def require_options_of_base(chosen: frozenset[str], base: Path) -> None:
    """Refuse options of a single tile that its base run has decided.

    Args:
        chosen: parameters that the user chose.
        base: folder of the base run.
    """
    decided = {**option_values(TrainSettings()), **{each.name: None for each in fields(SceneOptions)}}
    if others := sorted(chosen & decided.keys()):
        name = others[0].replace("_", "-")
        raise UserInputError(f"--{name} with --tile: a tile has the options of its base, {base}; leave it out")
