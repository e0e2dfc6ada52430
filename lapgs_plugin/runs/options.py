"""Declare the measurements of a training run. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass

from lapgs_plugin.options import option

PANEL = "Run"


@dataclass(frozen=True)
class MeasuringOptions:
    """Choose the measurements of a run in training. None of them counts as training time."""

    test_every: int | None = option(
        None,
        "Measure held-out PSNR every so many iterations, for the curves of `lapgs report`. Default: `lapgs train` at "
        "the end of each level, and some of the views in between; `lapgs run` at its end.",
        panel=PANEL,
        least=1,
    )
    breakdown: bool = option(
        False,
        "Measure the time of each part of an iteration: forward, loss, backward, densification, optimizer, other.",
        panel=PANEL,
    )
    gpu_busy: bool = option(
        False,
        "Estimate the seconds that the GPU executes kernels, from profiles of some iterations of each stage. They slow "
        "the iterations after them where the GPU waits for launches: take times from a run without this.",
        panel=PANEL,
    )
