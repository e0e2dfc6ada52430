"""Train tiles at the same time, each by a command of its own, and stop all of them together."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lapgs_plugin import interrupt
from lapgs_plugin.errors import LapgsError, one_line
from lapgs_plugin.limits import usable_processors
from lapgs_plugin.progress import item_progress
from lapgs_plugin.runs.layout import TILE_LOG
from lapgs_plugin.tiles.tile import Tile
from lapgs_plugin.training.settings import TrainingControl

POLL = 0.2
"""Seconds between two looks at the running tiles."""


@dataclass(frozen=True)
class Workers:
    """Say on which devices tiles are trained at the same time.

    Attributes:
        devices: CUDA_VISIBLE_DEVICES of each worker; an empty text trains on the CPU.
    """

    devices: tuple[str, ...]

    @classmethod
    def on_gpus(cls, count: int) -> Workers:
        """Return a worker for each of the first GPUs that this process may use."""
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        names = visible.split(",") if visible else [str(index) for index in range(count)]
        return cls(tuple(name.strip() for name in names[:count]))

    @classmethod
    def on_cpus(cls, count: int) -> Workers:
        """Return so many workers on CPUs."""
        return cls(("",) * count)


class TileFailedError(LapgsError):
    """The command of a tile failed."""


@dataclass(frozen=True)
class _Running:
    """Hold a tile in training: its process, and the device that it occupies."""

    tile: Tile
    device: str
    process: subprocess.Popen[bytes]


def train_apart(tiles: Sequence[Tile], workers: Workers, control: TrainingControl) -> None:
    """Train tiles by their commands, as many at a time as there are workers. Finished ones end at once.

    On an error or a signal the running commands get SIGTERM, write their checkpoints, and are waited for. They stop
    by themselves in the same way if this process is killed.

    Args:
        tiles: to train.
        workers: that share them.
        control: how each is executed. Without `threads` the workers share the processors.

    Raises:
        TileFailedError: a command failed.
    """
    free = list(reversed(workers.devices[: len(tiles)]))
    if control.threads is None:
        control = replace(control, threads=max(1, usable_processors() // max(1, len(free))))
    waiting, running = deque(tiles), list[_Running]()
    try:
        with item_progress("tiles") as bar:
            task = bar.add_task("Tiles", total=len(tiles))
            while waiting or running:
                while waiting and free:
                    running.append(_start(waiting.popleft(), free.pop(), control))
                time.sleep(POLL)
                for ended in [one for one in running if one.process.poll() is not None]:
                    running.remove(ended)
                    _require_success(ended)
                    free.append(ended.device)
                    bar.advance(task)
                bar.update(task)
    finally:
        _stop(running)


def _start(tile: Tile, device: str, control: TrainingControl) -> _Running:
    """Start the command of a tile, which writes its output into the tile's folder."""
    tile.folder.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "lapgs_plugin", *tile.words(control), "--resume"]
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": device, interrupt.PARENT: str(os.getpid())}
    with (tile.folder / TILE_LOG).open("ab") as log:
        process = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    return _Running(tile, device, process)


def _require_success(ended: _Running) -> None:
    """Check that a command succeeded.

    Raises:
        TileFailedError: it did not.
    """
    if (code := ended.process.returncode) == 0:
        return
    tile, log = ended.tile, ended.tile.folder / TILE_LOG
    raise TileFailedError(
        f"tile {tile.name} failed ({_last_words(log, code)}); its log is {log}; the other tiles were stopped with "
        "checkpoints; once the cause is mended, the same command with --resume continues"
    )


def _last_words(log: Path, code: int) -> str:
    """Return the last line of a log, or how the command ended if that was by a signal or without a word."""
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f"ended by signal {-code}" if code < 0 else one_line(last.removeprefix("lapgs: ")) or f"exit code {code}"


def _stop(running: Sequence[_Running]) -> None:
    """Stop commands by SIGTERM, and wait until their checkpoints are written."""
    if running:
        interrupt.advise("running tiles have checkpoints; the same command with --resume continues")
    for one in running:
        one.process.terminate()
    for one in running:
        one.process.wait()
