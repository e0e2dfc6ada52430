"""Train a whole run: its stages from the coarsest level to the finest. Each is archived; any can be resumed."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.errors import DeviceMemoryError, TrainingStoppedError, UserInputError
from lapgs_plugin.evaluation.exposure import predicted_exposures
from lapgs_plugin.evaluation.metrics import color_fitted_psnr, psnr
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import BatchRasterizer, Rasterizer, render_image
from lapgs_plugin.hierarchy.cameras import level_camera
from lapgs_plugin.hierarchy.inheritance import field_from_points, inherit
from lapgs_plugin.hierarchy.plan import Stage, StagePlan, continues_field
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.hierarchy.supervision import SUPERVISIONS
from lapgs_plugin.hooks import HookDispatcher, StageHook
from lapgs_plugin.interrupt import StopRequest, stop_request
from lapgs_plugin.ops import densification_statistics
from lapgs_plugin.ops.adam import StepScale
from lapgs_plugin.ops.color_transform import transform_colors
from lapgs_plugin.ops.composition import add_prediction, to_full_size
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.upsample import upsample_add
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.run import refined
from lapgs_plugin.runs.archive import CACHE, CHECKPOINT, OPTIMIZER, RunArchive
from lapgs_plugin.runs.gpu_busy import GpuBusy, require_cuda
from lapgs_plugin.runs.image_store import chosen_precision, eight_bit_levels
from lapgs_plugin.runs.level_images import ImageStores, LevelImages
from lapgs_plugin.runs.manifest import LevelRecord
from lapgs_plugin.runs.profiling import Breakdown, Overhead, PeakMemory, breakdown_on
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.runs.watcher import Watcher
from lapgs_plugin.scenes.exposure import measure_exposure
from lapgs_plugin.scenes.scene import Scene, View
from lapgs_plugin.training.checkpoint import check_checkpoint, check_densifier, check_moments, check_transforms
from lapgs_plugin.training.exposure import DIFFERENT, ViewExposures, from_gains, identities, start_from
from lapgs_plugin.training.joint import JointFields
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.monitor import Monitor, Tick
from lapgs_plugin.training.poses import ViewPoses
from lapgs_plugin.training.quality import (
    SAMPLED_VIEWS,
    SAMPLES_OF_A_STAGE,
    SAMPLES_TO_KEEP_BEST,
    QualityWatch,
    copied,
    few_views_line,
    require_views_to_set_aside,
    set_aside,
    spread_views,
)
from lapgs_plugin.training.schedule import StageSchedule, views_per_step
from lapgs_plugin.training.settings import BEST, OFF, TrainSettings
from lapgs_plugin.training.stage import StageProgress, StageRun
from lapgs_plugin.training.views import level_views

TRAIN, TEST = "train", "test"
"""Folders of cached predictions for training and held-out views."""
CHECKPOINT_SECONDS = 60.0
"""Time between two checkpoints unless a number of iterations is given."""
LOG_TICKS = 200
"""Approximate number of history entries and progress updates of a run."""


def make_plan(size: tuple[int, int], settings: TrainSettings, views: int | None = None) -> StagePlan:
    """Return the stages of a run on images of this size (width, height), which is `Scene.smallest_size`.

    Args:
        size: (width, height).
        settings: of the run.
        views: number of training views; None if unknown.

    Raises:
        UserInputError: levels, split and image size do not go together, or there are too few views for a step or for
            --keep best.
    """
    if views is not None and (asked := settings.asked_views or 1) > views:
        raise UserInputError(
            f"--views-per-step {asked}: the scene has {views} training views; give at most as many, or auto"
        )
    if views is not None and settings.keep == BEST:
        require_views_to_set_aside(views)
    return StagePlan.create(size, settings.scheduled, settings.levels, settings.shares, settings.kind)


def check_storage(settings: TrainSettings, device: torch.device) -> None:
    """Check that the device of a run has the place that the settings name for images.

    Raises:
        UserInputError: it has not.
    """
    if settings.images_on == "gpu" and device.type != "cuda":
        raise UserInputError("--images-on gpu: expected memory or disk, as a CPU trains this run")


def warm_up(
    rasterizer: Rasterizer,
    settings: TrainSettings,
    device: torch.device | str = "cpu",
    *,
    residuals: bool = False,
    joint: bool = False,
) -> None:
    """Run every kernel of an iteration once, so that compilation is not measured as training."""
    ahead = torch.tensor([[0.0, 0.0, 1.0]])
    first = field_from_points(ahead, ahead, settings.sh_degree).to(device)
    model = TrainableField.create(first, settings.rates, extent=1.0, sparse=settings.sparse_adam)
    camera, black = Camera(16, 16, 16.0, 16.0, 8.0, 8.0, torch.eye(4)), torch.zeros(3, device=device)
    result = rasterizer(model.field, camera, background=black)
    # Kernels of the loss are compiled for the types that targets and predictions are stored in.
    on_gpu = torch.device(device).type == "cuda"
    target_types = (torch.uint8, torch.float16) if on_gpu else (result.image.dtype,)
    coarse = torch.zeros(3, 8, 8, device=device)
    rendered = [result.image, render_image(rasterizer, model.field, camera, black)]
    if residuals:
        rendered.append(upsample_add(Pyramid(), coarse.to(target_types[-1]), rendered[1]))
    if joint:
        below = torch.zeros(8, 8, 3, device=device, requires_grad=True).permute(2, 0, 1)  # interleaved as renders are
        rendered.append(upsample_add(Pyramid(), below, rendered[1]))
    targets = [torch.zeros(3, 16, 16, dtype=each, device=device) for each in target_types]
    losses = [photometric_loss(image, target) for image in rendered for target in targets]
    torch.stack(losses).sum().backward()  # type: ignore[no-untyped-call]  # torch's
    model.step(means_rate=0.0, active_coefficients=1)
    if isinstance(rasterizer, BatchRasterizer) and rasterizer.can_batch:
        images = rasterizer.render_batch(model.field, [camera, camera], background=black).image
        none = torch.zeros(images.shape, dtype=target_types[0], device=device)
        photometric_loss(images, none).backward()  # type: ignore[no-untyped-call]  # torch's
        model.step(0.0, 1, scale=StepScale.of(2))
    if on_gpu:
        densification_statistics.triton_works()


@dataclass
class Trainer:
    """Train the hierarchy of one scene into a run folder.

    Attributes:
        scene: views, points and background.
        settings: of the run.
        archive: the run folder; its manifest has the same settings.
        rasterizer: renders every field.
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

    def __post_init__(self) -> None:
        views = len(self.scene.train)
        self._aside = set_aside(self.scene.train) if self.settings.keep == BEST else []
        aside = {view.name for view in self._aside}
        self.scene = replace(self.scene, train=tuple(view for view in self.scene.train if view.name not in aside))
        self.plan = make_plan(self.scene.smallest_size, self.settings, views)
        self._pyramid = Pyramid(self.settings.grid)
        self._supervision = SUPERVISIONS[self.settings.supervision]
        check_storage(self.settings, self.device)
        if self.gpu_busy:
            require_cuda(self.device)
            if self.settings.extended:
                raise UserInputError(
                    "--gpu-busy: is measured in whole stages, not when a run is extended; leave it out"
                )
        self._overhead = Overhead()
        self._quality = QualityWatch()
        self._best: dict[str, Any] | None = None  # the stage's best state so far, see `checkpoint.BestState`
        self._samples: frozenset[int] = frozenset()  # iterations of the stage after which some views are measured
        self._images: LevelImages | None = None
        self._train_cache: UpsampledImages | None = None
        self._test_cache: UpsampledImages | None = None
        self._memory = PeakMemory(self.device)
        self._last_tick = (0.0, 0)
        self._last_checkpoint = time.monotonic()

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
        checkpoint = self._checkpoint() if resume else None
        with stop_request() as stop:
            try:
                joint = any(self.settings.joint_from(stage) is not None for stage in self.plan)
                residuals = any(stage.signed for stage in self.plan)
                warm_up(self.rasterizer, self.settings, self.device, residuals=residuals, joint=joint)
                self.watcher.run_started(self.archive)
                few = few_views_line(len(self.scene.train), self.plan.iterations, bool(self.scene.test))
                if few is not None and not resume:
                    self.monitor.say(few)
                if self.settings.refine_poses and self.device.type == "cuda":
                    self.monitor.say(
                        "--refine-poses: each view is rendered alone, which takes longer than several at once"
                    )
                for stage in self.plan:
                    if stage.level in self.archive.available_levels and self._to_extend(stage) is None:
                        continue
                    here = checkpoint if checkpoint is not None and checkpoint["level"] == stage.level else None
                    self._run_stage(stage, here, stop)
            except torch.cuda.OutOfMemoryError as error:
                raise self._out_of_memory() from error
            finally:
                self._close_caches()
                if self._images is not None:
                    self._images.close()

    def _checkpoint(self) -> dict[str, Any] | None:
        """Return the checkpoint of the next stage; None if it starts from its beginning."""
        state, level = self.archive.load_checkpoint(), self.archive.manifest.next_level or 0
        if state is not None:
            (stage,) = (each for each in self.plan if each.level == level)
            path = self.archive.path(CHECKPOINT)
            check_checkpoint(state, path, stage, self.settings, self.archive.available_levels)
        return state

    def _to_extend(self, stage: Stage) -> LevelRecord | None:
        """Return the record of a finished stage that is to train on; None for all others."""
        done = {record.level: record for record in self.archive.manifest.records}.get(stage.level)
        whole = stage.iterations + self.settings.extension_of(stage)
        return done if done is not None and done.iterations < whole else None

    def _exposures(self, stage: Stage, checkpoint: dict[str, Any] | None) -> ViewExposures | None:
        """Return the colour transforms that a stage starts with; None if the run does not compensate exposure."""
        names, levels = [view.name for view in self.scene.train], self.archive.available_levels
        start: Tensor | None
        if levels:
            archived = self.archive.exposure(levels[-1])
            start = None if archived is None else start_from(archived, names)
        elif checkpoint is not None:  # `restore` has the values
            start = None if checkpoint.get("exposure") is None else identities(len(names))
        else:
            with self._overhead.timed("exposure"):
                start = self._first_exposures()
        if start is None:
            return None
        done = self.plan.iterations_before(stage.level)
        return ViewExposures.create(names, start, self.device, done, self.plan.iterations)

    def _poses(self, stage: Stage) -> ViewPoses | None:
        """Return the corrections of poses that a stage starts with; None if the run does not refine poses."""
        if not self.settings.refine_poses:
            return None
        levels, done = self.archive.available_levels, self.plan.iterations_before(stage.level)
        start = (self.archive.poses(levels[-1]) if levels else None) or {}
        total = self.plan.iterations
        return ViewPoses.create(self.scene.train, start, self.scene.extent, self.device, done, total)

    def _first_exposures(self) -> Tensor | None:
        """Return the colour transforms (v, 3, 4) that the run starts with, as --exposure says and the photos differ."""
        choice = self.settings.exposure
        if choice == OFF or not self._supervision.composes:
            return None
        measured = measure_exposure(self.scene)
        found, differ = f"{measured.spread:.2f} stops between photos", measured.spread >= DIFFERENT
        if choice == AUTO and not differ:
            return None
        self.monitor.say(
            f"exposure differs by {found}: each photo gets a colour transform; --exposure off trains without"
            if differ
            else f"exposure differs by {found}, hardly at all; each photo gets a colour transform all the same"
        )
        return from_gains(measured.gains) if differ else identities(len(self.scene.train))

    def _moments(self, level: int, field: GaussianField) -> dict[str, Any]:
        """Return Adam's state that the next level inherits from a finished one with its field."""
        moments = self.archive.optimizer_state(level)
        check_moments(moments, field, self.archive.path(f"level_{level}", OPTIMIZER))
        return moments

    def _run_stage(self, stage: Stage, checkpoint: dict[str, Any] | None, stop: StopRequest) -> None:
        """Train and archive one stage."""
        before = self._to_extend(stage)
        spent = None if before is None else before.overhead_seconds
        self._overhead = Overhead(spent if checkpoint is None else checkpoint["overhead"])
        self._memory = PeakMemory(self.device)
        run = self._prepare(stage, self._first_model(stage, checkpoint), checkpoint)
        self._samples = run.schedule.sampled(SAMPLES_OF_A_STAGE if not self._aside else SAMPLES_TO_KEEP_BEST)
        self._best = None if checkpoint is None else checkpoint.get("best")
        if checkpoint is not None:
            path = self.archive.path(CHECKPOINT)
            check_densifier(checkpoint["densifier"], run.densifier.state, len(run.model), path)
            for name, learned in (("exposure", run.exposures), ("poses", run.poses)):
                shape = None if learned is None else learned.transforms.shape
                check_transforms(checkpoint.get(name), shape, name, path)
            run.restore(checkpoint)
        if self.breakdown and not run.breakdown.measures:
            self.monitor.say(f"level {stage.level} was started without --breakdown: its parts are not measured")
        self.archive.rewind_history(stage.level, run.progress.iteration)
        if before is not None and checkpoint is None and self._aside:
            self._note_best(run)  # the finished run's state is the one to beat
        self.monitor.stage_started(run.stage, run.progress.iteration + 1)
        self._last_tick = (run.progress.seconds, run.progress.iteration)
        run.hooks.on_stage_start(run.stage)
        self.watcher.stage_started(run.stage)

        def after_iteration(run: StageRun) -> None:
            self._after_iteration(run, stop)

        run.run(after_iteration)
        run.hooks.on_stage_end(run.stage)
        self._finish(run)

    def _first_model(self, stage: Stage, checkpoint: dict[str, Any] | None) -> TrainableField:
        """Return the field that a stage starts from: the checkpoint's, the point cloud's or the previous level's."""
        torch.manual_seed(
            self.settings.seed * 1000 + stage.level
        )  # for random split positions, which a resumed run repeats
        rates, extent = self.settings.rates, self.scene.extent
        sparse = self.settings.sparse_adam
        if checkpoint is not None:
            return TrainableField.from_state(checkpoint["model"], rates, extent, device=self.device, sparse=sparse)
        with self._overhead.timed("inheritance"):
            if self._to_extend(stage) is not None:
                return TrainableField.create(
                    self.archive.field(stage.level).to(self.device), rates, extent, sparse=sparse
                )
            if continues_field(stage, self.plan.levels):
                field = self.archive.field(stage.level + 1)
                model = TrainableField.create(field.to(self.device), rates, extent, sparse=sparse)
                model.adopt_moments(self._moments(stage.level + 1, field), torch.arange(len(field)))
                return model
            if not stage.signed:
                degree = self.settings.sh_degree_of(stage)
                points = field_from_points(self.scene.points, self.scene.colors, degree)
                points = self.settings.densification.options.start(points)
                return TrainableField.create(points.to(self.device), rates, extent, sparse=sparse)
            generator = torch.Generator().manual_seed(self.settings.seed)
            coarser = self.archive.field(stage.level + 1)
            mode, ratio = self.settings.inherit_mode, self.settings.inherit_ratio
            field, kept = inherit(coarser, mode, ratio, generator, self.settings.sh_degree)
            model = TrainableField.create(field.to(self.device), rates, extent, sparse=sparse)
            if self.settings.inherit_mode == "full":
                model.adopt_moments(self._moments(stage.level + 1, coarser), kept)
            return model

    def _next_stage_inherits_moments(self, stage: Stage) -> bool:
        """Return whether the next stage inherits Adam's state from this one."""
        return stage.level > 0 and self.settings.inherit_mode == "full"

    def _prepare(self, stage: Stage, model: TrainableField, checkpoint: dict[str, Any] | None) -> StageRun:
        """Return a stage that is ready to train a model, or to be restored from a checkpoint."""
        coarser = self.plan.iterations_before(stage.level)
        batches = isinstance(self.rasterizer, BatchRasterizer) and self.rasterizer.can_batch
        batches = batches and not self.settings.refine_poses
        schedule = StageSchedule.create(
            self.settings,
            stage,
            coarser if continues_field(stage, self.plan.levels) else 0,
            views_per_step(self.settings, stage, len(self.scene.train), batches),
            len(self.scene.train),
        )
        sizes = {(view.camera.width, view.camera.height) for view in self.scene.train}
        if schedule.views > 1 and batches and len(sizes) > 1:
            self.monitor.say(
                f"level {stage.level}: steps for {schedule.views} views; the training views have {len(sizes)} sizes, "
                "and those of one size are rendered together"
            )
        if self._images is not None:
            self._images.close()
        with self._overhead.timed("pyramid"):
            self._images = self._level_images(stage)
        self._fill_caches(stage)
        before = self._to_extend(stage)
        return StageRun(
            stage=replace(stage, iterations=schedule.end),
            schedule=schedule,
            settings=self.settings,
            views=level_views(self.scene.train, stage.level),
            images=self._images,
            accumulated=self._train_cache,
            background=(torch.zeros(3) if stage.signed else torch.tensor(self.scene.background)).to(self.device),
            extent=self.scene.extent,
            rasterizer=self.rasterizer,
            hooks=HookDispatcher.create(self._supervision, self.settings.ssim_weight, self.user_hooks),
            model=model,
            densifier=self.settings.strategy_of(stage).density_control(schedule, self.scene.extent),
            joint_from=self.settings.joint_from(stage),
            unfreeze=self._unfreeze,
            exposures=self._exposures(stage, checkpoint),
            poses=self._poses(stage),
            breakdown=self._breakdown(before),
            progress=StageProgress() if before is None else StageProgress.of(before),
            busy=GpuBusy(stage.iterations if self.gpu_busy else 0),
            say=self.monitor.say,
        )

    def _breakdown(self, before: LevelRecord | None) -> Breakdown:
        """Return what measures the parts of iterations, from the beginning of the stage or after its record."""
        if not self.breakdown or (before is not None and not before.breakdown_seconds):
            return Breakdown()
        return breakdown_on(self.device, None if before is None else before.breakdown_seconds)

    def _unfreeze(self, states: dict[int, dict[str, Any]] | None) -> JointFields:
        """Return the finished fields for joint training, from a checkpoint's `JointFields.state` or the archive.

        Their cached predictions are dropped, because from now on they are rendered.
        """
        self._memory.note(self._image_bytes)
        self._close_caches()
        rates, extent, sparse = self.settings.rates, self.scene.extent, self.settings.sparse_adam

        def model(level: int) -> TrainableField:
            if states is not None:
                return TrainableField.from_state(states[level], rates, extent, device=self.device, sparse=sparse)
            return TrainableField.create(self.archive.field(level).to(self.device), rates, extent, sparse=sparse)

        return JointFields(
            models={level: model(level) for level in self.archive.available_levels if level > 0},
            cameras={view.name: view.camera for view in (*self.scene.train, *self.scene.test, *self._aside)},
            rasterizer=self.rasterizer,
            background=torch.tensor(self.scene.background).to(self.device),
            pyramid=self._pyramid,
        )

    def _fill_caches(self, stage: Stage) -> None:
        """Cache the composed prediction of the finished levels for every view of this stage."""
        self._close_caches()
        if not stage.signed:
            return
        with self._overhead.timed("cache"):
            self._train_cache = self._predictions(stage, self.scene.train, TRAIN)
        with self._overhead.timed("evaluation"):
            self._test_cache = self._predictions(stage, [*self.scene.test, *self._aside], TEST)

    def _predictions(self, stage: Stage, views: Sequence[View], name: str) -> UpsampledImages:
        """Return Up(I_hat^(l+1)) of each view, for the stage of level l."""
        coarser = stage.level + 1
        where = self.settings.images_on
        if where == AUTO and name == TEST:
            where = "memory"  # held-out views are rarely used, outside the clock: a GPU needs its memory for others
        precision = chosen_precision(self.settings.prediction_precision, self.device)
        cache = self._stores(views, where).make_upsampled(coarser, precision, name, self._pyramid)
        if views:
            renderer = HierarchyRenderer.from_archive(self.archive, self.rasterizer, self.device)
            at_full_size = {view.name: view.camera for view in views}
            cameras = refined(self.archive, at_full_size) if name == TRAIN else at_full_size
            for view in views:
                camera = level_camera(cameras[view.name], stage.level)
                cache.put(view.name, renderer.images([view.camera], coarser)[0], (camera.height, camera.width))
        return cache

    def _stores(self, views: Sequence[View], where: str = AUTO, eight_bit: bool = False) -> ImageStores:
        sizes = [(view.camera.width, view.camera.height) for view in views]
        return ImageStores(sizes, self.device, eight_bit, where, self.archive.path(CACHE))

    def _level_images(self, stage: Stage) -> LevelImages:
        """Return the targets of a stage's training views, on a CPU as float32 tensors."""
        views, on_gpu = self.scene.train, self.device.type == "cuda"
        eight_bit = on_gpu and stage.level == 0 and all(eight_bit_levels(view.image) is not None for view in views)
        with_coarse = self._supervision.needs_coarse and stage.level < self.plan.levels - 1
        stores = self._stores(views, eight_bit=eight_bit)
        masked = any(view.mask is not None for view in views)
        images = LevelImages(
            stores, stage.level, self._pyramid, with_coarse=with_coarse, masked=masked, exact=not on_gpu
        )
        for view in views:
            images.put(view.name, view.image, view.mask)
        return images

    def _out_of_memory(self) -> DeviceMemoryError:
        next_level = self.archive.manifest.next_level
        return DeviceMemoryError(
            f"the GPU has no memory left at level {next_level}; finished levels and the last checkpoint are kept: "
            "continue with --resume on a larger one, or start again with --packed, --images-on memory, a smaller "
            "--resolution or a smaller --cap-max"
        )

    def _close_caches(self) -> None:
        for cache in (self._train_cache, self._test_cache):
            if cache is not None:
                cache.close()
        self._train_cache = self._test_cache = None
        shutil.rmtree(self.archive.path(CACHE), ignore_errors=True)

    def _after_iteration(self, run: StageRun, stop: StopRequest) -> None:
        """Log, measure, save and stop if the last step made it due; none of it counts as optimization time."""
        iteration = run.progress.iteration
        last = iteration == run.stage.iterations
        due_test = last if self.test_every is None else run.passed(self.test_every)
        due_sample = run.reached(self._samples)
        due_tick = run.passed(max(1, self.settings.iterations // LOG_TICKS))
        if due_test or due_sample or due_tick or stop.requested:
            run.settle()  # so that the iterations in progress do not count as the time of what follows
        measured = self._held_out(run, due_test, due_sample and self.test_every is None)
        if due_sample and self._aside:
            self._note_best(run)
        if measured or due_tick:
            self._tick(run, measured)
        self._watch_quality(run, measured)
        if self.watcher.wants_look():
            run.settle()
            with self._overhead.timed("view"):
                self.watcher.look(run.stage, iteration, lambda: _fields(run), lambda: stop.requested)
        if stop.requested or self._due_checkpoint(run):
            self._save_checkpoint(run)
        if stop.requested:
            raise TrainingStoppedError(
                f"stopped at level {run.stage.level}, iteration {iteration} of {run.stage.iterations}; "
                f"a checkpoint is in {self.archive.path()}, the same command with --resume continues"
            )

    def _due_checkpoint(self, run: StageRun) -> bool:
        if self.checkpoint_every is not None:
            return run.progress.iteration % self.checkpoint_every < run.step_views
        return time.monotonic() - self._last_checkpoint >= CHECKPOINT_SECONDS

    def _tick(self, run: StageRun, measured: Mapping[str, float]) -> None:
        before_seconds, before_iteration = self._last_tick
        progress = run.progress
        self._last_tick = (progress.seconds, progress.iteration)
        records = self.archive.manifest.records
        finished = sum(record.train_seconds for record in records if record.level != run.stage.level)
        tick = Tick(
            level=run.stage.level,
            iteration=progress.iteration,
            elapsed=finished + progress.seconds,
            loss=progress.loss,
            num_gaussians=run.num_optimized,
            rate=(progress.iteration - before_iteration) / max(progress.seconds - before_seconds, 1e-9),
            **measured,
        )
        self.archive.append_history({key: value for key, value in vars(tick).items() if value is not None})
        self.monitor.tick(run.stage, tick)

    def _held_out(self, run: StageRun, every: bool, sample: bool) -> dict[str, float]:
        """Return the PSNR fields of a `Tick`: of every held-out view, of some, or of both; empty without such views."""
        some = spread_views(self.scene.test, SAMPLED_VIEWS) if self.scene.test and sample else []
        views = self.scene.test if every else some
        with self._overhead.timed("evaluation") if views else nullcontext():
            learned = None if run.exposures is None else run.exposures.archived()
            exposures = {} if learned is None else predicted_exposures(learned, [view.name for view in views])
            found = {view.name: self._psnr(run, view, exposures.get(view.name)) for view in views}
        measured = {"psnr": fmean(plain for plain, _ in found.values())} if every and views else {}
        if some:
            plain, fitted = zip(*(found[view.name] for view in some), strict=True)
            measured |= {"sampled_psnr": fmean(plain), "sampled_fitted_psnr": fmean(fitted)}
        return measured

    @torch.no_grad()
    def _psnr(self, run: StageRun, view: View, exposure: Tensor | None = None) -> tuple[float, float]:
        """Return the PSNR in dB of a view, composed so far and upsampled to full resolution, and after a colour fit.

        Args:
            exposure: (3, 4) colour transform from renders to the view's photo; None for renders as they are.
        """
        camera = level_camera(view.camera, run.stage.level)
        image = self.rasterizer(run.model.field, camera, background=run.background).image
        cached = None if self._test_cache is None else self._test_cache.get
        predict = cached if run.joint is None else run.joint.predict
        image = add_prediction(image, None if predict is None else predict(view.name))
        whole = to_full_size(image, view.camera, run.stage.level, self._pyramid)
        if exposure is not None:
            whole = transform_colors(whole, exposure.to(self.device))
        mask = None if view.mask is None else view.mask.to(self.device)
        photo = view.image.to(self.device)
        return psnr(whole, photo, mask), color_fitted_psnr(whole, photo, mask)

    def _note_best(self, run: StageRun) -> None:
        """Keep a copy of the state in memory if it is the best of the stage on the views that were set aside."""
        with self._overhead.timed("evaluation"):
            fitted = run.exposures is not None
            found = fmean(self._psnr(run, view)[fitted] for view in self._aside)
            if self._best is None or found > self._best["psnr"]:
                state = run.state()
                parts = {name: copied(state[name]) for name in ("model", "joint", "exposure", "poses")}
                self._best = {"psnr": found, "iteration": run.progress.iteration, **parts}
            if run.progress.iteration == run.stage.iterations and self._best["iteration"] < run.stage.iterations:
                self.monitor.say(
                    f"level {run.stage.level}: archives the state after iteration {self._best['iteration']} of "
                    f"{run.stage.iterations}, {self._best['psnr'] - found:.2f} dB better than the last one on "
                    f"{len(self._aside)} training views that were set aside"
                )

    def _take_best(self, run: StageRun) -> None:
        """Return to the best state of a finished stage."""
        best = self._best
        if best is None or best["iteration"] == run.stage.iterations:
            return
        settings = self.settings
        run.model = TrainableField.from_state(
            best["model"], settings.rates, self.scene.extent, device=self.device, sparse=settings.sparse_adam
        )
        run.joint = None if best["joint"] is None else self._unfreeze(best["joint"])
        run.restore_transforms(best)

    def _watch_quality(self, run: StageRun, measured: Mapping[str, float]) -> None:
        """Say it if held-out views got worse while the training loss fell."""
        key = "sampled_psnr" if run.exposures is None else "sampled_fitted_psnr"
        found, level = measured.get(key), run.stage.level
        if found is None or not self._quality.falls(level, found, run.progress.loss):
            return
        helps = ["fewer --iterations", "--masks for what moves or is no part of the scene"]
        if run.exposures is None and self._supervision.composes:
            helps.insert(0, "--exposure on if brightness or colours of the photos change")
        self.monitor.say(
            f"level {level}, iteration {run.progress.iteration}: held-out PSNR fell to {found:.1f} dB from "
            f"{self._quality.best:.1f} while the training loss fell; what may help: {', '.join(helps)}"
        )

    def _save_checkpoint(self, run: StageRun) -> None:
        with self._overhead.timed("checkpoints"):
            kept = {} if self._best is None else {"best": self._best}
            state = {**run.state(), **kept, "overhead": dict(self._overhead)}
            self.archive.save_checkpoint(state, extends_to=self.settings.iterations)
        self._last_checkpoint = time.monotonic()

    def _finish(self, run: StageRun) -> None:
        """Archive a finished stage."""
        self._take_best(run)
        before = self._to_extend(self.plan[run.stage.level])
        used = {} if before is None else before.memory_bytes
        field = run.model.field.detach()
        record = LevelRecord(
            level=run.stage.level,
            signed=run.stage.signed,
            iterations=run.stage.iterations,
            num_gaussians=len(field),
            peak_gaussians=run.progress.peak_gaussians,
            train_seconds=run.progress.seconds,
            overhead_seconds=dict(self._overhead),
            image_size=run.stage.image_size,
            memory_bytes={name: max(n, used.get(name, 0)) for name, n in self._memory.note(self._image_bytes).items()},
            mean_gaussians=run.progress.gaussian_steps / run.progress.iteration,
            breakdown_seconds=run.breakdown.seconds(),
            gpu_busy_seconds=run.busy.seconds(),
        )
        moments = run.model.optimizer_moments() if self._next_stage_inherits_moments(run.stage) else None
        along = None if run.joint is None else run.joint.fields
        exposure = None if run.exposures is None else run.exposures.archived()
        poses = None if run.poses is None else run.poses.archived()
        if before is None:
            self.archive.finish_level(record, field, moments, along, exposure, poses)
        else:
            extended = {"iterations": self.settings.iterations, "extended": self.settings.extended}
            self.archive.finish_extension(record, {**(along or {}), run.stage.level: field}, exposure, poses, extended)
        self.watcher.stage_finished(run.stage, lambda: _fields(run))

    @property
    def _image_bytes(self) -> int:
        """Bytes of the stage's images on the GPU."""
        targets = 0 if self._images is None else self._images.bytes_on_device
        caches = (cache for cache in (self._train_cache, self._test_cache) if cache is not None)
        return targets + sum(cache.store.bytes_on_device for cache in caches)


def _fields(run: StageRun) -> dict[int, GaussianField]:
    """Return the fields under training by level, without gradients."""
    joint = {} if run.joint is None else run.joint.fields
    return {**joint, run.stage.level: run.model.field.detach()}
