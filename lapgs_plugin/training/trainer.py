"""Train a whole run: its stages from the coarsest level to the finest. Each is archived; any can be resumed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from lapgs_plugin.errors import DeviceMemoryError, counted
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hierarchy.pruning import unpruned_line
from lapgs_plugin.hooks import HookDispatcher, StageHook, hooks_line
from lapgs_plugin.interrupt import StopRequest, stop_request
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH
from lapgs_plugin.runs.layout import CHECKPOINT
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.runs.profiling import Breakdown, Overhead, breakdown_on
from lapgs_plugin.runs.watcher import Watcher
from lapgs_plugin.stages.images import StageImages
from lapgs_plugin.stages.record import LoopCounts, StageRecord
from lapgs_plugin.training.between_steps import BetweenSteps
from lapgs_plugin.training.checkpoint import check_checkpoint, check_densifier, check_transforms
from lapgs_plugin.training.evaluation import StageEvaluation
from lapgs_plugin.training.gains import StageGains
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.planning import unpruned_levels
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.quality import (
    SAMPLES_OF_A_STAGE,
    SAMPLES_TO_KEEP_BEST,
    QualityWatch,
    few_views_line,
)
from lapgs_plugin.training.schedule import StageSchedule
from lapgs_plugin.training.stage import StageRun
from lapgs_plugin.training.stage_start import (
    first_appearance,
    first_model,
    first_poses,
    photos_of,
    predict_views,
    stage_geometry,
)
from lapgs_plugin.training.time_budget import (
    StageBudget,
    cost_of,
    parse_duration,
    require_time_left,
    seconds_to_archive,
)
from lapgs_plugin.training.warm_up import warm_up


@dataclass
class Trainer:
    """Train the hierarchy of one scene into a run folder.

    Attributes:
        prepared: the run, as `preparation.prepare` yields it.
        user_hooks: called after the stock ones.
        monitor: shows progress.
        watcher: looks at the fields between iterations.
        clock: returns seconds, those of `PreparedRun.began`.
        finest: level after which the run stops, to be continued.
    """

    prepared: PreparedRun
    user_hooks: Sequence[StageHook] = ()
    monitor: Monitor = field(default_factory=Monitor)
    watcher: Watcher = field(default_factory=Watcher)
    clock: Callable[[], float] = time.monotonic
    finest: int = 0

    def __post_init__(self) -> None:
        settings = self.prepared.settings
        self._quality = QualityWatch()
        self._ends: float | None = None  # when the run should end, by the clock
        self._hooks = HookDispatcher.create(
            self.prepared.supervision, settings.ssim_weight, self.user_hooks, settings.hooks
        )

    def run(self) -> None:
        """Train all stages that are not finished yet, or extend a finished run.

        A run whose settings have more iterations than its manifest is extended: its finest stage trains on.

        Raises:
            TrainingStoppedError: the user asked to stop; everything needed to resume is on disk.
            TrainingDivergedError: NaN or inf; finished levels and the last checkpoint are kept.
            DeviceMemoryError: the GPU is full; the same is kept.
        """
        prepared, archive = self.prepared, self.prepared.archive
        checkpoint = self._checkpoint() if prepared.resumes else None
        if prepared.control.threads is not None:
            torch.set_num_threads(prepared.control.threads)
        with one_pool(), stop_request() as stop, prepared.image_cache():
            try:
                warm_up(prepared)
                self._ends = self._run_ends(checkpoint)
                self.watcher.run_started(archive)
                if not prepared.resumes:
                    self._say_what_is_chosen()
                for level in reversed(range(self.finest, prepared.plan.levels)):
                    stage = self.prepared.plan[level]
                    if stage.level in archive.available_levels and prepared.record_to_extend(stage) is None:
                        continue
                    here = checkpoint if checkpoint is not None and checkpoint.get("level") == stage.level else None
                    self._run_stage(stage, here, stop)
            except torch.cuda.OutOfMemoryError as error:
                raise self._out_of_memory() from error

    def _run_ends(self, checkpoint: dict[str, Any] | None) -> float | None:
        """Return when the run should end, by the clock; None without --time.

        Raises:
            UserInputError: no time is left for training.
        """
        prepared, now = self.prepared, self.clock()
        if (text := prepared.settings.time) is None:
            return None
        if prepared.began is not None:
            require_time_left(text, now - prepared.began)
            return prepared.began + parse_duration(text)
        if checkpoint is not None:
            budget = checkpoint["budget"]  # None where the run has got its time since, of which nothing is over
            return now + (parse_duration(text) if budget is None else float(budget["run_seconds"]))
        records = prepared.archive.manifest.records
        spent = sum(record.train_seconds + sum(record.overhead_seconds.values()) for record in records)
        return now + parse_duration(text) - spent

    def _budget(self, stage: Stage, checkpoint: dict[str, Any] | None) -> StageBudget | None:
        """Return what decides the length of a stage by the clock; None without --time."""
        if (run_ends := self._ends) is None:
            return None
        prepared, saved = self.prepared, None if checkpoint is None else checkpoint["budget"]
        budget = StageBudget(self.clock, run_ends, stage.iterations, afterwards=len(prepared.scene.test))
        if saved is not None and prepared.began is None:
            return replace(budget, ends=self.clock() + saved["stage_seconds"])
        done = 0 if checkpoint is None else checkpoint["counts"]["iteration"]
        own = replace(stage, iterations=max(1, stage.iterations - done))
        finer = [each for each in prepared.plan if each.level < stage.level]
        written = sum(map(prepared.gaussians_to_archive, (stage, *finer)))
        return replace(budget, share=cost_of([own]) / cost_of([own, *finer]), reserve=seconds_to_archive(written))

    def _gains(self, stage: Stage, checkpoint: dict[str, Any] | None) -> StageGains | None:
        """Return what decides the length of a stage by views that are set aside; None without --stop auto.

        None for finer levels, too, whose lengths are in proportion to the coarsest one's. Their first gains promise too
        little: most comes when rates have fallen again, and of residuals when coarser levels are trained along.
        """
        if not self.prepared.settings.stops_early or stage.level < self.prepared.plan.levels - 1:
            return None
        most = self.prepared.planned[stage.level].iterations
        if checkpoint is not None:
            return StageGains(most, **checkpoint["gains"])
        return StageGains(most, planned=most)

    def _say_what_is_chosen(self) -> None:
        """Tell the user the effect of the settings on this scene and device."""
        scene, say = self.prepared.scene, self.monitor.say
        settings = self.prepared.settings
        say(self._strategy_line())
        if (hooks := hooks_line(settings.hooks)) is not None:
            say(hooks)
        if withheld := self.prepared.withheld:
            say(
                f"--stop auto: {len(withheld)} of {len(scene.train)} training views are set aside and decide when "
                f"levels end, after {self.prepared.planned.iterations:,} iterations together at most"
            )
        elif (few := few_views_line(len(scene.train), self.prepared.plan.iterations, bool(scene.test))) is not None:
            say(few)
        if settings.dropout is None and (share := settings.dropout_for(len(scene.train))) > 0.0:
            say(f"{len(scene.train)} training views are few: --dropout {share:g} leaves Gaussians out at random")
        for level in unpruned_levels(self.prepared.plan, settings):
            say(unpruned_line(settings.prune, level))
        if (ranks := self.prepared.ranks).size > 1:
            views = [str(self.prepared.schedule_of(stage).views) for stage in self.prepared.plan]
            say(f"{ranks.together}: {' and '.join(views)} views a step are shared out, coarsest level first")
        if self.prepared.sharding.divides:
            say("--shard: each rank has a share of the Gaussians and renders one view at a time")
        if settings.refine_poses and self.prepared.device.type == "cuda":
            say("--refine-poses: views are rendered one by one, which takes longer than several at once")

    def _strategy_line(self) -> str:
        """Say how Gaussians are added, and up to which numbers, coarsest level first."""
        strategies = [self.prepared.strategy_of(stage) for stage in self.prepared.plan]
        limits = [f"{strategy.most:,}" for strategy in strategies if strategy.most is not None]
        words = f", at most {' and '.join(limits)} Gaussians" if limits else ""
        return f"density control: --strategy {self.prepared.settings.densification.strategy}{words}"

    def _checkpoint(self) -> dict[str, Any] | None:
        """Return the checkpoint of the next stage; None if it starts from its beginning."""
        prepared, archive = self.prepared, self.prepared.archive
        state, level = archive.load_checkpoint(), archive.manifest.next_level or 0
        if state is not None:
            path, stage = archive.path(CHECKPOINT), prepared.plan[level]
            check_checkpoint(state, path, stage, prepared.settings, archive.available_levels)
        return state

    def _out_of_memory(self) -> DeviceMemoryError:
        level = self.prepared.archive.manifest.next_level or 0  # of a run that is extended, the finest
        return DeviceMemoryError(
            f"the GPU has no memory left at level {level}; finished levels and the last checkpoint are kept: "
            "continue with --resume on a larger one, or start again with --packed, --images-on memory, a smaller "
            "--resolution or a smaller --cap-max"
        )

    def _run_stage(self, stage: Stage, checkpoint: dict[str, Any] | None, stop: StopRequest) -> None:
        """Train and archive one stage."""
        # A run that was stopped with --stop auto may continue with --time.
        for decided in () if checkpoint is None else filter(None, (checkpoint["gains"], checkpoint["budget"])):
            self.prepared = self.prepared.lasting(stage.level, decided["planned"])
        stage, gains = self.prepared.plan[stage.level], self._gains(stage, checkpoint)
        budget = self._budget(stage, checkpoint)
        prepared, aside = self.prepared, self.prepared.aside
        before = prepared.record_to_extend(stage)
        schedule = self._schedule(stage)
        if checkpoint is not None:
            schedule = replace(schedule, least_sh_degree=checkpoint.get("least_sh_degree", 0))
        record = self._record(replace(stage, iterations=schedule.end), before, checkpoint)
        record.start()
        model = self._model(stage, checkpoint, record.overhead)
        with record.overhead.timed("pyramid"):
            images = photos_of(prepared, stage)
        with closing(images):
            jointly = checkpoint is not None and checkpoint.get("joint") is not None
            if stage.signed and not jointly:  # else rendered
                predict_views(prepared, stage, images, record.overhead)
            run = self._stage_run(stage, schedule, model, images, record, checkpoint, budget, gains)
            evaluation = StageEvaluation(run, self._quality, self.monitor)
            if checkpoint is not None:
                evaluation.best = checkpoint.get("best")
                self._restore(run, checkpoint)
            if prepared.control.breakdown and not record.breakdown.measures:
                self.monitor.say(f"level {stage.level} was started without --breakdown: its parts are not measured")
            record.rewind_history()
            if before is not None and checkpoint is None and aside:
                evaluation.note_best()  # the finished run's state is the one to beat
            self.monitor.stage_started(run.stage, record.counts.iteration + 1)
            if checkpoint is None:
                self._say_if_nothing_is_visible(run)
            between_steps = BetweenSteps(
                evaluation=evaluation,
                watcher=self.watcher,
                stop=stop,
                samples=SAMPLES_TO_KEEP_BEST if aside else SAMPLES_OF_A_STAGE,
                last_tick=(record.counts.seconds, record.counts.iteration),
            )
            run.hooks.on_stage_start(run.stage)
            self.watcher.stage_started(run.stage)
            run.run(between_steps)
            self.prepared = run.prepared  # with the length that the stage has got, with --time
            run.hooks.on_stage_end(run.stage)
            evaluation.return_to_best()
            evaluation.note_views()
            record.note_memory(images.bytes_on_device)
            self._archive_stage(run, extends=before is not None)
            self.watcher.stage_finished(run.stage, lambda: run.fields)

    def _record(self, stage: Stage, before: LevelRecord | None, checkpoint: dict[str, Any] | None) -> StageRecord:
        """Return the measurements of a stage so far: in its checkpoint, of one that is extended, or none yet.

        Parts of iterations are measured from the first one on or not at all, because they add up to the whole.
        """
        prepared, control = self.prepared, self.prepared.control
        counts, overhead, parts = LoopCounts(), Overhead(), dict[str, float]()
        if before is not None:
            counts, overhead = LoopCounts.of(before), Overhead(before.overhead_seconds)
            parts = before.breakdown_seconds
        if checkpoint is not None:
            counts, overhead = LoopCounts(**checkpoint["counts"]), Overhead(checkpoint["overhead"])
            parts = checkpoint["breakdown"]
        measures = control.breakdown and (counts.iteration == 0 or bool(parts))
        return StageRecord(
            archive=prepared.archive,
            stage=stage,
            iterations=prepared.settings.iterations,
            device=prepared.device,
            profiled=stage.iterations if control.gpu_busy else 0,
            counts=counts,
            overhead=overhead,
            breakdown=breakdown_on(prepared.device, parts) if measures else Breakdown(),
            memory_before={} if before is None else before.memory_bytes,
        )

    @torch.no_grad()
    def _say_if_nothing_is_visible(self, run: StageRun) -> None:
        """Tell the user if the view that a stage renders first shows no Gaussian, which would train to black."""
        view, near = run.first_view, NEAR_DEPTH * self.prepared.archive.manifest.scene.unit
        result = self.prepared.rasterizer(run.model.field, view.camera, background=run.background, sh_degree=0)
        if not bool(result.radii.any()):
            self.monitor.say(
                f"level {run.stage.level}: none of {counted(run.num_optimized, 'Gaussian')} is visible in {view.name}, "
                f"the first view: all are outside of it, behind it, or less than {near:.3g} in front of it; check that "
                "the points and the cameras are of one model"
            )

    def _model(self, stage: Stage, checkpoint: dict[str, Any] | None, overhead: Overhead) -> TrainableField:
        """Return the field to train, from the checkpoint or as a stage starts with it."""
        # For random split positions, which a resumed run repeats.
        torch.manual_seed(self.prepared.settings.seed * 1000 + stage.level)
        self.prepared.sharding.draw_apart()
        if checkpoint is not None:
            return self.prepared.restored_model(checkpoint["model"])
        with overhead.timed("inheritance"):
            return first_model(self.prepared, stage)

    def _schedule(self, stage: Stage) -> StageSchedule:
        """Return the schedule of a stage; tell the user if its views cannot all be rendered together."""
        schedule = self.prepared.schedule_of(stage)
        groups = len(set(self.prepared.size_groups(stage.level).values()))
        if schedule.views > 1 and self.prepared.batches and groups > 1:
            self.monitor.say(
                f"level {stage.level}: steps for {schedule.views} views; the training views have {groups} groups of "
                "similar sizes, and those of one group are rendered together"
            )
        return schedule

    def _stage_run(
        self,
        stage: Stage,
        schedule: StageSchedule,
        model: TrainableField,
        images: StageImages,
        record: StageRecord,
        checkpoint: dict[str, Any] | None,
        budget: StageBudget | None,
        gains: StageGains | None,
    ) -> StageRun:
        """Return a stage that is ready to train a model, or to be restored from a checkpoint."""
        prepared, poses = self.prepared, first_poses(self.prepared, stage)
        appearance, falloffs = first_appearance(prepared, stage, checkpoint, record.overhead, self.monitor)
        if record.counts.iteration == 0:
            record.counts.start_gaussians = prepared.sharding.total(len(model))
        return StageRun(
            prepared=prepared,
            stage=replace(stage, iterations=schedule.end),
            schedule=schedule,
            images=images,
            hooks=self._hooks,
            model=model,
            densifier=prepared.density_control(stage, schedule),
            appearance=appearance,
            falloffs=falloffs,
            poses=poses,
            geometry=stage_geometry(prepared, stage),
            record=record,
            say=self.monitor.say,
            budget=budget,
            gains=gains,
        )

    def _restore(self, run: StageRun, checkpoint: dict[str, Any]) -> None:
        """Check a checkpoint against the stage, and continue from it. The checkpoint is empty afterwards.

        The stage has copies of its tensors, and callers would keep the originals in memory to the end of the run.
        """
        path = self.prepared.archive.path(CHECKPOINT)
        count = len(checkpoint["model"]["params"]["means"])
        check_densifier(checkpoint["densifier"], run.densifier.state, count, path)
        for name, learned in run.transforms.items():
            shape = None if learned is None else learned.transforms.shape
            check_transforms(checkpoint.get(name), shape, name, path)
            if (best := checkpoint.get("best")) is not None:
                check_transforms(best.get(name), shape, f"best.{name}", path)
        run.restore(checkpoint)
        checkpoint.clear()

    def _archive_stage(self, run: StageRun, extends: bool) -> None:
        """Archive a finished stage, or the longer training of one that was finished before."""
        stage, whole = run.stage, self.prepared.sharding.whole
        fields = {level: field.with_parameters(whole(field.parameters)) for level, field in run.fields.items()}
        field = fields.pop(stage.level)
        settings, archive = self.prepared.settings, self.prepared.archive
        record, along = run.record.of_level(len(field)), fields
        if run.gains is not None:
            record = replace(record, decided=run.gains.length)
        exposure = None if run.appearance is None else run.appearance.archived()
        grids = None if run.appearance is None else run.appearance.archived_grids()
        poses = None if run.poses is None else run.poses.archived()
        if extends:
            extended = {"iterations": settings.iterations, "extended": settings.extended}
            archive.finish_extension(record, {**along, stage.level: field}, exposure, poses, grids, extended)
        else:
            inherited = stage.level > 0 and settings.inherit_mode == "full"
            moments = whole(run.model.optimizer_moments()) if inherited else None
            archive.finish_level(record, field, moments, along or None, exposure, poses, grids)
        for line in run.record.weak_lines():
            self.monitor.say(line)
