"""The finished fields, trained along in the last part of a residual stage.

What `adapters.joint` does in a checkout's loop, in ours: predictions are rendered anew instead of being read from a
cache, and the fields that they are made of step with the residual.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from lapgs_plugin.camera import Camera
from lapgs_plugin.field import GaussianField
from lapgs_plugin.pyramid import Pyramid
from lapgs_plugin.raster import Rasterizer, render_image
from lapgs_plugin.rendering.compose import level_camera
from lapgs_plugin.rendering.raising import add_raised, raised
from lapgs_plugin.training.model import TrainableField


@dataclass
class JointFields:
    """Finished fields under training.

    Attributes:
        models: by level, coarsest first.
        cameras: of every view at full size, by name.
        rasterizer: renders them.
        background: (3,) behind the base; residuals are rendered over zero.
        pyramid: Up between two levels.
    """

    models: Mapping[int, TrainableField]
    cameras: Mapping[str, Camera]
    rasterizer: Rasterizer
    background: Tensor
    pyramid: Pyramid

    def predict(self, name: str) -> Tensor:
        """(3, h, w) Up of what the fields make of a view, at the size of the level below them, with gradients."""
        composed: Tensor | None = None
        for level, model in self.models.items():
            camera = level_camera(self.cameras[name], level)
            background = self.background.new_zeros(3) if model.signed else self.background
            image = render_image(self.rasterizer, model.field, camera, background)
            composed = image if composed is None else add_raised(self.pyramid, composed, image)
        assert composed is not None
        camera = level_camera(self.cameras[name], min(self.models) - 1)
        return raised(self.pyramid, composed, (camera.height, camera.width))

    def step(self, means_rate: float, sh_rest_factor: float = 1.0) -> None:
        """One Adam step on every field, after backward passes through what `predict` gave.

        Args:
            means_rate: step size of the positions, in world units.
            sh_rest_factor: on the step size of SH above degree 0.
        """
        for model in self.models.values():
            model.step(means_rate, sh_rest_factor=sh_rest_factor)

    @property
    def fields(self) -> dict[int, GaussianField]:
        """What the fields have become, by level, without gradients."""
        return {level: model.field.detach() for level, model in self.models.items()}

    def state(self) -> dict[int, dict[str, Any]]:
        """Of every model, for checkpoints: what `TrainableField.from_state` takes, by level."""
        return {level: model.state() for level, model in self.models.items()}
