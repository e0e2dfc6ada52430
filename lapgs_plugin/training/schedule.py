"""Schedule the events of a stage by iteration. Imports no torch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from lapgs_plugin.hierarchy.plan import REFERENCE_DENSIFY_FROM, REFERENCE_ITERATIONS, Stage, nested_densify_until
from lapgs_plugin.training.settings import MOST_VIEWS, TrainSettings

LATE_SHARE = 0.25
"""Share of a stage, its last, in which the gradients of several views make one step, once densification has ended.
Positions hardly move any more, and the differences between single views are noise; earlier, more steps are better."""
LEAST_STEPS = 40
"""Fewest such steps; a stage that is too short for them steps after every view."""
PIXELS_OF_A_STEP = 1 << 22
"""Most pixels of all views of one step where the number of views is left to the program."""
STEPS_OF_A_STAGE = 900
"""Fewest steps of a stage where the program chooses the number of views; a short stage takes fewer views a step."""
PIXELS_TO_FILL = 1 << 21
"""Pixels of a step below which the processor takes longer to start kernels than the GPU to run them. More views up to
these cost little time, so that a short stage takes them, too, and has fewer steps."""
STEPS_OF_A_FILLED_STAGE = 300
"""Fewest steps of a stage then."""
RECOVERY = 300
"""Iterations that a field needs after a reset of opacities."""
MOST_PADDING = 0.05
"""Views of several sizes are rendered together if none has more padding than this share of its own pixels."""
PIXELS_OF_A_LAUNCH = 1 << 22
"""Pixels of views that are rendered together. More of them would take memory and save no time."""


def views_per_step(settings: TrainSettings, stage: Stage, training_views: int, batches: bool) -> int:
    """Return the number of views of one optimizer step in a stage.

    Args:
        settings: of the run.
        stage: its image size and length decide where the settings say "auto".
        training_views: number of training views, the upper limit for "auto".
        batches: whether the rasterizer renders several views together; "auto" is 1 where it does not, and on several
            ranks a multiple of their number.
    """
    asked = settings.asked_views
    if asked is None:
        pixels, ranks = stage.image_size[0] * stage.image_size[1], settings.ranks
        filled = min(ranks * PIXELS_TO_FILL // pixels, stage.iterations // STEPS_OF_A_FILLED_STAGE)
        limits = round(ranks * PIXELS_OF_A_STEP / pixels), max(filled, stage.iterations // STEPS_OF_A_STAGE)
        asked = max(1, min(MOST_VIEWS, training_views, *limits)) if batches else 1
        asked = max(ranks, asked // ranks * ranks)
    return asked


@dataclass(frozen=True)
class StageSchedule:
    """Tell which events are due in an iteration of one stage. It has no state.

    Iterations count from 1 in each stage. In a stage of n of N iterations, densification ends at `until` scaled by n/N,
    and the learning rate of positions falls to its last value at n, from the beginning of the decay on: by default the
    whole stage. So does the factor on the rate of SH above degree 0. The other constants are the settings' own.

    A field that was trained before, in `before` iterations of coarser nested levels, keeps its SH degree and stops
    densifying earlier (`plan.nested_densify_until`). Its opacities are reset only if the user says when: resets remove
    floaters near the cameras, which the coarser level did, and recovering from one takes iterations. The same holds for
    residuals, which start from the base's geometry or positions.

    Attributes:
        decay_from: the last iteration before the decay; 0 where it is the whole stage.
        accumulate_from, accumulate_views: from this iteration on, the gradients of so many views make one step.
        views: the same for earlier steps. A step ends early where something is due.
        extended: iterations after the `iterations` of the schedule, all as the last one is.
        least_sh_degree: reached before the stage got another length, which changes `sh_every`.
    """

    iterations: int
    densify_start: int
    densify_until: int
    densify_every: int
    reset_every: int
    sh_every: int
    sh_degree: int
    means_first: float
    means_last: float
    sh_rest_factor: float
    decay_from: int
    accumulate_from: int
    accumulate_views: int
    before: int
    views: int = 1
    extended: int = 0
    least_sh_degree: int = 0

    @classmethod
    def create(
        cls, settings: TrainSettings, stage: Stage, before: int = 0, views: int = 1, training_views: int = 1
    ) -> StageSchedule:
        shrink = min(1.0, settings.scheduled / REFERENCE_ITERATIONS)
        control = settings.densification

        def constant(chosen: int | None, reference: int, smallest: int) -> int:
            return chosen if chosen is not None else max(smallest, round(reference * shrink))

        resets = constant(control.reset_every, 3000, 300)
        keeps_opacities = before or (stage.signed and not settings.residual_resets)
        never = control.reset_every == 0 or "reset_every" in control.options.unused
        if never or (keeps_opacities and control.reset_every is None):
            resets = stage.iterations + 1  # never
        until = constant(control.until, control.options.densify_until, 1)
        of_stage = round(until * stage.iterations / settings.scheduled)
        if (share := settings.densify_share_of(stage)) is not None:
            of_stage = round(share * stage.iterations)
        densify_until = nested_densify_until(of_stage) if before else of_stage
        extended = settings.extension_of(stage)
        if extended:
            densify_until = min(densify_until, stage.iterations)
        # Refinements end a step, so that the long ones begin after the last of them.
        late = max(0, min(round(stage.iterations * LATE_SHARE), stage.iterations - densify_until))
        rates = settings.learning_rates
        return cls(
            iterations=stage.iterations,
            densify_start=constant(control.start, REFERENCE_DENSIFY_FROM, 1),
            densify_until=densify_until,
            densify_every=control.every,
            reset_every=resets,
            sh_every=constant(settings.sh_every, 1000, 1),
            sh_degree=settings.sh_degree_of(stage.level),
            means_first=rates.means_first,
            means_last=rates.means_last,
            sh_rest_factor=settings.sh_rate_factor_of(stage, training_views),
            decay_from=stage.iterations - max(1, round(stage.iterations * settings.decay)),
            accumulate_from=stage.iterations - late + 1,
            accumulate_views=settings.accumulate_views if late >= LEAST_STEPS * settings.accumulate_views else 1,
            before=before,
            views=views,
            extended=extended,
        )

    @property
    def end(self) -> int:
        """The last iteration."""
        return self.iterations + self.extended

    def refines(self, iteration: int) -> bool:
        """Return whether Gaussians are added and removed after this iteration, while densification lasts."""
        return self.densify_start < iteration < self.densify_until and iteration % self.densify_every == 0

    def gathers(self, iteration: int) -> bool:
        """Return whether the step of this iteration is a late one, which keeps the step sizes of one view."""
        return self.accumulate_views > 1 and iteration >= self.accumulate_from

    def views_of_step(self, done: int) -> int:
        """Return the number of views, at least 1, of the step after `done` iterations."""
        if self.gathers(done + 1):
            within = (done + 1 - self.accumulate_from) % self.accumulate_views
            return min(self.accumulate_views - within, self.end - done)
        return 1 if self.views == 1 else min(self.views, self._next_due(done) - done)

    def _next_due(self, done: int) -> int:
        """Return the first iteration after `done` that ends a step, because statistics or the field change with it."""
        due = [self.end]
        if done < self.densify_until:
            # Statistics are collected before iteration `densify_until`, and pruning follows it.
            due += [(done // every + 1) * every for every in (self.densify_every, self.reset_every)]
            due += [self.densify_until - 1, self.densify_until]
        if self.accumulate_views > 1:
            due.append(self.accumulate_from - 1)
        return min(end for end in (*due, *self.late_prunes) if end > done)

    @property
    def prunes_after(self) -> int | None:
        """The iteration that ends densification; None where there is none, or nothing comes after it."""
        return self.densify_until if self.densify_start < self.densify_until < self.iterations else None

    @cached_property
    def late_prunes(self) -> frozenset[int]:
        """The iterations after densification in which a strategy may prune once more: every tenth of the stage in its
        second half, moved to the end of a step where gradients of several views are gathered."""
        iterations = set()
        for tenth in range(6, 10):
            due = max(round(self.iterations * tenth / 10), self.densify_until + 1)
            if self.gathers(due):
                due += (self.accumulate_from - 1 - due) % self.accumulate_views
            iterations.add(due)
        return frozenset(due for due in iterations if due < self.iterations)

    def sampled(self, count: int) -> frozenset[int]:
        """Return so many iterations, evenly spread and ending with the last, after which quality is measured.

        Of a stage that is extended they are iterations of the extension, which resets no opacities. Others that follow
        a reset closely come before it instead: no field looks like itself then.
        """
        iterations, before = set(), self.iterations if self.extended else 0
        for index in range(1, count + 1):
            due = before + math.ceil((self.end - before) * index / count)
            reset, since = divmod(due, self.reset_every)
            recovers = reset and since < RECOVERY and due < self.densify_until + RECOVERY and not self.extended
            if recovers and index < count:
                due -= since + self.views  # the step that ends with the reset is the one after it
            iterations.add(max(1, due))
        return frozenset(iterations)

    def progress_at(self, iteration: int) -> float:
        """Return the share of the schedule that is done, from 0 to 1; 1 while a finished stage is extended."""
        return min(max(iteration / self.iterations, 0.0), 1.0)

    def decayed_at(self, iteration: int) -> float:
        """Return the share of the decay that is done, from 0 to 1; 1 while a finished stage is extended."""
        return min(max((iteration - self.decay_from) / (self.iterations - self.decay_from), 0.0), 1.0)

    def means_learning_rate(self, iteration: int) -> float:
        """Return the step size of positions in units of the scene's extent; it falls exponentially in the decay."""
        decayed = self.decayed_at(iteration)
        return math.exp((1 - decayed) * math.log(self.means_first) + decayed * math.log(self.means_last))

    def sh_rest_factor_at(self, iteration: int) -> float:
        """Return the factor on the rate of SH above degree 0, which falls exponentially to 1 in the decay."""
        factor: float = self.sh_rest_factor ** (1.0 - self.decayed_at(iteration))
        return factor

    def active_sh_degree(self, iteration: int) -> int:
        return min(self.sh_degree, max(self.least_sh_degree, (self.before + iteration) // self.sh_every))
