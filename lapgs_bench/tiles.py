"""Train the tiles of a run by the workers of experiments, and merge them. Imports more than a help text may."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lapgs_bench.experiments.commands import LAPGS, Step
from lapgs_bench.experiments.execution import follow
from lapgs_bench.experiments.launchers import check_launcher
from lapgs_bench.experiments.settings import WorkerSettings
from lapgs_bench.experiments.store import FAILED, Job, Outcome
from lapgs_plugin.cli.train import show_finished
from lapgs_plugin.errors import counted
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import JOBS, TILE_LOG
from lapgs_plugin.tiles.run import merge_tiles, unfinished_tiles
from lapgs_plugin.tiles.tile import Tile
from lapgs_plugin.tiles.workers import TileFailedError
from lapgs_plugin.training.backend import choose_rasterizer
from lapgs_plugin.training.settings import TrainingControl


def train_tiles(run: Path, moved_to: Path | None, engine: WorkerSettings, control: TrainingControl) -> None:
    """Run what the help of `lapgs bench tiles` says."""
    check_launcher(engine)
    if control.rasterizer != AUTO:  # which each worker chooses for its machine
        choose_rasterizer(control.rasterizer)
    run = run.absolute()  # workers may have other current folders
    tiles = unfinished_tiles(run, moved_to)
    if tiles:
        if engine.workers is not None:  # more would share the processors of this machine out in vain
            engine = replace(engine, workers=min(engine.workers, len(tiles)))
        jobs = [_job(tile, control) for tile in tiles]
        _require_success(follow(jobs, run / JOBS, engine, "tiles", _summary, repeat=True))
    manifest = RunArchive.open(run).manifest
    if not manifest.complete:  # by an earlier command, or by another one that waited for the same tiles
        merge_tiles(run)
    show_finished(run, moved_to or Path(manifest.scene.path))


def _job(tile: Tile, control: TrainingControl) -> Job:
    """Return the job that trains a tile, or continues it."""
    command = (*LAPGS, *tile.words(control), "--resume")
    log = tile.folder / TILE_LOG
    return Job(f"tile {tile.name}", None, str(tile.folder), str(log), (Step(command, str(tile.base)),), False, "{}")


def _summary(record: dict[str, float]) -> str:
    return f"{record['wall_seconds']:.1f} s"


def _require_success(outcomes: Sequence[Outcome]) -> None:
    """Check that all tiles are trained.

    Raises:
        TileFailedError: one failed.
    """
    failed = [outcome for outcome in outcomes if outcome.state == FAILED]
    if not failed:
        return
    how, *log = failed[0].error.split("\n")
    words = f"{how}: {log[-1].removeprefix('lapgs: ')}" if log else how
    raise TileFailedError(
        f"{len(failed)} of {counted(len(outcomes), 'tile')} failed, the first is {failed[0].run_id} ({words}); the "
        "others are kept; once the cause is mended, the same command continues"
    )
