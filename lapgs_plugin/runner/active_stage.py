"""One stage of a run over a checkout: what its replaced symbols ask for, and what is kept when it ends."""

from __future__ import annotations

import copy
import logging
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.adapters.base import StageWindow, TrainingCall
from lapgs_plugin.checkouts.level_views import PrefetchingViews
from lapgs_plugin.errors import DeviceMemoryError, RunFolderError, TrainingDivergedError
from lapgs_plugin.evaluation.metrics import mean_quality
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.inheritance import inherit
from lapgs_plugin.hierarchy.pruning import blended_pixels, least_blended
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.joint import FinishedStage, JointLevels
from lapgs_plugin.runner.run_state import Finished, LoadedScene, RunContext
from lapgs_plugin.runner.shim import StageRendering
from lapgs_plugin.runner.stage_images import StageImages
from lapgs_plugin.runs.archive import CACHE, OPTIMIZER, LevelRecord, RunArchive
from lapgs_plugin.runs.overhead import Overhead
from lapgs_plugin.runs.peak_memory import PeakMemory
from lapgs_plugin.runs.upsampled_images import UpsampledImages

logger = logging.getLogger(__name__)

HISTORY_ENTRIES = 200
"""About how many entries a run adds to its history."""


class ActiveStage:
    """One stage while it runs. After it is made: `load_images`, then `train` or `restore`, then `close`.

    Args:
        context: what the stages share.
        call: of the script's `training`, for the whole run.
        scene: loaded once for all stages.
        archive: open for writing.
        window: which stage, and when.
        finished: the stages before, coarsest first.
        before: what the last of them left; None for the base.
        path: how signed colour is evaluated.
    """

    def __init__(
        self,
        context: RunContext,
        call: TrainingCall,
        scene: LoadedScene,
        archive: RunArchive,
        window: StageWindow,
        finished: Sequence[FinishedStage],
        before: Finished | None,
        path: ColorPath,
    ) -> None:
        self._context, self._whole_call, self._loaded = context, call, scene
        self._archive, self.window, self._finished, self._before = archive, window, finished, before
        self._options, self._adapter, self._device = context.options, context.adapter, context.device
        self._hooks, self._pyramid = context.hooks, Pyramid(context.options.grid)
        self.stage = window.stage
        self.overhead = Overhead(settle=self._synchronize)
        self._began: float | None = None
        self._excluded = 0.0  # seconds since `_began` that are not optimization
        self._iteration = self._peak = 0
        self._memory: PeakMemory  # of `train`
        self._gaussian_steps = 0  # Gaussians, summed over the iterations
        self._trained_along = 0  # Gaussians of finished fields, while these learn as well
        self._gaussians: Any = None
        self._kept: Tensor | None = None  # which Gaussians of the level before are inherited
        self._views: dict[str, Any] = {}
        self._path = path
        self._joint: JointLevels | None = None
        self._joint_from = self._options.joint_from(window.stage)
        self._call = self._adapter.stage_call(call, window, str(archive.path(f"level_{self.stage.level}")))
        predictions = None if before is None else before.predictions
        self._images = StageImages(
            context.album, scene, self.stage, self._options, self._device, archive.path(CACHE), predictions
        )
        self._rendering = StageRendering(
            signed=self.stage.signed,
            path=path,
            views={id(camera.world_view_transform): self._images.key(camera) for camera in self._images.cameras},
            targets=self._images.targets,
            accumulated=self._images.accumulated,
            coarse=self._images.coarse,
            composed=self._images.composed_keys,
            on_image=self._hooks.on_image if self._hooks else None,
        )

    def load_images(self) -> None:
        """Make the level's images; from here on whatever the checkout renders is this stage's."""
        with self.overhead.timed("pyramid"):
            self._images.load()
        self._context.shim.stage = self._rendering

    @property
    def as_finished(self) -> FinishedStage:
        """What the stages after this one have to know of it, once its field is in the archive."""
        return FinishedStage(self.stage, self._call)

    @property
    def resets_opacities(self) -> bool:
        """Whether the checkout may. What it is for, floaters near the cameras, was done in the base's stage."""
        if self.stage.signed:
            return self._options.residual_resets
        return not self.window.continues_field

    # What the replaced symbols ask for.

    def scene_for(self, gaussians: Any) -> Any:
        """The scene of this stage, with `gaussians` initialised from it."""
        self._gaussians = gaussians
        scene = with_attributes(
            self._loaded.scene,
            gaussians=gaussians,
            model_path=self._call.dataset.model_path,
            train_cameras={1.0: self._prefetching([self._view(camera) for camera in self._images.train])},
            test_cameras={1.0: [self._view(camera) for camera in self._images.test]},
        )
        with self.overhead.timed("inheritance"):
            self._initialise(gaussians)
        self._adapter.stage_scene(scene)
        return scene

    def optimizers_made(self, gaussians: Any) -> None:
        """The checkout has set up its optimizers: give them inherited state, and fuse their steps."""
        for optimizer in self._adapter.optimizers(gaussians):
            if self._before is not None:
                self._inherit_moments(optimizer, self._before.moments)
            if self._options.fused_adam and self._device.type == "cuda":
                _fuse(optimizer)

    def iteration_begins(self, gaussians: Any, iteration: int) -> None:
        """The training loop comes to its next iteration, counted from 1."""
        if self._began is None:
            self._synchronize()
            self._began = time.perf_counter()
        if self._context.watcher.wants_look():
            with self.outside("view"):
                self._context.watcher.look(self.stage, iteration - 1, lambda: self._fields(gaussians), lambda: False)
        self._context.parts.breakdown.mark("other")
        every = self._context.test_every
        if every is not None and iteration > 1 and (iteration - 1) % every == 0 and self._images.test:
            elapsed = self._elapsed()
            with self.outside("evaluation"):
                self._report_held_out(gaussians, iteration - 1, elapsed)
        if self._options.prune and iteration == self._densified_before:
            self._prune(gaussians)
        if iteration == self._joint_from:
            self._train_jointly(gaussians)
        self._iteration = iteration
        count = len(gaussians._xyz) + self._trained_along
        self._peak = max(self._peak, count)
        self._gaussian_steps += count
        if self._hooks:
            self._hooks.iteration_begins(iteration)
        if iteration % max(1, self.window.total // HISTORY_ENTRIES) == 0:
            self._archive.append_history(
                {"level": self.stage.level, "iteration": iteration, "elapsed": self._elapsed(), "num_gaussians": count}
            )

    @property
    def _densified_before(self) -> int | None:
        """The first iteration without densification after those with; None where it is not in this stage."""
        opt = self._call.opt
        return opt.densify_until_iter if opt.densify_from_iter < opt.densify_until_iter < opt.iterations else None

    def _prune(self, gaussians: Any) -> None:
        """Remove what training views hardly see, as the checkout removes Gaussians."""
        self._context.parts.breakdown.mark("densification")
        pixels = self._blended_pixels(gaussians)
        gaussians.tmp_radii = gaussians.max_radii2D  # some prune it as well, though it matters while they densify alone
        with torch.no_grad():
            gaussians.prune_points(least_blended(pixels, self._options.prune))
        gaussians.tmp_radii = None
        self.densified(gaussians)
        self._context.parts.breakdown.mark("other")

    def _blended_pixels(self, gaussians: Any) -> Tensor:
        """(n,) `pruning.blended_pixels` of the field under training."""
        alone = StageRendering(signed=False, path=self._path, views={}, capture=True)
        background = torch.zeros(3, device=self._device)
        colors, degree = gaussians._features_dc, gaussians.active_sh_degree
        grey = torch.nn.Parameter(torch.zeros_like(colors))
        images = (
            self._context.image(alone, self._call, self._view(camera), gaussians, background)
            for camera in self._images.train
        )
        try:
            gaussians._features_dc, gaussians.active_sh_degree = grey, 0
            return blended_pixels(images, grey)
        finally:
            gaussians._features_dc, gaussians.active_sh_degree = colors, degree

    def _train_jointly(self, gaussians: Any) -> None:
        """From now on the finished fields learn as well, and what they predict is rendered."""
        self._memory.note(self._images.bytes_on_device)
        self._images.drop_predictions()
        self._joint = JointLevels(self._context, self._finished, self._archive, self._images, self._path)
        self._joint.follow(gaussians, self._options.color_factor)
        self._trained_along = sum(record.num_gaussians for record in self._archive.manifest.records)
        self._rendering.accumulated = self._joint

    def _fields(self, gaussians: Any) -> dict[int, GaussianField]:
        """What is under training, by level."""
        joint = {} if self._joint is None else self._joint.fields
        return {**joint, self.stage.level: self._adapter.snapshot(gaussians, signed=self.stage.signed)}

    def densified(self, gaussians: Any) -> None:
        """Density control has run.

        Raises:
            TrainingDivergedError: it left nothing.
        """
        if len(gaussians._xyz) == 0:
            raise TrainingDivergedError(
                f"pruning left no Gaussian at level {self.stage.level}, iteration {self._iteration} of "
                f"{self.stage.iterations}; expected some whose opacity grew: give more --iterations, or options of "
                f"{self._adapter.info.title} that prune less; finished levels ({self._finished_levels()}) are kept"
            )
        if self._hooks:
            self._hooks.densified()

    @contextmanager
    def outside(self, what: str) -> Iterator[None]:
        """Time that is not optimization though it passes inside the training loop."""
        self._synchronize()
        start = time.perf_counter()
        self._context.parts.breakdown.pause()
        with self.overhead.timed(what):
            yield
        self._excluded += time.perf_counter() - start
        self._context.parts.breakdown.mark("other")

    # Start, middle and end of the stage.

    def train(self) -> Finished:
        """Run the checkout's training for this stage and archive what it made.

        Raises:
            LapgsError: training left nothing to archive.
        """
        stage = self.stage
        width, height = stage.image_size
        place = {"gpu": "GPU", "memory": "CPU", "disk": "disk"}[self._images.targets.where]
        self._archive.rewind_history(stage.level, 0)  # a run that stopped inside this stage trains all of it again
        logger.info(
            "level %d: %d iterations at %dx%d, images on the %s", stage.level, stage.iterations, width, height, place
        )
        self._hooks.stage_begins(stage, self._rendering)
        self._memory = PeakMemory(self._device)
        self._context.parts.stage_begins()
        self._context.watcher.stage_started(stage)
        self._call.run()
        self._context.parts.breakdown.pause()
        self._synchronize()
        seconds, memory = self._seconds(), self._memory.note(self._images.bytes_on_device)
        self._hooks.stage_ends(stage)
        gaussians, self._gaussians = self._gaussians, None
        field = self._adapter.export_field(gaussians, signed=stage.signed).to("cpu")
        if self._images.test and (stage.level == 0 or self._context.test_every is not None):
            with self.overhead.timed("evaluation"):
                self._report_held_out(gaussians, stage.iterations)
        finished = self._finish(gaussians, field, self._carried(gaussians), self._moments(gaussians))
        self._archive_level(finished, seconds, memory)
        self._context.watcher.stage_finished(stage, lambda: self._fields(gaussians))
        return finished

    def restore(self) -> Finished:
        """What `train` returned when this level was finished, from its archived field."""
        field = self._archive.field(self.stage.level)
        gaussians = self._adapter.model_of(self._whole_call, field.to(self._device))
        left: dict[str, Any] = {"carried": {}, "moments": {}}
        if self._archive.path(f"level_{self.stage.level}", OPTIMIZER).exists():
            left = self._archive.optimizer_state(self.stage.level)
            if not all(isinstance(left.get(part), dict) for part in ("carried", "moments")):
                raise RunFolderError(
                    f"{self._archive.path(f'level_{self.stage.level}', OPTIMIZER)} holds {', '.join(map(str, left))}, "
                    "expected carried and moments; start again with --overwrite"
                )
        carried = {
            name: torch.nn.Parameter(value.detach().to(self._device)) if isinstance(value, Tensor) else value
            for name, value in left["carried"].items()
        }
        return self._finish(gaussians, field, carried, left["moments"])

    def close(self) -> None:
        """Let go of the stage's images, those that the next stage needs excepted."""
        self._context.shim.stage = None
        self._joint, self._rendering.accumulated = None, None
        self._images.close()
        self._views.clear()
        self._gaussians = None
        if self._device.type == "cuda":
            torch.cuda.empty_cache()

    def write_scene_files(self, source: Path) -> None:
        """Give the level's folder what the checkout's Scene writes beside a model: its viewers look for it there."""
        target = self._archive.path(f"level_{self.stage.level}")
        target.mkdir(exist_ok=True)
        for path in source.iterdir():
            if path.is_file():
                shutil.copy(path, target)

    def out_of_memory(self, error: torch.cuda.OutOfMemoryError) -> DeviceMemoryError:
        """One line that says what filled the GPU and what helps."""
        images = self._images.bytes_on_device
        help_ = "--images-on memory takes them off the GPU" if images else "a larger threshold for densification helps"
        return DeviceMemoryError(
            f"out of GPU memory at level {self.stage.level} with {self._peak:,} Gaussians; images held on the GPU: "
            f"{images / 2**30:.2f} GiB; {help_}, more --levels or a smaller resolution too; "
            f"finished levels ({self._finished_levels()}) are kept, --resume continues after them "
            f"[{str(error).splitlines()[0]}]"
        )

    def _finished_levels(self) -> str:
        return ", ".join(map(str, self._archive.available_levels)) or "none"

    def _seconds(self) -> float:
        """Of optimization so far."""
        assert self._began is not None, "training() without an iteration"
        return time.perf_counter() - self._began - self._excluded

    def _elapsed(self) -> float:
        """Seconds of optimization since the start of the run."""
        return sum(record.train_seconds for record in self._archive.manifest.records) + self._seconds()

    def _archive_level(self, finished: Finished, seconds: float, memory: dict[str, int]) -> None:
        stage, field = self.stage, finished.field
        left = {"carried": dict(finished.carried), "moments": dict(finished.moments)}
        self._archive.finish_level(
            LevelRecord(
                level=stage.level,
                signed=stage.signed,
                iterations=stage.iterations,
                num_gaussians=len(field),
                peak_gaussians=max(self._peak, len(field)),
                train_seconds=seconds,
                overhead_seconds=dict(self.overhead),
                image_size=stage.image_size,
                memory_bytes=memory,
                mean_gaussians=self._gaussian_steps / stage.iterations,
                breakdown_seconds=self._context.parts.breakdown.seconds(),
            ),
            field,
            left if stage.level > 0 and any(left.values()) else None,
            None if self._joint is None else self._joint.export_fields(),
        )

    def _finish(
        self,
        gaussians: Any,
        field: GaussianField,
        carried: Mapping[str, Any],
        moments: Mapping[str, dict[str, Tensor]],
    ) -> Finished:
        predictions = None
        if self.stage.level > 0 and not self._options.nested:
            with self.overhead.timed("cache"):
                predictions = self._predict(gaussians)
        return Finished(field, predictions, carried, moments)

    @torch.no_grad()
    def _predict(self, gaussians: Any) -> UpsampledImages:
        """The composed image of every view, for the next level."""
        predictions = self._images.new_predictions()
        for camera in self._images.cameras:
            width, height = self._images.size(camera, self.stage.level - 1)
            predictions.put(self._images.key(camera), self._composed(gaussians, camera), (height, width))
        predictions.get(self._images.key(self._images.cameras[0]))  # compiles Up now, and not on the next stage's clock
        return predictions

    @torch.no_grad()
    def _report_held_out(self, gaussians: Any, iteration: int, elapsed: float | None = None) -> None:
        """Note how good the held-out views are after an iteration, all brought to full resolution."""
        cameras = self._images.test
        means = mean_quality(
            (self._whole(gaussians, camera), self._context.album.photo(self._images.key(camera)).image(self._device))
            for camera in cameras
        )
        when = {} if elapsed is None else {"elapsed": elapsed}
        self._archive.append_history({"level": self.stage.level, "iteration": iteration, **when, **means})
        logger.info("held-out PSNR: %.2f dB over %d views", means["psnr"], len(cameras))

    def _whole(self, gaussians: Any, camera: Any) -> Tensor:
        """(3, h, w) a view at full resolution, as if every finer residual were zero."""
        image = self._composed(gaussians, camera)
        for level in range(self.stage.level - 1, -1, -1):
            width, height = self._images.size(camera, level)
            image = self._pyramid.up(image, (height, width))
        return image

    def _composed(self, gaussians: Any, camera: Any) -> Tensor:
        """(3, h, w) I_hat^l of a view, before exposure and clamping."""
        rendering = replace(self._rendering, composed=self._images.keys, capture=True)
        background = torch.full((3,), float(self._call.dataset.white_background), device=self._device)
        return self._context.image(rendering, self._call, self._view(camera), gaussians, background)

    def _initialise(self, gaussians: Any) -> None:
        """Points for the base; for a finer level what is inherited of the field before."""
        points, others = self._loaded.points, self._loaded.others
        if self._before is None:
            gaussians.create_from_pcd(points, *others)
            return
        options = self._options
        generator = torch.Generator().manual_seed(options.seed)
        mode = options.inherit_mode
        field, self._kept = inherit(self._before.field, mode, options.inherit_ratio, generator)
        positions = field.means.numpy().astype(np.float64)
        grey = np.full_like(positions, 0.5)  # the colour whose SH coefficient is zero
        gaussians.create_from_pcd(
            type(points)(points=positions, colors=grey, normals=np.zeros_like(positions)), *others
        )
        if mode != "xyz":
            names = ["_rotation", "_scaling", "_opacity"]
            if mode == "full":
                names += ["_features_dc", "_features_rest"]
            self._adapter.import_field(gaussians, field.to(self._device), names)
        for name, value in self._before.carried.items():
            setattr(gaussians, name, value)

    def _inherit_moments(self, optimizer: torch.optim.Optimizer, moments: Mapping[str, dict[str, Tensor]]) -> None:
        for group in optimizer.param_groups:
            if state := moments.get(group["name"]):
                optimizer.state[group["params"][0]] = {
                    name: value[self._kept].to(self._device) if value.ndim else value for name, value in state.items()
                }

    def _carried(self, gaussians: Any) -> dict[str, Any]:
        """Attributes for the next model besides its Gaussians. A residual's SH start again at degree 0."""
        degree = {"active_sh_degree": gaussians.active_sh_degree} if self._options.nested else {}
        return {**self._adapter.carried_over(gaussians), **degree}

    def _moments(self, gaussians: Any) -> dict[str, dict[str, Tensor]]:
        """Optimizer state by parameter group on the CPU, if the next stage inherits it."""
        if self._options.inherit_mode != "full" or self.stage.level == 0:
            return {}
        state = {}
        for optimizer in self._adapter.optimizers(gaussians):
            for group in optimizer.param_groups:
                values = optimizer.state.get(group["params"][0], {})
                state[group["name"]] = {n: torch.as_tensor(v).detach().cpu().clone() for n, v in values.items()}
        return state

    def _view(self, camera: Any) -> Any:
        """The camera at this stage's level; one object for each, however often a scene is asked."""
        key = self._images.key(camera)
        if key not in self._views:
            size = self._images.size(camera, self.stage.level)
            self._views[key] = self._adapter.view_at(
                camera, size, self.stage.signed, lambda: self._rendering.target(key)
            )
        return self._views[key]

    def _prefetching(self, views: list[Any]) -> list[Any]:
        """Views that bring their images to the GPU before they are drawn, unless those lie there."""
        if not self._images.wait_elsewhere:
            return views
        keys = {id(view): key for key, view in self._views.items()}
        return PrefetchingViews(views, lambda view: self._rendering.prefetch(keys[id(view)]))

    def _synchronize(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize()


def with_attributes(value: Any, **changes: Any) -> Any:
    """A shallow copy with other attributes."""
    changed = copy.copy(value)
    for name, new in changes.items():
        setattr(changed, name, new)
    return changed


def _fuse(optimizer: torch.optim.Optimizer) -> None:
    """Let a plain Adam step each tensor in one kernel instead of a dozen; the result differs by rounding."""
    if type(optimizer) is not torch.optim.Adam:
        return
    for group in optimizer.param_groups:
        group["fused"], group["foreach"] = True, False
        for parameter in group["params"]:
            if "step" in (state := optimizer.state.get(parameter, {})):
                state["step"] = state["step"].to(parameter.device)
