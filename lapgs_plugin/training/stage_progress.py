"""Hold how far a stage is, for the log and for checkpoints."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lapgs_plugin.runs.manifest import LevelRecord

LOSS_SMOOTHING = 0.95
"""Weight of earlier losses in the loss that is shown and logged: single views differ too much to show a trend."""


@dataclass
class StageProgress:
    """Hold what a stage changes besides the field.

    Attributes:
        iteration: the last finished one, from 1 within the stage; 0 before the first.
        seconds: optimization time of this stage so far.
        loss: smoothed loss, NaN before the first iteration.
        peak_gaussians: most Gaussians optimized at once in this stage.
        gaussian_steps: Gaussians optimized, summed over the iterations.
        most_views: views in one launch that fit into the GPU's memory; None as long as all have.
        start_gaussians: number of Gaussians of the field before the first iteration; None if an older version began.
    """

    iteration: int = 0
    seconds: float = 0.0
    loss: float = math.nan
    peak_gaussians: int = 0
    gaussian_steps: int = 0
    most_views: int | None = None
    start_gaussians: int | None = None

    @classmethod
    def of(cls, record: LevelRecord) -> StageProgress:
        """Return the progress at the end of a finished stage, whose smoothed loss is not kept."""
        mean = record.num_gaussians if record.mean_gaussians is None else record.mean_gaussians
        steps = round(mean * record.iterations)
        start = record.start_gaussians
        return cls(record.iterations, record.train_seconds, math.nan, record.peak_gaussians, steps, None, start)

    def add_loss(self, loss: float, views: int) -> None:
        """Add the mean loss of some views to the smoothed loss."""
        kept = LOSS_SMOOTHING**views
        self.loss = loss if math.isnan(self.loss) else kept * self.loss + (1 - kept) * loss
