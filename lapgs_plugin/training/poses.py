"""Refine the poses of the training views: `--refine-poses`.

Each view has a correction of its camera, see `fields.pose`, which learns with the field. What all corrections have in
common, a similarity transform of the scene, is removed, so that held-out views stay aligned with the field. Where
corrections change slowly from view to view, held-out views are moved as their neighbours are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any, ClassVar

import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.pose import corrected, turned_gradient, with_pose_gradient
from lapgs_plugin.runs.archive import Poses
from lapgs_plugin.runs.neighbours import predicted_poses
from lapgs_plugin.scenes.scene import View
from lapgs_plugin.stages.view_transforms import ViewTransforms
from lapgs_plugin.training.views import LevelView

FIRST_RATE = 0.1
"""Adam's step size at the start of a run, in pixels of the full image that a turn shifts it by."""
LAST_RATE = 0.002
"""The same at the end of a run."""
LEAST_VARIATION = 1e-6
"""Similarity transforms that move cameras less than this, relative to the others, are not removed."""


@dataclass
class ViewPoses(ViewTransforms):
    """Hold and optimize the corrections (v, 6) of all training views: radians, and shifts in units of the extent.

    Attributes:
        cameras: of the views as they came, by name, at full size.
        extent: of the scene, in world units.
    """

    STARTS_AT: ClassVar[float] = 0.2  # a field that still takes shape draws poses anywhere

    cameras: Mapping[str, Camera]
    extent: float
    _moved: dict[tuple[str, int, int], Camera] = field(default_factory=dict, repr=False)
    _centres: dict[str, Tensor] = field(default_factory=dict, repr=False)
    _known: Poses = field(default_factory=dict, repr=False)  # `archived` since the last step
    _common: Tensor = field(init=False, repr=False)  # (6 v, k) orthonormal

    def __post_init__(self) -> None:
        super().__post_init__()
        self._common = _similarities([camera.position for camera in self.cameras.values()], self.extent)
        self._common = self._common.to(self.transforms)

    @classmethod
    def create(
        cls, views: Sequence[View], start: Poses, extent: float, device: torch.device, done: int, total: int
    ) -> ViewPoses:
        """Start a stage with empty moments from archived corrections; views without one start uncorrected."""
        rows = torch.tensor([start.get(view.name, [0.0] * 6) for view in views])
        rows[:, 3:] /= extent
        cameras = {view.name: view.camera for view in views}
        return cls([*cameras], torch.nn.Parameter(rows.to(device)), done, total, cameras, extent)

    def camera(self, name: str, camera: Camera) -> Camera:
        """Return a view's camera, of any size, at the refined pose; for held-out views see `runs.neighbours`.

        It is the same object until the next step: a rasterizer may know it by that.
        """
        self._known = self._known or self.archived()
        key = name, camera.width, camera.height
        if key not in self._moved:
            known = self._known if name in self._index else predicted_poses(self._known, [name])
            self._moved[key] = corrected(camera, known[name]) if name in known else camera
        return self._moved[key]

    def watched(self, name: str, gaussians: GaussianField) -> GaussianField:
        """Return the same field for one render of a view, whose backward pass adds to the gradient of its pose."""
        if name not in self._index:
            return gaussians
        if name not in self._centres:
            centre = self.camera(name, self.cameras[name]).position
            self._centres[name] = centre.to(gaussians.means, non_blocking=True)
        return with_pose_gradient(gaussians, self.transforms[self._index[name]], self._centres[name], self.extent)

    def archived(self) -> Poses:
        """Return the corrections by view, shifts in world units."""
        rows = self.transforms.detach().cpu().double()
        rows = torch.cat([rows[:, :3], rows[:, 3:] * self.extent], dim=1)
        return dict(zip(self.names, rows.tolist(), strict=True))

    @property
    def _rates(self) -> tuple[float, float]:
        focal = median(camera.fx for camera in self.cameras.values())
        return FIRST_RATE / focal, LAST_RATE / focal

    def _step(self) -> None:
        gradient = self.transforms.grad
        if gradient is None:
            return  # no view's pose was refined in this pass
        gradient[:, :3] = turned_gradient(self.transforms.detach()[:, :3], gradient[:, :3])
        super()._step()
        self._forget_cameras()

    def restore(self, state: Mapping[str, Any]) -> None:
        """See `ViewTransforms.restore`."""
        super().restore(state)
        self._forget_cameras()

    def _forget_cameras(self) -> None:
        self._known = {}
        self._moved.clear()
        self._centres.clear()

    def _recentre(self) -> None:
        flat = self.transforms.view(-1)
        flat.sub_(self._common @ (self._common.T @ flat))


def at_pose(view: LevelView, poses: ViewPoses | None) -> LevelView:
    """Return a view at its refined pose, or as it came."""
    return view if poses is None else replace(view, camera=poses.camera(view.name, view.camera))


def _similarities(centres: Sequence[Tensor], extent: float) -> Tensor:
    """Return an orthonormal basis (6 v, k) of the corrections that small similarity transforms of the scene make.

    Args:
        centres: (3,) of v cameras.
        extent: of the scene, the unit of shifts.
    """
    places = torch.stack(list(centres)).double()
    places = (places - places.mean(0)) / extent  # (v, 3)
    axes = torch.eye(3, dtype=torch.float64).expand(len(places), 3, 3)
    nothing = torch.zeros_like(axes)
    turns = torch.cat([-axes, torch.linalg.cross(axes, places[:, :, None].expand_as(axes), dim=1)], dim=1)  # (v, 6, 3)
    shifts = torch.cat([nothing, axes], dim=1)
    growth = torch.cat([nothing[:, :, 0], places], dim=1)[:, :, None]  # (v, 6, 1)
    columns = torch.cat([turns, shifts, growth], dim=2).flatten(0, 1)  # (6 v, 7)
    basis: Tensor
    basis, sizes, _ = torch.linalg.svd(columns, full_matrices=False)
    return basis[:, sizes > LEAST_VARIATION * sizes[0]]
