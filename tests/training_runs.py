"""Runs of the built-in trainer in a test: start, resume, stop and listen to them."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.ops.composition import to_full_size
from lapgs_plugin.rasterizers.choice import PlacedRasterizer
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.rendering.run import run_renderer
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import Manifest, SceneReference
from lapgs_plugin.scenes.scene import Scene, View
from lapgs_plugin.training.monitor import Monitor, Tick
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.settings import TrainingControl, TrainSettings
from lapgs_plugin.training.trainer import Trainer

RING = SceneReference("ring", "full", True, (0.0, 0.0, 0.0), "colmap")
"""What manifests say of `ring_scene`."""
CONTROL = {each.name for each in fields(TrainingControl)}


def ring_manifest(settings: TrainSettings, rasterizer: str = "cpu", scene: SceneReference = RING) -> Manifest:
    return Manifest(scene=scene, rasterizer=rasterizer, **settings.for_manifest())


def make_archive(path: Path, settings: TrainSettings, rasterizer: str = "cpu") -> RunArchive:
    return RunArchive.create(path, ring_manifest(settings, rasterizer))


def placed(rasterizer: Rasterizer) -> PlacedRasterizer:
    """Place a rasterizer on the CPU."""
    return PlacedRasterizer(rasterizer, torch.device("cpu"), {})


def train(
    path: Path, scene: Scene, settings: TrainSettings, rasterizer: Rasterizer | None = None, **options: Any
) -> RunArchive:
    """Train a new run; `options` are those of `Trainer` and `TrainingControl`."""
    rasterizer = CpuRasterizer() if rasterizer is None else rasterizer
    with make_archive(path, settings, rasterizer.name) as archive:
        _train(scene, settings, archive, rasterizer, options)
    return RunArchive.open(path)


def resume(path: Path, scene: Scene, settings: TrainSettings, **options: Any) -> RunArchive:
    """Train a stopped run to its end."""
    with RunArchive.open(path, resume=True) as archive:
        _train(scene, settings, archive, CpuRasterizer(), options, resumes=True)
    return RunArchive.open(path)


def _train(
    scene: Scene,
    settings: TrainSettings,
    archive: RunArchive,
    rasterizer: Rasterizer,
    options: dict[str, Any],
    **decided: Any,
) -> None:
    control = TrainingControl(**{name: options.pop(name) for name in CONTROL & options.keys()})
    run = PreparedRun.of(scene, settings, archive, placed(rasterizer), control, **decided)
    Trainer(run, **options).run()


def plys(archive: RunArchive) -> list[bytes]:
    """The fields' files, coarsest level first."""
    return [archive.field_path(level).read_bytes() for level in archive.available_levels]


def rendered_gains(archive: RunArchive, views: Sequence[View]) -> list[float]:
    """Return the decibels that the finest level adds to the PSNR of each view, rendered from the run folder."""
    renderer = run_renderer(archive, "cpu")
    gains = []
    for view in views:
        images = renderer.render(view.camera).composed
        whole = {
            level: to_full_size(image, view.camera.size, level, renderer.pyramid) for level, image in images.items()
        }
        gains.append(psnr(whole[0], view.image) - psnr(whole[1], view.image))
    return gains


class StopAt(Monitor):
    """Stop the run, as Ctrl-C does, when a level reaches an iteration."""

    def __init__(self, level: int, iteration: int) -> None:
        self._place = (level, iteration)

    def tick(self, stage: Stage, tick: Tick) -> None:
        if (tick.level, tick.iteration) == self._place:
            signal.raise_signal(signal.SIGINT)


class Said(Monitor):
    """Keep the lines that a run says."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        self.lines.append(text)
