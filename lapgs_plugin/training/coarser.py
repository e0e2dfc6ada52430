"""Predict the views of a residual stage by its coarser levels: from a cache, or rendered while they are trained."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor

from lapgs_plugin.ops.composition import add_prediction
from lapgs_plugin.runs.profiling import Breakdown
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.training.joint import JointFields
from lapgs_plugin.training.model import TrainableField


@dataclass
class CoarserLevels:
    """Predict views by the finished levels under a stage.

    Attributes:
        cached: Up of the previous level's prediction by view name; None for a field that is not a residual.
        joint_from: the iteration from which the finished fields are trained jointly; None if they never are.
        unfreeze: makes them trainable, from their state in a checkpoint or, given None, from the archive.
        breakdown: gets the time in which they are rendered.
        joint: the fields while they are trained jointly; None before.
    """

    cached: UpsampledImages | None
    joint_from: int | None
    unfreeze: Callable[[dict[int, dict[str, Any]] | None], JointFields]
    breakdown: Breakdown
    joint: JointFields | None = None

    def is_joint(self, iteration: int) -> bool:
        """Return whether the fields are trained jointly in an iteration."""
        return self.joint_from is not None and iteration >= self.joint_from

    def start_if_joint(self, iteration: int) -> None:
        """Make the fields trainable in the first iteration that trains them."""
        if self.is_joint(iteration) and self.joint is None:
            self.restore(None)

    def restore(self, states: dict[int, dict[str, Any]] | None) -> None:
        """Train the fields jointly from here on, from a `JointFields.state` or, given None, from the archive."""
        self.joint = self.unfreeze(states)

    def prediction(self, names: Sequence[str]) -> Tensor | None:
        """Return the upsampled prediction (3, h, w) of a view, or (b, 3, h, w) of several; None without levels."""
        if self.joint is not None:
            self.breakdown.mark("forward")
            return self.joint.predict(names)
        return None if self.cached is None else self.cached.get(*names)

    def adder(self, names: Sequence[str]) -> Callable[[Tensor], Tensor]:
        """Return what adds `prediction` to renders of the views."""
        if self.joint is not None:
            self.breakdown.mark("forward")
        below = self.joint or self.cached
        return partial(add_prediction, accumulated=None) if below is None else below.adder(names)

    def prefetch(self, name: str) -> None:
        """Start copying a view's cached prediction to the device."""
        if self.cached is not None and self.joint is None:
            self.cached.prefetch(name)

    @property
    def models(self) -> Sequence[TrainableField]:
        """The fields under joint training."""
        return () if self.joint is None else tuple(self.joint.models.values())
