"""Declare what a user can choose about `lapgs run`. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from lapgs_plugin.hierarchy.settings import (
    APPEARANCES,
    JOINT_SHARE,
    PANEL,
    STORAGE,
    HierarchySettings,
    is_large,
    require_composed,
)
from lapgs_plugin.options import option, require_positive
from lapgs_plugin.registry import NONE
from lapgs_plugin.runs.options import PANEL as RUN_PANEL

ELSEWHERE = ("levels", "grid", "supervision", "inherit", "seed", "masks", "dry_run")
"""Settings that a manifest has fields of its own for, and one that changes no result."""

SMALL_JOINT_SHARE = 0.5
"""Default share of a residual stage that is joint unless images are large, where it takes a quarter more time than
`JOINT_SHARE`."""


@dataclass(frozen=True)
class RunSettings(HierarchySettings):
    """Choose how `lapgs run` trains a checkout; everything else is the checkout's own."""

    sh_rate: float = option(
        1.0,
        "Factor on the checkout's learning rate of SH above degree 0, in every level, where its script has no option "
        "for it.",
        panel=PANEL,
    )
    prune_by_size: bool = option(
        True,
        "Let the checkout's densification remove Gaussians that are large on screen or in the scene.",
        panel=PANEL,
        names=("--prune-by-size/--no-prune-by-size",),
    )
    fused_adam: bool = option(
        True,
        "Step all tensors of the checkout's plain Adam optimizers in one kernel.",
        panel=STORAGE,
        names=("--fused-adam/--no-fused-adam",),
    )
    fused_ssim: bool = option(
        True,
        "Compute the checkout's loss, or its SSIM alone, in our kernels, where its functions return the same.",
        panel=STORAGE,
        names=("--fused-ssim/--no-fused-ssim",),
    )
    run_ahead: bool = option(
        True,
        "Let the checkout's loop go on while the GPU computes what the loop only logs, and update its statistics of "
        "visible Gaussians without listing them.",
        panel=STORAGE,
        names=("--run-ahead/--no-run-ahead",),
    )

    appearance: str = option(
        NONE,
        "Learn how each training photo differs from the scene. affine: a colour transform, against changes of exposure "
        "and white balance. bilateral: a grid of them over the image and brightness, also against vignetting and local "
        "tone mapping. Renders show the mean exposure.",
        panel=PANEL,
        choices=(NONE, *APPEARANCES),
    )
    dry_run: bool = option(
        True,
        "Before the first stage, try one iteration of the checkout and everything that the run does with its model.",
        panel=RUN_PANEL,
        names=("--dry-run/--no-dry-run",),
    )

    depth: str = option(
        "none",
        "Supervise depth in all levels but residuals, beside the script's loss: a folder of depth maps named as the "
        "photos, points (those of COLMAP that a photo sees), auto (the scene's folder depth/, if any), or none.",
    )

    masks: str = option(
        "auto",
        "Masks of the photos: a folder of images that are black where a photo is ignored, none, or auto (the scene's "
        "folder masks/ if there is one).",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("--sh-rate", self.sh_rate, "factor")
        require_composed(self.appearance, self.supervision)

    @property
    def paper_settings(self) -> Mapping[str, object]:
        """See `HierarchySettings.paper_settings`."""
        return {**super().paper_settings, "appearance": NONE, "depth": NONE}

    @property
    def shares(self) -> tuple[Fraction, ...] | None:
        """As `HierarchySettings.shares`, but two levels are split as in the paper, and nested levels like them.

        A script ends its densification in the middle of its run, and so do halves end the coarser level: of nested
        levels the finest would see none. A script's residual field gains less by a base that was trained longer than
        it loses by its own shorter stage.
        """
        if self.split is not None or self.levels == 1 or not (self.nested or self.levels == 2):
            return super().shares
        coarser = self.levels - 1
        return (Fraction(1, 3 * coarser),) * coarser + (Fraction(2, 3),)

    @property
    def has_residuals(self) -> bool:
        """Whether some fields are residuals; without any, one call of the script's `training` trains all levels."""
        return self.levels > 1 and not self.nested

    @property
    def joint_share(self) -> float:
        """See `HierarchySettings.joint_share`."""
        return super().joint_share if self.nested or self.joint is not None else SMALL_JOINT_SHARE

    def for_size(self, size: tuple[int, int]) -> RunSettings:
        """Return settings with which less of a residual stage is joint if images are large and no share was given.

        Args:
            size: (width, height) of the smallest photo.
        """
        if not is_large(size) or self.nested or self.joint is not None:
            return self
        return replace(self, joint=JOINT_SHARE[self.kind])

    def for_manifest(self) -> dict[str, Any]:
        """Return what the manifest has under "settings"."""
        return {name: value for name, value in self.resolved().items() if name not in ELSEWHERE}
