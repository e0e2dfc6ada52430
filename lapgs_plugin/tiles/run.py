"""Train a run with --tiles: its coarser levels, each tile's finest level in a run of its own, and their merge."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.errors import RunFolderError, UserInputError, counted
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.units import in_unit
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.rendering.run import run_cameras
from lapgs_plugin.runs.archive import Exposures, RunArchive
from lapgs_plugin.runs.layout import TILE, TILES, has_begun, is_run
from lapgs_plugin.runs.manifest import LevelRecord, SceneReference
from lapgs_plugin.scenes.options import SceneOptions
from lapgs_plugin.tiles.grid import TileGrid, has_grid, read_grid
from lapgs_plugin.tiles.options import require_tileable
from lapgs_plugin.tiles.tile import Tile
from lapgs_plugin.tiles.visibility import TileViews, views_of_tile
from lapgs_plugin.tiles.workers import Workers, train_apart
from lapgs_plugin.training.backend import training_rasterizer
from lapgs_plugin.training.checkpoint import check_moments
from lapgs_plugin.training.preparation import Say, TrainRequest, prepare
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.saved_settings import settings_from_manifest
from lapgs_plugin.training.settings import TrainingControl

SHARED = 1
"""The finest level that all tiles share."""
LEAST_VIEWS = 2
"""Training views that a tile needs: fewer show no depth."""

Train = Callable[[PreparedRun, int], None]
"""Trains a run down to a level."""


def train_tiles(
    request: TrainRequest,
    shape: tuple[int, int] | None,
    train: Train,
    say: Say,
    queue: Say | None = None,
    workers: Workers | None = None,
) -> bool:
    """Train a run in tiles, or continue it: what is finished already is left as it is. Return whether it is complete.

    Args:
        request: of the run.
        shape: rows and columns; None chooses them, or takes those of the run that is continued.
        train: trains the base and each tile.
        say: shows a line to the user.
        queue: takes the command of each tile, which is not trained here then; None trains and merges them.
        workers: train tiles at the same time, each in a process of its own; None trains one after the other, here.

    Raises:
        UserInputError: no tile is seen by enough views.
        LapgsError: as `prepare` and `train`; tiles of another run are in its folder.
    """
    out, scene = Path(request.out), Path(request.scene)
    if not request.resume:
        require_tileable(request.settings)
    elif is_run(out) and not has_grid(out):
        raise RunFolderError(
            f"{out} was started without --tiles; leave the option out, or start again with --overwrite"
        )
    with prepare(request, say) as run:
        require_tileable(run.settings)
        if run.settings.extended:
            raise UserInputError(f"{out} is made of tiles, which are not extended; start again with --overwrite")
        grid = _grid(run, shape)
        if run.archive.manifest.complete:
            return True
        say(f"{grid.text} tiles over level {SHARED}")
        train(run, SHARED)
    del run  # and its photos
    tiles = [Tile(out, scene, place) for place in grid]
    if queue is not None:
        for tile in tiles:
            queue(tile.command(request.control))
        return False
    if workers is None:
        for tile in tiles:
            train_tile(tile, tile.folder, request.control, train, say)
    else:
        train_apart(_unfinished(tiles), workers, request.control)
    merge_tiles(out)
    return True


def unfinished_tiles(out: Path, moved_to: Path | None = None) -> list[Tile]:
    """Return the tiles of a run that are still to be trained by their commands, none of a run that is merged.

    Args:
        out: the run, whose base is finished.
        moved_to: current folder of the scene; None if it is where the manifest says.

    Raises:
        RunFolderError: it is not made of tiles or is one of them, its base is not finished, or its scene is missing.
        UserInputError: it is another scene.
    """
    base, grid = RunArchive.open(out), read_grid(out)
    if grid.only is not None:
        raise RunFolderError(f"{out} is a tile of another run; give that one")
    if base.manifest.complete:
        return []
    scene = Path(base.manifest.scene.path) if moved_to is None else moved_to.absolute()
    _require_base(base, scene)
    run_cameras(base, moved_to)  # is refused here once, instead of by the command of each tile
    return _unfinished([Tile(out, scene, place) for place in grid])


def _unfinished(tiles: Sequence[Tile]) -> list[Tile]:
    """Return those tiles that are not trained yet."""
    return [tile for tile in tiles if not (is_run(tile.folder) and RunArchive.open(tile.folder).manifest.complete)]


def train_tile(
    tile: Tile, out: Path, control: TrainingControl, train: Train, say: Say, overwrite: bool = False
) -> bool:
    """Train a tile into a run folder of its own, or continue that; return False if too few views see it.

    Args:
        tile: whose base is finished.
        out: its run folder. A finished one is left as it is.
        control: how it is executed.
        train: trains it.
        say: shows a line to the user.
        overwrite: replace a run in `out`.

    Raises:
        RunFolderError: the base is unfinished, or `out` holds another run.
        LapgsError: as `prepare` and `train`.
    """
    grid = read_grid(tile.base)
    grid.require(tile.place)
    base = RunArchive.open(tile.base)
    _require_base(base, tile.scene)
    begun = not overwrite and is_run(out) and has_begun(out)
    before = _require_tile_of(base, replace(grid, only=tile.place), out) if begun else None
    if before is not None and before.manifest.complete:
        return True
    resumes = before is not None and SHARED in before.available_levels
    shared = base.field(SHARED)
    inside = grid.contains(tile.place, shared.means)
    seen = _views(base, tile, shared, inside, control)
    if sum(name in seen.masks for name in run_cameras(base, tile.scene)[0]) < LEAST_VIEWS:
        say(f"tile {tile.name}: fewer than {LEAST_VIEWS} training views see it, so it keeps level {SHARED}'s field")
        return False
    say(
        f"tile {tile.name} of {grid.text}: {counted(len(seen.masks), 'view')}, {seen.share:.0%} of their pixels; "
        f"alone: {tile.command(control)}"
    )
    settings = settings_from_manifest(base.manifest, str(base.path()))
    photos = _options_of(base.manifest.scene)
    request = TrainRequest(tile.scene, out, settings, photos, control, overwrite=overwrite or begun)
    if resumes:
        request = replace(request, overwrite=False, resume=True, chosen=frozenset())
    with prepare(request, say) as run:
        if not resumes:
            replace(grid, only=tile.place).save(run.archive.path())
            _adopt(run.archive, base, shared, inside | seen.seen)
        train(_seen_by(run, seen), 0)
    return True


def _require_base(base: RunArchive, scene: Path) -> None:
    """Check that a tile of a run can be trained on a scene.

    Raises:
        RunFolderError: the level that tiles share is not finished, or all of them are merged already.
        UserInputError: it is another scene.
    """
    if SHARED not in base.available_levels:
        raise RunFolderError(f"{base.path()}: level {SHARED} is not finished; continue it with --resume first")
    if base.manifest.complete:
        raise RunFolderError(f"{base.path()}: its tiles are merged already; start again with --overwrite")
    before = Path(base.manifest.scene.path)
    if before.exists() and scene.exists() and not before.samefile(scene):
        raise UserInputError(f"{scene}: the run in {base.path()} was started with the scene {before}; give that one")


def _views(base: RunArchive, tile: Tile, shared: GaussianField, inside: Tensor, control: TrainingControl) -> TileViews:
    """Return what the views of a run see of a tile, which has those Gaussians of the shared field that are `inside`."""
    settings = settings_from_manifest(base.manifest, str(base.path()))
    placed = training_rasterizer(
        base.manifest.rasterizer if control.rasterizer == AUTO else control.rasterizer, settings
    )
    train, test = run_cameras(base, tile.scene)
    rasterizer = in_unit(placed.rasterizer, base.manifest.scene.unit)
    cameras: Mapping[str, Camera] = {**train, **test}
    with one_pool():
        return views_of_tile(cameras, shared, inside, rasterizer, placed.device)


def _seen_by(run: PreparedRun, seen: TileViews) -> PreparedRun:
    """Return a run that trains on a tile's views alone."""
    scene = replace(run.scene, train=seen.of(run.scene.train), test=seen.of(run.scene.test))
    return replace(run, scene=scene, aside=seen.of(run.aside), part_of_views=True)


def _grid(run: PreparedRun, shape: tuple[int, int] | None) -> TileGrid:
    """Return the tiles of a run: of a new one those that are asked for, else those that it has."""
    out = run.archive.path()
    if not has_grid(out):
        grid = TileGrid.of(run.scene, shape)
        grid.save(out)
        return grid
    grid = read_grid(out)
    if shape not in (None, grid.shape):
        raise UserInputError(
            f"--tiles {shape[0]}x{shape[1]}: the run in {out} was started with {grid.text}; leave the option out to "
            "continue it, or start again with --overwrite"
        )
    return grid


def _options_of(scene: SceneReference) -> SceneOptions:
    """Return how a run's photos were read."""
    return SceneOptions(
        eval=scene.eval,
        resolution=scene.resolution,
        images=scene.images,
        masks=scene.masks,
        sky=scene.sky,
        background=",".join(map(str, scene.background)),
    )


def _adopt(archive: RunArchive, base: RunArchive, shared: GaussianField, kept: Tensor) -> None:
    """Copy the shared levels into a tile's run, of the finest only some Gaussians: those in the tile and in its views.

    Args:
        archive: of the tile.
        base: the run that has the levels.
        shared: field of level `SHARED`.
        kept: (n,) bool, which of its Gaussians.
    """
    archive.write_vignetting(base.vignetting())
    for level in base.available_levels:
        if level == SHARED:
            moments = base.optimizer_state(SHARED)
            check_moments(moments, shared, base.path())
            field, moments = shared.kept(kept), _rows_of(moments, kept)
        else:
            field, moments = base.field(level), None
        record = replace(base.manifest.record(level), num_gaussians=len(field))
        archive.finish_level(record, field, moments, exposure=base.exposure(level))


def _rows_of(moments: Mapping[str, Mapping[str, Any]], kept: Tensor) -> dict[str, Any]:
    """Return Adam's state of some rows (n,) bool."""
    return {
        name: {key: value if key == "step" else value[kept] for key, value in state.items()}
        for name, state in moments.items()
    }


def _require_tile_of(base: RunArchive, grid: TileGrid, folder: Path) -> RunArchive:
    """Return the run of a tile, if it was made for this base.

    Args:
        base: the run that it is part of.
        grid: that it was made with.
        folder: of its run.

    Raises:
        RunFolderError: it was not.
    """
    tile = RunArchive.open(folder)
    ours, theirs = (
        replace(each.manifest, scene=replace(each.manifest.scene, path="-"), records=(), created="", rasterizer="")
        for each in (base, tile)
    )
    if read_grid(folder) != grid or ours != theirs:
        raise RunFolderError(
            f"{folder} is a tile of another run than {base.path()}: its {TILES}, scene or settings differ; remove it, "
            "or choose another folder"
        )
    return tile


def merge_tiles(out: Path) -> None:
    """Finish a run by the Gaussians that each tile has inside of itself. Tiles that no view sees keep the base's.

    Args:
        out: the run, whose shared levels are finished. All of its tiles that views see are trained.

    Raises:
        UserInputError: no tile is seen by enough views.
        RunFolderError: another process writes to the run, or its tiles are merged already.
    """
    grid = read_grid(out)
    unseen = {place for place in grid if not is_run(out / TILE.format(*place))}
    if len(unseen) == math.prod(grid.shape):
        raise UserInputError(
            f"{out}: fewer than {LEAST_VIEWS} training views see each of its {grid.text} tiles, so that nothing was "
            "trained beyond the base; start again with --overwrite and fewer tiles"
        )
    with RunArchive.open(out, resume=True) as archive:
        shared = archive.field(SHARED)
        parts, records, colors = [], [], []
        for place in grid:
            field = shared
            if place not in unseen:
                tile = _require_tile_of(archive, replace(grid, only=place), out / TILE.format(*place))
                field = tile.field(0)
                records.append(tile.manifest.record(0))
                colors.append(tile.exposure(0) or {})
            parts.append(field.kept(grid.contains(place, field.means)))
        merged = shared.with_parameters(
            {name: torch.cat([part.parameters[name] for part in parts]) for name in shared.parameters}
        )
        archive.finish_level(_record_of(merged, records), merged, exposure=_mean(archive.exposure(SHARED), colors))


def _mean(shared: Exposures | None, of_tiles: Sequence[Exposures]) -> Exposures | None:
    """Return each photo's colour transform: the mean of those that tiles learned, else that of the shared level."""
    if shared is None:
        return None
    learned = {name: [colors[name] for colors in of_tiles if name in colors] for name in shared}
    return {name: np.mean(learned[name] or [own], axis=0).tolist() for name, own in shared.items()}


def _record_of(merged: GaussianField, records: list[LevelRecord]) -> LevelRecord:
    """Return the record of a merged level: seconds of all tiles, one after the other, and Gaussians of the largest."""
    overhead: dict[str, float] = {}
    for record in records:
        for name, seconds in record.overhead_seconds.items():
            overhead[name] = overhead.get(name, 0.0) + seconds
    return replace(
        records[0],
        num_gaussians=len(merged),
        peak_gaussians=max(record.peak_gaussians for record in records),
        train_seconds=sum(record.train_seconds for record in records),
        overhead_seconds=overhead,
        mean_gaussians=None,
        start_gaussians=None,
        breakdown_seconds={},
        gpu_busy_seconds=None,
    )
