"""Small runs that several ranks train, or one process that makes the same sums. As a program this is one of the ranks.

RANK=0 WORLD_SIZE=2 ... python -m tests.ranks FOLDER WORD...

It trains all cases into the folder, then one whose fields differ, and runs `lapgs` with the words.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.cli.app import run
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.ranks.archive import open_for
from lapgs_plugin.training.ranks.equality import RanksDifferError
from lapgs_plugin.training.ranks.group import Ranks, joined
from lapgs_plugin.training.settings import Densification, TrainingControl, TrainSettings
from lapgs_plugin.training.strategies import Gradients, Mcmc, Multiview
from lapgs_plugin.training.trainer import Trainer
from tests.training_runs import placed, ring_manifest
from tests.training_scene import blob_field, ring_scene

STARTED_ON = 2
"""Ranks that all these runs are started on."""
DIFFERENT = "different"
"""Folder of the run of ranks whose fields differ."""
PHOTOS = 13
"""Training photos, the last of which have shards to themselves in an epoch."""


def plain_scene() -> Scene:
    return ring_scene(train=PHOTOS)


def masked_scene() -> Scene:
    """The scene with sky in the upper part of every second photo, outside of its mask."""
    scene = plain_scene()
    inside = torch.ones(1, *scene.train[0].image.shape[1:], dtype=torch.bool)
    inside[:, :12] = False
    views = [replace(view, mask=inside, sky=~inside) if index % 2 else view for index, view in enumerate(scene.train)]
    return replace(scene, train=tuple(views))


def mixed_scene() -> Scene:
    """The scene with photos of two sizes."""
    small, large = ring_scene(train=PHOTOS, size=(40, 56)), plain_scene()
    views = zip(small.train, large.train, strict=True)
    return replace(large, train=tuple(pair[index % 2] for index, pair in enumerate(views)))


def settings(strategy: Any, name: str, **values: Any) -> TrainSettings:
    density = Densification(strategy=name, options=strategy, start=4, until=40, every=8)
    defaults = {"iterations": 40, "sh_degree": 1, "levels": 2, "sh_every": 12, "accumulate_views": 4}
    return TrainSettings(densification=density, ranks=STARTED_ON, **{**defaults, **values})


CASES: dict[str, tuple[Callable[[], Scene], TrainSettings]] = {
    "laplacian": (plain_scene, settings(Gradients(), "3dgs", hierarchy="laplacian", joint=0.5)),
    "nested": (plain_scene, settings(Mcmc(cap_max=150), "mcmc", hierarchy="nested", appearance="affine", dropout=0.3)),
    "masks": (
        masked_scene,
        settings(Mcmc(cap_max=150), "mcmc", hierarchy="laplacian", joint=0.5, appearance="bilateral", keep="best"),
    ),
    "mixed sizes": (mixed_scene, settings(Multiview(), "multiview", levels=1, prune=0.02)),
    "poses": (plain_scene, settings(Gradients(), "3dgs", levels=1, refine_poses=True, keep="best")),
}


def train(path: Path, name: str, ranks: Ranks, **decided: Any) -> None:
    """Train a case into a new folder; `decided` are further arguments of `PreparedRun.of`."""
    make, asked = CASES[name]
    with open_for(ranks, path, lambda kind: kind.create(path, ring_manifest(asked))) as archive:
        control = TrainingControl(test_every=20)
        prepared = PreparedRun.of(make(), asked, archive, placed(CpuRasterizer()), control, ranks=ranks, **decided)
        Trainer(prepared).run()


def start(module: str, words: Sequence[Sequence[object]]) -> list[subprocess.Popen[str]]:
    """Start a module as ranks of this machine, as torchrun's agent does, each with arguments of its own."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    size = str(len(words))
    shared = {"MASTER_ADDR": "localhost", "MASTER_PORT": str(port), "TORCHELASTIC_RUN_ID": "test"}
    shared |= {"TORCH_CPP_LOG_LEVEL": "FATAL"}  # as the command line sets it, before `tests.ranks` imports torch
    shared |= {"WORLD_SIZE": size, "LOCAL_WORLD_SIZE": size, "OMP_NUM_THREADS": "1"}
    return [
        subprocess.Popen(
            [sys.executable, "-m", module, *map(str, own)],
            env={**os.environ, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank, own in enumerate(words)
    ]


def main() -> None:
    """Be one of the ranks."""
    folder, *words = sys.argv[1:]
    ranks = joined()
    for name in CASES:
        train(Path(folder) / name, name, ranks)
    try:
        train(Path(folder) / DIFFERENT, "poses", ranks, first_field=blob_field(seed=ranks.rank))
    except RanksDifferError as error:
        print(error, flush=True)
    ranks.close()
    sys.argv[1:] = words
    run()


if __name__ == "__main__":
    main()
