"""A scene on disk and run folders of it, made without training: what the commands after training start from."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from lapgs_plugin.hierarchy.plan import level_size
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import LevelRecord, Manifest, SceneReference
from lapgs_plugin.training.settings import TrainSettings
from tests.training_scene import HEIGHT, WIDTH, blob_field, ring_camera

VIEWS = 10
BACKGROUND = (0.1, 0.2, 0.3)
ITERATIONS = {1: 100, 0: 200}
SECONDS = {1: 3.5, 0: 8.25}
MEMORY = {
    1: {"peak": 3_500_000_000, "images": 500_000_000},
    0: {"peak": 5_000_000_000, "images": 2_000_000_000},
}
MEANS = {1: 130.5, 0: 110.25}
BREAKDOWN = {
    1: {"forward": 0.5, "loss": 0.25, "backward": 1.75, "other": 1.0},
    0: {"forward": 1.5, "loss": 0.5, "backward": 3.25, "other": 3.0},
}


def write_scene(folder: Path, view_names: list[str] | None = None, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    """A transforms scene of ten striped PNGs; with eval, views 0 and 8 are held out."""
    names = view_names or [f"photos/{i:02d}.png" for i in range(VIEWS)]
    width, height = size
    y, x = np.mgrid[:height, :width].astype(np.float64)
    frames = []
    for i, name in enumerate(names):
        camera = ring_camera(2 * math.pi * i / len(names), width, height)
        pose = np.linalg.inv(camera.world_to_camera.double().numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        stripes = [0.5 + 0.4 * np.sin(0.3 * (c + 1) * x + 0.2 * y + i) for c in range(3)]
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.rint(np.stack(stripes[::-1], axis=2) * 255).astype(np.uint8)).save(folder / name)
    values = {"w": width, "h": height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    (folder / "transforms.json").write_text(json.dumps({**values, "frames": frames}))
    return folder


def write_run(
    folder: Path,
    scene: Path,
    *,
    levels: int = 2,
    finished: int | None = None,
    hold_out: bool = True,
    seed: int = 0,
    nested: bool = False,
) -> Path:
    """A run folder of `levels` levels (at most 2), of which the first `finished` are there."""
    settings = TrainSettings(iterations=300, levels=levels, hierarchy="nested" if nested else "laplacian")
    reference = SceneReference(str(scene), "full", hold_out, BACKGROUND, "transforms")
    manifest = Manifest(scene=reference, rasterizer="cpu", **settings.for_manifest())
    with RunArchive.create(folder, manifest) as archive:
        elapsed = 0.0
        for level in list(range(levels - 1, -1, -1))[:finished]:
            signed = not nested and level < levels - 1
            field = blob_field(count=200 + 50 * level, seed=seed + level)
            sh = 0.3 * field.sh if signed else field.sh
            record = LevelRecord(
                level=level,
                signed=signed,
                iterations=ITERATIONS[level],
                num_gaussians=len(field),
                peak_gaussians=len(field) + 7,
                train_seconds=SECONDS[level],
                overhead_seconds={"pyramid": 0.5, "cache": 0.25} if signed else {"pyramid": 0.125},
                image_size=level_size((WIDTH, HEIGHT), level),
                memory_bytes=MEMORY[level],
                mean_gaussians=MEANS[level],
                breakdown_seconds=BREAKDOWN[level],
            )
            for iteration in range(10, ITERATIONS[level] + 1, 10):
                share = iteration / ITERATIONS[level]
                entry = {
                    "level": level,
                    "iteration": iteration,
                    "elapsed": elapsed + share * SECONDS[level],
                    "loss": 0.3 / (1 + 3 * share) + 0.01 * level,
                    "num_gaussians": round(len(field) * (0.5 + share / 2)),
                    "rate": 12.5,
                }
                archive.append_history(
                    {**entry, "psnr": 15.0 + 8 * share - 2 * level} if iteration % 50 == 0 else entry
                )
            elapsed += SECONDS[level]
            archive.finish_level(record, replace(field, sh=sh, signed=signed))
    return folder
