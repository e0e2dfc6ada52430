"""Name a tile of a run, and the command that trains it alone."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.runs.layout import TILE
from lapgs_plugin.training.settings import TrainingControl


@dataclass(frozen=True)
class Tile:
    """Name a tile of a run.

    Attributes:
        base: folder of the run whose coarser levels it shares.
        scene: folder of the scene, now.
        place: row and column.
    """

    base: Path
    scene: Path
    place: tuple[int, int]

    @property
    def folder(self) -> Path:
        """Where its run is expected."""
        return self.base / TILE.format(*self.place)

    @property
    def name(self) -> str:
        """Row and column as --tile takes them."""
        return f"{self.place[0]},{self.place[1]}"

    def words(self, control: TrainingControl) -> list[str]:
        """Return the arguments of `lapgs` that train it alone, executed as its base is."""
        words = ["train", str(self.scene), "--tile", self.name, "--base", str(self.base), "-o", str(self.folder)]
        chosen = {
            "--rasterizer": None if control.rasterizer == AUTO else control.rasterizer,
            "--threads": control.threads,
            "--checkpoint-every": control.checkpoint_every,
            "--log": control.log,
            "--test-every": control.test_every,
        }
        flags = {"--breakdown": control.breakdown, "--gpu-busy": control.gpu_busy}
        words += [word for name, value in chosen.items() if value is not None for word in (name, str(value))]
        return words + [name for name, wanted in flags.items() if wanted]

    def command(self, control: TrainingControl) -> str:
        """Return the command that trains it alone, for a shell."""
        return shlex.join(["lapgs", *self.words(control)])
