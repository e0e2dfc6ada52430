"""Who looks at a run while it is trained, without being part of it: asked between iterations, outside training's clock.

A `StageHook` takes part in an iteration and may change it. A `Watcher` is shown the field and changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from lapgs_plugin.hierarchy.plan import Stage

if TYPE_CHECKING:
    from lapgs_plugin.fields.gaussian_field import GaussianField
    from lapgs_plugin.runs.archive import RunArchive


class Watcher:
    """Base of whoever watches a run. Each method does nothing; all are called by the thread that trains."""

    def run_started(self, archive: RunArchive) -> None:
        """A run begins or is resumed; `archive` is its folder, with the levels that are finished."""

    def stage_started(self, stage: Stage) -> None:
        """A stage's first iteration is next."""

    def wants_look(self) -> bool:
        """Whether to call `look` now; asked after every iteration, so it must cost next to nothing."""
        return False

    def look(
        self,
        stage: Stage,
        iteration: int,
        fields: Callable[[], Mapping[int, GaussianField]],
        interrupted: Callable[[], bool],
    ) -> None:
        """Look at what is under training, for as long as it takes.

        Args:
            stage: that runs.
            iteration: the last finished one, from 1 within the stage.
            fields: gives the current parameters by level: those of the stage, and of finished levels where they are
                trained along; without gradients. They may change when `look` has returned.
            interrupted: whether the user asked training to stop; whoever waits for anything asks it now and then.
        """

    def stage_finished(self, stage: Stage, fields: Callable[[], Mapping[int, GaussianField]]) -> None:
        """A stage is archived; `fields` gives its result, and finished fields that were trained along, by level."""
