"""Sum up the records of a run's levels, for metrics.json and for rows of experiments.

Imports nothing that reads images, so that experiments can be gathered where no image can be read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

from lapgs_plugin.runs.manifest import DecidedLength, LevelRecord

FEW_LEFT = 0.1
"""Share of the Gaussians that a level started with, below which its end is reported."""
SMALL_GAIN = 0.1
"""Decibels that the finest level should add to the PSNR of held-out images."""
LEAST_VIEWS = 4
"""Fewest held-out views whose gains say whether a level matters."""
LEAST_ITERATIONS = 500
"""Fewest iterations of a finest level that should change images."""
VIEW_PSNR = "view_psnr"
"""Key of the history and of metrics.json: PSNR in dB of each held-out view at full size, in the scene's order."""
COARSER_VIEW_PSNR = "coarser_view_psnr"
"""Key of the history: the same without the level, by the coarser levels as they are when it ends."""


def weak_levels(
    records: Sequence[LevelRecord], gains: Sequence[float], settings: Mapping[str, Any], *, advised: bool = True
) -> list[str]:
    """Return a line for each level that lost nearly all of its Gaussians, and one if the finest hardly matters.

    The second compares the mean gain and its standard error with `SMALL_GAIN`, because gains differ between views.
    Levels that `--prune` made small are not named.

    Args:
        records: of finished levels.
        gains: decibels that the finest level adds to the PSNR of each held-out view; empty if that was not measured.
        settings: of the run's manifest.
        advised: whether lines name options of `lapgs train` and `lapgs run`.
    """
    pruned = bool(settings.get("prune"))
    died = [record for record in records if not pruned and _lost_nearly_all(record)]
    lines = [_died_line(record, advised) for record in died]
    finest = records[-1] if records else None
    if finest is not None and finest.level == 0 and finest.iterations >= LEAST_ITERATIONS and finest not in died:
        mean, error = _mean_and_error(gains)
        if mean + error < SMALL_GAIN:
            lines.append(
                f"level 0 changes the PSNR of {len(gains)} held-out images by {mean:+.2f} dB: by this measure it adds "
                f"little to the coarser level's, enlarged; compare LPIPS with {_instead(finest.signed, advised)}"
            )
    return lines


def length_line(level: int, iterations: int, decided: DecidedLength) -> str:
    """Say how many iterations a level has, and why."""
    gain = "an unknown gain" if decided.gain is None else f"{decided.gain:+.2f} dB"
    limit = "the most it may have" if iterations == decided.most else f"of at most {decided.most:,}"
    return (
        f"level {level}: {iterations:,} iterations, {limit}; after {decided.after:,}, {decided.views} views set aside "
        f"promised {gain} for a third more"
    )


def length_lines(records: Sequence[LevelRecord]) -> list[str]:
    """Return `length_line` of the levels whose lengths were decided."""
    return [length_line(record.level, record.iterations, record.decided) for record in records if record.decided]


def finest_gains(psnrs: Mapping[int, Sequence[float]]) -> list[float]:
    """Return the decibels that level 0 adds to each view, from the views' PSNR by level; empty if they do not match."""
    fine, coarse = psnrs.get(0, ()), psnrs.get(1, ())
    return [ours - without for ours, without in zip(fine, coarse, strict=True)] if len(fine) == len(coarse) else []


def smaller_gains(*gains: Sequence[float]) -> Sequence[float]:
    """Return those gains that have the smaller mean; empty if all are."""
    return min(filter(None, gains), key=fmean, default=())


def last_view_psnrs(history: Iterable[Mapping[str, Any]], *, along: bool) -> dict[int, list[float]]:
    """Return the last PSNR of each held-out view by level, from the entries of a run's history.

    Args:
        along: whether figures of level 1 are those at the end of level 0, with which it may have trained along, instead
            of those at its own end.
    """
    psnrs: dict[int, list[float]] = {}
    for entry in history:
        if VIEW_PSNR in entry:
            psnrs[entry["level"]] = entry[VIEW_PSNR]
        if along and COARSER_VIEW_PSNR in entry:
            psnrs[entry["level"] + 1] = entry[COARSER_VIEW_PSNR]
    return psnrs


def _lost_nearly_all(record: LevelRecord) -> bool:
    return record.start_gaussians is not None and record.num_gaussians < FEW_LEFT * record.start_gaussians


def _died_line(record: LevelRecord, advised: bool) -> str:
    text = (
        f"level {record.level} ended with {record.num_gaussians:,} of the {record.start_gaussians:,} Gaussians that it "
        "started with: "
    )
    if record.signed:
        return f"{text}hardly any of its detail is in the image; compare with {_instead(True, advised)}"
    return f"{text}its images may lack detail; check that the points and the cameras are of one model"


def _instead(signed: bool, advised: bool) -> str:
    """Return what a user may try instead of a finest level that brings little."""
    if not advised:
        return "fewer levels, the other hierarchy or more photos"
    return "--hierarchy nested, --levels 1 or more photos" if signed else "--levels 1 or more photos"


def _mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean of some values and its standard error, which is infinite for fewer than `LEAST_VIEWS`."""
    if len(values) < LEAST_VIEWS:
        return 0.0, math.inf
    return fmean(values), stdev(values) / math.sqrt(len(values))


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
