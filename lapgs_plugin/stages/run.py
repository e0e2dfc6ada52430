"""Hold the state that all stages of a run share, whichever trainer trains them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.inheritance import Inherited, inherit
from lapgs_plugin.hierarchy.plan import StagePlan
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.settings import HierarchySettings
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS, Supervision
from lapgs_plugin.ops.composition import to_full_size
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CACHE


@dataclass(frozen=True)
class StagedRun:
    """Hold a run that is ready to train.

    Attributes:
        settings: of the hierarchy.
        plan: the stages.
        archive: the run folder, open for writing.
        device: of training.
    """

    settings: HierarchySettings
    plan: StagePlan
    archive: RunArchive
    device: torch.device

    @cached_property
    def pyramid(self) -> Pyramid:
        """Up and Down between levels, on the run's grid."""
        return Pyramid(self.settings.grid)

    @property
    def supervision(self) -> Supervision:
        """The target of residuals."""
        return SUPERVISIONS[self.settings.supervision]

    @property
    def finished_levels(self) -> str:
        """The finished levels for messages, coarsest first."""
        return ", ".join(map(str, self.archive.available_levels)) or "none"

    @property
    def cache_folder(self) -> Path:
        """Where images are kept on the disk."""
        return self.archive.path(CACHE)

    @contextmanager
    def image_cache(self) -> Iterator[None]:
        """Keep images on the disk inside; remove them at the end, and at the beginning those of a killed run."""
        shutil.rmtree(self.cache_folder, ignore_errors=True)
        try:
            yield
        finally:
            shutil.rmtree(self.cache_folder, ignore_errors=True)

    def inherited(self, coarser: GaussianField, sh_degree: int | None = None) -> Inherited:
        """Return the first field of a residual, the same at every call.

        Args:
            coarser: field of the next coarser level.
            sh_degree: see `inherit`.
        """
        generator = torch.Generator().manual_seed(self.settings.seed)
        return inherit(coarser, self.settings.inherit_mode, self.settings.inherit_ratio, generator, sh_degree)

    def beside_photo(
        self, level: int, image: Tensor, photo: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return a view's composed image at full size, its photo and its mask, as `metrics.psnr` takes them.

        Args:
            level: of the image.
            image: (3, h, w) composed image at the level's size, with finer residuals of zero.
            photo: (3, H, W) at full size, on any device.
            mask: (1, H, W), False where the photo is ignored; None uses all of it.
        """
        whole = to_full_size(image, (photo.shape[2], photo.shape[1]), level, self.pyramid)
        return whole, photo.to(whole.device), None if mask is None else mask.to(whole.device)
