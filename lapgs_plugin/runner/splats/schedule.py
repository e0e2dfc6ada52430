"""Change a script's settings for one stage of a run with residuals."""

from __future__ import annotations

import copy
from typing import Any

from lapgs_plugin.checkouts.training_call import StageWindow
from lapgs_plugin.hierarchy.settings import HierarchySettings

THRESHOLD = "grow_grad2d"
"""Threshold of gsplat's DefaultStrategy on screen-space gradients."""
NEVER = 10**9
"""An interval that no run reaches."""


def stage_config(config: Any, window: StageWindow, result_dir: str, settings: HierarchySettings) -> Any:
    """Return a script's settings for one stage: schedule scaled to its length, its own output folder.

    Args:
        config: settings of the whole run.
        window: the stage.
        result_dir: of its outputs.
        settings: of the hierarchy.
    """
    own, stage = copy.copy(config), window.stage
    own.strategy = copy.copy(config.strategy)
    own.result_dir, own.max_steps = result_dir, stage.iterations
    for name in ("eval_steps", "save_steps", "ply_steps"):
        if hasattr(own, name):
            setattr(own, name, window.local(getattr(own, name)))
    for name, value in vars(own.strategy).items():
        if name.endswith("_stop_iter") and value > 0:
            setattr(own.strategy, name, window.scaled(value))
    set_threshold(own.strategy, config.strategy, window.threshold_factor)
    if stage.signed and hasattr(own.strategy, "reset_every") and not settings.residual_resets:
        own.strategy.reset_every = NEVER
    return own


def set_threshold(strategy: Any, of_run: Any, factor: float) -> None:
    """Set a strategy's threshold of densification to that of the run's, times a factor; MCMC has none."""
    if hasattr(of_run, THRESHOLD):
        setattr(strategy, THRESHOLD, getattr(of_run, THRESHOLD) * factor)
