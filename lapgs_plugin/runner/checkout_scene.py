"""Load a checkout's Scene once, and copy it for each stage."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lapgs_plugin.adapters.base import BackboneAdapter
from lapgs_plugin.checkouts.source import OTHERWISE, START
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.errors import SceneError, UserInputError
from lapgs_plugin.runner.object_values import with_values
from lapgs_plugin.scenes.colmap import why_no_points


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
            SceneError: the scene has no points.
            UserInputError: the Scene initialised no model from points, or has cameras at several resolutions.
        """
        model = _PointRecorder()
        own = call.changed(dataset=with_values(call.dataset, {"model_path": str(folder)}))
        with own.own_folder():
            scene = adapter.profile.make_scene(own.values, model)
        if not hasattr(model, "points"):
            raise UserInputError(
                f"the Scene of {adapter.root} initialised no model with create_from_pcd, expected of "
                f"{adapter.info.title}; choose another --backbone, or train with `lapgs run --off`"
            )
        if not len(getattr(model.points, "points", ())):  # 3DGS's points are None if it cannot read their PLY
            raise SceneError(why_no_points(Path(call.dataset.source_path)))
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

    def copy(self, gaussians: Any, model_path: str, train: list[Any], test: list[Any]) -> Any:
        """Return the checkout's Scene with another model, output folder and cameras."""
        cameras = {"train_cameras": train, "test_cameras": test}
        lists = {name: dict.fromkeys(getattr(self.scene, name), views) for name, views in cameras.items()}
        return with_values(self.scene, {"gaussians": gaussians, "model_path": model_path, **lists})


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
