"""Try a checkout before the first stage: one iteration of its own loop, then all that a run does with its model.

What fails there would fail after minutes or hours otherwise. The loop is left at its second iteration. Generators of
random numbers, the script's arguments and its output are as if nothing had run.
"""

from __future__ import annotations

import io
import logging
import random
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.optim.optimizer import Optimizer, register_optimizer_step_post_hook

from lapgs_plugin.adapters.base import PARAMETERS, BackboneAdapter
from lapgs_plugin.checkouts.absent_modules import NoLog
from lapgs_plugin.checkouts.attachment import Attachment, Replacement
from lapgs_plugin.checkouts.level_views import shrunk, view_name
from lapgs_plugin.checkouts.model_values import explain_values_beside, values_beside
from lapgs_plugin.checkouts.packages import OWN
from lapgs_plugin.checkouts.schedule import Schedule
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.errors import DeviceMemoryError, LapgsError, UserInputError, first_line, typed_line
from lapgs_plugin.evaluation.metrics import mean_quality
from lapgs_plugin.hierarchy.plan import Stage, StagePlan, level_size
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.rasterizers.signed_color import PROBE_TOLERANCE, ColorPath, explain_fallback
from lapgs_plugin.runner.archived_values import NESTED_WORKS
from lapgs_plugin.runner.checkout_scene import CheckoutScene
from lapgs_plugin.runner.context import CheckoutContext
from lapgs_plugin.runner.depth import require_depth
from lapgs_plugin.runner.object_values import fields_of, with_values
from lapgs_plugin.runner.rasterizer_choice import Decision, decide
from lapgs_plugin.runner.rasterizer_trial import RasterizerCall, trials_of
from lapgs_plugin.runner.running_stage import RunningStage
from lapgs_plugin.runner.stage_rendering import Captured, StageRendering
from lapgs_plugin.runner.step_clock import CLOCK
from lapgs_plugin.stages.joint import RenderedPredictions
from lapgs_plugin.stages.record import LoopRecord

logger = logging.getLogger(__name__)

MOST_POINTS = 20_000
"""About how many of the scene's points the dry run starts from."""

TRIED_VIEWS = 3
"""Views in which rasterizers are compared, at the size of each stage."""

NATIVE_COEFFICIENTS = 15
"""SH coefficients above the first that a rasterizer may read when it does not know the flag of signed colour."""

OFF = "`lapgs run --off` runs the script as it is"

NESTED_MAY_WORK = "nested levels may work: --hierarchy nested"


class DryRun:
    """Try a checkout.

    Args:
        context: shared objects of the run, whose replacements are attached.
        call: the script's call of `training`.
        scene: the checkout's scene.
        plan: the stages.
        schedule: of the script's training function.
    """

    def __init__(
        self, context: CheckoutContext, call: TrainingCall, scene: CheckoutScene, plan: StagePlan, schedule: Schedule
    ) -> None:
        self._context, self._scene, self._plan, self._schedule = context, scene, plan, schedule
        self._adapter = context.adapter
        self._call = call
        self._cameras = {context.images.key(camera): camera for camera in (*scene.train, *scene.test)}
        # Residuals ask for more than other stages do.
        self._stage = next((stage for stage in plan if stage.signed), next(iter(plan)))

    def run(self, folder: Path, path: ColorPath) -> None:
        """Try one iteration of the script's loop, and all that a run does with its model.

        Args:
            folder: receives what the checkout writes.
            path: how signed colour is evaluated.

        Raises:
            UserInputError: the checkout cannot be trained so; the line says what failed, where, and what works.
        """
        works = NESTED_MAY_WORK if self._stage.signed else OFF
        with undisturbed(self._context.device), _silent_writer(self._adapter.train):
            rendering = StageRendering(self._stage.signed, path, self._cameras)
            if self._stage.signed:
                rendering.accumulated = self._black_predictions()
                rendering.composed = frozenset(self._cameras)
            call = self._scratch_call(folder)
            stage = _DryStage(self._stage, rendering, call, self._scene_for)
            self._iterate(stage, works)
            if self._stage.signed:
                self._iterate_later(rendering, call)
            self._require_parameters(stage.gaussians)
            view = self._view(self._scene.train[0])
            with self._step("a view rendered as the loop does", "an image (3, h, w)", OFF):
                captured = self._render(view, stage.gaussians)
            with self._step("the model as a field for the archive", "the parameters of 3DGS", OFF):
                field = self._adapter.export_field(stage.gaussians, signed=False)
            with self._step("the last render repeated", "an image (3, h, w)", OFF):
                self._context.compare(captured, field, residual_follows=self._stage.signed)
            if self._stage.signed:
                with self._step("a model made from a finished field", "one that renders", NESTED_MAY_WORK):
                    self._render(view, self._adapter.model_of(stage.call, field))
            self._evaluate(view, captured.image)

    def color_path(self) -> ColorPath:
        """Return how the checkout's rasterizer evaluates signed colour, which is found out by rendering.

        Raises:
            UserInputError: it cannot; the line says what failed, where, and what works.
        """
        with (
            undisturbed(self._context.device),
            self._step(
                "signed colour", "negative colours of a model that has the parameters of 3DGS alone", NESTED_MAY_WORK
            ),
        ):
            with self._step("a model of the scene's points", "one as without lapgs", OFF):
                gaussians = self._new_model()
            self._require_parameters(gaussians)
            self._require_settable(gaussians)
            self._require_three_axes(gaussians)
            archived = self._adapter.model_of(self._call, self._adapter.snapshot(gaussians, signed=False))
            with self._values_beside_explained(gaussians, archived):
                path = self._color_path(self._view(self._scene.train[0]), archived)
        if path is ColorPath.PRECOMPUTED:
            logger.warning("%s", explain_fallback(self._adapter.rasterizer, self._adapter.root))
        return path

    def choose_rasterizer(self) -> Decision:
        """Return whose rasterizer trains, after both rendered some views at the size of each stage.

        The Gaussians are those that the checkout makes of the scene's points, and as many of them as later in a run.
        """
        module, cameras = self._adapter.rasterizer, self._scene.train
        cameras = cameras[:: -(-len(cameras) // TRIED_VIEWS)]
        with undisturbed(self._context.device):
            try:
                gaussians = self._new_model()
                views = [self._view(camera, stage) for stage in self._plan for camera in cameras]
                own = [self._render(view, gaussians) for view in views]
            except Exception as error:  # the loop may do what is missing here; else the first iteration fails
                return Decision(OWN, f"the checkout's own {module}: no view to compare with ({typed_line(error)})")
            try:
                with self._context.wrapper.taking_ours():
                    ours = [self._render(view, gaussians) for view in views]
                names = [view_name(self._context.images.key(camera)) for _ in self._plan for camera in cameras]
                calls = map(RasterizerCall.of, names, own, ours)
                trials = list(trials_of(calls, self._context.device))
            except Exception as error:  # what a rasterizer cannot do is in its message
                why = f"that of lapgs cannot take its place ({first_line(error)})"
                return Decision(OWN, f"the checkout's own {module}: {why}")
        return decide(module, trials)

    def find_image(self) -> None:
        """Render a view, by which the wrapper of the rasterizer knows which of a renderer's images is the model's.

        Hooks and masks would get a map that is rasterized before the image, in the first iteration.
        """
        with undisturbed(self._context.device):
            try:
                self._render(self._view(self._scene.train[0]), self._new_model())
            except Exception as error:  # the loop may do what is missing here
                logger.debug("no view could be rendered before the first iteration: %s", typed_line(error))

    def require_depth(self) -> None:
        """Check that the rasterizer renders depths, where --depth asks for them.

        Raises:
            UserInputError: it does not.
        """
        with undisturbed(self._context.device), self._step("a view with depth", "one as without lapgs", OFF):
            captured = self._render(self._view(self._scene.train[0]), self._new_model())
            require_depth(self._context.request.settings.depth, captured)

    def _new_model(self) -> Any:
        """Return the checkout's model of some of the scene's points."""
        gaussians = self._adapter.new_model(self._call)
        gaussians.create_from_pcd(_some(self._scene.points), *self._scene.others)
        return gaussians

    def _iterate(self, stage: _DryStage, works: str) -> None:
        """Run the first iteration of the script's loop."""
        with self._context.stages.run(stage), self._step("the first iteration", "one as without lapgs", works):
            stage.call.run()
        if stage.iteration == 0:
            raise UserInputError(
                f"{self._training_place}: {stage.call.function.__name__}() began no iteration, expected one call of "
                f"{CLOCK}, or one step of the positions, an iteration; {OFF}"
            )

    def _iterate_later(self, rendering: StageRendering, call: TrainingCall) -> None:
        """Run an iteration with all losses that begin later in a run, of which some cannot be a residual's.

        The base would be trained before that is found out. What else fails does so because nothing led up to it.
        """
        later = self._schedule.begun(self._call.variables, self._plan.iterations)
        if not later.notes:
            return
        stage = _DryStage(self._stage, rendering, later.applied_to(call), self._scene_for)
        try:
            with self._context.stages.run(stage):
                stage.call.run()
        except LapgsError:
            raise
        except Exception as error:
            logger.debug("dry run of what begins later (%s): %s", ", ".join(later.notes), typed_line(error))

    def _scratch_call(self, folder: Path) -> TrainingCall:
        """Return the script's call with an output folder of its own, and without reports or checkpoints."""
        if self._stage.signed:
            call = self._adapter.stage_call(self._call, self._context.window(self._plan, self._stage), str(folder))
        else:
            call = self._call.copied()
            call.dataset.model_path = str(folder)
        return call.listing(lambda _: [])

    def _scene_for(self, call: TrainingCall, gaussians: Any) -> Any:
        """Return the checkout's scene with views of the tried stage, and make Gaussians of some of its points."""
        train, test = ([self._view(camera) for camera in cameras] for cameras in (self._scene.train, self._scene.test))
        gaussians.create_from_pcd(_some(self._scene.points), *self._scene.others)
        return self._scene.copy(gaussians, call.dataset.model_path, train, test)

    def _black_predictions(self) -> RenderedPredictions:
        """Return black images as predictions by the coarser level."""
        sizes, coarser = {key: self._context.images[key].size for key in self._cameras}, self._stage.level + 1

        def black(level: int, keys: Sequence[str]) -> Tensor:
            width, height = level_size(sizes[keys[0]], level)
            return torch.zeros(3, height, width, device=self._context.device)

        return RenderedPredictions((coarser,), black, sizes, Pyramid(self._context.request.settings.grid))

    def _view(self, camera: Any, stage: Stage | None = None) -> Any:
        """Return a camera at the level of a stage, by default the tried one."""
        stage, images, device = stage or self._stage, self._context.images, self._context.device
        image = images[images.key(camera)]
        size = level_size(image.size, stage.level)
        return self._adapter.view_at(camera, size, stage.signed, lambda: shrunk(image.load(device), size))

    def _render(self, view: Any, gaussians: Any, path: ColorPath | None = None) -> Captured:
        """Render a view over black, of a residual if `path` is given."""
        rendering = StageRendering(path is not None, path or ColorPath.NATIVE, self._cameras, capture=True)
        call = self._call if path is None else self._adapter.call_of_residuals(self._call)
        return self._context.render(rendering, call, view, gaussians, black=True)

    def _require_parameters(self, gaussians: Any) -> None:
        """Refuse a model that lacks what a field has, unless its adapter makes fields otherwise."""
        needed = self._adapter.archived_parameters()
        if absent := [name for name in needed if not hasattr(gaussians, name)]:
            raise UserInputError(
                f"{self._adapter.profile.source.model[1]}: a field is archived from {', '.join(needed)}; the model "
                f"has no {', '.join(absent)}; {OFF}"
            )

    @contextmanager
    def _values_beside_explained(self, gaussians: Any, archived: Any) -> Iterator[None]:
        """Name what a model made from a field lacks as the cause of an error, if it lacks values of each Gaussian.

        Args:
            gaussians: the checkout's model, made of points.
            archived: one made from the field of it.
        """
        try:
            yield
        except (LapgsError, torch.cuda.OutOfMemoryError):
            raise
        except Exception as error:
            source, rows, those = self._adapter.profile.source, _rows(gaussians), _rows(archived)
            beside = [name for name, count in rows.items() if count == len(gaussians._xyz) != those.get(name)]
            why = explain_values_beside(source, PARAMETERS) or (beside and values_beside(source.model[1], beside))
            if why:
                raise UserInputError(f"no residuals: {why}; {NESTED_MAY_WORK}") from error
            raise

    def _require_settable(self, gaussians: Any) -> None:
        """Refuse a model whose parameters are computed, which cannot start from a finished field."""
        location = self._adapter.profile.source.model[1]
        names = self._adapter.archived_parameters()
        descriptors = {name: getattr(type(gaussians), name, None) for name in names}
        computed = [name for name, by in descriptors.items() if isinstance(by, property) and by.fset is None]
        if computed := computed or [name for name in names if getattr(gaussians, name).grad_fn is not None]:
            raise UserInputError(
                f"{location}: the model computes {', '.join(computed)} of other values, expected parameters, which a "
                f"residual's are set to; {NESTED_WORKS}"
            )

    def _require_three_axes(self, gaussians: Any) -> None:
        location, axes = self._adapter.profile.source.model[1], gaussians._scaling.shape[1]
        if axes != 3:
            raise UserInputError(f"{location}: residuals need three scale axes, found {axes}; {NESTED_WORKS}")

    @property
    def _training_place(self) -> str:
        source = self._adapter.profile.source
        return source.location(source.training)

    @torch.no_grad()
    def _evaluate(self, view: Any, image: Tensor) -> None:
        """Measure an image, and say so if that is not possible: the run itself does not need it."""
        try:
            mean_quality([(image, view.original_image)])
        except Exception as error:
            logger.warning("held-out views cannot be measured (%s): the run goes on without", typed_line(error))

    def _color_path(self, view: Any, gaussians: Any) -> ColorPath:
        """Return how the rasterizer evaluates signed colour: render colours of both signs with and without its flag."""
        rest = gaussians._features_rest
        kept = gaussians._features_dc, gaussians._features_rest
        signs = torch.tensor([-2.0, 1.0, -1.0], device=kept[0].device)
        try:
            gaussians._features_dc = torch.nn.Parameter(signs.expand_as(kept[0]).clone())
            gaussians._features_rest = torch.nn.Parameter(torch.zeros_like(rest))
            expected = self._colored(view, gaussians, ColorPath.PRECOMPUTED)
            self._require_signed(expected[0])
            if rest.shape[1] < NATIVE_COEFFICIENTS:
                return ColorPath.PRECOMPUTED
            images = self._colored(view, gaussians, ColorPath.NATIVE)
        finally:
            gaussians._features_dc, gaussians._features_rest = kept
        same = all(
            bool(((a - b).abs() <= PROBE_TOLERANCE * (1 + b.abs().max())).all())
            for a, b in zip(images, expected, strict=True)
        )
        return ColorPath.NATIVE if same else ColorPath.PRECOMPUTED

    def _require_signed(self, image: Tensor) -> None:
        """Refuse a checkout whose image of negative, positive and negative colours over black is not that."""
        red, green, blue = image.flatten(1).unbind()
        if bool((green > 0).any()) and bool(((red < 0) & (blue < 0)).any()):
            return
        raise UserInputError(
            f"{self._training_place}: colours of both signs do not "
            "come out of the checkout's renderer, expected that it passes the model's SH on to its rasterizer; a "
            f"residual could not subtract; {NESTED_WORKS}"
        )

    def _colored(self, view: Any, gaussians: Any, path: ColorPath) -> tuple[Tensor, ...]:
        """Return the image of a residual and the gradients of its sum by the SH coefficients.

        Those above the first are lost where only the forward pass of a rasterizer was patched.
        """
        with torch.enable_grad():
            image = self._render(view, gaussians, path).image
            sh = gaussians._features_dc, gaussians._features_rest
            return image.detach(), *torch.autograd.grad(image.sum(), sh, allow_unused=True, materialize_grads=True)

    @contextmanager
    def _step(self, what: str, expected: str, works: str) -> Iterator[None]:
        """Turn an exception of the checkout into one line with its place there."""
        try:
            yield
        except (LapgsError, torch.cuda.OutOfMemoryError):
            raise
        except Exception as error:
            location = source_line(error, self._adapter)
            raise UserInputError(
                f"dry run: {what} failed at {location}: {typed_line(error)}; expected {expected}; {works}"
            ) from error


def source_line(error: Exception, adapter: BackboneAdapter) -> str:
    """Return file and line, of the checkout or of another package's adapter of it, in which an error was raised."""
    root, modules = adapter.root, [ancestor.__module__ for ancestor in type(adapter).__mro__]
    brought = {getattr(sys.modules[name], "__file__", None) for name in modules if not name.startswith("lapgs_plugin.")}
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if Path(frame.filename).is_relative_to(root) or frame.filename in brought]
    innermost = (own or frames)[-1]
    path = Path(innermost.filename)
    return f"{path.relative_to(root) if path.is_relative_to(root) else path.name}:{innermost.lineno}"


def _rows(gaussians: Any) -> dict[str, int]:
    """Return the number of rows of a model's tensors by attribute."""
    kept = (vars(gaussians), *(getattr(gaussians, name, {}) for name in ("_parameters", "_buffers")))  # of a Module
    return {n: len(v) for values in kept for n, v in values.items() if isinstance(v, Tensor) and v.ndim}


class _Enough(BaseException):
    """Leave the script's loop."""


class _DryStage(RunningStage):
    """Answer the replaced symbols for one iteration."""

    has_more = True

    def __init__(
        self,
        stage: Stage,
        rendering: StageRendering,
        call: TrainingCall,
        make_scene: Callable[[TrainingCall, Any], Any],
    ) -> None:
        super().__init__(stage, rendering, LoopRecord(torch.device("cpu")))  # what it measures is dropped
        self.call, self._make_scene = call, make_scene

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Leave the loop after its first iteration."""

        def stepped(optimizer: Optimizer, *_: Any) -> None:
            if self.iteration == 0 and self.is_stepped_by(optimizer):
                raise _Enough  # the loop would run to its end

        watching = register_optimizer_step_post_hook(stepped)
        try:
            yield
        except _Enough:
            pass
        finally:
            watching.remove()

    def scene_for(self, gaussians: Any) -> Any:
        self.gaussians = gaussians
        return self._make_scene(self.call, gaussians)

    def iteration_begins(self, gaussians: Any) -> None:
        if self.iteration:
            raise _Enough
        self.record.count(1, gaussians=0)


def _some(points: Any) -> Any:
    """Return some of a scene's points; all if it has more of them than points, such as faces."""
    count = len(points.points)
    rows = {name: v for name, v in fields_of(points).items() if hasattr(v, "__len__") and len(v)}
    if count <= MOST_POINTS or any(len(v) != count for v in rows.values()):
        return points
    return with_values(points, {name: value[:: count // MOST_POINTS + 1] for name, value in rows.items()})


@contextmanager
def undisturbed(device: torch.device) -> Iterator[None]:
    """Keep generators of random numbers, printed output and log as they are."""
    devices = [torch.cuda.current_device()] if device.type == "cuda" else []
    states = random.getstate(), np.random.get_state()
    disabled = logging.root.manager.disable
    with torch.random.fork_rng(devices), redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        logging.disable(max(disabled, logging.INFO))
        try:
            yield
        finally:
            logging.disable(disabled)
            random.setstate(states[0])
            np.random.set_state(states[1])


@contextmanager
def full_gpu_told() -> Iterator[None]:
    """Turn the error of a full GPU before the first stage into one line.

    Raises:
        DeviceMemoryError: the GPU was full.
    """
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        raise DeviceMemoryError(
            "dry run: out of GPU memory, before anything was written; expected room for an iteration of the coarsest "
            "level; free what other programs use (nvidia-smi lists them), or take more --levels or a smaller "
            f"resolution [{first_line(error)}]"
        ) from error


def _silent_writer(train: Any) -> Any:
    """Replace TensorBoard's writer in a script, whose thread would outlive the folder."""
    if "SummaryWriter" not in vars(train):
        return nullcontext()
    return Attachment([Replacement(train, "SummaryWriter", lambda _: NoLog, "training()")])
