"""Choose the rasterizer and the device of a run: our kernels or gsplat on a GPU, the CPU rasterizer without one."""

from __future__ import annotations

import torch

from lapgs_plugin.environment import driver_version, gpus_are_hidden
from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.rasterizers.choice import RASTERIZERS, RAYS, PlacedRasterizer, placed_rasterizer
from lapgs_plugin.rasterizers.gsplat import rasterizer as gsplat
from lapgs_plugin.training.settings import TrainSettings

LONG_ON_A_CPU = 4e9
"""Pixels to render, over all iterations, from which a CPU takes long."""
MINUTES_ON_A_CPU = "--resolution 1/4 --iterations 3000"
"""Options that are proposed there."""


def choose_rasterizer(name: str) -> str:
    """Return the rasterizer that `--rasterizer auto` means on this machine; any other name is returned unchanged.

    With a GPU it is gsplat, whose place our kernels take where they can, or an error, so that a run does not leave the
    GPU idle unnoticed. An empty CUDA_VISIBLE_DEVICES, or -1, hides the GPU.

    Raises:
        MissingExtraError: there is a GPU, and PyTorch, or both Triton and gsplat, cannot use it.
        UserInputError: an unknown name.
    """
    known = (AUTO, *RASTERIZERS)
    if name not in known:
        raise UserInputError(f"--rasterizer {name}: expected {', '.join(known[:-1])} or {known[-1]}")
    if name != AUTO:
        return name
    if not torch.cuda.is_available():
        if not gpus_are_hidden() and (driver := driver_version()):
            build = f"which is built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA"
            raise MissingExtraError(
                f"there is a GPU with driver {driver}, and PyTorch {torch.__version__}, {build}, cannot use it; "
                "`lapgs doctor` says what to update or install, --rasterizer cpu does without"
            )
        return "cpu"
    if reason := gsplat.missing():
        raise MissingExtraError(
            f"there is a CUDA device, and {reason}; `lapgs doctor` says what to install, --rasterizer cpu does without"
        )
    return gsplat.NAME


def training_rasterizer(name: str, settings: TrainSettings) -> PlacedRasterizer:
    """Return the rasterizer of a run with these settings, and its device.

    Args:
        name: of the rasterizer, or auto, see `choose_rasterizer`.
        settings: of the run.

    Raises:
        UserInputError: an unknown name, settings that it does not honour, or images on a GPU that does not train.
        MissingExtraError: gsplat cannot render on this machine.
    """
    name = choose_rasterizer(name)
    if name == gsplat.NAME:
        if settings.sparse_adam and torch.cuda.is_available() and (reason := gsplat.gsplat_missing()):
            raise MissingExtraError(f"--sparse-adam is gsplat's: {reason}; `lapgs doctor` says more, or leave it out")
        rasterizer = gsplat.GsplatRasterizer(
            antialiasing=settings.antialiased,
            packed=settings.packed,
            absgrad=settings.densification.options.needs_absgrad,
            own_radii=True,
            rays=settings.distorted,
        )
        return PlacedRasterizer(rasterizer, torch.device("cuda"), {})
    placed = placed_rasterizer(name, settings={RAYS: True} if settings.distorted else None)
    asked = {
        "--antialiased": settings.antialiased,
        "--packed": settings.packed,
        "--sparse-adam": settings.sparse_adam,
    }
    if needs_gsplat := [option for option, chosen in asked.items() if chosen]:
        raise UserInputError(
            f"{', '.join(needs_gsplat)} with --rasterizer {name}: only gsplat on a CUDA device does that; leave it out"
        )
    if settings.images_on == "gpu" and placed.device.type != "cuda":
        raise UserInputError("--images-on gpu: expected memory or disk, as a CPU trains this run")
    return placed


def long_on_a_cpu(size: tuple[int, int], iterations: int) -> str:
    """Return a line with faster options if training takes hours on a CPU, else an empty one."""
    width, height = size
    if iterations * width * height <= LONG_ON_A_CPU:
        return ""
    return (
        f"without a GPU {iterations:,} iterations of {width}x{height} pixels can take hours; "
        f"{MINUTES_ON_A_CPU} takes minutes"
    )
