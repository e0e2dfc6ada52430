"""Hold the stage that is running, which answers the replaced symbols of a checkout."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.runner.stage_rendering import StageRendering
from lapgs_plugin.runner.step_clock import TimedLoop
from lapgs_plugin.stages.record import LoopRecord


class RunningStage(TimedLoop):
    """Answer the replaced symbols of a checkout while its `training` runs for a stage.

    Args:
        stage: its level, size and length.
        rendering: how its images are rendered.
        record: its measurements.
    """

    def __init__(self, stage: Stage, rendering: StageRendering, record: LoopRecord) -> None:
        super().__init__(record)
        self.stage, self.rendering = stage, rendering

    @abstractmethod
    def entered(self) -> AbstractContextManager[None]:
        """Prepare the stage, act on exceptions raised inside, and release its images and models."""

    @abstractmethod
    def scene_for(self, gaussians: Any) -> Any:
        """Return the scene of this stage, and initialise `gaussians` from it."""

    def optimizers_made(self, gaussians: Any) -> None:
        """Prepare the optimizers that the checkout has just set up."""

    def densified(self, gaussians: Any) -> None:
        """Act after density control."""


class Stages:
    """Hold the running stage.

    Attributes:
        running: the stage that answers the replaced symbols; None between stages.
        rendering: how the checkout's rasterizers render; None leaves their calls unchanged.
    """

    def __init__(self) -> None:
        self.running: RunningStage | None = None
        self.rendering: StageRendering | None = None

    @contextmanager
    def run(self, stage: RunningStage) -> Iterator[None]:
        """Let a stage answer the replaced symbols inside."""
        assert self.running is None, "one stage runs at a time"
        self.running = stage
        try:
            with self.rendering_as(stage.rendering), stage.entered():
                yield
        finally:
            self.running = None

    @contextmanager
    def rendering_as(self, rendering: StageRendering) -> Iterator[None]:
        """Render otherwise inside, with or without a running stage."""
        outer, self.rendering = self.rendering, rendering
        try:
            yield
        finally:
            self.rendering = outer
