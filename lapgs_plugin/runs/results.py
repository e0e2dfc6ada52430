"""Read and check the JSON files of a run besides its manifest: history, metrics, and the record of a bare run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt
from typing_extensions import NotRequired

from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.runs.manifest import MemoryBytes
from lapgs_plugin.untrusted import Strict, StrictWithMore, read_json

MEASURED = {"test": "held-out", "train": "training", "other": "another scene's"}
"""Names of the measured views of `Metrics`, by their "split"."""


class HistoryEntry(StrictWithMore):
    """Check one line of the history."""

    level: NonNegativeInt
    iteration: NonNegativeInt
    elapsed: NotRequired[NonNegativeFloat]
    loss: NotRequired[float]
    psnr: NotRequired[float]
    sampled_psnr: NotRequired[float]
    sampled_fitted_psnr: NotRequired[float]
    ssim: NotRequired[float]
    num_gaussians: NotRequired[NonNegativeInt]
    view_psnr: NotRequired[list[float]]
    coarser_view_psnr: NotRequired[list[float]]


class _Distances(StrictWithMore):
    """Check LPIPS variants that were measured."""

    lpips_vgg: NotRequired[float]
    lpips_alex: NotRequired[float]
    lpips_squeeze: NotRequired[float]
    lpips_vgg_3dgs: NotRequired[float]


class MetricsOfView(_Distances):
    """Check one view in `Metrics`."""

    name: str
    psnr: float
    fitted_psnr: NotRequired[float]
    ssim: float


class MetricsOfLevel(StrictWithMore):
    """Check one level in `Metrics`."""

    psnr: float
    upsampled_psnr: float
    view_psnr: list[float]
    start_gaussians: NotRequired[NonNegativeInt | None]
    iterations: PositiveInt
    image_size: Annotated[list[PositiveInt], Field(min_length=2, max_length=2)]
    train_seconds: NonNegativeFloat
    num_gaussians: NonNegativeInt
    mean_gaussians: NonNegativeFloat | None
    peak_gaussians: NonNegativeInt
    breakdown_seconds: dict[str, NonNegativeFloat]
    gpu_busy_seconds: NotRequired[NonNegativeFloat | None]
    memory_bytes: MemoryBytes


class Metrics(_Distances):
    """Check the metrics of a run, as far as `evaluation.figures` describes them."""

    psnr: NotRequired[float]
    fitted_psnr: NotRequired[float]
    ssim: NotRequired[float]
    lpips_missing: NotRequired[dict[str, str]]
    fps: NotRequired[NonNegativeFloat]
    split: NotRequired[Literal["test", "train", "other"]]
    num_views: NotRequired[NonNegativeInt]
    views: NotRequired[list[MetricsOfView]]
    levels: NotRequired[dict[str, MetricsOfLevel]]
    train_seconds: NotRequired[NonNegativeFloat]
    overhead_seconds: NotRequired[dict[str, NonNegativeFloat]]
    breakdown_seconds: NotRequired[dict[str, NonNegativeFloat]]
    gpu_busy_seconds: NotRequired[NonNegativeFloat | None]
    num_gaussians: NotRequired[dict[str, NonNegativeInt]]
    weighted_gaussians: NotRequired[NonNegativeFloat]
    mean_gaussians: NotRequired[NonNegativeFloat | None]
    peak_gaussians: NotRequired[NonNegativeInt]
    peak_memory_bytes: NotRequired[NonNegativeInt | None]
    peak_memory_without_images_bytes: NotRequired[int | None]
    rasterizer: NotRequired[str]
    versions: NotRequired[dict[str, str]]


class Timeline(Strict):
    """Check one moment of a `BareRecord`."""

    iteration: NonNegativeInt
    elapsed: NonNegativeFloat
    num_gaussians: NonNegativeInt
    psnr: NotRequired[float]
    ssim: NotRequired[float]


class BareRecord(Strict):
    """Check the record of a script's own run, as `lapgs run --off --record` measures it (`runner.recording`)."""

    backbone: NotRequired[str]
    compiled: NotRequired[dict[str, str]]
    iterations: PositiveInt
    train_seconds: NonNegativeFloat
    saving_seconds: NonNegativeFloat
    num_gaussians: NonNegativeInt
    peak_gaussians: NonNegativeInt
    mean_gaussians: NonNegativeFloat
    memory_bytes: MemoryBytes
    gpu_busy_seconds: NotRequired[NonNegativeFloat]
    psnr: NotRequired[float]
    ssim: NotRequired[float]
    timeline: list[Timeline]


def read_bare_record(path: Path) -> dict[str, Any]:
    """Read a `files.BARE_RECORD`.

    Raises:
        RunFolderError: it cannot be read, or is damaged.
    """
    advice = "record the run again, with `lapgs run --off --record`"
    return dict(read_json(path, BareRecord, error=RunFolderError, advice=advice))
