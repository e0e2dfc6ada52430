"""Hold the facts about a backbone: its name, its rasterizer, and the files by which its checkout is recognised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

FAMILY_FILES = ("train.py", "gaussian_renderer/__init__.py", "scene/gaussian_model.py")
"""Files of most checkouts of the family, relative to their roots."""

FAMILY_EXTENSIONS = {"simple_knn._C": "nearest neighbours", "fused_ssim": "fast SSIM"}
"""Compiled modules besides the rasterizer that training scripts of the family import, each with its purpose."""

RASTER_OPTIONS = {"antialiasing": bool, "kernel_size": float, "mult": float}
"""Options of the family's scripts that change how a saved field is rendered, with their types."""


@dataclass(frozen=True)
class BackboneInfo:
    """Hold the facts about a backbone.

    Attributes:
        name: for `--backbone` and the manifest.
        title: as its authors write it.
        rasterizer: the CUDA module it renders with.
        stand_in: the variant of `family` that takes the module's place on a CPU, where runs are
            rendered without a checkout, and where it fits the checkout's calls; empty is chosen by the calls alone.
        densify_thresholds: its options that are thresholds on screen-space gradients for densification; empty finds
            them by their names.
        own_files: files of its checkout that tell it from other code bases, relative to the checkout's root.
        family_files: files of its checkout that other code bases have, too.
        fork_of: names of backbones that may recognise its checkout, too, because it has files of theirs.
        density_scores: functions of its script or utilities whose scores density control uses.
        raster_defaults: settings of the rasterizer that its options have by default, where these change the image and
            differ from `extensions.CONSTANTS`.
        telling_options: options in the `cfg_args` file that no other backbone writes.
        unscaled: its options that count iterations in a stage of any length; see `checkouts.schedule`.
    """

    name: str
    title: str
    rasterizer: str
    stand_in: str = ""
    densify_thresholds: tuple[str, ...] = ()
    own_files: tuple[str, ...] = ()
    family_files: tuple[str, ...] = FAMILY_FILES
    fork_of: tuple[str, ...] = ()
    density_scores: tuple[str, ...] = ()
    raster_defaults: Mapping[str, Any] = field(default_factory=dict)
    telling_options: tuple[str, ...] = ()
    unscaled: tuple[str, ...] = ()

    @property
    def files(self) -> tuple[str, ...]:
        """Files that a checkout must have to be recognised."""
        return (*self.family_files, *self.own_files)

    @property
    def script(self) -> str:
        """Its training script: one of its own files, or `train.py`."""
        return next((name for name in self.own_files if Path(name).name.startswith("train")), "train.py")

    @property
    def extensions(self) -> Mapping[str, str]:
        """Compiled modules that its training script imports, each with its purpose."""
        return {self.rasterizer: "rasterizer", **FAMILY_EXTENSIONS}

    def recognises(self, folder: Path) -> bool:
        """Return whether `folder` has all files of a checkout."""
        return all((folder / name).is_file() for name in self.files)

    def is_fork_of(self, other: BackboneInfo) -> bool:
        """Return whether a checkout that both recognise is this one's."""
        return other.name in self.fork_of or set(other.files) < set(self.files)
