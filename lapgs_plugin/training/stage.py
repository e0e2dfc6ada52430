"""One stage: optimize one field against one level of the pyramid."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, groupby
from typing import Any

import torch
from gsplat.strategy.ops import remove
from torch import Tensor
from torch.autograd.grad_mode import set_multithreading_enabled

from lapgs_plugin.errors import FieldError, TrainingDivergedError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField, require_finite
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hooks import HookDispatcher, StageContext
from lapgs_plugin.ops.adam import ONE_VIEW, StepScale
from lapgs_plugin.ops.backward import backward
from lapgs_plugin.runs.image_store import AHEAD
from lapgs_plugin.runs.run_files import Falloffs
from lapgs_plugin.stages.appearance import ViewAppearance
from lapgs_plugin.stages.geometry import StageGeometry, depth_weight
from lapgs_plugin.stages.images import StageImages
from lapgs_plugin.stages.record import LoopCounts, StageRecord
from lapgs_plugin.stages.view_transforms import ViewTransforms
from lapgs_plugin.training.densification import DensityControl, scale_to_last
from lapgs_plugin.training.dropout import thinned
from lapgs_plugin.training.gains import StageGains
from lapgs_plugin.training.joint import JointFields
from lapgs_plugin.training.launches import LaunchPlanner, PlannedLaunch
from lapgs_plugin.training.losses import LossOf, ViewLosses
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.poses import ViewPoses, at_pose
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.ranks.equality import require_equal_fields
from lapgs_plugin.training.ranks.sums import StepSums
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.scoring import FieldScoring
from lapgs_plugin.training.stage_start import joint_fields
from lapgs_plugin.training.time_budget import StageBudget
from lapgs_plugin.training.views import LevelView, level_views

FINITE_CHECK_EVERY = 100
"""Iterations between two checks of all parameters for NaN; the loss is checked in every iteration."""
LOSS_SMOOTHING = 0.95
"""Weight of earlier losses in the loss that is shown and logged: single views differ too much to show a trend."""
LOSSES_READ_EVERY = 50
"""Losses that are read together on a GPU: each reading waits until the GPU has caught up with the processor."""


@dataclass(frozen=True)
class _Launch:
    """Hold a finished launch: views that were rendered together, after their backward pass.

    Attributes:
        result: of the render without its image; None if density control does not need it. Its gradients are those of
            views as large as the last.
        camera: of the last view.
        loss: mean of the views' losses.
        iteration: of the last view.
        views: their number.
        gaussians: number that is optimized.
    """

    result: RenderResult | None
    camera: Camera
    loss: Tensor
    iteration: int
    views: int
    gaussians: int


@dataclass
class StageRun:
    """Train one stage.

    Attributes:
        prepared: the run.
        stage, schedule: of the stage.
        images: photos of the training views, and their predictions by the coarser levels.
        model: the field, edited in place.
        densifier: density control with its statistics.
        appearance: transforms of the training views' images; None with `--appearance none`.
        falloffs: brightness of the corners of views, see `measure_vignetting`.
        poses: corrections of the training views' poses; None without refinement.
        geometry: supervises depth, normals and sky; None without.
        record: measures it.
        budget: decides the stage's length by the clock; None where it is planned.
        gains: decides it by views that are set aside; None where they do not.
        say: shows a line to the user.
        joint: the finished fields while they are trained jointly; None before.
        loss: smoothed loss, NaN before the first iteration and after a finished stage.
        step_views: number of views of the last step.
        background: (3,) behind the base; residuals are rendered over zero.

    The field, the images and the background are on the training device.
    """

    prepared: PreparedRun
    stage: Stage
    schedule: StageSchedule
    images: StageImages
    hooks: HookDispatcher
    model: TrainableField
    densifier: DensityControl
    appearance: ViewAppearance | None
    falloffs: Falloffs
    poses: ViewPoses | None
    geometry: StageGeometry | None
    record: StageRecord
    say: Callable[[str], None]
    budget: StageBudget | None = None
    gains: StageGains | None = None
    joint: JointFields | None = None
    loss: float = math.nan
    step_views: int = 1
    _late_steps: int = 0  # whose losses are in `_unread`
    _unread: list[tuple[Tensor, int, int]] = field(default_factory=list)  # losses, their last iterations, how many
    _context: StageContext | None = None  # of the last rendered view; None without hooks of a user

    def __post_init__(self) -> None:
        prepared, stage = self.prepared, self.stage
        settings = self._settings = prepared.settings
        self._rasterizer, self._breakdown = prepared.rasterizer, self.record.breakdown
        self._views = self._trained_views()
        self._steps = prepared.steps_of(stage, len(self._views))
        self._sums = StepSums(self._steps) if self._steps.summed else None
        for learned in filter(None, self.transforms.values()):
            learned.ranks = prepared.ranks
        self.background = torch.zeros(3, device=prepared.device) if stage.signed else prepared.background
        self._planner = LaunchPlanner(
            views=self._views,
            steps=self._steps,
            schedule=self.schedule,
            size_groups=prepared.size_groups(stage.level) if prepared.batches else None,
            joint_from=settings.joint_from(replace(stage, iterations=self.schedule.iterations)),
        )
        self._dropout = settings.dropout_for(len(prepared.scene.train))
        # A residual that inherits its base's moments moves by them above its degree, too, and starts again at degree 0.
        self._inherits_moments = stage.signed and settings.inherit_mode == "full"
        self._losses = ViewLosses(
            stage=stage,
            images=self.images,
            breakdown=self.record.breakdown,
            hooks=self.hooks,
            rasterizer=self._rasterizer,
            appearance=self.appearance,
            falloffs=self.falloffs,
            ssim_weight=settings.ssim_weight,
        )
        self._scoring = FieldScoring(
            rasterizer=self._rasterizer,
            views=self._views,
            losses=self._losses,
            poses=self.poses,
            background=self.background,
            seed=settings.seed,
            breakdown=self._breakdown,
            steps=self._steps,
        )
        self._count_all()

    def run(self, after_iteration: Callable[[StageRun], None]) -> None:
        """Train to the end of the stage, from the iteration in `record`. An iteration is a view, a step one or more.

        Args:
            after_iteration: called after every step, outside the timed region; may raise to stop the run.

        Raises:
            TrainingDivergedError: the loss or a parameter became NaN or infinite.
        """
        self.require_equal_fields()
        if self.budget is not None:
            self.budget.start(self.counts.iteration)
        while self.counts.iteration < self.stage.iterations:
            self._profile()
            self.record.resume_clock()
            iterations = self._planner.step_after(self.counts.iteration)
            self.step_views = len(iterations)
            self._step(iterations)
            self.record.pause_clock()
            self.counts.iteration += self.step_views
            self._fit_into_time()
            if self._late_steps >= LOSSES_READ_EVERY or self.counts.iteration == self.stage.iterations:
                self.settle()
            after_iteration(self)
        self._profile()

    def _fit_into_time(self) -> None:
        """Let the stage have the iterations that the clock allows, as rank 0 decides after some steps for all ranks."""
        ranks, ended = self.prepared.ranks, self.counts.iteration >= self.stage.iterations
        if self.budget is not None and (ended or self._late_steps % ranks.steps_a_decision == 0):
            self._last(ranks.from_leader(self.budget.length(self.counts.iteration)))
            ends_now = self.counts.iteration >= self.stage.iterations
            if ends_now and not ended:  # `_step` did not know that it was the last
                self.require_finite(self.counts.iteration)

    def note_gains(self, psnrs: Sequence[float]) -> None:
        """Let the stage have the iterations that views set aside gain by.

        Args:
            psnrs: of `PreparedRun.withheld` in dB, after the last iteration.
        """
        assert self.gains is not None
        self.gains.note(self.counts.iteration, psnrs)
        if self.gains.decided is not None:
            self._train_on(self._trained_views())
        self._last(self.gains.planned)

    @property
    def withholds(self) -> bool:
        """Whether views are not trained on now, because the stage's length depends on them."""
        return self.gains is not None and self.gains.decided is None

    def _trained_views(self) -> tuple[LevelView, ...]:
        prepared = self.prepared
        withheld = {view.name for view in prepared.withheld} if self.withholds else set()
        return level_views([view for view in prepared.scene.train if view.name not in withheld], self.stage.level)

    def _train_on(self, views: tuple[LevelView, ...]) -> None:
        """Train on these views from the next step on."""
        self._views, self._steps = views, self.prepared.steps_of(self.stage, len(views))
        self._planner = replace(self._planner, views=views, steps=self._steps)
        self._scoring = replace(self._scoring, views=views, steps=self._steps)

    def _last(self, iterations: int) -> None:
        """Let the stage have so many iterations."""
        if iterations == self.stage.iterations:
            return
        self.prepared = self.prepared.lasting(self.stage.level, iterations)
        self.stage = self.record.stage = self.prepared.plan[self.stage.level]
        self.record.iterations = self.prepared.plan.iterations
        planned_before, schedule = self.schedule, self.prepared.schedule_of(self.stage)
        # Renders never leave out coefficients that were trained.
        self.schedule = replace(schedule, least_sh_degree=planned_before.active_sh_degree(self.counts.iteration))
        statistics = self.densifier.state
        self.densifier = self.prepared.density_control(self.stage, self.schedule)
        self.densifier.state = statistics
        self._count_all()
        joint_from = self._settings.joint_from(self.stage) if self.joint is None else self._planner.joint_from
        self._planner = replace(self._planner, schedule=self.schedule, joint_from=joint_from)
        for learned in filter(None, self.transforms.values()):
            learned.total = self.prepared.plan.iterations
        if self._skips_pruning(planned_before):
            self.record.resume_clock()
            self._prune()
            self.record.pause_clock()

    def _skips_pruning(self, before: StageSchedule) -> bool:
        """Return whether pruning, still to come by the schedule before, is over by the one that is followed now."""
        due, was_due = self.schedule.prunes_after, before.prunes_after
        if not self._settings.prune or due is None or was_due is None:
            return False
        return due <= self.counts.iteration < was_due

    def _profile(self) -> None:
        """Start or end a profile if it is due, outside the timed region."""
        if self.record.busy.due(self.counts.iteration):
            self.settle()
            self.record.profile(self.counts.iteration)

    def settle(self) -> None:
        """Wait for a GPU to finish its iterations, as part of the training time, and read their losses.

        Raises:
            TrainingDivergedError: one is NaN or infinite.
        """
        if not self._late_steps:
            return
        waiting, self._unread, self._late_steps = self._unread, [], 0
        self.catch_up()
        losses = torch.stack([loss for loss, _, _ in waiting]).tolist() if waiting else []
        noted = [(iteration, loss, views) for loss, (_, iteration, views) in zip(losses, waiting, strict=True)]
        if self._steps.shared:
            noted = sorted(chain.from_iterable(self.prepared.ranks.gathered(noted)))
        for iteration, loss, views in noted:
            self._note_loss(loss, iteration, views)

    def catch_up(self) -> None:
        """Wait for a GPU to finish its iterations, as part of the training time."""
        self.record.resume_clock()
        self.record.wait_for_device()
        self.record.pause_clock()

    def passed(self, every: int) -> bool:
        """Return whether the last step reached or passed a multiple of `every` iterations, or the stage's end."""
        return self.counts.iteration % every < self.step_views or self.counts.iteration == self.stage.iterations

    def reached(self, iterations: Collection[int]) -> bool:
        """Return whether the last step had one of some iterations."""
        last = self.counts.iteration
        return any(iteration in iterations for iteration in range(last - self.step_views + 1, last + 1))

    def train_jointly(self, states: dict[int, dict[str, Any]] | None) -> None:
        """Train the finished fields, too, from here on: from a `JointFields.state` or, given None, from the archive."""
        self.record.note_memory(self.images.bytes_on_device)
        self.images.drop_predictions()
        self.joint = joint_fields(self.prepared, self.poses, states)
        self.images.predictions = self.images.held_out = self.joint.predictions(self.prepared.pyramid)
        self._count_all()

    def leave_finished_fields(self) -> None:
        """Go back to the finished fields as they are archived, which the stage then leaves as they are."""
        archived = joint_fields(self.prepared, self.poses, None)
        self.joint = None
        self.images.predictions = self.images.held_out = archived.predictions(self.prepared.pyramid)
        self._count_all()

    @property
    def _models(self) -> list[TrainableField]:
        """The fields under training."""
        return [self.model, *(() if self.joint is None else self.joint.models.values())]

    def _count_all(self) -> None:
        """Learn the number of Gaussians that all ranks together have, and this one's share of it."""
        total, own = self.prepared.sharding.total, sum(map(len, self._models))
        self._elsewhere = total(own) - own
        self.densifier.share = len(self.model) / max(1, total(len(self.model)))

    @property
    def num_optimized(self) -> int:
        """Number of Gaussians under training: the stage's own and those of jointly trained fields."""
        return sum(map(len, self._models)) + self._elsewhere

    @property
    def fields(self) -> dict[int, GaussianField]:
        """The fields under training by level, without gradients."""
        return {**({} if self.joint is None else self.joint.fields), self.stage.level: self.model.field.detach()}

    @property
    def counts(self) -> LoopCounts:
        """Iterations, seconds and Gaussians so far."""
        return self.record.counts

    @property
    def _device(self) -> torch.device:
        return self.prepared.device

    @property
    def _reads_late(self) -> bool:
        """Whether losses of several steps are read together."""
        return self._steps.shared or self._device.type == "cuda"

    @property
    def first_view(self) -> LevelView:
        """The view that the stage's first iteration renders."""
        return at_pose(self._planner.view(1), self.poses)

    def _step(self, iterations: range) -> None:
        """Render all views of a step, propagate their losses back, and step the optimizers once."""
        last = iterations[-1]
        if self._sums is not None and self.joint is None and self._planner.is_joint(last):
            self.train_jointly(None)  # on all ranks at once, whichever of them has the first view
        launches = self._run_launches(iterations)
        self._breakdown.mark("backward")
        self._sum_over_ranks(iterations)
        trained = self._steps.trained(len(iterations))
        self.densifier.regularize(self.model, range(last - trained + 1, last + 1))
        self._count_gaussians(launches)
        self._breakdown.mark("other")
        context, self._context = self._context, None
        if context is not None:
            self.hooks.after_backward(context)
        self._breakdown.mark("optimizer")
        means_rate, rest = (
            self.schedule.means_learning_rate(last) * self.prepared.scene.extent,
            self.schedule.sh_rest_factor_at(last),
        )
        scale = ONE_VIEW if self.schedule.gathers(last) else StepScale.of(trained)
        active = None if self._inherits_moments else (self.schedule.active_sh_degree(last) + 1) ** 2
        self.model.step(means_rate, active, rest, scale)
        if self.joint is not None:
            self.joint.step(means_rate, rest, scale)
        for learned in filter(None, self.transforms.values()):
            learned.after_step(last, len(iterations))
        self._breakdown.mark("densification")
        if self._sums is None:
            for launch in launches[:-1]:
                if launch.result is not None:
                    self.densifier.accumulate(launch.result, launch.camera)
            self._densify(context, last, launches[-1].result, launches[-1].camera)
        else:  # statistics of all views are there
            self._densify(context, last, None, at_pose(self._planner.view(last), self.poses).camera)
        self._breakdown.mark("other")
        if last % FINITE_CHECK_EVERY < len(iterations) or last == self.stage.iterations:
            self.require_finite(last)

    def _sum_over_ranks(self, iterations: range) -> None:
        """Give the fields the gradients of all views of a step, and density control their statistics."""
        if self._sums is not None:
            needed = any(map(self.densifier.needs_statistics, iterations))
            self._sums.give(len(self._steps.parts(iterations)), self._models, self.densifier, needed)

    def _count_gaussians(self, launches: Sequence[_Launch]) -> None:
        """Count the Gaussians of a step for each of its views."""
        if not self._steps.shared:
            self.counts.gaussian_steps += sum(launch.gaussians * launch.views for launch in launches)
        else:
            self.counts.gaussian_steps += self.num_optimized * self.step_views

    def _run_launches(self, iterations: range) -> list[_Launch]:
        """Run all launches of a step. If the GPU's memory is too small, start the step again with smaller launches."""
        while True:
            planned = self._planner.launches(iterations)
            is_last = iterations[-1] == self.stage.iterations
            following = [] if is_last else self._planner.launches(self._planner.step_after(iterations[-1]))[:1]
            try:
                thens = [*planned[1:], *following, None]
                done = self._run_planned(planned, thens)
            except torch.cuda.OutOfMemoryError:
                most = max(len(launch.views) for launch in planned)
                if most == 1:
                    raise
            else:
                if self._reads_late:
                    self._unread += [(launch.loss, launch.iteration, launch.views) for launch in done]
                    self._late_steps += 1
                return done
            # Outside of `except`, because the error keeps the tensors of the render alive.
            self._forget_gradients()
            self._planner.limit(most // 2)
            self.say(
                f"level {self.stage.level}: no memory for {most} views at once; from here on {most // 2} are rendered "
                "together, and steps take as many as before"
            )

    def _run_planned(self, planned: Sequence[PlannedLaunch], thens: Sequence[PlannedLaunch | None]) -> list[_Launch]:
        """Run launches; the images of the first of `thens` are prefetched in the first one, and so on."""
        done: list[_Launch] = []
        for part, launches in groupby(zip(planned, thens, strict=False), key=lambda pair: pair[0].part):
            own = [self._launch(launch, then) for launch, then in launches]
            done += own
            if self._sums is not None:
                renders = [(launch.result, launch.camera) for launch in own if launch.result is not None]
                self._sums.take(part, self._models, self.densifier, renders)
        return done

    def _forget_gradients(self) -> None:
        self._context = None
        if self._sums is not None:
            self._sums.forget()
        for model in self._models:
            for param in model.params.values():
                param.grad = None
        for learned in filter(None, self.transforms.values()):
            learned.forget_gradients()

    @property
    def transforms(self) -> dict[str, ViewTransforms | None]:
        """Learned transforms of the training views, by their names in checkpoints."""
        return {"appearance": self.appearance, "poses": self.poses}

    def _launch(self, planned: PlannedLaunch, then: PlannedLaunch | None) -> _Launch:
        """Render some views of a step and propagate their losses back; the images of `then` are prefetched."""
        iterations, last = planned.iterations, planned.at
        if self.joint is None and self._planner.is_joint(last):
            self.train_jointly(None)
        views = [at_pose(view, self.poses) for view in planned.views]
        names, cameras = [view.name for view in views], [view.camera for view in views]
        plain = self._losses.is_plain
        loss_of = self._losses.plain(names, cameras) if plain else self._hooked_loss(iterations, names, cameras)
        if then is not None:
            self._prefetch(then)
        self._breakdown.mark("forward")
        gaussians = self.model.field
        share = self._dropout * self.schedule.progress_at(last)
        draws = self._steps.generator(iterations[-1], gaussians.means.device) if share else None
        shown = thinned(gaussians, share, draws)
        shown = shown if self.poses is None else self.poses.watched(names[0], shown)
        rendered, result = self._render(shown, cameras, last)
        self._breakdown.mark("loss")
        loss = self._with_geometry(loss_of(rendered, shown), iterations, views, shown)
        del rendered  # composed by now, and every image of a large size takes memory, as does that of `result`
        kept = loss.detach()
        if result is not None:
            result = replace(result, image=kept, transmittance=None)
        if not self._reads_late:
            self._note_loss(kept.item(), last, len(views))
        elif self._device.type == "cpu":  # at once, before a loss that is not finite does harm
            self._require_finite_loss(kept.item(), last)
        self._breakdown.mark("backward")
        with set_multithreading_enabled(False):  # a thread of a GPU's own is waited for twice
            backward(loss, len(views))  # the gradient of the sum of the views' losses
        if result is not None:
            scale_to_last(result, [camera.size for camera in cameras])
        self._breakdown.mark("other")
        return _Launch(result, cameras[-1], kept, last, len(views), self.num_optimized)

    def _with_geometry(
        self, loss: Tensor, iterations: Sequence[int], views: Sequence[LevelView], shown: GaussianField
    ) -> Tensor:
        """Return the mean loss of some views with those of their depth, normals and sky, if any."""
        names, cameras = [view.name for view in views], [view.camera for view in views]
        turns = [self._steps.turn(iteration) for iteration in iterations]
        if self.geometry is not None:
            weight = depth_weight(self.prepared.plan, self.stage, iterations[-1])
            own = self.geometry.loss(turns, names, cameras, shown, weight)
            loss = loss if own is None else loss + own
        coarser = [] if self.joint is None else self.joint.sky_losses(turns, names)
        return sum(coarser, loss)

    def _hooked_loss(self, iterations: Sequence[int], names: Sequence[str], cameras: Sequence[Camera]) -> LossOf:
        """Call the hooks that come before a render; return the loss of some views by all hooks."""
        contexts = self._losses.contexts(iterations, names, cameras)
        for context in contexts:
            self.hooks.before_render(context)
        self._context = contexts[-1]
        return self._losses.hooked(contexts, names, cameras)

    def _render(
        self, gaussians: GaussianField, cameras: Sequence[Camera], iteration: int
    ) -> tuple[Tensor, RenderResult | None]:
        """Return the image, or images of several cameras, and the whole result if density control needs it."""
        needed, degree = self.densifier.needs_statistics(iteration), self.schedule.active_sh_degree(iteration)
        if len(cameras) > 1:
            result = self._rasterizer.render_batch(
                gaussians, cameras, background=self.background, sh_degree=degree, with_geometry=needed
            )
            return result.image, result if needed else None
        if needed:
            result = self._rasterizer(gaussians, cameras[0], background=self.background, sh_degree=degree)
            return result.image, result
        image = self._rasterizer.render_image(gaussians, cameras[0], background=self.background, sh_degree=degree)
        return image, None

    def _prefetch(self, planned: PlannedLaunch) -> None:
        """Copy the images of the next launch to the device while this one renders; files of those that follow, too."""
        names = [view.name for view in planned.views[:AHEAD]]
        if self._settings.images_on == "disk":
            after = max(planned.iterations) + 1
            later = range(after, min(after + AHEAD - len(names), self.stage.iterations + 1))
            own = sorted(iteration for part in self._steps.parts(later) for iteration in part)
            names += [self._planner.view(iteration).name for iteration in own]
        self.images.photos.prefetch(*names)
        if self.images.predictions is not None:
            for name in names:
                self.images.predictions.prefetch(name)

    def _densify(
        self, context: StageContext | None, iteration: int, result: RenderResult | None, camera: Camera
    ) -> None:
        threshold = self.densifier.score_threshold(iteration)
        scores = None
        if threshold is not None:
            degree = self.schedule.active_sh_degree(iteration)
            scores = self._scoring.scores(self.model.field.detach(), iteration, degree, threshold)
        changed = self.densifier.after_step(self.model, iteration, result, camera, scores)
        if self._settings.prune and iteration == self.schedule.prunes_after:
            self._prune()
            changed = True
        elif changed:
            self._count_all()
        if changed and context is not None:
            self.hooks.on_densify(context)
        self.counts.peak_gaussians = max(self.counts.peak_gaussians, self.num_optimized)

    def _prune(self) -> None:
        """Remove the least visible Gaussians."""
        gone = self._scoring.least_visible(self.model.field.detach(), self._settings.prune)
        remove(self.model.params, self.model.optimizers, self.densifier.state, gone)
        self._count_all()

    def _note_loss(self, loss: float, iteration: int, views: int) -> None:
        """Add the mean loss of some views to the smoothed loss; `iteration` is that of the last view."""
        self._require_finite_loss(loss, iteration)
        kept = LOSS_SMOOTHING**views
        self.loss = loss if math.isnan(self.loss) else kept * self.loss + (1 - kept) * loss

    def _require_finite_loss(self, loss: float, iteration: int) -> None:
        if not math.isfinite(loss):
            raise self._diverged(f"the loss is {loss}, expected a finite number", iteration)

    def require_finite(self, iteration: int) -> None:
        """Raise a TrainingDivergedError that names an iteration if a field under training has NaN or inf."""
        try:
            require_finite(self.fields, self.stage.level)
        except FieldError as error:
            raise self._diverged(str(error), iteration) from error

    def require_equal_fields(self) -> None:
        """Raise a RanksDifferError if the ranks' fields should be equal and have come apart."""
        if self.prepared.sharding.divides:
            return
        where = f"level {self.stage.level}, iteration {self.counts.iteration}"
        require_equal_fields(self.prepared.ranks, self._models, where)

    def _diverged(self, problem: str, iteration: int) -> TrainingDivergedError:
        return TrainingDivergedError(
            f"training diverged at level {self.stage.level}, iteration {iteration}: {problem}; "
            "finished levels and the last checkpoint are kept, start again with other settings"
        )

    def state(self) -> dict[str, Any]:
        """Return everything needed to continue this stage to the same bits, as plain tensors and numbers."""
        self.settle()
        on_gpu, whole = self._device.type == "cuda", self.prepared.sharding.whole
        return {
            "level": self.stage.level,
            "counts": vars(self.counts),
            "loss": self.loss,
            "most_views": self._planner.most_views,
            "least_sh_degree": self.schedule.least_sh_degree,
            "breakdown": self._breakdown.seconds(),
            "budget": None if self.budget is None else self.budget.state(),
            "gains": None if self.gains is None else self.gains.state(),
            "model": whole(self.model.state()),
            "densifier": whole(self.densifier.state),
            "joint": None if self.joint is None else whole(self.joint.state()),
            **{name: None if learned is None else learned.state() for name, learned in self.transforms.items()},
            "random": torch.get_rng_state(),
            **({"random_gpu": torch.cuda.get_rng_state(self._device)} if on_gpu else {}),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a result of `state`; model and record must have been made from it already."""
        self.loss, self._planner.most_views = state["loss"], state["most_views"]
        rows = self.prepared.sharding.rows
        self.densifier.state = {
            name: value[rows(len(value))].to(self._device) if isinstance(value, Tensor) else value
            for name, value in state["densifier"].items()
        }
        if (joint := state.get("joint")) is not None:
            self.train_jointly(joint)
        self.restore_transforms(state)
        torch.set_rng_state(state["random"])
        if "random_gpu" in state:
            torch.cuda.set_rng_state(state["random_gpu"], self._device)
        self.prepared.sharding.draw_apart()

    def restore_transforms(self, state: Mapping[str, Any]) -> None:
        """Restore the learned transforms of the training views from a result of `state`."""
        for name, learned in self.transforms.items():
            if (values := state.get(name)) is not None:
                assert learned is not None, "the trainer looks for it"
                learned.restore(values)
