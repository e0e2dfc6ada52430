"""Cloning, splitting, pruning and opacity reset, by gsplat's implementation of the 3DGS heuristics."""

from __future__ import annotations

from typing import Any

from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import reset_opa

from lapgs_plugin.raster import RenderResult
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.settings import Densification, StageSchedule


class Densifier:
    """Density control of one stage: feeds a rasterizer's statistics to gsplat's `DefaultStrategy`.

    Args:
        schedule: when the stage densifies and resets.
        settings: thresholds.
        extent: scene extent in world units, which decides what is cloned and what is split.
    """

    def __init__(self, schedule: StageSchedule, settings: Densification, extent: float) -> None:
        self._schedule = schedule
        self._strategy = DefaultStrategy(
            grow_grad2d=settings.grow_grad2d,
            refine_start_iter=schedule.densify_start,
            refine_stop_iter=schedule.densify_until,
            refine_every=schedule.densify_every,
            reset_every=schedule.reset_every,
        )
        self.state: dict[str, Any] = self._strategy.initialize_state(scene_scale=extent)

    def after_step(self, model: TrainableField, iteration: int, result: RenderResult, size: tuple[int, int]) -> bool:
        """Accumulate the statistics of one render and edit the field when the schedule says so.

        Args:
            model: edited in place; its parameters are new tensors afterwards when something changed.
            iteration: counts from 1 within the stage.
            result: the render, after `backward()`.
            size: (width, height) it was rendered at.

        Returns:
            Whether Gaussians were added, removed or reset.
        """
        if iteration >= self._schedule.densify_until:
            return False
        means2d = result.means2d.detach()[None]  # (1, n, 2)
        assert result.means2d.grad is not None
        means2d.grad = result.means2d.grad[None]
        info = {
            "means2d": means2d,
            "radii": result.radii[None, :, None].expand(1, -1, 2),  # (1, n, 2)
            "width": size[0],
            "height": size[1],
            "n_cameras": 1,
            "gaussian_ids": None,
        }
        self._strategy.step_post_backward(model.params, model.optimizers, self.state, iteration, info)
        reset = iteration % self._schedule.reset_every == 0
        if reset:
            # gsplat 1.5.3 never resets (its test reads `== 0 & step > 0`); later versions do, and twice is as once.
            reset_opa(model.params, model.optimizers, self.state, value=self._strategy.prune_opa * 2.0)
        refined = iteration > self._schedule.densify_start and iteration % self._schedule.densify_every == 0
        return refined or reset
