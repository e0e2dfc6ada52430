"""Look at a run between iterations, outside training's clock, without changing it.

A `StageHook` takes part in an iteration and may change it. A `Watcher` only looks at the field.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from lapgs_plugin.hierarchy.plan import Stage

if TYPE_CHECKING:
    from lapgs_plugin.fields.gaussian_field import GaussianField
    from lapgs_plugin.runs.archive import RunArchive


class Watcher:
    """Watch a run. Each method here does nothing; the thread that trains calls them all."""

    def run_started(self, archive: RunArchive) -> None:
        """Receive the folder of a run that begins or is resumed, with the levels that are finished."""

    def stage_started(self, stage: Stage) -> None:
        """Receive a stage before its first iteration."""

    def wants_look(self) -> bool:
        """Return whether to call `look` now. Called after every iteration, so it must be fast."""
        return False

    def look(
        self,
        stage: Stage,
        iteration: int,
        fields: Callable[[], Mapping[int, GaussianField]],
        interrupted: Callable[[], bool],
    ) -> None:
        """Look at the fields under training, for as long as it takes.

        Args:
            stage: in training.
            iteration: the last finished one, from 1 within the stage.
            fields: returns current fields by level, without gradients: the stage's, and finished ones that are trained
                jointly. They may change when `look` has returned.
            interrupted: returns whether the user asked training to stop; call it regularly while you wait.
        """

    def stage_finished(self, stage: Stage, fields: Callable[[], Mapping[int, GaussianField]]) -> None:
        """Receive an archived stage; `fields` returns its field and jointly trained ones by level."""
