"""Write the figures of a run for TensorBoard: `lapgs train --log tensorboard`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Stage, StagePlan
from lapgs_plugin.training.monitor import Monitor, Tick

if TYPE_CHECKING:
    from torch.utils.tensorboard.writer import SummaryWriter

FIGURES: Mapping[str, str] = {
    "loss": "training/loss",
    "num_gaussians": "training/gaussians",
    "rate": "training/iterations a second",
    "psnr": "held out/PSNR",
    "sampled_psnr": "held out/PSNR of some views",
    "sampled_fitted_psnr": "held out/PSNR of some views after a colour fit",
}
"""Names of a tick's figures in TensorBoard, by its attributes."""


def require_tensorboard() -> None:
    """Raise a UserInputError if TensorBoard is not installed."""
    try:
        import torch.utils.tensorboard.writer  # noqa: F401  # whether it is there
    except ImportError as error:
        raise UserInputError(
            "--log tensorboard: TensorBoard is not installed; pip install 'lapgs_plugin[tensorboard]', or leave the "
            "option out: history.jsonl of the run folder has the same figures"
        ) from error


class TensorboardMonitor(Monitor):
    """Write every tick as scalars, and pass everything on to another monitor. Use as a context manager.

    Args:
        folder: of the event files.
        plan: stages of the run; steps count the iterations of all of them.
        shown: the other monitor.
    """

    def __init__(self, folder: Path, plan: StagePlan, shown: Monitor) -> None:
        self._folder, self._plan, self._shown = folder, plan, shown
        self._writer: SummaryWriter | None = None

    def __enter__(self) -> TensorboardMonitor:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()

    def stage_started(self, stage: Stage, first_iteration: int) -> None:
        if self._writer is None:
            from torch.utils.tensorboard.writer import SummaryWriter

            step = self._step(stage.level, first_iteration)
            # TensorBoard drops later steps of an interrupted run, which are trained again.
            self._writer = SummaryWriter(str(self._folder), purge_step=step)
        self._shown.stage_started(stage, first_iteration)

    def tick(self, stage: Stage, tick: Tick) -> None:
        assert self._writer is not None, "a stage has started"
        self._plan = self._plan.lasting(stage.level, stage.iterations)  # with --time its length changes
        for name, title in FIGURES.items():
            if (value := getattr(tick, name)) is not None:
                step = self._step(tick.level, tick.iteration)
                self._writer.add_scalar(title, value, step)
        self._shown.tick(stage, tick)

    def say(self, text: str) -> None:
        self._shown.say(text)

    def _step(self, level: int, iteration: int) -> int:
        """Return the number of iterations of the run up to one of a stage."""
        return iteration + self._plan.iterations_before(level)
