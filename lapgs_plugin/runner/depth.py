"""Supervise depth in a checkout's training loop, which does not know of it.

Its rasterizer blends inverse depths instead of colours, in a second call for the same view. The loss is added as a
hook's is: the image stays the same, and a backward pass through it adds the loss's gradients.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.level_views import SceneImages, view_name
from lapgs_plugin.errors import UserInputError, typed_line
from lapgs_plugin.fields.rasterizer import BEHIND_CAMERA
from lapgs_plugin.hierarchy.plan import Stage, StagePlan
from lapgs_plugin.runner.hook_calls import HookCaller, with_term
from lapgs_plugin.runner.object_values import RasterOutputs, fields_of, size_of
from lapgs_plugin.runner.running_stage import Stages
from lapgs_plugin.runner.signed_calls import BACKGROUNDS
from lapgs_plugin.runner.stage_rendering import Captured, OnCall
from lapgs_plugin.scenes.depth import DepthTargets, depth_size, load_depth, resolve_depth
from lapgs_plugin.scenes.masks import NONE, stem_of
from lapgs_plugin.scenes.scene import View, load_scene
from lapgs_plugin.stages.geometry import (
    EVERY,
    depth_loss,
    depth_scale,
    depth_weight,
    mean_inverse_depth,
    resized_blend,
)

logger = logging.getLogger(__name__)

RANGE_MARGIN = 1e-3
"""Relative amount by which a blended inverse depth may lie outside of those of the Gaussians, and opacity above 1."""
SEEN = 0.5
"""Least opacity of a pixel whose depth is checked."""


@dataclass(frozen=True)
class CheckoutDepth:
    """Add depth losses to the images of a checkout's loop.

    Attributes:
        targets: of the scene.
        names: of the views in `targets`, by key of the checkout's view.
        stages: hold the running stage.
        hooks: know whether a score is being computed, which has no losses.
        device: that trains.
    """

    targets: DepthTargets
    names: Mapping[str, str]
    stages: Stages
    hooks: HookCaller
    device: torch.device

    @classmethod
    def load(
        cls,
        setting: str,
        dataset: Any,
        images: SceneImages,
        keys: Sequence[str],
        stages: Stages,
        hooks: HookCaller,
        device: torch.device,
    ) -> CheckoutDepth | None:
        """Read the depth of a checkout's training views; None without --depth.

        Args:
            setting: value of --depth.
            dataset: the script's options of its model.
            images: of the scene, with masks.
            keys: of the training views.
            stages, hooks, device: see the attributes.

        Raises:
            SceneError, UserInputError: as `scenes.depth`.
        """
        source, folder = Path(dataset.source_path), getattr(dataset, "images", None) or "images"
        resolved = resolve_depth(source, setting)
        if resolved == NONE:
            return None
        if own := getattr(dataset, "depths", ""):
            logger.warning("--depth %s and the script's --depths %s both supervise depth; leave one out", setting, own)
        scene = load_scene(source, images=folder, masks=NONE, progress=False, read=False)
        names = _names_by_key(keys, [view.name for view in scene.train])
        key_of = {name: key for key, name in names.items()}
        masked = partial(_with_mask, images)
        train = tuple(masked(view, key_of[view.name]) for view in scene.train if view.name in key_of)
        targets = load_depth(replace(scene, train=train), resolved, folder, lambda line: logger.info("%s", line))
        assert targets is not None, "there is depth"
        return cls(targets, names, stages, hooks, device)

    def in_stage(self, plan: StagePlan, stage: Stage, sizes: Mapping[str, tuple[int, int]]) -> OnCall:
        """Return the function that adds the loss of a stage's views to their images.

        Args:
            plan: of the run.
            stage: of the plan, no residual.
            sizes: (width, height) of the stage's views by key.
        """
        present, targets = {*self.targets.names}, dict[str, tuple[Tensor, Tensor]]()  # with scales

        def on_call(
            key: str, image: Tensor, rasterizer: Callable[..., Any], inputs: Mapping[str, Any], settings: Any
        ) -> Tensor:
            running = self.stages.running
            iteration = 1 if running is None else max(1, running.iteration)
            if iteration % EVERY or self.hooks.paused or self.names.get(key) not in present or key not in sizes:
                return image
            if key not in targets:
                own = self.targets.inverse(self.names[key], depth_size(sizes[key])).to(self.device)
                targets[key] = own, depth_scale(own)
            target, scale = targets[key]
            blend = resized_blend(blended_inverse_depths(rasterizer, inputs, settings), target)
            loss = depth_loss(mean_inverse_depth(*blend), target, scale)
            return with_term(image, EVERY * depth_weight(plan, stage, iteration) * loss)

        return on_call


def blended_inverse_depths(
    rasterizer: Callable[..., Any], inputs: Mapping[str, Any], settings: Any
) -> tuple[Tensor, Tensor]:
    """Return blended inverse depths and opacity (h, w) by a checkout's rasterizer, as `render_inverse_depths`.

    Args:
        rasterizer: with its settings.
        inputs: of a call for colours, by name.
        settings: of the rasterizer.

    Raises:
        UserInputError: the inputs or the settings are not those of 3DGS's rasterizers.
    """
    fields = fields_of(settings)
    background = next((fields[name] for name in BACKGROUNDS if isinstance(fields.get(name), Tensor)), None)
    pose = fields.get("viewmatrix")
    if background is None or not isinstance(pose, Tensor) or not {"shs", "colors_precomp"} & inputs.keys():
        raise UserInputError(
            f"the rasterizer takes {', '.join(inputs)} with the settings {', '.join(fields)}; expected shs or "
            "colors_precomp with bg and viewmatrix"
        )
    pose, background = pose.reshape(4, 4), background.flatten()
    depths = inputs["means3D"] @ pose[:3, 2] + pose[3, 2]  # matrices of 3DGS are transposed
    inverse = torch.where(depths > BEHIND_CAMERA, depths, 1.0).reciprocal()
    shown = (background[1] < 0.5).to(inverse)  # unlike the background, so that the second channel tells the opacity
    colors = torch.stack([inverse, shown.expand_as(inverse), torch.zeros_like(inverse)], 1)
    others = {name: value for name, value in inputs.items() if name not in ("dc", "shs")}
    if isinstance(centres := others.get("means2D"), Tensor):
        others["means2D"] = torch.zeros_like(centres)  # density control reads the gradients of the image alone
    image = RasterOutputs.of(rasterizer(**{**others, "colors_precomp": colors}), size_of(settings)).image
    left = (image[1] - shown) / (background[1] - shown)  # transmittance
    return image[0] - left * background[0], 1.0 - left


@torch.no_grad()
def require_depth(setting: str, captured: Captured) -> None:
    """Check that a checkout's rasterizer renders depths.

    Args:
        setting: value of --depth.
        captured: a call of it.

    Raises:
        UserInputError: it does not.
    """
    try:
        blended, opacity = blended_inverse_depths(captured.rasterizer, captured.inputs, captured.settings)
        pose = fields_of(captured.settings)["viewmatrix"].reshape(4, 4)
        depths = captured.inputs["means3D"] @ pose[:3, 2] + pose[3, 2]
        nearest, farthest = depths[depths > BEHIND_CAMERA].aminmax()
        mean = mean_inverse_depth(blended, opacity)[opacity > SEEN]
        outside = mean * nearest > 1 + RANGE_MARGIN, mean * farthest < 1 - RANGE_MARGIN, opacity > 1 + RANGE_MARGIN
        if any(bool(wrong.any()) for wrong in outside):
            raise UserInputError("what it blends instead of colours are not the Gaussians' depths")
    except torch.cuda.OutOfMemoryError:
        raise
    except Exception as error:
        why = str(error) if isinstance(error, UserInputError) else typed_line(error)
        raise UserInputError(
            f"--depth {setting}: the checkout's rasterizer renders no depths ({why}); leave it out, take ours with "
            "--rasterizer lapgs, or use `lapgs train`"
        ) from error


def _with_mask(images: SceneImages, view: View, key: str) -> View:
    return View(view.name, view.camera, lambda: view.image, partial(images.mask, key) if images.masked else None)


def _names_by_key(keys: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return the names of photos in the scene by key of a checkout's views, which may lack folders and suffixes."""
    spellings = [{name, stem_of(name), PurePosixPath(name).name, PurePosixPath(stem_of(name)).name} for name in names]
    uses = Counter(spelling for own in spellings for spelling in own)
    known = {
        spelling: name for name, own in zip(names, spellings, strict=True) for spelling in own if uses[spelling] == 1
    }
    return {key: known[name] for key in keys if (name := view_name(key)) in known}
