"""Make the row of results of a finished run: flat, one value a column, units in the column's name.

    run, scene, dataset, images, resolution, backbone, method, iterations, seed, options, arguments    settings
    psnr, ssim, lpips_*, fps            and every other number of metrics.json
    measured_by                         "lapgs eval" or "training": origin of the image metrics
    gpu_busy_seconds                    of the optimization, with --gpu-busy
    train_seconds, overhead_seconds, overhead_<purpose>_seconds, wall_seconds
    gaussians, gaussians_level_<l>      of the archived fields; peak_gaussians, mean_gaussians during training
    peak_memory_bytes, peak_memory_without_images_bytes    on a GPU
    <part>_ms, iteration_ms             milliseconds an iteration, with --breakdown
    lapgs_version, torch, gpu, processor, host, python, started, attempt, folder

A row has no columns for values that were not measured.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lapgs_bench.experiments.commands import measured_folder
from lapgs_bench.experiments.expansion import RunSpec
from lapgs_bench.experiments.store import Job
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.files import BARE_RECORD
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.runs.results import read_bare_record
from lapgs_plugin.runs.training_figures import training_figures

LOGGED_METRICS = ("psnr", "ssim")
"""Image metrics that training records itself."""
SINGLE = (
    "gpu_busy_seconds",
    "peak_gaussians",
    "mean_gaussians",
    "peak_memory_bytes",
    "peak_memory_without_images_bytes",
)
"""Figures of training that become columns unchanged, if they were measured."""
EVALUATED, RECORDED = "lapgs eval", "training"


def result_row(job: Job) -> dict[str, Any]:
    """Return the figures of a finished run; `worker` adds time and machine.

    Raises:
        RunFolderError: the run's folder lacks files that its commands should have written.
    """
    assert job.spec is not None, "a job without results has no row of them"
    folder = measured_folder(job.spec, Path(job.folder))
    row = {**_identity(job.spec, job.run_id), "measured_by": EVALUATED if job.evaluate else RECORDED}
    if not job.evaluate and folder != Path(job.folder):
        return {**row, **_bare_figures(Path(job.folder))}
    archive = RunArchive.open(folder)
    manifest = archive.manifest
    if not manifest.complete:
        raise RunFolderError(f"{folder} is not complete, although its command succeeded; look at {job.log}")
    return {**row, **_figures_of_records(manifest.records), **_image_figures(archive, job.evaluate)}


def _identity(spec: RunSpec, run_id: str) -> dict[str, Any]:
    return {
        "run": run_id,
        **{
            name: getattr(spec, name)
            for name in ("scene", "dataset", "images", "resolution", "backbone", "method", "iterations", "seed")
        },
        "options": json.dumps(dict(spec.options), sort_keys=True),
        "arguments": json.dumps(list(spec.arguments)),
    }


def _image_figures(archive: RunArchive, evaluate: bool) -> dict[str, Any]:
    """Return the image metrics of `lapgs eval`, or the last ones that training recorded."""
    if not evaluate:
        logged = [entry for entry in archive.history() if entry.get("psnr") is not None]
        return {name: logged[-1][name] for name in LOGGED_METRICS if name in logged[-1]} if logged else {}
    metrics = archive.metrics()
    if metrics is None:
        raise RunFolderError(f"{archive.path()} has no metrics.json, although `lapgs eval` succeeded; run it again")
    return {
        name: value for name, value in metrics.items() if isinstance(value, (int, float, str)) and name != "rasterizer"
    }


def _figures_of_records(records: Sequence[LevelRecord]) -> dict[str, Any]:
    """Return the figures of training."""
    figures = training_figures(records)
    overhead, parts, counts = (figures[name] for name in ("overhead_seconds", "breakdown_seconds", "num_gaussians"))
    row: dict[str, Any] = {
        "train_seconds": figures["train_seconds"],
        "overhead_seconds": math.fsum(overhead.values()),
        **{f"overhead_{name}_seconds": seconds for name, seconds in overhead.items()},
        "gaussians": sum(counts.values()),
        **{f"gaussians_level_{level}": count for level, count in counts.items()},
        **{name: figures[name] for name in SINGLE if figures[name] is not None},
    }
    if parts:
        iterations = sum(record.iterations for record in records)
        row |= {f"{name}_ms": 1e3 * seconds / iterations for name, seconds in parts.items()}
        row["iteration_ms"] = 1e3 * math.fsum(parts.values()) / iterations
    return row


def _bare_figures(folder: Path) -> dict[str, Any]:
    """Return the recorded figures of a script that ran by itself."""
    values = read_bare_record(folder / BARE_RECORD)
    count = values["num_gaussians"]
    row = {
        "train_seconds": values["train_seconds"],
        "gaussians": count,
        "gaussians_level_0": count,
        **{name: values[name] for name in ("peak_gaussians", "mean_gaussians")},
    }
    row |= {name: values[name] for name in ("gpu_busy_seconds", *LOGGED_METRICS) if name in values}
    if memory := values["memory_bytes"]:
        row["peak_memory_bytes"] = memory["peak"]
        row["peak_memory_without_images_bytes"] = memory["peak"] - memory["images"]
    return row
