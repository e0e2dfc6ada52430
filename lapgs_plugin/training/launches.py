"""Group the views of a step into launches: views that are rendered together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from lapgs_plugin.ops.mixed_sizes import largest_size
from lapgs_plugin.training.ranks.steps import WholeSteps
from lapgs_plugin.training.schedule import PIXELS_OF_A_LAUNCH, StageSchedule
from lapgs_plugin.training.views import LevelView


@dataclass(frozen=True)
class PlannedLaunch:
    """Hold views that are rendered together, at the poses of their scene.

    Attributes:
        iterations: that train them, in order.
        views: of the iterations.
        part: of the step, see `WholeSteps.own`.
        at: the iteration whose settings they are rendered with.
    """

    iterations: Sequence[int]
    views: Sequence[LevelView]
    part: int
    at: int


@dataclass
class LaunchPlanner:
    """Plan the launches of a stage's steps.

    Attributes:
        views: the training views at the stage's level.
        steps, schedule: of the stage.
        size_groups: as `PreparedRun.size_groups` returns them; None if views are rendered one by one.
        joint_from: first iteration in which the finished fields are trained jointly; None without.
        most_views: views in one launch that fit into the GPU's memory; None as long as all have.
    """

    views: Sequence[LevelView]
    steps: WholeSteps
    schedule: StageSchedule
    size_groups: Mapping[tuple[int, int], int] | None
    joint_from: int | None
    most_views: int | None = None
    _last: tuple[range, list[PlannedLaunch]] | None = field(default=None, init=False, repr=False)

    def view(self, iteration: int) -> LevelView:
        """Return the view that an iteration trains."""
        return self.views[self.steps.view(iteration)]

    def is_joint(self, iteration: int) -> bool:
        """Return whether the finished fields are trained jointly in an iteration."""
        return self.joint_from is not None and iteration >= self.joint_from

    def step_after(self, done: int) -> range:
        """Return the iterations of the step after `done` ones."""
        return range(done + 1, done + 1 + self.schedule.views_of_step(done))

    def launches(self, iterations: range) -> list[PlannedLaunch]:
        """Group those iterations of a step that this rank trains into launches, at most `most_views` in each.

        The last result is kept: the step before asks for it, too, to prefetch the images.
        """
        if self._last is None or self._last[0] != iterations:
            parts = enumerate(self.steps.parts(iterations))
            self._last = iterations, [launch for part, own in parts for launch in self._of_part(part, own, iterations)]
        return self._last[1]

    def limit(self, most_views: int) -> None:
        """Plan launches of at most so many views from here on."""
        self.most_views, self._last = most_views, None

    def _of_part(self, part: int, iterations: Sequence[int], step: range) -> list[PlannedLaunch]:
        """Group iterations of a step into launches: views of similar sizes and one SH degree, no more than fit."""
        views = [self.view(iteration) for iteration in iterations]

        def together(chosen: Sequence[int]) -> PlannedLaunch:
            own = [iterations[index] for index in chosen]
            return PlannedLaunch(own, [views[index] for index in chosen], part, self.steps.decisive(own[-1], step))

        if self.size_groups is None or len(iterations) == 1:
            return [together([index]) for index in range(len(iterations))]
        alike: dict[tuple[bool, int, int], list[int]] = {}
        for index, (iteration, view) in enumerate(zip(iterations, views, strict=True)):
            degree = self.schedule.active_sh_degree(iteration)
            key = self.is_joint(iteration), self.size_groups[view.camera.size], degree
            alike.setdefault(key, []).append(index)
        launches = []
        for group in alike.values():
            width, height = largest_size([views[index].camera.size for index in group])
            most = max(1, round(PIXELS_OF_A_LAUNCH / (width * height)))
            count = math.ceil(len(group) / min(most, self.most_views or most))
            size = math.ceil(len(group) / count)
            for start in range(0, len(group), size):
                launches.append(together(group[start : start + size]))
        return launches
