"""Order the training views of a stage, reproducibly, and bring their cameras to the level's size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.scenes.scene import View


@dataclass(frozen=True)
class LevelView:
    """Describe a training view at one pyramid level.

    Attributes:
        name: of the image, unique in the scene.
        camera: the view's camera at the level's size.
    """

    name: str
    camera: Camera


def level_views(views: Sequence[View], level: int) -> tuple[LevelView, ...]:
    """Return every view with its camera at `level`."""
    return tuple(LevelView(view.name, level_camera(view.camera, level)) for view in views)


def view_index(iteration: int, count: int, seed: int, level: int) -> int:
    """Return which of `count` views an iteration (from 1) of a stage trains: every view once an epoch, shuffled.

    A pure function of its arguments, so that a resumed run sees the same views as an uninterrupted one.
    """
    epoch, position = divmod(iteration - 1, count)
    return shuffled(count, seed, level, epoch)[position]


@lru_cache(maxsize=4)
def shuffled(count: int, seed: int, level: int, number: int) -> list[int]:
    """Return `count` views of a level in the random order of that number."""
    draw = (seed * 1_000_003 + level) * 1_000_003 + number
    generator = torch.Generator().manual_seed(draw % 2**63)  # the generator takes no larger seed
    order: list[int] = torch.randperm(count, generator=generator).tolist()
    return order
