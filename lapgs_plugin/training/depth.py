"""Supervise the depth of a field: maps beside the photos, or the points that they see.

Inverse depth is compared with that of the view, as in "A Hierarchical 3D Gaussian Representation" (Kerbl et al. 2024).
Residuals have no depth: in a hierarchy of them, the base alone is supervised.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, render_inverse_depths
from lapgs_plugin.hierarchy.plan import Stage, StagePlan
from lapgs_plugin.scenes.depth import DepthTargets, depth_size

FIRST_WEIGHT, LAST_WEIGHT = 1.0, 0.01
"""Weight of the depth loss at the start and the end of the supervised iterations; its logarithm falls linearly."""

LEAST_OPACITY = 0.01
"""Opacity of a pixel below which its loss fades out."""
EVERY = 2
"""Iterations from one with depth to the next, whose loss counts as often: a depth costs about as much as an image."""


def mean_inverse_depth(rasterizer: Rasterizer, gaussians: GaussianField, camera: Camera) -> Tensor:
    """Return a pixel's mean inverse depth (h, w), by the opacities of what it shows, differentiable.

    The blended one would not do: something nearer that is less opaque has the same.
    """
    inverse, opacity = render_inverse_depths(rasterizer, gaussians, camera)
    return inverse / opacity.clamp_min(LEAST_OPACITY)


def depth_loss(inverse: Tensor, target: Tensor) -> Tensor:
    """Return the mean absolute difference of inverse depths (h, w) over the target's median, where that is no NaN.

    It is 0 if the target is 0 or NaN everywhere.
    """
    valid, typical = ~target.isnan(), target.nanmedian()
    share = torch.where(typical > 0.0, 1.0 / (valid.sum() * typical), 0.0)
    return torch.where(valid, inverse - torch.where(valid, target, 0.0), 0.0).abs().sum() * share


@dataclass
class StageDepth:
    """Compute the depth losses of a stage's views.

    Attributes:
        rasterizer: renders depths.
        targets: (h, w) inverse depth by view, in world units, on the device; NaN where there is none.
    """

    rasterizer: Rasterizer
    targets: Mapping[str, Tensor]
    _cameras: dict[str, tuple[Camera, Camera]] = field(default_factory=dict, repr=False)

    @classmethod
    def create(
        cls, depth: DepthTargets, cameras: Mapping[str, Camera], rasterizer: Rasterizer, device: torch.device
    ) -> StageDepth:
        """Bring the depth of views to the size of a level.

        Args:
            depth: of the scene.
            cameras: of the training views at the level's size, by name.
            rasterizer: renders depths.
            device: that trains.
        """
        names = [name for name in depth.names if name in cameras]
        return cls(rasterizer, {name: depth.inverse(name, depth_size(cameras[name].size)).to(device) for name in names})

    def loss(
        self, iterations: Sequence[int], names: Sequence[str], cameras: Sequence[Camera], gaussians: GaussianField
    ) -> Tensor | None:
        """Return the mean loss of some views, without weight; None if it is due in none of them.

        Args:
            iterations: of the stage that train the views.
            names: of the views.
            cameras: theirs at the level's size.
            gaussians: the field.
        """
        losses = [
            depth_loss(mean_inverse_depth(self.rasterizer, gaussians, self._camera(name, camera)), target)
            for iteration, name, camera in zip(iterations, names, cameras, strict=True)
            if iteration % EVERY == 0 and (target := self.targets.get(name)) is not None
        ]
        return EVERY * torch.stack(losses).sum() / len(names) if losses else None

    def _camera(self, name: str, camera: Camera) -> Camera:
        """Return a view's camera at the size of its target, the same object for the same camera."""
        size = depth_size(camera.size)
        if size == camera.size:
            return camera
        if name not in self._cameras or self._cameras[name][0] is not camera:
            self._cameras[name] = camera, camera.resized(*size)
        return self._cameras[name][1]


def depth_weight(plan: StagePlan, stage: Stage, iteration: int) -> float:
    """Return the weight of the depth loss in an iteration of a stage, by the share of the supervised ones before it."""
    supervised = {planned.level: planned.iterations for planned in plan if not planned.signed}
    before = sum(iterations for level, iterations in supervised.items() if level > stage.level)
    progress = min(1.0, (before + iteration) / sum(supervised.values()))
    return FIRST_WEIGHT * math.exp(progress * math.log(LAST_WEIGHT / FIRST_WEIGHT))
