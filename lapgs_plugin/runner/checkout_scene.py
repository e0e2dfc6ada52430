"""Load a checkout's Scene once, and copy it for each stage."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lapgs_plugin.adapters.base import BackboneAdapter, TrainingCall
from lapgs_plugin.errors import UserInputError


@dataclass(frozen=True)
class CheckoutScene:
    """Hold a checkout's Scene, whose cameras have no images."""

    scene: Any
    points: Any  # the checkout's BasicPointCloud
    others: tuple[Any, ...]  # arguments of `create_from_pcd` after the points

    @classmethod
    def load(
        cls, make_scene: Callable[..., Any], call: TrainingCall, adapter: BackboneAdapter, folder: Path
    ) -> CheckoutScene:
        """Make the checkout's Scene without a model.

        Args:
            make_scene: the checkout's Scene class.
            call: the script's call of `training`.
            adapter: adapter of the checkout.
            folder: receives the files that the Scene writes beside a model.

        Raises:
            UserInputError: the Scene initialised no model from points.
        """
        model = _PointRecorder()
        scene = make_scene(_with_attributes(call.dataset, model_path=str(folder)), model)
        if not hasattr(model, "points"):
            raise UserInputError(
                f"the Scene of {adapter.script.checkout} initialised no model with create_from_pcd, expected of "
                f"{adapter.info.title}; choose another --backbone, or train with `lapgs run --off`"
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
        return _with_attributes(
            self.scene,
            gaussians=gaussians,
            model_path=model_path,
            train_cameras={1.0: train},
            test_cameras={1.0: test},
        )


class _PointRecorder:
    """Take the place of the model that a Scene initialises, and keep the points."""

    def create_from_pcd(self, points: Any, *others: Any) -> None:
        self.points, self.others = points, others


def _with_attributes(value: Any, **changes: Any) -> Any:
    """Return a shallow copy with other attributes."""
    changed = copy.copy(value)
    for name, new in changes.items():
        setattr(changed, name, new)
    return changed
