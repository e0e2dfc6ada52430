"""Read and check the JSON files of a run besides its manifest: history, metrics, and the record of a bare run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt

from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.runs.manifest import MemoryBytes
from lapgs_plugin.untrusted import STRICT, STRICT_WITH_MORE, read_json

if sys.version_info >= (3, 12):
    from typing import NotRequired, TypedDict
else:  # pydantic cannot read the older TypedDict of `typing`
    from typing_extensions import NotRequired, TypedDict


class HistoryEntry(TypedDict):
    """One line of the history."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    level: NonNegativeInt
    iteration: NonNegativeInt
    elapsed: NotRequired[NonNegativeFloat]
    loss: NotRequired[float]
    psnr: NotRequired[float]
    sampled_psnr: NotRequired[float]
    sampled_fitted_psnr: NotRequired[float]
    ssim: NotRequired[float]
    num_gaussians: NotRequired[NonNegativeInt]


class MetricsOfView(TypedDict):
    """One view in `Metrics`."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    name: str
    psnr: float
    fitted_psnr: NotRequired[float]
    ssim: float
    lpips_vgg: NotRequired[float]
    lpips_alex: NotRequired[float]
    lpips_squeeze: NotRequired[float]
    lpips_vgg_3dgs: NotRequired[float]


class MetricsOfLevel(TypedDict):
    """One level in `Metrics`."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    psnr: float
    upsampled_psnr: float
    iterations: PositiveInt
    image_size: Annotated[list[PositiveInt], Field(min_length=2, max_length=2)]
    train_seconds: NonNegativeFloat
    num_gaussians: NonNegativeInt
    mean_gaussians: NonNegativeFloat | None
    peak_gaussians: NonNegativeInt
    breakdown_seconds: dict[str, NonNegativeFloat]
    gpu_busy_seconds: NotRequired[NonNegativeFloat | None]
    memory_bytes: MemoryBytes


class Metrics(TypedDict):
    """The metrics of a run, as far as `evaluation.figures.run_figures` measured them."""

    __pydantic_config__ = STRICT_WITH_MORE  # type: ignore[misc]  # what pydantic documents
    psnr: NotRequired[float]
    fitted_psnr: NotRequired[float]
    ssim: NotRequired[float]
    lpips_vgg: NotRequired[float]
    lpips_alex: NotRequired[float]
    lpips_squeeze: NotRequired[float]
    lpips_vgg_3dgs: NotRequired[float]
    lpips_missing: NotRequired[dict[str, str]]
    fps: NotRequired[NonNegativeFloat]
    split: NotRequired[Literal["test", "train"]]
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


class Timeline(TypedDict):
    """One moment of a `BareRecord`."""

    __pydantic_config__ = STRICT  # type: ignore[misc]  # what pydantic documents
    iteration: NonNegativeInt
    elapsed: NonNegativeFloat
    num_gaussians: NonNegativeInt


class BareRecord(TypedDict):
    """A script's own run without a hierarchy, as `lapgs run --off --record` measures it (`runner.recording`)."""

    __pydantic_config__ = STRICT  # type: ignore[misc]  # what pydantic documents
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
