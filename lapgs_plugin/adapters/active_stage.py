"""One stage of a run over a checkout: what its replaced symbols ask for, and what is kept when it ends."""

from __future__ import annotations

import copy
import logging
import math
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lapgs_plugin.adapters.base import BackboneAdapter, StageWindow, TrainingCall
from lapgs_plugin.adapters.hooking import HookCaller
from lapgs_plugin.adapters.level_views import AnnouncingViews, PhotoAlbum, make_level_view
from lapgs_plugin.adapters.shim import RasterizerShim, StageRendering
from lapgs_plugin.archive import CACHE, OPTIMIZER, LevelRecord, RunArchive
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.evaluation.metrics import psnr
from lapgs_plugin.field import GaussianField
from lapgs_plugin.imagestore import ImageStore, place
from lapgs_plugin.inheritance import inherit
from lapgs_plugin.plan import level_size, parse_split
from lapgs_plugin.pyramid import Pyramid
from lapgs_plugin.signed_color import ColorPath
from lapgs_plugin.supervision import Supervision, parse_supervision

logger = logging.getLogger(__name__)

HISTORY_ENTRIES = 200
"""About how many entries a run adds to its history."""


@dataclass(frozen=True)
class HierarchyOptions:
    """What a user can choose about the hierarchy; everything else is the backbone's.

    Attributes:
        levels: number of levels; 1 is the plain backbone, archived as a run.
        split: share of the iterations of each stage, coarsest first, as text; None takes the paper's.
        grid: of the pyramid.
        supervision, inherit, inherit_ratio: see their modules.
        residual_color_rate: factor on the SH learning rates of residual stages.
        images_on: "gpu", "memory", "disk", or "auto" to let their size decide.
        prediction_precision: what cached predictions are stored as.
        fused_adam: let PyTorch's Adam step each tensor in one kernel.
        seed: of the draw of inherited Gaussians.
    """

    levels: int = 2
    split: str | None = None
    grid: str = "camera"
    supervision: str = "reconstructed"
    inherit: str = "geometry"
    inherit_ratio: float = 1.0
    residual_color_rate: float = 4.0
    images_on: str = "auto"
    prediction_precision: str = "float16"
    fused_adam: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        parse_supervision(self.supervision)
        Pyramid(self.grid)
        if self.residual_color_rate <= 0 or not math.isfinite(self.residual_color_rate):
            raise UserInputError(f"--residual-color-rate {self.residual_color_rate}: expected a positive factor")
        if self.images_on not in ("auto", "gpu", "memory", "disk"):
            raise UserInputError(f"--images-on {self.images_on}: expected auto, gpu, memory or disk")

    def shares(self) -> tuple[Fraction, ...] | None:
        if self.split is not None:
            return parse_split(self.split)
        return PAPER_SPLIT if self.levels == len(PAPER_SPLIT) else None


PAPER_SPLIT = (Fraction(1, 3), Fraction(2, 3))
"""10k and 20k of 30k iterations for two levels, as in the paper's main tables; more levels take `StagePlan`'s."""


@dataclass(frozen=True)
class RunContext:
    """What all stages of a run share.

    Attributes:
        adapter: of the checkout.
        options: of the hierarchy.
        device: where the checkout renders.
        album: the images of its scene.
        shim: between its render and its rasterizer.
        hooks: of the user.
    """

    adapter: BackboneAdapter
    options: HierarchyOptions
    device: torch.device
    album: PhotoAlbum
    shim: RasterizerShim
    hooks: HookCaller


@dataclass(frozen=True)
class LoadedScene:
    """A checkout's scene, its cameras without images."""

    scene: Any
    points: Any  # the checkout's BasicPointCloud
    others: tuple[Any, ...]  # what create_from_pcd takes after the points

    @property
    def train(self) -> list[Any]:
        return list(self.scene.getTrainCameras())

    @property
    def test(self) -> list[Any]:
        return list(self.scene.getTestCameras())


@dataclass(frozen=True)
class Finished:
    """What a stage leaves for the next one.

    Attributes:
        field: its Gaussians, on the CPU.
        predictions: Up(I_hat^l) of every view by key; None after the finest level.
        carried: attributes for the next model.
        moments: optimizer state by parameter group, for full inheritance.
    """

    field: GaussianField
    predictions: ImageStore | None
    carried: Mapping[str, Any]
    moments: Mapping[str, dict[str, Tensor]]


class ActiveStage:
    """One stage while it runs."""

    def __init__(
        self,
        context: RunContext,
        call: TrainingCall,
        scene: LoadedScene,
        archive: RunArchive,
        window: StageWindow,
        before: Finished | None,
        path: ColorPath,
    ) -> None:
        self._whole_call, self._loaded = call, scene
        self._archive, self.window, self._before = archive, window, before
        self._options, self._adapter, self._album = context.options, context.adapter, context.album
        self._pyramid, self._supervision = Pyramid(context.options.grid), parse_supervision(context.options.supervision)
        self._device, self._hooks = context.device, context.hooks
        self.stage = window.stage
        self.overhead: dict[str, float] = {}
        self._excluded = 0.0
        self._began: float | None = None
        self._peak = 0
        self._gaussians: Any = None
        self._moments_due = False
        self._call = self._adapter.stage_call(call, window, str(archive.path(f"level_{self.stage.level}")))
        with self.timed("pyramid"):
            self._keys = {id(camera): self._album.key(camera) for camera in (*scene.train, *scene.test)}
            self._targets = self._make_targets()
        self._views: dict[str, Any] = {}
        self._rendering = StageRendering(
            signed=self.stage.signed,
            path=path,
            views={id(camera.world_view_transform): self._keys[id(camera)] for camera in (*scene.train, *scene.test)},
            targets=self._targets,
            accumulated=None if before is None else before.predictions,
            composed=frozenset(self._keys[id(camera)] for camera in self._composed_cameras()),
            on_image=self._hooks.on_image if self._hooks else None,
        )
        context.shim.stage = self._rendering

    # What the replaced symbols ask for.

    def scene_for(self, gaussians: Any) -> Any:
        """The scene of this stage, with `gaussians` initialised from it."""
        self._gaussians = gaussians
        loaded = self._loaded
        scene = with_attributes(
            loaded.scene,
            gaussians=gaussians,
            model_path=self._call.dataset.model_path,
            train_cameras={1.0: self._announcing([self._view(camera) for camera in loaded.train])},
            test_cameras={1.0: [self._view(camera) for camera in loaded.test]},
        )
        with self.timed("inheritance"):
            self._initialise(gaussians)
        self._adapter.stage_scene(scene)
        return scene

    def optimizers_made(self, gaussians: Any) -> None:
        """The checkout has set up its optimizers: give them inherited state, and fuse their steps."""
        if self._moments_due and self._before is not None:
            for optimizer in self._adapter.optimizers(gaussians):
                for group in optimizer.param_groups:
                    if state := self._before.moments.get(group["name"]):
                        optimizer.state[group["params"][0]] = {
                            name: value[self._kept].to(self._device) if value.ndim else value
                            for name, value in state.items()
                        }
        if self._options.fused_adam and self._device.type == "cuda":
            for optimizer in self._adapter.optimizers(gaussians):
                _fuse(optimizer)

    def iteration_begins(self, gaussians: Any, iteration: int) -> None:
        now = time.perf_counter()
        if self._began is None:
            self._synchronize()
            self._began = now = time.perf_counter()
        count = len(gaussians._xyz)
        self._peak = max(self._peak, count)
        if self._hooks:
            self._hooks.iteration_begins(self.stage, iteration)
        if iteration % max(1, self.window.total // HISTORY_ENTRIES) == 0:
            finished = sum(record.train_seconds for record in self._archive.manifest.records)
            elapsed = finished + now - self._began - self._excluded
            self._archive.append_history(
                {"level": self.stage.level, "iteration": iteration, "elapsed": elapsed, "num_gaussians": count}
            )

    def densified(self) -> None:
        if self._hooks:
            self._hooks.densified()

    @contextmanager
    def outside(self, what: str) -> Iterator[None]:
        """Time that is not optimization though it passes inside the training loop."""
        self._synchronize()
        start = time.perf_counter()
        with self.timed(what):
            yield
        self._excluded += time.perf_counter() - start

    # Start, middle and end of the stage.

    def train(self) -> Finished:
        """Run the checkout's training for this stage and archive what it made."""
        stage = self.stage
        logger.info(
            "level %d: %d iterations at %dx%d, images on the %s",
            *(
                stage.level,
                stage.iterations,
                *stage.image_size,
                {"gpu": "GPU", "memory": "CPU", "disk": "disk"}[self._where],
            ),
        )
        self._hooks.stage_begins(stage, self._rendering)
        if self._device.type == "cuda":
            torch.cuda.reset_peak_memory_stats()
        self._call.run()
        self._synchronize()
        assert self._began is not None, "training() without an iteration"
        seconds = time.perf_counter() - self._began - self._excluded
        memory = self._memory()
        self._hooks.stage_ends(stage)
        gaussians, self._gaussians = self._gaussians, None
        field = self._adapter.export_field(gaussians, signed=stage.signed).to("cpu")
        finished = self._finish(gaussians, field, self._adapter.carried_over(gaussians), self._moments(gaussians))
        left = {"carried": dict(finished.carried), "moments": dict(finished.moments)}
        with self.timed("archive"):
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
                ),
                field,
                left if stage.level > 0 and any(left.values()) else None,
            )
        return finished

    def restore(self) -> Finished:
        """What `train` returned when this level was finished, from its archived field."""
        field = self._archive.field(self.stage.level)
        gaussians = self._adapter.new_model(self._whole_call)
        self._adapter.import_field(gaussians, field.to(self._device))
        gaussians.active_sh_degree = field.sh_degree
        left: dict[str, Any] = {"carried": {}, "moments": {}}
        if self._archive.field_path(self.stage.level).with_name(OPTIMIZER).exists():
            left = self._archive.optimizer_state(self.stage.level)
        carried = {name: torch.nn.Parameter(value.detach().to(self._device)) for name, value in left["carried"].items()}
        return self._finish(gaussians, field, carried, left["moments"])

    def close(self) -> None:
        """Let go of the stage's images, those that the next stage needs excepted."""
        for store in self._stores:
            store.close()
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

    def out_of_memory(self, error: torch.cuda.OutOfMemoryError) -> UserInputError:
        """One line that says what filled the GPU and what helps."""
        images = self._image_bytes()
        finished = ", ".join(map(str, self._archive.available_levels)) or "none"
        help_ = "--images-on memory takes them off the GPU" if images else "a larger threshold for densification helps"
        return UserInputError(
            f"out of GPU memory at level {self.stage.level} with {self._peak:,} Gaussians; images held on the GPU: "
            f"{images / 2**30:.2f} GiB; {help_}, more --levels or a smaller resolution too; "
            f"finished levels ({finished}) are kept, --resume continues after them [{str(error).splitlines()[0]}]"
        )

    def _finish(
        self,
        gaussians: Any,
        field: GaussianField,
        carried: Mapping[str, Any],
        moments: Mapping[str, dict[str, Tensor]],
    ) -> Finished:
        predictions = None
        if self.stage.level > 0:
            with self.timed("cache"):
                predictions = self._predict(gaussians)
        elif self._loaded.test:
            with self.timed("evaluation"):
                self._report_held_out(gaussians)
        return Finished(field, predictions, carried, moments)

    @torch.no_grad()
    def _predict(self, gaussians: Any) -> ImageStore:
        """Up of the composed image of every view, for the next level."""
        cameras = (*self._loaded.train, *self._loaded.test)
        finer = self.stage.level - 1
        bytes_each = 4 if self._options.prediction_precision == "float32" else 2
        pixels = sum(math.prod(self._size(camera, finer)) for camera in cameras)
        store = self._store(bytes_each * 3 * pixels, self._options.prediction_precision, "predictions")
        for camera in cameras:
            width, height = self._size(camera, finer)
            store.put(self._keys[id(camera)], self._pyramid.up(self._composed(gaussians, camera), (height, width)))
        return store

    @torch.no_grad()
    def _report_held_out(self, gaussians: Any) -> None:
        values = []
        for camera in self._loaded.test:
            image = self._composed(gaussians, camera).clamp(0, 1)
            values.append(psnr(image, self._targets.get(self._keys[id(camera)])))
        mean = math.fsum(values) / len(values)
        self._archive.append_history({"level": self.stage.level, "iteration": self.stage.iterations, "psnr": mean})
        logger.info("held-out PSNR of the composed hierarchy: %.2f dB over %d views", mean, len(values))

    def _composed(self, gaussians: Any, camera: Any) -> Tensor:
        """(3, h, w) I_hat^l of a view, before exposure and clamping."""
        self._rendering.composed, self._rendering.capture = frozenset(self._keys.values()), True
        background = torch.full((3,), float(self._call.dataset.white_background), device=self._device)
        self._adapter.render(self._call, self._view(camera), gaussians, background)
        assert self._rendering.captured is not None
        return self._rendering.captured

    def _initialise(self, gaussians: Any) -> None:
        """Points for the base; for a residual the field of the level before."""
        points, others = self._loaded.points, self._loaded.others
        if self._before is None:
            gaussians.create_from_pcd(points, *others)
            return
        options = self._options
        generator = torch.Generator().manual_seed(options.seed)
        field, self._kept = inherit(self._before.field, options.inherit, options.inherit_ratio, generator)
        positions = field.means.numpy().astype(np.float64)
        grey = np.full_like(positions, 0.5)  # the colour whose SH coefficient is zero
        gaussians.create_from_pcd(
            type(points)(points=positions, colors=grey, normals=np.zeros_like(positions)), *others
        )
        if options.inherit != "xyz":
            names = ["_rotation", "_scaling", "_opacity"]
            if options.inherit == "full":
                names += ["_features_dc", "_features_rest"]
                self._moments_due = True
            self._adapter.import_field(gaussians, field.to(self._device), names)
        for name, value in self._before.carried.items():
            setattr(gaussians, name, value)

    def _moments(self, gaussians: Any) -> dict[str, dict[str, Tensor]]:
        """Optimizer state by parameter group on the CPU, if the next stage inherits it."""
        if self._options.inherit != "full" or self.stage.level == 0:
            return {}
        state = {}
        for optimizer in self._adapter.optimizers(gaussians):
            for group in optimizer.param_groups:
                values = optimizer.state.get(group["params"][0], {})
                state[group["name"]] = {n: torch.as_tensor(v).detach().cpu().clone() for n, v in values.items()}
        return state

    def _make_targets(self) -> ImageStore:
        """The level's images of every view."""
        level, exact = self.stage.level, self._album.exact
        cameras = (*self._loaded.train, *self._loaded.test)
        pixels = sum(math.prod(self._size(camera, level)) for camera in cameras)
        supervised = {id(camera) for camera in self._loaded.train}
        of_laplacian = self.stage.signed and self._supervision is Supervision.GT_LAPLACIAN
        precision = "uint8" if level == 0 and exact and not of_laplacian else "float16"
        store = self._store((1 if precision == "uint8" else 2) * 3 * pixels, precision, "targets")
        for camera in cameras:
            key = self._keys[id(camera)]
            images = self._pyramid.gaussian(self._album.photo(key).image(self._device), level + 1 + of_laplacian)
            image = images[level]
            if of_laplacian and id(camera) in supervised:
                image = image - self._pyramid.up(images[level + 1], (image.shape[1], image.shape[2]))
            store.put(key, image)
        return store

    def _store(self, num_bytes: int, precision: str, name: str) -> ImageStore:
        """A store for so many bytes of images, where the user wants them or where they fit."""
        where = self._options.images_on
        if where == "auto":
            where = place(num_bytes, self._device)
        elif where == "gpu" and self._device.type == "cpu":
            where = "memory"
        self._where = where
        return ImageStore(
            where, precision, device=self._device, folder=self._archive.path(CACHE, f"{name}_{self.stage.level}")
        )

    def _composed_cameras(self) -> list[Any]:
        """Cameras whose rendered residual is composed: all, but for the ablations that supervise residuals alone."""
        if self._supervision is Supervision.RECONSTRUCTED:
            return [*self._loaded.train, *self._loaded.test]
        return self._loaded.test

    def _size(self, camera: Any, level: int) -> tuple[int, int]:
        return level_size(self._album.photo(self._keys[id(camera)]).size, level)

    def _view(self, camera: Any) -> Any:
        """The camera at this stage's level; one object for each, however often a scene is asked."""
        key = self._keys[id(camera)]
        if key not in self._views:
            size = self._size(camera, self.stage.level)
            view = make_level_view(camera, size, lambda: self._target(key))
            self._adapter.level_view(view, camera, size, self.stage.signed)
            self._views[key] = view
        return self._views[key]

    def _announcing(self, views: list[Any]) -> list[Any]:
        """Views that bring their images to the GPU before they are drawn, unless those lie there."""
        away = sum(store.bytes_on_disk for store in self._stores)
        if self._device.type == "cuda":
            away += sum(store.bytes_in_memory for store in self._stores)
        if not away:
            return views
        keys = {id(view): key for key, view in self._views.items()}
        return AnnouncingViews(views, lambda view: self._rendering.announce(keys[id(view)]))

    def _target(self, key: str) -> Tensor:
        """(3, h, w) what a render of the view is compared with."""
        target = self._targets.get(key)
        online = self._supervision is Supervision.ONLINE_RESIDUAL
        if online and self.stage.signed and key not in self._rendering.composed:
            assert self._before is not None
            assert self._before.predictions is not None
            return target - self._before.predictions.get(key)
        return target

    @property
    def _stores(self) -> tuple[ImageStore, ...]:
        """The images that this stage reads."""
        predictions = None if self._before is None else self._before.predictions
        return (self._targets,) if predictions is None else (self._targets, predictions)

    def _image_bytes(self) -> int:
        """Bytes of images that this stage holds on the GPU."""
        return sum(store.bytes_on_device for store in self._stores)

    def _memory(self) -> dict[str, int]:
        """Peak bytes on the GPU during the stage, and how many of them were images."""
        if self._device.type != "cuda":
            return {}
        return {"peak": torch.cuda.max_memory_allocated(), "images": self._image_bytes()}

    def _synchronize(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize()

    @contextmanager
    def timed(self, what: str) -> Iterator[None]:
        """Add the time spent inside to the stage's overhead under `what`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._synchronize()
            self.overhead[what] = self.overhead.get(what, 0.0) + time.perf_counter() - start


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
