"""Train a whole run: its stages from the coarsest level to the finest. Each is archived; any can be resumed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from lapgs_plugin.errors import DeviceMemoryError, UserInputError, counted
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.fields.units import in_unit
from lapgs_plugin.hierarchy.plan import Stage, level_size
from lapgs_plugin.hierarchy.pruning import unpruned_line
from lapgs_plugin.hooks import HookDispatcher, StageHook, hooks_line
from lapgs_plugin.interrupt import StopRequest, stop_request
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.gpu_busy import GpuBusy, require_cuda
from lapgs_plugin.runs.layout import CHECKPOINT
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.runs.profiling import Breakdown, Overhead, PeakMemory, breakdown_on
from lapgs_plugin.runs.training_figures import last_psnr, weak_levels
from lapgs_plugin.runs.watcher import Watcher
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training.between_steps import BetweenSteps
from lapgs_plugin.training.checkpoint import check_checkpoint, check_densifier, check_transforms
from lapgs_plugin.training.coarser import CoarserLevels
from lapgs_plugin.training.context import RunContext
from lapgs_plugin.training.densification import control_of
from lapgs_plugin.training.evaluation import StageEvaluation
from lapgs_plugin.training.joint import JointFields
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.planning import check_storage, iterations_continued, make_plan, unpruned_levels
from lapgs_plugin.training.quality import (
    SAMPLES_OF_A_STAGE,
    SAMPLES_TO_KEEP_BEST,
    QualityWatch,
    few_views_line,
    set_aside,
)
from lapgs_plugin.training.schedule import StageSchedule, views_per_step
from lapgs_plugin.training.settings import BEST, TrainSettings
from lapgs_plugin.training.stage import StageRun
from lapgs_plugin.training.stage_images import StageImages
from lapgs_plugin.training.stage_progress import StageProgress
from lapgs_plugin.training.stage_start import first_exposures, first_model, first_poses, joint_fields
from lapgs_plugin.training.strategies import Strategy
from lapgs_plugin.training.views import level_views
from lapgs_plugin.training.warm_up import warm_up


@dataclass
class Trainer:
    """Train the hierarchy of one scene into a run folder.

    Attributes:
        scene: views, points and background.
        settings: of the run.
        archive: the run folder; its manifest has the same settings.
        rasterizer: renders every field, in the unit of the manifest's scene.
        device: of the rasterizer and of training.
        user_hooks: called after the stock ones.
        monitor: shows progress.
        checkpoint_every: iterations between two checkpoints; None writes one every minute. One is also written when the
            user stops a run.
        test_every: iterations between two measurements of all held-out views; None measures all at the end of each
            stage, and some of them a few times before.
        breakdown: measure the parts of iterations.
        gpu_busy: profile some iterations of each stage; needs a CUDA device.
        watcher: looks at the fields between iterations.
        first_field: the first stage starts from it; None starts from the scene's points.
    """

    scene: Scene
    settings: TrainSettings
    archive: RunArchive
    rasterizer: Rasterizer
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    user_hooks: Sequence[StageHook] = ()
    monitor: Monitor = field(default_factory=Monitor)
    checkpoint_every: int | None = None
    test_every: int | None = None
    breakdown: bool = False
    gpu_busy: bool = False
    watcher: Watcher = field(default_factory=Watcher)
    first_field: GaussianField | None = None

    def __post_init__(self) -> None:
        views = self.scene.train
        aside = set_aside(views) if self.settings.keep == BEST else []
        names = {view.name for view in aside}
        trained = replace(self.scene, train=tuple(view for view in views if view.name not in names))
        self._context = RunContext(
            scene=trained,
            aside=tuple(aside),
            settings=self.settings,
            archive=self.archive,
            rasterizer=in_unit(self.rasterizer, self.archive.manifest.scene.unit),
            device=self.device,
            monitor=self.monitor,
            plan=make_plan(self.scene.smallest_size, self.settings, len(views)),
            first_field=self.first_field,
        )
        check_storage(self.settings, self.device)
        if self.gpu_busy:
            require_cuda(self.device)
            if self.settings.extended:
                raise UserInputError(
                    "--gpu-busy: is measured in whole stages, not when a run is extended; leave it out"
                )
        self._quality = QualityWatch()
        self._hooks = HookDispatcher.create(
            self._context.supervision, self.settings.ssim_weight, self.user_hooks, self.settings.hooks
        )

    def run(self, resume: bool = False) -> None:
        """Train all stages that are not finished yet, or extend a finished run.

        A run whose settings have more iterations than its manifest is extended: its finest stage trains on.

        Args:
            resume: continue from the run folder's checkpoint, or after its last finished level.

        Raises:
            TrainingStoppedError: the user asked to stop; everything needed to resume is on disk.
            TrainingDivergedError: NaN or inf; finished levels and the last checkpoint are kept.
            DeviceMemoryError: the GPU is full; the same is kept.
        """
        context, plan = self._context, self._context.plan
        checkpoint = self._checkpoint() if resume else None
        with one_pool(), stop_request() as stop:
            try:
                joint = any(self.settings.joint_from(stage) is not None for stage in plan)
                residuals = any(stage.signed for stage in plan)
                warm_up(self.rasterizer, self.settings, self.device, residuals=residuals, joint=joint)
                self.watcher.run_started(self.archive)
                if not resume:
                    self._say_what_is_chosen()
                for stage in plan:
                    if stage.level in self.archive.available_levels and context.record_to_extend(stage) is None:
                        continue
                    here = checkpoint if checkpoint is not None and checkpoint["level"] == stage.level else None
                    self._run_stage(stage, here, stop)
            except torch.cuda.OutOfMemoryError as error:
                raise self._out_of_memory() from error

    def _say_what_is_chosen(self) -> None:
        """Tell the user what the settings mean for this scene and device."""
        scene, say = self._context.scene, self.monitor.say
        say(self._strategy_line())
        if (hooks := hooks_line(self.settings.hooks)) is not None:
            say(hooks)
        if (few := few_views_line(len(scene.train), self._context.plan.iterations, bool(scene.test))) is not None:
            say(few)
        if self.settings.dropout is None and (share := self.settings.dropout_for(len(scene.train))) > 0.0:
            say(f"{len(scene.train)} training views are few: --dropout {share:g} leaves Gaussians out at random")
        for level in unpruned_levels(self._context.plan, self.settings):
            say(unpruned_line(self.settings.prune, level))
        if self.settings.refine_poses and self.device.type == "cuda":
            say("--refine-poses: views are rendered one by one, which takes longer than several at once")

    def _strategy_line(self) -> str:
        """Say how Gaussians are added, and up to which numbers, coarsest level first."""
        found = [self._strategy_of(stage).most for stage in self._context.plan]
        limits = [f"{most:,}" for most in found if most is not None]
        words = f", at most {' and '.join(limits)} Gaussians" if limits else ""
        return f"density control: --strategy {self.settings.densification.strategy}{words}"

    def _strategy_of(self, stage: Stage) -> Strategy:
        sizes = [level_size(view.camera.size, stage.level) for view in self._context.scene.train]
        return self.settings.strategy_of(stage, len(sizes), sum(map(math.prod, sizes)))

    def _checkpoint(self) -> dict[str, Any] | None:
        """Return the checkpoint of the next stage; None if it starts from its beginning."""
        state, level = self.archive.load_checkpoint(), self.archive.manifest.next_level or 0
        if state is not None:
            path, stage = self.archive.path(CHECKPOINT), self._context.plan[level]
            check_checkpoint(state, path, stage, self.settings, self.archive.available_levels)
        return state

    def _out_of_memory(self) -> DeviceMemoryError:
        level = self.archive.manifest.next_level or 0  # of a run that is extended, the finest
        return DeviceMemoryError(
            f"the GPU has no memory left at level {level}; finished levels and the last checkpoint are kept: "
            "continue with --resume on a larger one, or start again with --packed, --images-on memory, a smaller "
            "--resolution or a smaller --cap-max"
        )

    def _run_stage(self, stage: Stage, checkpoint: dict[str, Any] | None, stop: StopRequest) -> None:
        """Train and archive one stage."""
        before = self._context.record_to_extend(stage)
        spent = None if before is None else before.overhead_seconds
        overhead = Overhead(spent if checkpoint is None else checkpoint["overhead"])
        memory = PeakMemory(self.device)
        model = self._model(stage, checkpoint, overhead)
        schedule = self._schedule(stage)
        with closing(StageImages(self._context, stage, overhead)) as images:
            run = self._stage_run(stage, schedule, model, images, memory, checkpoint, overhead)
            evaluation = StageEvaluation(self._context, images, overhead, self._quality)
            if checkpoint is not None:
                evaluation.best = checkpoint.get("best")
                self._restore(run, checkpoint)
            if self.breakdown and not run.breakdown.measures:
                self.monitor.say(f"level {stage.level} was started without --breakdown: its parts are not measured")
            self.archive.rewind_history(stage.level, run.progress.iteration)
            aside = self._context.aside
            if before is not None and checkpoint is None and aside:
                evaluation.note_best(run)  # the finished run's state is the one to beat
            self.monitor.stage_started(run.stage, run.progress.iteration + 1)
            if checkpoint is None:
                self._say_if_nothing_is_visible(run)
            between_steps = BetweenSteps(
                context=self._context,
                evaluation=evaluation,
                watcher=self.watcher,
                stop=stop,
                samples=schedule.sampled(SAMPLES_TO_KEEP_BEST if aside else SAMPLES_OF_A_STAGE),
                test_every=self.test_every,
                checkpoint_every=self.checkpoint_every,
                last_tick=(run.progress.seconds, run.progress.iteration),
            )
            run.hooks.on_stage_start(run.stage)
            self.watcher.stage_started(run.stage)
            run.run(between_steps)
            run.hooks.on_stage_end(run.stage)
            evaluation.return_to_best(run)
            self._archive_stage(run, before, overhead, memory.note(images.bytes_on_device))
            self.watcher.stage_finished(run.stage, lambda: run.fields)

    @torch.no_grad()
    def _say_if_nothing_is_visible(self, run: StageRun) -> None:
        """Tell the user if the view that a stage renders first shows no Gaussian, which would train to black."""
        view, near = run.first_view, NEAR_DEPTH * self.archive.manifest.scene.unit
        result = self._context.rasterizer(run.model.field, view.camera, background=run.background, sh_degree=0)
        if not bool(result.radii.any()):
            self.monitor.say(
                f"level {run.stage.level}: none of {counted(len(run.model), 'Gaussian')} is visible in {view.name}, "
                f"the first view: all are outside of it, behind it, or less than {near:.3g} in front of it; check that "
                "the points and the cameras are of one model"
            )

    def _model(self, stage: Stage, checkpoint: dict[str, Any] | None, overhead: Overhead) -> TrainableField:
        """Return the field to train, from the checkpoint or as a stage starts with it."""
        # For random split positions, which a resumed run repeats.
        torch.manual_seed(self.settings.seed * 1000 + stage.level)
        if checkpoint is not None:
            return self._context.restored_model(checkpoint["model"])
        with overhead.timed("inheritance"):
            return first_model(self._context, stage)

    def _schedule(self, stage: Stage) -> StageSchedule:
        """Return the schedule of a stage; tell the user if its views cannot all be rendered together."""
        plan, train, batches = self._context.plan, self._context.scene.train, self._batches
        schedule = StageSchedule.create(
            self.settings,
            stage,
            iterations_continued(plan, stage),
            views_per_step(self.settings, stage, len(train), batches),
            len(train),
        )
        sizes = {view.camera.size for view in train}
        if schedule.views > 1 and batches and len(sizes) > 1:
            self.monitor.say(
                f"level {stage.level}: steps for {schedule.views} views; the training views have {len(sizes)} sizes, "
                "and those of one size are rendered together"
            )
        return schedule

    @property
    def _batches(self) -> bool:
        """Whether views are rendered together; a pose's gradient needs the Gaussians' gradients of its view alone."""
        return not self.settings.refine_poses and self.rasterizer.can_batch

    def _stage_run(
        self,
        stage: Stage,
        schedule: StageSchedule,
        model: TrainableField,
        images: StageImages,
        memory: PeakMemory,
        checkpoint: dict[str, Any] | None,
        overhead: Overhead,
    ) -> StageRun:
        """Return a stage that is ready to train a model, or to be restored from a checkpoint."""
        context, before = self._context, self._context.record_to_extend(stage)
        breakdown, poses = self._breakdown(before, checkpoint), first_poses(context, stage)

        def unfreeze(states: dict[int, dict[str, Any]] | None) -> JointFields:
            memory.note(images.bytes_on_device)
            images.drop_predictions()  # from now on they are rendered
            return joint_fields(context, poses, states)

        return StageRun(
            stage=replace(stage, iterations=schedule.end),
            schedule=schedule,
            settings=self.settings,
            views=level_views(context.scene.train, stage.level),
            images=images.targets,
            background=torch.zeros(3, device=self.device) if stage.signed else context.background,
            extent=context.scene.extent,
            rasterizer=context.rasterizer,
            hooks=self._hooks,
            model=model,
            densifier=control_of(self._strategy_of(stage), schedule, context.scene.extent),
            coarser=CoarserLevels(images.train_predictions, self.settings.joint_from(stage), unfreeze, breakdown),
            exposures=first_exposures(context, stage, checkpoint, overhead),
            poses=poses,
            batches=self._batches,
            breakdown=breakdown,
            progress=StageProgress(start_gaussians=len(model)) if before is None else StageProgress.of(before),
            busy=GpuBusy(stage.iterations if self.gpu_busy else 0),
            say=self.monitor.say,
        )

    def _breakdown(self, before: LevelRecord | None, checkpoint: dict[str, Any] | None) -> Breakdown:
        """Return what measures the parts of iterations, from the beginning of the stage or after what was measured.

        Without a measurement from the first iteration on, the parts would not add up to the whole.
        """
        spent = None if before is None else before.breakdown_seconds
        if checkpoint is not None:
            spent = checkpoint.get("breakdown")
        continues = before is not None or checkpoint is not None
        if not self.breakdown or (continues and not spent):
            return Breakdown()
        return breakdown_on(self.device, spent)

    def _restore(self, run: StageRun, checkpoint: dict[str, Any]) -> None:
        """Check a checkpoint against the stage, and continue from it."""
        path = self.archive.path(CHECKPOINT)
        check_densifier(checkpoint["densifier"], run.densifier.state, len(run.model), path)
        for name, learned in run.transforms.items():
            shape = None if learned is None else learned.transforms.shape
            check_transforms(checkpoint.get(name), shape, name, path)
            if (best := checkpoint.get("best")) is not None:
                check_transforms(best.get(name), shape, f"best.{name}", path)
        run.restore(checkpoint)

    def _archive_stage(
        self, run: StageRun, before: LevelRecord | None, overhead: Overhead, memory: dict[str, int]
    ) -> None:
        """Archive a finished stage, or the longer training of one that was finished before, with its record then."""
        stage, field = run.stage, run.model.field.detach()
        used = {} if before is None else before.memory_bytes
        record = LevelRecord(
            level=stage.level,
            signed=stage.signed,
            iterations=stage.iterations,
            num_gaussians=len(field),
            peak_gaussians=run.progress.peak_gaussians,
            train_seconds=run.progress.seconds,
            overhead_seconds=dict(overhead),
            image_size=stage.image_size,
            memory_bytes={name: max(n, used.get(name, 0)) for name, n in memory.items()},
            mean_gaussians=run.progress.gaussian_steps / run.progress.iteration,
            breakdown_seconds=run.breakdown.seconds(),
            gpu_busy_seconds=run.busy.seconds(),
            start_gaussians=run.progress.start_gaussians,
        )
        joint = run.coarser.joint
        along = {} if joint is None else joint.fields
        exposure = None if run.exposures is None else run.exposures.archived()
        poses = None if run.poses is None else run.poses.archived()
        if before is None:
            inherited = stage.level > 0 and self.settings.inherit_mode == "full"
            moments = run.model.optimizer_moments() if inherited else None
            self.archive.finish_level(record, field, moments, along or None, exposure, poses)
        else:
            extended = {"iterations": self.settings.iterations, "extended": self.settings.extended}
            self.archive.finish_extension(record, {**along, stage.level: field}, exposure, poses, extended)
        for line in weak_levels([record], last_psnr(self.archive.history()) if stage.level == 0 else {}):
            self.monitor.say(line)
