"""Keep the cameras of a run whose script changed those of its scene: by a normalised world, or rounded intrinsics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.fields.camera import Camera

Numbers = Annotated[list[float], Field(min_length=22, max_length=22)]
CameraTable = dict[str, dict[str, Numbers]]
"""Cameras as JSON, under "train" and "test" by view name: width, height, fx, fy, cx, cy, and the pose row by row."""
TRAIN, TEST = "train", "test"


@dataclass(frozen=True)
class TrainedCameras:
    """Hold the cameras of training and held-out views by name, in the world of the run's fields."""

    train: Mapping[str, Camera]
    test: Mapping[str, Camera]

    def as_json(self) -> dict[str, Any]:
        """Return them as a `CameraTable`."""
        return {
            part: {name: _numbers(camera) for name, camera in cameras.items()}
            for part, cameras in ((TRAIN, self.train), (TEST, self.test))
        }

    @classmethod
    def from_json(cls, table: CameraTable, name: str) -> TrainedCameras:
        """Invert `as_json`; `name` names the file in messages.

        Raises:
            RunFolderError: a part is missing, or a size is no positive whole number.
        """
        if table.keys() != {TRAIN, TEST}:
            raise RunFolderError(
                f"{name} has {', '.join(table) or 'nothing'}, expected {TRAIN} and {TEST}; train again"
            )
        bad = next((view for part in table.values() for view, row in part.items() if not _is_camera(row)), None)
        if bad is not None:
            raise RunFolderError(f"{name}: the camera of {bad} has no size or focal length; train again")
        return cls(*({view: _camera(row) for view, row in table[part].items()} for part in (TRAIN, TEST)))


def _numbers(camera: Camera) -> list[float]:
    pose: Tensor = camera.world_to_camera.double()
    return [*camera.size, camera.fx, camera.fy, camera.cx, camera.cy, *pose.flatten().tolist()]


def _is_camera(row: list[float]) -> bool:
    sizes, focal = row[:2], row[2:4]
    return all(1 <= side < 1 << 31 and side == int(side) for side in sizes) and min(focal) > 0


def _camera(row: list[float]) -> Camera:
    pose = torch.tensor(row[6:], dtype=torch.float64).view(4, 4).float()
    return Camera(int(row[0]), int(row[1]), row[2], row[3], row[4], row[5], pose)
