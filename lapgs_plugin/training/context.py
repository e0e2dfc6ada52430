"""Hold what all stages of a run share: the scene, the settings, the run folder and the renderer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField, field_from_splats
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.hierarchy.plan import Stage, StagePlan
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS, Supervision
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.scenes.scene import Scene, View
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.settings import TrainSettings


@dataclass(frozen=True)
class RunContext:
    """Hold what all stages of a run share.

    Attributes:
        scene: its training views are those that are trained on.
        aside: training views that were set aside to choose the best state; empty without --keep best.
        settings, archive, rasterizer, device, monitor: as `Trainer` takes them.
        plan: the stages.
        first_field: the first stage starts from it; None starts from the scene's points.
    """

    scene: Scene
    aside: tuple[View, ...]
    settings: TrainSettings
    archive: RunArchive
    rasterizer: Rasterizer
    device: torch.device
    monitor: Monitor
    plan: StagePlan
    first_field: GaussianField | None

    @cached_property
    def pyramid(self) -> Pyramid:
        """Up and Down between levels, on the run's grid."""
        return Pyramid(self.settings.grid)

    @property
    def supervision(self) -> Supervision:
        """What residuals are trained against."""
        return SUPERVISIONS[self.settings.supervision]

    @property
    def background(self) -> Tensor:
        """(3,) colour behind the base, on the device."""
        return torch.tensor(self.scene.background).to(self.device)

    def record_to_extend(self, stage: Stage) -> LevelRecord | None:
        """Return the record of a finished stage that is to train on; None for all others."""
        done = {record.level: record for record in self.archive.manifest.records}.get(stage.level)
        whole = stage.iterations + self.settings.extension_of(stage)
        return done if done is not None and done.iterations < whole else None

    def model(self, field: GaussianField) -> TrainableField:
        """Return a field ready to be trained on the device, with empty moments."""
        rates, extent, sparse = self.settings.rates, self.scene.extent, self.settings.sparse_adam
        return TrainableField.create(field.to(self.device), rates, extent, sparse=sparse)

    def restored_model(self, state: dict[str, Any]) -> TrainableField:
        """Return the model of a `TrainableField.state`, on the device."""
        model = self.model(field_from_splats(state["params"], state["signed"]))
        model.restore(state)
        return model
