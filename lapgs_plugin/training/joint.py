"""Train finished fields jointly with the residual, in the last part of its stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import Any

from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.adam import ONE_VIEW, StepScale
from lapgs_plugin.stages.geometry import StageGeometry
from lapgs_plugin.stages.joint import RenderedPredictions
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.poses import ViewPoses


@dataclass
class JointFields:
    """Train finished fields.

    Attributes:
        models: by level, coarsest first.
        cameras: of every view at full size, by name.
        rasterizer: renders them.
        background: (3,) behind the base; residuals are rendered over zero.
        poses: refined poses of the training views, which learn from these renders, too; None without refinement.
        skies: supervision of their sky by level; empty without.
    """

    models: Mapping[int, TrainableField]
    cameras: Mapping[str, Camera]
    rasterizer: Rasterizer
    background: Tensor
    poses: ViewPoses | None
    skies: Mapping[int, StageGeometry]
    _level_cameras: dict[tuple[str, int], Camera] = dataclass_field(default_factory=dict)

    def predictions(self, pyramid: Pyramid) -> RenderedPredictions:
        """Return predictions by these fields, with gradients."""
        sizes = {name: camera.size for name, camera in self.cameras.items()}
        return RenderedPredictions(tuple(self.models), self._render, sizes, pyramid)

    def _render(self, level: int, names: Sequence[str]) -> Tensor:
        """Return the image of a level's field for a view, or for several in one set of launches."""
        model, cameras = self.models[level], [self._camera(name, level) for name in names]
        background = self.background.new_zeros(3) if model.signed else self.background
        if len(cameras) == 1:
            field = model.field if self.poses is None else self.poses.watched(names[0], model.field)
            return self.rasterizer.render_image(field, cameras[0], background=background)
        return self.rasterizer.render_batch(model.field, cameras, background=background, with_geometry=False).image

    def sky_losses(self, turns: Sequence[int], names: Sequence[str]) -> list[Tensor]:
        """Return the weighted losses of the fields by the sky of some views; arguments as `StageGeometry.loss`."""
        losses = []
        for level, sky in self.skies.items():
            cameras = [self._camera(name, level) for name in names]
            losses.append(sky.loss(turns, names, cameras, self.models[level].field, 0.0))
        return [loss for loss in losses if loss is not None]

    def _camera(self, name: str, level: int) -> Camera:
        """Return a view's camera, always the same object: a rasterizer may know it by that."""
        if (name, level) not in self._level_cameras:
            self._level_cameras[name, level] = level_camera(self.cameras[name], level)
        camera = self._level_cameras[name, level]
        return camera if self.poses is None else self.poses.camera(name, camera)

    def step(self, means_rate: float, sh_rest_factor: float = 1.0, scale: StepScale = ONE_VIEW) -> None:
        """Make one Adam step on every field, after backward passes through its renders.

        Args:
            means_rate: step size of the positions for one view, in world units.
            sh_rest_factor: on the step size of SH above degree 0.
            scale: how the step differs from one for a single view.
        """
        for model in self.models.values():
            model.step(means_rate, sh_rest_factor=sh_rest_factor, scale=scale)

    @property
    def fields(self) -> dict[int, GaussianField]:
        """The current fields by level, without gradients."""
        return {level: model.field.detach() for level, model in self.models.items()}

    def state(self) -> dict[int, dict[str, Any]]:
        """Return the state of every model by level, for checkpoints."""
        return {level: model.state() for level, model in self.models.items()}
