"""Divide a scene's ground into tiles."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from pydantic import Field, FiniteFloat, NonNegativeInt
from torch import Tensor

from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.files import is_file, write_text
from lapgs_plugin.rendering.rig import Rig, camera_positions
from lapgs_plugin.runs.layout import TILES
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.untrusted import STRICT, read_json

VIEWS_OF_A_TILE = 400
"""Training views for which --tiles auto makes a tile."""
NEAR = 2.0
"""Points up to this far from the middle of the cameras, in distances of the outermost camera, share out the ground."""

Axis = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Cuts = Annotated[tuple[FiniteFloat, ...], Field(max_length=1024)]


@dataclass(frozen=True)
class TileGrid:
    """Divide the world into rows and columns of tiles, which have no height and, at the edge, no end.

    Attributes:
        across: unit vector along the longer side of the scene, which columns divide.
        along: unit vector on the ground that rows divide.
        row_cuts: positions along `along` between the rows, ascending.
        column_cuts: of each row, positions along `across` between its tiles, ascending.
        only: row and column of the tile that a run trains; None for a run of all tiles.

    Raises:
        UserInputError: rows have different numbers of tiles, or there are not as many rows as the cuts make.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    across: Axis
    along: Axis
    row_cuts: Cuts
    column_cuts: Annotated[tuple[Cuts, ...], Field(min_length=1, max_length=1024)]
    only: tuple[NonNegativeInt, NonNegativeInt] | None = None

    def __post_init__(self) -> None:
        columns = {len(cuts) for cuts in self.column_cuts}
        if len(columns) != 1 or len(self.column_cuts) != len(self.row_cuts) + 1:
            raise UserInputError(
                f"{len(self.row_cuts)} cuts between {len(self.column_cuts)} rows of {sorted(columns)} cuts, expected "
                "one less than the rows, and as many in each row"
            )

    @classmethod
    def of(cls, scene: Scene, shape: tuple[int, int] | None) -> TileGrid:
        """Divide a scene so that tiles have about as many sparse points.

        Args:
            scene: its training cameras say where the ground is, and which points are near.
            shape: rows and columns; None chooses them by the number of training views.
        """
        cameras = [view.camera for view in scene.train]
        centres, up = camera_positions(cameras), Rig.of(cameras).up
        middle = centres.mean(axis=0)
        flat = centres - middle
        flat = flat - np.outer(flat @ up, up)
        across = np.linalg.svd(flat, full_matrices=False)[2][0]
        along = np.cross(up, across)
        along /= np.linalg.norm(along)
        shape = shape or _shape_for(len(cameras), float(np.std(flat @ across)), float(np.std(flat @ along)))
        points = scene.points.double().numpy()
        distances = np.linalg.norm(points - middle, axis=1)
        near = points[distances <= NEAR * np.linalg.norm(centres - middle, axis=1).max()]
        points = near if len(near) >= math.prod(shape) else points
        row_cuts = _quantiles(points @ along, shape[0])
        rows = np.searchsorted(row_cuts, points @ along, side="right")
        column_cuts = [_quantiles(points[rows == row] @ across, shape[1]) for row in range(shape[0])]
        return cls(_axis(across), _axis(along), tuple(row_cuts), tuple(map(tuple, column_cuts)))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return len(self.column_cuts), len(self.column_cuts[0]) + 1

    @property
    def text(self) -> str:
        """Rows and columns as --tiles takes them."""
        return f"{self.shape[0]}x{self.shape[1]}"

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """Yield the row and the column of each tile."""
        rows, columns = self.shape
        return ((row, column) for row in range(rows) for column in range(columns))

    def contains(self, tile: tuple[int, int], points: Tensor) -> Tensor:
        """Return which of the points (n, 3) a tile has, (n,) bool. Each point is in exactly one tile."""
        row, column = tile
        places = points.detach().cpu().double()
        rows = _part(places, self.along, self.row_cuts)
        columns = _part(places, self.across, self.column_cuts[row])
        return (rows == row) & (columns == column)

    def require(self, tile: tuple[int, int]) -> None:
        """Raise a UserInputError about a tile that is not of the grid."""
        rows, columns = self.shape
        if tile[0] >= rows or tile[1] >= columns:
            raise UserInputError(
                f"--tile {tile[0]},{tile[1]}: the run has {self.text} tiles, expected at most {rows - 1},{columns - 1}"
            )

    def save(self, folder: Path) -> None:
        """Write the grid into a run folder."""
        write_text(folder / TILES, json.dumps(asdict(self), indent=2) + "\n", training=True)


def has_grid(folder: Path) -> bool:
    """Return whether a run is made of tiles, or is one."""
    return is_file(folder / TILES)


def read_grid(folder: Path) -> TileGrid:
    """Read the grid of a run that is made of tiles.

    Raises:
        RunFolderError: it is not made of tiles, or the file is damaged.
    """
    if not has_grid(folder):
        raise RunFolderError(f"{folder} is no run with --tiles (it has no {TILES}); give the one that has the base")
    grid: TileGrid = read_json(
        folder / TILES, TileGrid, error=RunFolderError, advice="restore it or train again with --overwrite"
    )
    return grid


def _shape_for(views: int, wide: float, high: float) -> tuple[int, int]:
    """Return rows and columns for so many training views, whose cameras vary so much along both sides."""
    count = math.ceil(views / VIEWS_OF_A_TILE)
    rows = max(1, min(count, round(math.sqrt(count * high / wide)))) if wide > 0 else 1
    return rows, math.ceil(count / rows)


def _quantiles(positions: np.ndarray[Any, Any], parts: int) -> list[float]:
    """Return the positions between equal parts, ascending."""
    if len(positions) == 0:
        return [0.0] * (parts - 1)
    return [float(cut) for cut in np.quantile(positions, [part / parts for part in range(1, parts)])]


def _part(points: Tensor, axis: Axis, cuts: tuple[float, ...]) -> Tensor:
    """Return between which cuts along an axis points (n, 3) lie, (n,)."""
    positions = points @ torch.tensor(axis, dtype=points.dtype)
    return torch.searchsorted(torch.tensor(cuts, dtype=points.dtype), positions, right=True)


def _axis(vector: np.ndarray[Any, Any]) -> Axis:
    x, y, z = (float(number) for number in vector)
    return x, y, z
