"""Supervise depth, normals and sky of a field: maps beside the photos, or the points that they see; masks of the sky.

Inverse depth is compared with that of the view, as in "A Hierarchical 3D Gaussian Representation" (Kerbl et al. 2024).
Normals are those of the field's depths, as in 2DGS (Huang et al. 2024). Residuals have no depth: in a hierarchy of
them, the base alone is supervised.

In the sky every field is trained to be transparent, by the cross-entropy of its opacity, as in "Street Gaussians" (Yan
et al. 2024). A residual that is transparent adds no colour there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, render_inverse_depths
from lapgs_plugin.hierarchy.plan import Stage, StagePlan
from lapgs_plugin.scenes.depth import DepthTargets, depth_size
from lapgs_plugin.scenes.scene import View

FIRST_WEIGHT, LAST_WEIGHT = 1.0, 0.01
"""Weight of the depth loss at the start and the end of the supervised iterations; its logarithm falls linearly."""

LEAST_OPACITY = 0.01
"""Opacity of a pixel below which its loss fades out."""
EVERY = 2
"""Turns from one with these losses to the next, which count as often: their render costs as much as an image."""

NORMAL_WEIGHT = 0.05
"""Weight of the normal loss, that of 2DGS for normals of depths."""
SKY_WEIGHT = 0.05
"""Weight of the sky loss, that of Street Gaussians."""
LEAST_TRANSMITTANCE = 1e-5
"""Lower bound of the transmittance in the sky loss. Rasterizers stop blending above it."""
ALL_OF_A_PIXEL = 0.999
"""Share of a pixel that has to show sky for the pixel to be supervised."""


def mean_inverse_depth(blended: Tensor, opacity: Tensor) -> Tensor:
    """Return a pixel's mean inverse depth (h, w), by the opacities of what it shows.

    The blended one would not do: something nearer that is less opaque has the same.
    """
    return blended / opacity.clamp_min(LEAST_OPACITY)


def resized_blend(blend: tuple[Tensor, Tensor], target: Tensor) -> tuple[Tensor, Tensor]:
    """Return blended values and opacity, (h, w) each, at the size of a target that is not larger."""
    if blend[0].shape == target.shape:
        return blend
    both = F.interpolate(torch.stack(blend)[None], tuple(target.shape), mode="area")[0]
    return both[0], both[1]


def depth_scale(target: Tensor) -> Tensor:
    """Return a scalar: the inverse of a target's median times its number of pixels with depth; 0 without any depth.

    The median sorts all pixels and waits for a GPU.
    """
    typical = target.nanmedian()
    return torch.where(typical > 0.0, 1.0 / ((~target.isnan()).sum() * typical), 0.0)


def depth_loss(inverse: Tensor, target: Tensor, scale: Tensor) -> Tensor:
    """Return the mean absolute difference of inverse depths (h, w) over the target's median, where that is no NaN.

    Args:
        inverse, target: (h, w).
        scale: `depth_scale` of the target.
    """
    valid = ~target.isnan()
    return torch.where(valid, inverse - torch.where(valid, target, 0.0), 0.0).abs().sum() * scale


def sky_loss(opacity: Tensor, sky: Tensor) -> Tensor:
    """Return the mean cross-entropy of an image's opacity (h, w) with transparency in its sky (h, w bool).

    It is the sum of -log(1 - alpha) of the blended Gaussians. So what lies behind opaque ones has a gradient, too.
    """
    left = (1.0 - opacity).clamp_min(LEAST_TRANSMITTANCE)
    return torch.where(sky, -left.log(), 0.0).mean()


def normals_of(inverse: Tensor, camera: Camera) -> Tensor:
    """Return unit normals (3, h - 2, w - 2) towards the camera, in its axes, of inner pixels by inverse depths (h, w).

    On a plane inverse depth is linear in the image, n . (x, y, 1) / d. So differences give its normal exactly.
    """
    across = (inverse[1:-1, 2:] - inverse[1:-1, :-2]) * (camera.fx / 2)
    down = (inverse[2:, 1:-1] - inverse[:-2, 1:-1]) * (camera.fy / 2)
    inner = (torch.arange(1, side - 1, dtype=inverse.dtype, device=inverse.device) for side in camera.size[::-1])
    rows, columns = torch.meshgrid(*inner, indexing="ij")
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    along = inverse[1:-1, 1:-1] - x * across - y * down
    return -F.normalize(torch.stack([across, down, along]), dim=0)


def normal_loss(inverse: Tensor, opacity: Tensor, target: Tensor, camera: Camera) -> Tensor:
    """Return the mean of 1 - cos of the angles between a field's normals and a target, where that is no NaN.

    Pixels count by their opacity, which gets no gradient.

    Args:
        inverse, opacity: (h, w).
        target: (3, h, w) unit normals in the camera's axes.
        camera: of this size.
    """
    wanted = target[:, 1:-1, 1:-1]
    valid = ~wanted.isnan().any(0)
    cosines = (normals_of(inverse, camera) * torch.where(valid, wanted, 0.0)).sum(0)
    weight = valid * opacity.detach()[1:-1, 1:-1]
    return (weight * (1.0 - cosines)).sum() / weight.sum().clamp_min(1.0)


@dataclass
class StageGeometry:
    """Compute the losses of a stage's views by depth, normals and sky, all of one render.

    Attributes:
        rasterizer: renders inverse depths and opacities.
        depths: (h, w) inverse depth by view, in world units, on the device; NaN where there is none.
        normals: (3, h, w) by view, on the device, in the camera's axes; NaN where there is none.
        skies: (h, w) bool by view, on the device, True in the sky.
    """

    rasterizer: Rasterizer
    depths: Mapping[str, Tensor]
    normals: Mapping[str, Tensor]
    skies: Mapping[str, Tensor]
    _scales: dict[str, Tensor] = field(init=False, repr=False)  # of `depths`
    _cameras: dict[str, tuple[Camera, Camera]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self._scales = {name: depth_scale(depth) for name, depth in self.depths.items()}

    def loss(
        self,
        turns: Sequence[int],
        names: Sequence[str],
        cameras: Sequence[Camera],
        gaussians: GaussianField,
        depth_weight: float,
    ) -> Tensor | None:
        """Return the weighted mean loss of some views; None if it is due in none of them.

        Args:
            turns: of the views, whose losses are due at multiples of `EVERY`.
            names: of the views.
            cameras: theirs at the level's size.
            gaussians: the field.
            depth_weight: of the depth loss.
        """
        losses = [
            self._of_view(name, self._camera(name, camera), gaussians, depth_weight)
            for turn, name, camera in zip(turns, names, cameras, strict=True)
            if turn % EVERY == 0 and any(name in those for those in (self.depths, self.normals, self.skies))
        ]
        return EVERY * torch.stack(losses).sum() / len(names) if losses else None

    def _of_view(self, name: str, camera: Camera, gaussians: GaussianField, depth_weight: float) -> Tensor:
        """Return the weighted loss of a view that has depth, normals or sky."""
        blended, opacity = render_inverse_depths(self.rasterizer, gaussians, camera)
        inverse, losses = mean_inverse_depth(blended, opacity), [blended.new_zeros(())]
        if (depth := self.depths.get(name)) is not None:
            losses.append(depth_weight * depth_loss(inverse, depth, self._scales[name]))
        if (normals := self.normals.get(name)) is not None:
            losses.append(NORMAL_WEIGHT * normal_loss(inverse, opacity, normals, camera))
        if (sky := self.skies.get(name)) is not None:
            losses.append(SKY_WEIGHT * sky_loss(opacity, sky))
        return torch.stack(losses).sum()

    def _camera(self, name: str, camera: Camera) -> Camera:
        """Return a view's camera at the size of its target, the same object for the same camera."""
        size = depth_size(camera.size)
        if size == camera.size:
            return camera
        if name not in self._cameras or self._cameras[name][0] is not camera:
            self._cameras[name] = camera, camera.resized(*size)
        return self._cameras[name][1]


def depths_of(depth: DepthTargets, cameras: Mapping[str, Camera], device: torch.device) -> dict[str, Tensor]:
    """Return the inverse depths (h, w) of views at the size of a level, on a device.

    Args:
        depth: of the scene.
        cameras: of the training views at the level's size, by name.
        device: that trains.
    """
    names = [name for name in depth.names if name in cameras]
    return {name: depth.inverse(name, depth_size(cameras[name].size)).to(device) for name in names}


def at_level(normals: Mapping[str, Tensor], cameras: Mapping[str, Camera], device: torch.device) -> dict[str, Tensor]:
    """Return unit normals (3, h, w) of views at the size of a level, NaN where a pixel has none; as `depths_of`."""
    sized = {}
    for name, values in ((name, values) for name, values in normals.items() if name in cameras):
        width, height = depth_size(cameras[name].size)
        known = ~values.isnan().any(0, keepdim=True)
        both = torch.cat([torch.where(known, values, 0.0), known.float()])[None]
        *mean, share = F.interpolate(both, (height, width), mode="area")[0]
        sized[name] = torch.where(share >= 0.5, F.normalize(torch.stack(mean), dim=0), torch.nan).to(device)
    return sized


def skies_of(views: Sequence[View], cameras: Mapping[str, Camera], device: torch.device) -> dict[str, Tensor]:
    """Return which pixels (h, w) show nothing but sky, of those views that have a mask of it; as `depths_of`."""
    skies = {}
    for name, sky in ((view.name, view.sky) for view in views):
        if sky is not None:
            width, height = depth_size(cameras[name].size)
            share = F.interpolate(sky[None].float(), (height, width), mode="area")[0, 0]
            skies[name] = (share > ALL_OF_A_PIXEL).to(device)
    return skies


def depth_weight(plan: StagePlan, stage: Stage, iteration: int) -> float:
    """Return the weight of the depth loss in an iteration of a stage, by the share of the supervised ones before it."""
    supervised = {planned.level: planned.iterations for planned in plan if not planned.signed}
    before = sum(iterations for level, iterations in supervised.items() if level > stage.level)
    progress = min(1.0, (before + iteration) / sum(supervised.values()))
    return FIRST_WEIGHT * math.exp(progress * math.log(LAST_WEIGHT / FIRST_WEIGHT))
