"""Run one stage of a checkout's training: answer its replaced symbols, and archive the stage when it ends."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.checkouts.training_call import StageWindow, TrainingCall
from lapgs_plugin.errors import (
    DeviceMemoryError,
    FieldError,
    LapgsError,
    MissingExtraError,
    TrainingDivergedError,
    first_line,
    typed_line,
)
from lapgs_plugin.evaluation.metrics import means
from lapgs_plugin.fields.gaussian_field import GaussianField, require_finite
from lapgs_plugin.gpu_raster.arriving_number import ArrivingNumber
from lapgs_plugin.hierarchy.pruning import unpruned_line
from lapgs_plugin.runner.context import FinishedStage, StageResult, TrainingRun
from lapgs_plugin.runner.joint import JointModels
from lapgs_plugin.runner.running_stage import RunningStage
from lapgs_plugin.runner.stage_model import StageModel
from lapgs_plugin.runner.stage_pruning import prune_least_visible, pruning_iteration
from lapgs_plugin.runner.stage_rendering import StageRendering
from lapgs_plugin.runner.stage_views import StageViews
from lapgs_plugin.runner.step_clock import CLOCK
from lapgs_plugin.runs.profiling import Breakdown, breakdown_on
from lapgs_plugin.stages.opacity_weight import OpacityWeight
from lapgs_plugin.stages.record import StageRecord

logger = logging.getLogger(__name__)


class ActiveStage(RunningStage):
    """Train a stage, or restore it from the archive, inside of `Stages.run`.

    Args:
        run, window: the stage, its run, and its place there.
        call: the script's call of `training` that trains the stage.
        finished: the stages before, coarsest first.
        before: result of the last of them; None for the base.

    Attributes:
        returned: result of the script's call, for its main block.
    """

    record: StageRecord

    def __init__(
        self,
        run: TrainingRun,
        window: StageWindow,
        call: TrainingCall,
        finished: Sequence[FinishedStage],
        before: StageResult | None,
    ) -> None:
        self._views = StageViews(run, window.stage, call, None if before is None else before.predictions)
        measuring = run.context.request.measuring
        record = StageRecord(
            archive=run.archive,
            stage=window.stage,
            iterations=window.total,
            device=run.device,
            profiled=window.stage.iterations if measuring.gpu_busy else 0,
            breakdown=breakdown_on(run.device) if measuring.breakdown else Breakdown(),
        )
        super().__init__(window.stage, self._views.rendering, record)
        self._context, self._run, self.window, self._finished, self._call = run.context, run, window, finished, call
        self._options, self._adapter, self._archive = run.settings, run.context.adapter, run.archive
        self._model = StageModel(run, self.stage, before)
        self._joint: JointModels | None = None
        self._joint_from = self._options.joint_from(self.stage)
        self._joint_count = 0  # Gaussians of finished fields that are trained jointly
        self._prune_at = pruning_iteration(self._call) if self._options.prune else None
        until = min(getattr(call.opt, "densify_until_iter", self.stage.iterations), self.stage.iterations)
        self._opacity_weight = OpacityWeight(call.options if self.stage.signed else (), until)
        self.returned: Any = None
        self._diverged_at: int | None = None  # first iteration after which positions were seen not to be finite
        # Whether positions were finite after an iteration, on its way from the device: the loop runs ahead of it.
        self._asked: tuple[int, ArrivingNumber] | None = None

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Hold the level's images inside, and keep a trained field despite an error.

        Raises:
            DeviceMemoryError: the GPU was full.
        """
        try:
            with self.record.overhead.timed("pyramid"):
                self._views.load_images()
            with self._opacity_weight.restored():
                try:
                    yield
                except Exception as error:
                    self._finish_despite(error)
                    raise
        except torch.cuda.OutOfMemoryError as error:
            raise self._out_of_memory(error) from error
        finally:
            self._joint = self.gaussians = None
            self._views.close()
            if self._run.device.type == "cuda":
                torch.cuda.empty_cache()

    @property
    def has_more(self) -> bool:
        return self.iteration < self.stage.iterations

    def scene_for(self, gaussians: Any) -> Any:
        self.gaussians = gaussians
        folder = Path(self._call.dataset.model_path)
        folder.mkdir(exist_ok=True)  # not before: some checkouts refuse an output folder that is there
        for path in filter(Path.is_file, self._run.scene_files.iterdir()):
            shutil.copy(path, folder)
        scene = self._run.scene.copy(
            gaussians, self._call.dataset.model_path, self._views.train_views(), self._views.test_views()
        )
        with self.record.overhead.timed("inheritance"):
            self._model.initialise(gaussians)
        return scene

    def optimizers_made(self, gaussians: Any) -> None:
        """Prepare the optimizers that the checkout has just set up; some set them up again in the middle of a stage."""
        self._model.prepare_optimizers(gaussians, inherit=self.iteration == 0)
        if self._joint is not None:
            self._joint.follow(gaussians, self._options.color_factor)

    def iteration_begins(self, gaussians: Any) -> None:
        iteration = self.iteration + 1
        self.record.start_clock()
        self._step_appearance()
        self._show(gaussians, iteration - 1)
        self.record.breakdown.mark("other")
        every = self._context.request.measuring.test_every
        if every is not None and iteration > 1 and (iteration - 1) % every == 0 and self._views.test:
            elapsed = self.record.elapsed_in_run()
            with self.record.outside("evaluation"):
                self._measure_held_out(gaussians, iteration - 1, elapsed)
        if iteration == self._prune_at:
            self._prune(gaussians)
        if iteration == self._joint_from:
            self._train_jointly(gaussians)
        self._opacity_weight.set(iteration)
        count = gaussians._xyz.shape[0] + self._joint_count
        self.record.count(iteration, count)
        if iteration % self.record.history_every == 0:
            self.record.write_history(iteration, {"elapsed": self.record.elapsed_in_run(), "num_gaussians": count})
            self._ask_for_divergence(gaussians, iteration - 1)

    def densified(self, gaussians: Any) -> None:
        """Call hooks after density control.

        Raises:
            TrainingDivergedError: no Gaussian is left.
        """
        if len(gaussians._xyz) == 0:
            raise TrainingDivergedError(
                f"pruning left no Gaussian at level {self.stage.level}, iteration {self.iteration} of "
                f"{self.stage.iterations}; expected some whose opacity grew: give more --iterations, or options of "
                f"{self._adapter.info.title} that prune less; finished levels ({self._run.finished_levels}) are kept"
            )
        self._context.hooks.densified()

    def train(self) -> StageResult:
        """Run the checkout's training for this stage and archive the field.

        Raises:
            LapgsError: training left nothing to archive.
        """
        self.begin()
        self.returned = self._call.run()
        self.require_trained(self.iteration, self.stage.iterations)
        return self.finish()

    def begin(self) -> None:
        """Announce the stage and start its measurements."""
        self._log_start()
        self.record.start()
        self.record.rewind_history()
        self._context.hooks.on_stage_start(self.stage)
        self._context.request.watcher.stage_started(self.stage)

    def require_trained(self, done: int, total: int, *, ended: bool = True) -> None:
        """Check that this stage was trained, after the script's call for it has returned.

        Args:
            done: iterations of the call that were seen.
            total: iterations that the call was asked for.
            ended: whether the call got as far as to its last stage; one call may train several.

        Raises:
            LapgsError: no iteration of the stage was seen, or the call returned before the last stage.
        """
        name = self._call.function.__name__
        if not ended or self.iteration == 0:
            raise LapgsError(
                f"{name}() ended after {done} of {total} iterations, in level {self.stage.level}; expected one call of "
                f"{CLOCK}, or one step of the positions, an iteration; train this checkout with `lapgs run --off`, or "
                "with as many --iterations as it runs"
            )
        if done != total:
            logger.warning("%s() ran %d iterations, expected %d as --iterations says", name, done, total)

    def finish(self) -> StageResult:
        """Archive the field after the stage's last iteration.

        Raises:
            LapgsError: training left nothing to archive, or NaN or inf.
        """
        gaussians, self.gaussians = self.gaussians, None  # an error from here on does not archive it again
        self._note_divergence()
        self._step_appearance()
        self.record.stop(self._views.images.bytes_on_device)
        self._context.hooks.on_stage_end(self.stage)
        field = self._exported(gaussians, self.stage.signed)
        joint = None if self._joint is None else self._joint.fields(self._exported)
        self._require_finite({self.stage.level: field, **(joint or {})})
        inherited = {"carried": self._model.carried(gaussians), "moments": self._model.moments(gaussians)}
        result = self._result(gaussians, field, **inherited)
        inherits = self.stage.level > 0 and any(inherited.values())
        appearance = self._views.appearance
        self._archive.finish_level(
            self.record.of_level(len(field)),
            field,
            inherited if inherits else None,
            joint,
            exposure=None if appearance is None else appearance.archived(),
            grids=None if appearance is None else appearance.archived_grids(),
        )
        if self._views.test and (self.stage.level <= 1 or self._context.request.measuring.test_every is not None):
            self._evaluate(gaussians)
        for line in self.record.weak_lines():
            logger.warning("%s", line)
        self._compare(gaussians, field)
        self._context.request.watcher.stage_finished(self.stage, lambda: self._fields(gaussians))
        return result

    def _finish_despite(self, error: Exception) -> None:
        """Archive the field if a checkout's own error came with the last iteration or later, as of a report."""
        refused = isinstance(error, LapgsError) and not isinstance(error, MissingExtraError)
        if refused or self.gaussians is None or self.iteration < self.stage.iterations:
            return
        self.finish()
        logger.warning(
            "%s() failed after it had trained level %d, which is in the run folder (%s)",
            self._call.function.__name__,
            self.stage.level,
            typed_line(error),
        )

    def restore(self) -> StageResult:
        """Return the result of this stage from its archived field."""
        field = self._archive.field(self.stage.level)
        gaussians = self._adapter.model_of(self._run.call, field.to(self._run.device))
        return self._result(gaussians, field, *self._model.load_inherited(self._archive))

    def _out_of_memory(self, error: torch.cuda.OutOfMemoryError) -> DeviceMemoryError:
        """Return the error for a full GPU: one line with its contents and what helps."""
        images = self._views.images.bytes_on_device
        help_ = "--images-on memory takes them off the GPU" if images else "a larger threshold for densification helps"
        peak = self.record.counts.peak_gaussians
        return DeviceMemoryError(
            f"out of GPU memory at level {self.stage.level} with {peak:,} Gaussians; images held on the "
            f"GPU: {images / 2**30:.2f} GiB; {help_}, more --levels or a smaller resolution too; "
            f"finished levels ({self._run.finished_levels}) are kept, --resume continues after them "
            f"[{first_line(error)}]"
        )

    def _log_start(self) -> None:
        width, height = self.stage.image_size
        where = {"gpu": "GPU", "memory": "CPU", "disk": "disk"}[self._views.images.photos.targets.where]
        logger.info(
            "level %d: %d iterations at %dx%d, images on the %s",
            self.stage.level,
            self.stage.iterations,
            width,
            height,
            where,
        )
        if self._options.prune and self._prune_at is None:
            logger.warning("%s", unpruned_line(self._options.prune, self.stage.level))

    def _ask_for_divergence(self, gaussians: Any, iteration: int) -> None:
        """Ask the device whether positions are finite; `_note_divergence` reads its answer when it is there."""
        self._note_divergence()
        if self._diverged_at is None:
            finite = (0 * gaussians._xyz.detach()).sum() == 0  # 0 times NaN or inf is NaN
            self._asked = iteration, ArrivingNumber.of(finite)

    def _note_divergence(self) -> None:
        """Warn once if positions were not finite. Training goes on: some checkouts prune such Gaussians."""
        asked, self._asked = self._asked, None
        if asked is None or asked[1].read():
            return
        self._diverged_at = asked[0]
        logger.warning(
            "level %d has positions of NaN or inf after iteration %d; while it has, it cannot be archived",
            self.stage.level,
            self._diverged_at,
        )

    def _require_finite(self, fields: Mapping[int, GaussianField]) -> None:
        """Raise a TrainingDivergedError if a field, by level, has NaN or inf."""
        try:
            require_finite(fields, self.stage.level)
        except FieldError as error:
            seen = "" if self._diverged_at is None else f", first seen after iteration {self._diverged_at}"
            raise TrainingDivergedError(
                f"training diverged at level {self.stage.level}, iteration {self.iteration} of "
                f"{self.stage.iterations}{seen}: {error}; finished levels ({self._run.finished_levels}) are kept, "
                "start again with lower learning rates, or see whether `lapgs run --off` diverges too"
            ) from error

    def _fields(self, gaussians: Any) -> dict[int, GaussianField]:
        """Return the fields that are being optimized, by level."""
        joint = {} if self._joint is None else self._joint.fields(self._adapter.snapshot)
        return {**joint, self.stage.level: self._adapter.snapshot(gaussians, self.stage.signed)}

    def _exported(self, gaussians: Any, signed: bool) -> GaussianField:
        """Return a model's field for the archive, on the CPU."""
        return self._adapter.export_field(gaussians, signed).to("cpu")

    def _step_appearance(self) -> None:
        """Step what is learned of the photos after the last iteration, if that ended a pass through them."""
        if self._views.appearance is not None and self.iteration > 0:
            self._views.appearance.after_step(self.iteration, 1)

    def _show(self, gaussians: Any, iteration: int) -> None:
        """Show the fields after an iteration to the run's watcher if it wants to look."""
        watcher = self._context.request.watcher
        if watcher.wants_look():
            with self.record.outside("view"):
                watcher.look(self.stage, iteration, lambda: self._fields(gaussians), lambda: False)

    def _prune(self, gaussians: Any) -> None:
        self.record.breakdown.mark("densification")
        prune_least_visible(self._views, gaussians, self._options.prune, self._run.color_path)
        self.record.breakdown.mark("other")

    def _train_jointly(self, gaussians: Any) -> None:
        """Optimize the finished fields, too, and render them instead of reading their predictions."""
        self.record.note_memory(self._views.images.bytes_on_device)
        self._views.images.drop_predictions()
        self._joint = JointModels(self._run, self._finished, self._views)
        self._views.predict_jointly(self._joint.predictions())
        self._joint.follow(gaussians, self._options.color_factor)
        self._joint_count = sum(record.num_gaussians for record in self._archive.manifest.records)

    def _evaluate(self, gaussians: Any) -> None:
        """Measure the held-out views of the archived level; a failure costs no more than the measurement."""
        try:
            with self.record.after_archive("evaluation"):
                views = self._measure_held_out(gaussians, self.stage.iterations)
                if self.stage.level <= 1:
                    self.record.write_view_psnrs([view["psnr"] for view in views], self._views.held_out_without())
        except LapgsError:  # the run folder cannot be written
            raise
        except Exception as error:
            logger.warning(
                "held-out views of level %d could not be measured (%s); the level is in the run folder, and `lapgs "
                "eval` measures the run",
                self.stage.level,
                typed_line(error),
            )

    def _compare(self, gaussians: Any, field: GaussianField) -> None:
        """Compare the archived field with the checkout's own render of it: some quantize or filter late in a run."""
        if self.stage.level > 0 and self._options.nested:
            return
        rendering = StageRendering(self.stage.signed, self._run.color_path, self._views.cameras, capture=True)
        state = f"; level {self.stage.level} is in the run folder"
        with self.record.after_archive("evaluation"), torch.no_grad():
            captured = self._views.render_alone(rendering, gaussians, next(iter(self._views.cameras)), black=False)
            self._context.compare(captured, field, residual_follows=self.stage.level > 0, state=state)

    def _measure_held_out(self, gaussians: Any, iteration: int, elapsed: float | None = None) -> list[dict[str, float]]:
        """Write the mean quality of the held-out views after an iteration to the history, and return that of each."""
        views = self._views.held_out_qualities(gaussians)
        quality = means(views)
        self.record.write_history(iteration, {**({} if elapsed is None else {"elapsed": elapsed}), **quality})
        logger.info("held-out PSNR: %.2f dB over %d views", quality["psnr"], len(views))
        return views

    def _result(self, gaussians: Any, field: GaussianField, carried: Any, moments: Any) -> StageResult:
        predictions = None
        if self.stage.level > 0 and not self._options.nested:
            with self.record.overhead.timed("cache"):
                predictions = self._views.predict(gaussians)
        return StageResult(field, predictions, carried, moments)
