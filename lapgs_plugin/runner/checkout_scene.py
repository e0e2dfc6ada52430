"""Load a checkout's Scene once, and copy it for each stage."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.checkouts.source import OTHERWISE, START
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.errors import SceneError, UserInputError
from lapgs_plugin.reference_raster.layout import JACOBIAN_LIMIT, NEAR_DEPTH
from lapgs_plugin.runner.object_values import with_values
from lapgs_plugin.scenes.colmap import why_no_points
from lapgs_plugin.scenes.scene import require_places, some_of

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CheckoutScene:
    """Hold a checkout's Scene, whose cameras have no images."""

    scene: Any
    points: Any  # the checkout's BasicPointCloud
    others: tuple[Any, ...]  # arguments of `create_from_pcd` after the points

    @classmethod
    def load(cls, call: TrainingCall, adapter: BackboneAdapter, folder: Path) -> CheckoutScene:
        """Make the checkout's Scene without a model, with the arguments that the script gives.

        Args:
            call: the script's call of `training`.
            adapter: adapter of the checkout.
            folder: receives the files that the Scene writes beside a model.

        Raises:
            SceneError: the scene has no points, or no file of them.
            UserInputError: the Scene initialised no model from points, or has cameras at several resolutions.
        """
        model = _PointRecorder()
        own = call.changed(dataset=with_values(call.dataset, {"model_path": str(folder)}))
        source_path = Path(call.dataset.source_path)
        with own.own_folder(), _missing_points_told(source_path):
            scene = adapter.profile.make_scene(own.values, model)
        if not hasattr(model, "points"):
            raise UserInputError(
                f"the Scene of {adapter.root} initialised no model with create_from_pcd, expected of "
                f"{adapter.info.title}; choose another --backbone, or train with `lapgs run --off`"
            )
        if not len(getattr(model.points, "points", ())):  # 3DGS's points are None if it cannot read their PLY
            raise SceneError(why_no_points(source_path))
        for name in ("train_cameras", "test_cameras"):
            scales = getattr(scene, name, None)
            if not isinstance(scales, dict) or len(scales) != 1:
                raise UserInputError(
                    f"the Scene of {adapter.root} has {name} at scales {list(scales or ())}, expected one scale: "
                    "levels have sizes of their own; `lapgs run --off` runs the script as it is"
                )
        return cls(scene, model.points, model.others)

    @property
    def train(self) -> list[Any]:
        """Training cameras."""
        return list(self.scene.getTrainCameras())

    @property
    def test(self) -> list[Any]:
        """Held-out cameras."""
        return list(self.scene.getTestCameras())

    def check_points(self) -> None:
        """Say if the rasterizer would draw few of the points that training starts from, or none.

        Raises:
            SceneError: they are at too few places to have sizes.
        """
        points = torch.as_tensor(np.asarray(self.points.points)).float()  # (n, 3)
        require_places(points, "the scene has")
        seen = [_depths_in_view(camera, some_of(points)) for camera in self.train]
        near, ahead = sum(int((depths <= NEAR_DEPTH).sum()) for depths in seen), sum(map(len, seen))
        if 2 * near > ahead:
            factor = 10.0 ** math.ceil(math.log10(NEAR_DEPTH / float(torch.cat(seen).median())) + 1)
            logger.warning(
                "%d %% of the points in view are nearer to the cameras than %g, the near plane of 3DGS rasterizers, "
                "which draw nothing there; `lapgs train` takes scenes of any size, or scale poses and points by %g",
                100 * near // ahead,
                NEAR_DEPTH,
                factor,
            )
        dark = [camera for camera, depths in zip(self.train, seen, strict=True) if not (depths > NEAR_DEPTH).any()]
        dark = [camera for camera in dark if not (_depths_in_view(camera, points) > NEAR_DEPTH).any()]
        if dark:
            logger.warning(
                "no Gaussian will be visible at first in %d of %d training views, such as %s; check that the points "
                "and the cameras are of one model",
                len(dark),
                len(seen),
                dark[0].image_name,
            )

    def copy(self, gaussians: Any, model_path: str, train: list[Any], test: list[Any]) -> Any:
        """Return the checkout's Scene with another model, output folder and cameras."""
        cameras = {"train_cameras": train, "test_cameras": test}
        lists = {name: dict.fromkeys(getattr(self.scene, name), views) for name, views in cameras.items()}
        return with_values(self.scene, {"gaussians": gaussians, "model_path": model_path, **lists})


@contextmanager
def _missing_points_told(scene: Path) -> Iterator[None]:
    """Turn a checkout's error that a scene's file of points is not there into one line."""
    try:
        yield
    except FileNotFoundError as error:
        if Path(error.filename or "").stem.lower() == "points3d":
            raise SceneError(why_no_points(scene)) from error
        raise


class _PointRecorder:
    """Take the place of the model that a Scene initialises, and keep the points."""

    def create_from_pcd(self, points: Any, *others: Any) -> None:
        self.points, self.others = points, others

    def __getattr__(self, name: str) -> Any:
        if name.startswith(("load", "create", "restore")):
            raise UserInputError(
                f"the checkout's Scene makes its model by {name}(), expected {START}() of a scene's points: it trains "
                f"on a finished model; {OTHERWISE}"
            )
        raise AttributeError(f"the model of a scene has no {name} before it is made of points")


def _depths_in_view(camera: Any, points: Tensor) -> Tensor:
    """Return the depths of those points (n, 3) that a checkout's camera would show, hidden ones among them."""
    pose = camera.world_view_transform.detach().to("cpu", points.dtype)  # (4, 4), for rows
    local: Tensor = points @ pose[:3, :3] + pose[3, :3]
    x, y, depths = local.unbind(1)
    tangents = [math.tan(getattr(camera, name, math.pi / 2) / 2) for name in ("FoVx", "FoVy")]
    # Gaussians that are centred a little outside of the image reach into it.
    inside = [axis.abs() < JACOBIAN_LIMIT * tangent * depths for axis, tangent in zip((x, y), tangents, strict=True)]
    return depths[(depths > 0) & inside[0] & inside[1]]
