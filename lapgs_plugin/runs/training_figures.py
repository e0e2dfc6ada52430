"""Sum up the records of a run's levels, for metrics.json and for rows of experiments.

Imports nothing that reads images, so that experiments can be gathered where no image can be read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lapgs_plugin.runs.manifest import LevelRecord

FEW_LEFT = 0.1
"""Share of the Gaussians that a level started with, below which its end is reported."""
SMALL_GAIN = 0.1
"""Decibels that the finest level should add to the PSNR of whole images."""


def weak_levels(records: Sequence[LevelRecord], psnr: Mapping[int, float], views: str = "held-out") -> list[str]:
    """Return a line for each level that lost nearly all of its Gaussians, and one if the finest hardly matters.

    Args:
        records: of finished levels.
        psnr: of whole images after each level, in dB, as far as it was measured.
        views: which views were measured.
    """
    lines = [
        f"level {record.level} ended with {record.num_gaussians:,} of the {record.start_gaussians:,} Gaussians that it "
        "started with: hardly any of its detail is in the image; compare with fewer levels or the other hierarchy"
        for record in records
        if record.start_gaussians is not None and record.num_gaussians < FEW_LEFT * record.start_gaussians
    ]
    if psnr.keys() >= {0, 1} and (gain := psnr[0] - psnr[1]) < SMALL_GAIN:
        lines.append(
            f"level 0 changes the PSNR of {views} images by {gain:+.2f} dB, from {psnr[1]:.2f} to {psnr[0]:.2f}: by "
            "this measure it adds little to the coarser level's, enlarged; compare their LPIPS, fewer levels or the "
            "other hierarchy"
        )
    return lines


def last_psnr(history: Iterable[Mapping[str, Any]]) -> dict[int, float]:
    """Return the last PSNR of all held-out views by level, from the entries of a run's history."""
    return {entry["level"]: entry["psnr"] for entry in history if "psnr" in entry}


def training_figures(records: Sequence[LevelRecord]) -> dict[str, Any]:
    """Return the figures of finished levels as JSON, with levels as text as JSON requires.

    Keys:
        train_seconds: seconds of optimization over all stages; overhead_seconds: all other seconds, by name.
        breakdown_seconds: seconds of the optimization by part (`profiling.PARTS`); empty unless all levels have them.
        gpu_busy_seconds: seconds that the GPU executed kernels in the optimization; None unless all levels have it.
        num_gaussians: by level, Gaussians of the fields that the image is rendered from; of nested levels the last.
        peak_gaussians: the most that were optimized at a time.
        weighted_gaussians: mean of the levels' Gaussians, weighted by iterations, as in the paper's plot of time.
        mean_gaussians: Gaussians being optimized, mean over all iterations; None when not recorded.
        peak_memory_bytes, peak_memory_without_images_bytes: GPU memory of the highest stage; None on a CPU.
    """
    iterations = [record.iterations for record in records]
    means = [record.mean_gaussians for record in records if record.mean_gaussians is not None]
    memory = [record.memory_bytes for record in records if record.memory_bytes]
    busy = [record.gpu_busy_seconds for record in records if record.gpu_busy_seconds is not None]
    whole = all(record.breakdown_seconds for record in records)
    # The last field that renders a whole image, and the residuals that are added to it.
    rendered = records[max((index for index, record in enumerate(records) if not record.signed), default=0) :]
    return {
        "train_seconds": math.fsum(record.train_seconds for record in records),
        "overhead_seconds": sums(record.overhead_seconds for record in records),
        "breakdown_seconds": sums(record.breakdown_seconds for record in records) if whole else {},
        "gpu_busy_seconds": math.fsum(busy) if len(busy) == len(records) else None,
        "num_gaussians": {str(record.level): record.num_gaussians for record in rendered},
        "weighted_gaussians": _weighted([record.num_gaussians for record in records], iterations),
        "mean_gaussians": _weighted(means, iterations) if len(means) == len(records) else None,
        "peak_gaussians": max(record.peak_gaussians for record in records),
        "peak_memory_bytes": max((usage["peak"] for usage in memory), default=None),
        "peak_memory_without_images_bytes": max((usage["peak"] - usage["images"] for usage in memory), default=None),
    }


def sums(parts: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Add up the values of each name."""
    total: dict[str, float] = {}
    for part in parts:
        for name, value in part.items():
            total[name] = total.get(name, 0.0) + value
    return total


def _weighted(values: Sequence[float], weights: Sequence[int]) -> float:
    return math.fsum(value * weight for value, weight in zip(values, weights, strict=True)) / sum(weights)
