"""Plan the stages of a run, and check its settings against the photos."""

from __future__ import annotations

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Stage, StagePlan, continues_field
from lapgs_plugin.training.gains import LEAST_PHOTOS
from lapgs_plugin.training.quality import LEAST_VIEWS
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.settings import BEST, TrainSettings


def make_plan(size: tuple[int, int], settings: TrainSettings, views: int | None = None) -> StagePlan:
    """Return the stages of a run on images of this size (width, height), which is `Scene.smallest_size`.

    Args:
        size: (width, height).
        settings: of the run.
        views: number of training views; None if unknown.

    Raises:
        UserInputError: levels, split and image size do not go together, or there are too few views for a step, for
            --keep best or for --stop auto.
    """
    if views is not None and (asked := settings.asked_views or 1) > views:
        raise UserInputError(
            f"--views-per-step {asked}: the scene has {views} training views; give at most as many, or auto"
        )
    if views is not None and settings.keep == BEST and views < LEAST_VIEWS:
        raise UserInputError(
            f"--keep best: sets training views aside, and the scene has {views} of them, expected at least "
            f"{LEAST_VIEWS}; leave it out"
        )
    if views is not None and settings.stops_early and views < LEAST_PHOTOS:
        raise UserInputError(
            f"--stop auto: sets training views aside, and the scene has {views} of them, expected at least "
            f"{LEAST_PHOTOS}; leave it out"
        )
    return StagePlan.create(size, settings.scheduled, settings.levels, settings.shares, settings.kind)


def iterations_continued(plan: StagePlan, stage: Stage) -> int:
    """Return the iterations of coarser levels that trained a stage's field before; 0 if it is a field of its own."""
    return plan.iterations_before(stage.level) if continues_field(stage, plan.levels) else 0


def unpruned_levels(plan: StagePlan, settings: TrainSettings) -> list[int]:
    """Return the levels, coarsest first, that --prune leaves as they are, because their densification does not end."""
    if not settings.prune:
        return []
    schedules = [(stage, StageSchedule.create(settings, stage, iterations_continued(plan, stage))) for stage in plan]
    return [stage.level for stage, schedule in schedules if schedule.prunes_after is None]


def require_pruning(plan: StagePlan, settings: TrainSettings) -> None:
    """Check that some level's densification ends within its stage if a run is to be pruned then.

    Raises:
        UserInputError: none does, so that --prune would change nothing.
    """
    if settings.prune and len(unpruned_levels(plan, settings)) == plan.levels:
        raise UserInputError(
            f"--prune {settings.prune}: prunes when a level's densification ends, and at no level does one begin and "
            "end before the last iteration; leave --prune out, or change --densify-from, --densify-until or "
            "--iterations"
        )
