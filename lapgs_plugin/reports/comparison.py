"""Compare the figures of a run with those of its baseline: the table of `lapgs report` and its page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lapgs_plugin.evaluation.lpips import LPIPS_KEY, lpips_titles
from lapgs_plugin.runs.manifest import Manifest
from lapgs_plugin.runs.results import MEASURED

Metrics = dict[str, Any]
"""Content of metrics.json, see `evaluation.figures`."""

OPTIONAL_ROWS = {"gpu_busy_seconds", "mean_gaussians", "peak_memory_bytes", "peak_memory_without_images_bytes"}
"""Rows that are left out when no run has them: imported runs know little of their training, a CPU no GPU memory."""


@dataclass(frozen=True)
class Cell:
    """A figure of one run.

    Attributes:
        value: the number; None when it was not measured.
        text: the number as shown.
        parts: the parts of a sum, each with its name; empty otherwise.
    """

    value: float | None
    text: str
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Row:
    """A figure of all runs.

    Attributes:
        key: short name for scripts.
        label: name for people, with the unit.
        cells: of the run, then of the baseline if there is one.
        change: change from the baseline to the run, "" without a baseline.
    """

    key: str
    label: str
    cells: tuple[Cell, ...]
    change: str = ""


def comparison_rows(metrics: Sequence[Metrics]) -> tuple[Row, ...]:
    """Return the rows for the metrics of a run, and then of its baseline if there is one.

    Quality is only compared between views of one kind: a baseline's of other views says of which it is.
    """
    splits = [run["split"] for run in metrics]
    views = MEASURED[splits[0]]
    table: tuple[tuple[str, str, str, Callable[[float, float], str]], ...] = (
        ("psnr", f"PSNR, {views} views (dB)", "{:.2f}", _difference("{:+.2f} dB")),
        ("ssim", f"SSIM, {views} views", "{:.4f}", _difference("{:+.4f}")),
        *(
            (key, f"{title}, {views} views", "{:.4f}", _difference("{:+.4f}"))
            for key, title in lpips_titles({name for run in metrics for name in run}).items()
        ),
        ("train_seconds", "Optimization (s)", "{:.1f}", _speed),
        ("gpu_busy_seconds", "GPU busy (s)", "{:.1f}", _speed),
        ("overhead_seconds", "Overhead (s)", "{:.1f}", _difference("{:+.1f} s")),
        ("num_gaussians", "Gaussians to render", "{:,.0f}", _ratio),
        ("weighted_gaussians", "Gaussians of levels, weighted by iterations", "{:,.0f}", _ratio),
        ("mean_gaussians", "Gaussians optimized, mean", "{:,.0f}", _ratio),
        ("peak_gaussians", "Gaussians optimized, most", "{:,.0f}", _ratio),
        ("peak_memory_bytes", "Peak GPU memory (GB)", "{:.2f}", _ratio),
        ("peak_memory_without_images_bytes", "Peak GPU memory without images (GB)", "{:.2f}", _ratio),
        ("fps", "Frames a second", "{:,.0f}", _ratio),
    )
    rows = []
    for key, label, pattern, compare in table:
        scale = 1e-9 if key.endswith("_bytes") else 1.0
        alike = not _is_quality(key) or len(set(splits)) == 1
        cells = tuple(
            # A user's own loop that measures no time records 0 seconds.
            _cell(run.get(key) or None if key == "train_seconds" else run.get(key), pattern, scale)
            for run in metrics
        )
        if not alike and cells[1].value is not None:
            cells = cells[0], replace(cells[1], text=f"{cells[1].text} ({MEASURED[splits[1]]})")
        values = [cell.value for cell in cells if cell.value is not None]
        if not values and key in OPTIONAL_ROWS:
            continue
        rows.append(Row(key, label, cells, compare(*values) if alike and len(values) == 2 else ""))
    return tuple(rows)


def _is_quality(key: str) -> bool:
    """Return whether a row is a figure of measured views."""
    return key in ("psnr", "ssim") or key.startswith(LPIPS_KEY.format(""))


def _cell(value: float | dict[str, float] | None, pattern: str, scale: float) -> Cell:
    """Make the cell of a number, or of the sum of named numbers."""
    if value is None:
        return Cell(None, "not measured")
    if not isinstance(value, dict):
        value *= scale
        return Cell(value, pattern.format(value))
    total = math.fsum(value.values())
    parts = [f"{f'level {name}' if name.isdigit() else name} {pattern.format(part)}" for name, part in value.items()]
    return Cell(total, pattern.format(total), tuple(parts) if len(parts) > 1 else ())


def _difference(pattern: str) -> Callable[[float, float], str]:
    return lambda run, baseline: pattern.format(run - baseline)


def _speed(run: float, baseline: float) -> str:
    return f"{baseline / run:.2f}x as fast" if run and baseline else ""


def _ratio(run: float, baseline: float) -> str:
    return f"{run / baseline:.2f}x" if baseline else ""


def setup_differences(run: Manifest, baseline: Manifest, metrics: Sequence[Metrics]) -> list[str]:
    """Describe the differences in setup that make a comparison of two runs unfair; `metrics` are theirs."""
    pairs = {
        "scene": (run.scene.path, baseline.scene.path),
        "images": (run.scene.images, baseline.scene.images),
        "resolution": (run.scene.resolution, baseline.scene.resolution),
        "masks": (run.scene.masks, baseline.scene.masks),
        "masks of the sky": (run.scene.sky, baseline.scene.sky),
        "held-out views": (run.scene.eval, baseline.scene.eval),
        "background": (run.scene.background, baseline.scene.background),
        "rasterizer": (run.rasterizer, baseline.rasterizer),
        "iterations": (run.settings.get("iterations"), baseline.settings.get("iterations")),
        "SH degree": (run.sh_degree, baseline.sh_degree),
        "measured views": tuple(MEASURED[figures["split"]] for figures in metrics),
    }
    return [f"{name} {ours} against {theirs}" for name, (ours, theirs) in pairs.items() if ours != theirs]
