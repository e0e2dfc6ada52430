"""Check the options of a command without running it. Experiments check all runs before the first one starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lapgs_plugin.runner.settings import RunSettings
    from lapgs_plugin.training.preparation import TrainRequest


class Rehearsal:
    """Receive the checked options of a command. With a Rehearsal as its context's object, a command ends there."""

    def train(self, request: TrainRequest) -> None:
        """Receive the request of a command line of `lapgs train`."""

    def run(self, settings: RunSettings, arguments: Sequence[str]) -> None:
        """Receive the settings of `lapgs run` and the script's own arguments."""
