"""Make small experiments, and jobs that copy a run folder instead of training."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from lapgs_bench.experiments.commands import Step
from lapgs_bench.experiments.expansion import RunSpec
from lapgs_bench.experiments.store import Job
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import LevelRecord, Manifest, SceneReference

RAY_WARNS = pytest.mark.filterwarnings(
    "ignore:Tip. In future versions of Ray:FutureWarning",
    "ignore::pytest.PytestUnraisableExceptionWarning",  # about processes that it leaves to themselves
)
"""Mark of a test that starts a cluster of Ray. It needs Ray: pip install 'lapgs_plugin[ray]'."""

SMALL: dict[str, Any] = {
    "name": "small",
    "title": "Small",
    "iterations": 40,
    "seeds": [0, 1],
    "scenes": [{"name": "a", "path": "a"}, {"name": "b", "path": "b"}],
    "backbones": {"cpu": {"rasterizer": "cpu"}, "fast": {"checkout": "fastgs", "preset": "fastgs.big"}},
    "variants": [
        {"name": "bare", "method": "bare", "baseline": True},
        {"name": "two levels", "options": {"levels": 2}},
        {"name": "fast alone", "backbones": ["fast"], "options": {"levels": 3}, "arguments": ["--dense", "0.1"]},
    ],
}

START = "import pathlib, shutil, sys, time; out, started, source, seconds = sys.argv[1:]; "
COPY = (
    START + "stream = open(started, 'a'); stream.write(pathlib.Path(out).name + '\\n'); stream.close(); "
    "time.sleep(float(seconds)); shutil.copytree(source, out)"
)
"""Trains by copying. Arguments: out, a file that gets a line for every start, the folder to copy, seconds to take."""


def run_spec(number: int = 0, **changes: Any) -> RunSpec:
    values: dict[str, Any] = {
        **{"scene": "a", "dataset": "", "images": "images", "resolution": "full", "backbone": "cpu"},
        **{"rasterizer": "cpu", "checkout": None, "method": "hierarchy", "iterations": 10, "seed": number},
        **{"options": {"levels": 2}, "arguments": []},
    }
    return RunSpec(**{**values, **changes})


def tiny_run(folder: Path, psnr: float = 20.0) -> Path:
    """Write a complete, evaluated run folder of two levels with a few Gaussians."""
    scene = SceneReference("/nowhere", "full", True, (0.0, 0.0, 0.0), "colmap")
    manifest = Manifest(scene, 2, "camera", "reconstructed", "geometry", 0, "cpu", 0, {})
    with RunArchive.create(folder, manifest) as archive:
        for level, count in ((1, 3), (0, 5)):
            record = LevelRecord(
                level=level,
                signed=level == 0,
                iterations=10 * (2 - level),
                num_gaussians=count,
                peak_gaussians=count + 1,
                train_seconds=6.0,
                overhead_seconds={"pyramid": 0.5},
                image_size=(8 // (level + 1), 8 // (level + 1)),
                memory_bytes={"peak": 100 * count, "images": 10 * count},
                mean_gaussians=float(count),
                breakdown_seconds={"forward": 1.0, "backward": 2.0},
            )
            archive.finish_level(record, _field(count, signed=level == 0))
        archive.write_metrics({"psnr": psnr, "ssim": 0.5, "views": [], "lpips_missing": {"vgg": "no weights"}})
    return folder


def _field(count: int, signed: bool) -> GaussianField:
    return GaussianField(
        means=torch.rand(count, 3),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        log_scales=torch.zeros(count, 3),
        opacity_logits=torch.zeros(count),
        sh=torch.zeros(count, 1, 3),
        signed=signed,
    )


def copying_jobs(folder: Path, count: int, seconds: float = 0.0, code: str = COPY) -> list[Job]:
    """Make jobs that copy a tiny run; `folder`/started gets a line for every start."""
    source = folder / "source"
    if not source.exists():
        tiny_run(source)
    return [
        _job(folder, run_spec(number), (*_python(code), *_paths(folder, number, seconds))) for number in range(count)
    ]


def starts(folder: Path) -> Counter[str]:
    """Count the starts of each run, whichever attempt."""
    path = folder / "started"
    return Counter(name.partition("-attempt")[0] for name in path.read_text().split()) if path.exists() else Counter()


def _job(folder: Path, spec: RunSpec, command: Sequence[str]) -> Job:
    own, log = folder / "runs" / spec.run_id, folder / "logs" / f"{spec.run_id}.log"
    return Job(spec.run_id, spec, str(own), str(log), (Step(tuple(command), str(folder)),), True, "{}")


def _python(code: str) -> tuple[str, ...]:
    return sys.executable, "-c", code


def _paths(folder: Path, number: int, seconds: float) -> tuple[str, ...]:
    own = folder / "runs" / run_spec(number).run_id
    return str(own), str(folder / "started"), str(folder / "source"), str(seconds)
