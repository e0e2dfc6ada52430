"""Declare the scene, device and rasterizer with which a run is rendered. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lapgs_plugin.options import option


@dataclass(frozen=True)
class RenderOptions:
    """Choose the scene folder, device and rasterizer with which a run is rendered."""

    scene: Path | None = option(
        None, "Scene folder, if it was moved after training, or a scene of other photos in the same coordinates."
    )
    device: str = option("auto", "cuda, cpu, or auto: CUDA if there is a CUDA device, else the CPU.")
    rasterizer: str = option(
        "auto",
        "cpu, oracle, gsplat, one of an installed package, or the module of an installed CUDA rasterizer such as "
        "diff_gaussian_rasterization. "
        "auto: the rasterizer that the run was trained with, else gsplat, else cpu.",
    )


WHERE_TRAINED = RenderOptions()
"""The scene where the run was trained, and the most similar rasterizer of this machine."""
