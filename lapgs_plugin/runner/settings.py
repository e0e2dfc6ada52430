"""Declare what a user can choose about `lapgs run`. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lapgs_plugin.hierarchy.settings import STORAGE, HierarchySettings
from lapgs_plugin.options import option

IN_MANIFEST = ("levels", "grid", "supervision", "inherit", "seed", "masks")
"""Settings that the manifest has fields of its own for."""


@dataclass(frozen=True)
class RunSettings(HierarchySettings):
    """Choose how `lapgs run` trains a checkout; everything else is the checkout's own."""

    fused_adam: bool = option(
        True,
        "Step the backbone's plain Adam optimizers in one kernel a tensor.",
        panel=STORAGE,
        names=("--fused-adam/--no-fused-adam",),
    )

    masks: str = option(
        "auto",
        "Masks of the photos: a folder of images that are black where a photo is ignored, none, or auto (the scene's "
        "folder masks/ if there is one).",
    )

    def for_manifest(self) -> dict[str, Any]:
        """Return what the manifest has under "settings"."""
        return {name: value for name, value in self.resolved().items() if name not in IN_MANIFEST}
