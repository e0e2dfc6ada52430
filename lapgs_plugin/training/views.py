"""What a stage trains on: every view at the level's size, in a reproducible order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lapgs_plugin.camera import Camera
from lapgs_plugin.pyramid import Pyramid
from lapgs_plugin.rendering.compose import level_camera
from lapgs_plugin.scenes.scene import View


@dataclass(frozen=True)
class LevelView:
    """A training view at one pyramid level.

    Attributes:
        name: of the image, unique in the scene.
        camera: the view's camera at the level's size.
        target: (3, h, w) the image's Gaussian pyramid at this level, float32.
        coarse_target: (3, h, w) Up of the next coarser level of the same pyramid; None at the coarsest level.
    """

    name: str
    camera: Camera
    target: Tensor
    coarse_target: Tensor | None


def level_views(
    views: Sequence[View], level: int, levels: int, pyramid: Pyramid, with_coarse: bool
) -> tuple[LevelView, ...]:
    """Every view's camera and target at `level`.

    Args:
        with_coarse: also keep Up of the coarser target, which only the `gt_laplacian` supervision looks at.
    """
    made = []
    for view in views:
        camera = level_camera(view.camera, level)
        coarse = None
        if with_coarse and level < levels - 1:
            images = pyramid.gaussian(view.image, level + 2)
            target, coarse = images[level], pyramid.up(images[level + 1], (camera.height, camera.width))
        else:
            target = pyramid.gaussian(view.image, level + 1)[level]
        made.append(LevelView(view.name, camera, target.contiguous(), coarse))
    return tuple(made)


def view_index(iteration: int, count: int, seed: int, level: int) -> int:
    """Which of `count` views iteration `iteration` (from 1) of a stage trains: every view once an epoch, shuffled.

    A pure function of its arguments, so that a resumed run sees the views an uninterrupted one would have seen.
    """
    epoch, position = divmod(iteration - 1, count)
    generator = torch.Generator().manual_seed((seed * 1_000_003 + level) * 1_000_003 + epoch)
    return int(torch.randperm(count, generator=generator)[position])
