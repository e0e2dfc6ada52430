"""A run of `lapgs run`: a checkout's own `training`, called once a stage, archived level by level.

What happens to a call of `training(dataset, opt, pipe, ...)`:

    load     the checkout's Scene, once; its images go to an album on the CPU
    stage    level views over the scene, targets and predictions in ImageStores, the adapter's arguments, `training`
    archive  the field, what it took; predictions of all views for the next stage; then the field is let go of

The order is that of `lapgs_plugin.training.trainer`; everything between render and optimizer is the checkout's.
"""

from __future__ import annotations

import logging
import os
import shutil
import sys
import tempfile
import uuid
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.adapters.base import BackboneAdapter, StageWindow, TrainingCall
from lapgs_plugin.checkouts.attachment import Attachment, Replacement
from lapgs_plugin.checkouts.level_views import PhotoAlbum
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.hierarchy.plan import Hierarchy, StagePlan
from lapgs_plugin.hooks import StageHook
from lapgs_plugin.rasterizers.choice import RASTER_SETTINGS
from lapgs_plugin.rasterizers.extensions import CudaExtension
from lapgs_plugin.rasterizers.signed_color import ColorPath, SignedColorRasterizer
from lapgs_plugin.runner.active_stage import ActiveStage, with_attributes
from lapgs_plugin.runner.hooking import HookCaller
from lapgs_plugin.runner.installed_rasterizer import require_matching_rasterizer
from lapgs_plugin.runner.iteration_parts import IterationParts
from lapgs_plugin.runner.joint import FinishedStage
from lapgs_plugin.runner.run_state import Finished, LoadedScene, RunContext
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runner.shim import RasterizerShim
from lapgs_plugin.runs.archive import CACHE, Manifest, RunArchive, SceneReference
from lapgs_plugin.runs.watching import Watcher

logger = logging.getLogger(__name__)

OPACITY_RESET = "reset_opacity"
"""That method of the family's GaussianModel which is density control and can be left out by itself."""


class HierarchyDriver:
    """Runs a script's main block with its `training` replaced by the stages of a hierarchy.

    Args:
        adapter: of the script's backbone.
        options: of the hierarchy.
        device: "cuda", or "cpu" inside `cpu_device.cuda_on_cpu`.
        resume, overwrite: what to do with a run that is in the output folder already.
        hooks: run after those registered by entry point.
        breakdown: measure the parts of iterations.
        watcher: may look at the fields between iterations; None for nobody.
        test_every: iterations between two measurements of held-out views; None measures them at the end of the run.

    Attributes:
        folder: of the run, once it is complete.
    """

    def __init__(
        self,
        adapter: BackboneAdapter,
        options: RunSettings,
        *,
        device: str = "cuda",
        resume: bool = False,
        overwrite: bool = False,
        hooks: Sequence[StageHook] = (),
        breakdown: bool = False,
        watcher: Watcher | None = None,
        test_every: int | None = None,
    ) -> None:
        self._adapter, self._options = adapter, options
        self._resume, self._overwrite = resume, overwrite
        self._shim, self._album = RasterizerShim(), PhotoAlbum()
        place = torch.device(device)
        self._parts = IterationParts(place, breakdown)
        self._context = RunContext(
            adapter=adapter,
            options=options,
            device=place,
            album=self._album,
            shim=self._shim,
            hooks=HookCaller(hooks),
            parts=self._parts,
            watcher=watcher or Watcher(),
            test_every=test_every,
        )
        self._active: ActiveStage | None = None
        self.folder: Path | None = None

    def run(self) -> None:
        """Run the main block.

        Raises:
            LapgsError: the checkout, its options, the scene and the hierarchy do not go together.
        """
        replacements = [
            *self._replacements(),
            *self._adapter.replacements(self._window),
            *self._parts.outer_replacements(self._adapter.train, self._adapter.info),
        ]
        with Attachment(replacements), self._parts.watching_optimizers():
            self._adapter.script.run_main()

    def _window(self) -> StageWindow | None:
        return None if self._active is None else self._active.window

    def _replacements(self) -> list[Replacement]:
        train = self._adapter.train
        for name in ("gaussian_renderer", "utils.camera_utils"):
            if name not in sys.modules:
                raise UserInputError(
                    f"{self._adapter.script.path} does not import {name}, expected of {self._adapter.info.title}; "
                    "choose another --backbone, or train with `lapgs run --off`"
                )
        renderer, loader = sys.modules["gaussian_renderer"], sys.modules["utils.camera_utils"]
        require_matching_rasterizer(renderer, self._adapter.info.rasterizer, self._adapter.info.title)
        whoever = "render(), and through it the training loop, score functions and reports"
        missing = [name for name in ("GaussianModel", "Scene") if not hasattr(train, name)]
        if missing:
            raise UserInputError(
                f"{self._adapter.script.path} has no {missing[0]}, expected of {self._adapter.info.title}; "
                "choose another --backbone, or train with `lapgs run --off`"
            )
        return [
            Replacement(train, "training", self._make_training, ("dataset", "opt", "pipe"), "the main block"),
            Replacement(train, "Scene", self._make_scene, ("args", "gaussians"), "training()"),
            Replacement(loader, "Camera", self._album.adopting, None, "the scene's loader, for every image"),
            *self._parts.inner_replacements(renderer),
            Replacement(renderer, "GaussianRasterizationSettings", self._shim.settings, None, whoever),
            Replacement(renderer, "GaussianRasterizer", self._shim.rasterizer, None, whoever),
            Replacement(
                train.GaussianModel,
                "update_learning_rate",
                self._make_update_learning_rate,
                ("self", "iteration"),
                "training() at the start of every iteration",
            ),
            Replacement(
                train.GaussianModel,
                "training_setup",
                self._make_training_setup,
                ("self", "training_args"),
                "training()",
            ),
            Replacement(train.Scene, "save", self._make_save, ("self", "iteration"), "training() at --save_iterations"),
            *(
                Replacement(
                    train.GaussianModel,
                    name,
                    self._make_opacity_reset if name == OPACITY_RESET else self._make_density_control,
                    ("self",),
                    "training()",
                )
                for name in self._adapter.info.density_control
            ),
        ]

    # What takes the place of each symbol.

    def _make_training(self, original: Callable[..., None]) -> Callable[..., None]:
        def training(*args: Any, **kwargs: Any) -> None:
            self._train(TrainingCall.bind(original, args, kwargs))

        return training

    def _make_scene(self, original: Callable[..., Any]) -> Callable[..., Any]:
        self._scene_class = original

        def make_scene(args: Any, gaussians: Any, *rest: Any, **kwargs: Any) -> Any:
            assert self._active is not None, "training() makes its scene inside a stage"
            return self._active.scene_for(gaussians)

        return make_scene

    def _make_update_learning_rate(self, original: Callable[[Any, int], Any]) -> Callable[[Any, int], Any]:
        def update_learning_rate(gaussians: Any, iteration: int) -> Any:
            if self._active is not None:
                self._active.iteration_begins(gaussians, iteration)
            return original(gaussians, iteration)

        return update_learning_rate

    def _make_training_setup(self, original: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
        def training_setup(gaussians: Any, training_args: Any) -> None:
            original(gaussians, training_args)
            if self._active is not None:
                self._active.optimizers_made(gaussians)

        return training_setup

    def _make_save(self, original: Callable[[Any, int], None]) -> Callable[[Any, int], None]:
        def save(scene: Any, iteration: int) -> None:
            if self._active is None:
                original(scene, iteration)
                return
            with self._active.outside("saving"):
                original(scene, iteration)

        return save

    def _make_density_control(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def control(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
            result = original(gaussians, *args, **kwargs)
            if self._active is not None:
                self._active.densified(gaussians)
            return result

        return control

    def _make_opacity_reset(self, original: Callable[..., Any]) -> Callable[..., Any]:
        control = self._make_density_control(original)

        def reset_opacity(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
            if self._active is None or self._active.resets_opacities:
                return control(gaussians, *args, **kwargs)
            return None

        return reset_opacity

    # The run.

    def _train(self, call: TrainingCall) -> None:
        hierarchy = self._options.kind
        self._adapter.refuse(call, self._options.levels, hierarchy)
        folder = Path(call.dataset.model_path or _folder_as_the_checkouts_name_it()).absolute()
        if not self._resume:
            RunArchive.require_room(folder, self._overwrite)
        path = self._color_path()
        with tempfile.TemporaryDirectory(prefix="lapgs-scene-") as scratch:
            scene = self._load_scene(call, Path(scratch))
            plan = StagePlan.create(
                self._album.smallest_size(),
                call.opt.iterations,
                self._options.levels,
                self._options.shares,
                hierarchy,
            )
            with self._open_archive(folder, self._manifest(call, plan)) as archive:
                self._context.watcher.run_started(archive)
                try:
                    self._run_stages(call, scene, plan, archive, path, Path(scratch))
                except KeyboardInterrupt:
                    kept = ", ".join(map(str, archive.available_levels)) or "none"
                    logger.info("stopped; finished levels in %s: %s; --resume continues after them", folder, kept)
                    raise
                finally:
                    # A run that stops in between makes its images again when it goes on.
                    shutil.rmtree(archive.path(CACHE), ignore_errors=True)
        self.folder = folder
        logger.info("run folder: %s", folder)

    def _run_stages(
        self,
        call: TrainingCall,
        scene: LoadedScene,
        plan: StagePlan,
        archive: RunArchive,
        path: ColorPath,
        files: Path,
    ) -> None:
        start = 0
        finished: list[FinishedStage] = []
        before: Finished | None = None
        for stage in plan:
            options = self._options
            window = StageWindow(
                stage, start, plan.iterations, plan.levels, options.color_factor, options.threshold_factor(stage)
            )
            active = ActiveStage(self._context, call, scene, archive, window, tuple(finished), before, path)
            self._active = active
            try:
                active.load_images()
                if stage.level in archive.available_levels:
                    before = active.restore()
                else:
                    active.write_scene_files(files)
                    before = active.train()
            except torch.cuda.OutOfMemoryError as error:
                raise active.out_of_memory(error) from error
            finally:
                self._active = None
                active.close()
            finished.append(active.as_finished)
            start += stage.iterations

    def _color_path(self) -> ColorPath:
        """How signed colour is evaluated by the installed rasterizer, found by trying it."""
        extension = CudaExtension(self._adapter.info.rasterizer, self._context.device)
        if self._options.levels == 1 or self._options.nested:
            return ColorPath.NATIVE  # never asked for: no field is signed
        return SignedColorRasterizer(extension, checkout=self._adapter.script.checkout).path

    def _load_scene(self, call: TrainingCall, scratch: Path) -> LoadedScene:
        """The checkout's Scene over a model that only notes what it would be initialised from."""
        recorder = _PointRecorder()
        dataset = with_attributes(call.dataset, model_path=str(scratch))
        scene = self._scene_class(dataset, recorder)
        if not hasattr(recorder, "points"):
            raise UserInputError(
                f"the Scene of {self._adapter.script.checkout} initialised no model with create_from_pcd, expected of "
                f"{self._adapter.info.title}; choose another --backbone, or train with `lapgs run --off`"
            )
        self._adapter.first_points(len(recorder.points.points))
        return LoadedScene(scene, recorder.points, recorder.others)

    def _open_archive(self, folder: Path, manifest: Manifest) -> RunArchive:
        """The run folder, new or continued.

        Raises:
            RunFolderError: it is in use, or was started with other options.
        """
        if not self._resume:
            return RunArchive.create(folder, manifest, self._overwrite)
        archive = RunArchive.open(folder, resume=True)
        try:
            _require_same_run(archive.manifest, manifest)
        except BaseException:
            archive.close()
            raise
        return archive

    def _manifest(self, call: TrainingCall, plan: StagePlan) -> Manifest:
        dataset = call.dataset
        return Manifest(
            scene=SceneReference(
                path=str(Path(dataset.source_path).absolute()),
                resolution=f"3dgs:{dataset.resolution}",
                eval=bool(dataset.eval),
                background=(1.0, 1.0, 1.0) if dataset.white_background else (0.0, 0.0, 0.0),
                kind="colmap" if (Path(dataset.source_path) / "sparse").exists() else "transforms",
                images=dataset.images or "images",
            ),
            levels=plan.levels,
            grid=self._options.grid,
            supervision=self._options.supervision,
            inherit=self._options.inherit,
            sh_degree=dataset.sh_degree,
            rasterizer=self._adapter.info.rasterizer,
            seed=self._options.seed,
            settings={
                "backbone": {
                    "name": self._adapter.info.name,
                    "checkout": str(self._adapter.script.checkout),
                    "arguments": sys.argv[1:],
                },
                RASTER_SETTINGS: self._adapter.raster_settings(call),
                "iterations": plan.iterations,
                **self._options.for_manifest(),
            },
        )


class _PointRecorder:
    """Stands where a Scene expects the model that it initialises."""

    def create_from_pcd(self, points: Any, *others: Any) -> None:
        self.points, self.others = points, others


def _folder_as_the_checkouts_name_it() -> str:
    """Where the family writes when no -m is given."""
    return str(Path("output") / (os.getenv("OAR_JOB_ID") or str(uuid.uuid4())[:10]))


def _require_same_run(found: Manifest, wanted: Manifest) -> None:
    """Refuse to continue a run with other settings: its levels would not belong together."""
    before, now = _identity(found), _identity(wanted)
    for name in {**before, **now}:
        if before.get(name) != now.get(name):
            # Who leaves the option out may have done so before, when it stood for residuals.
            same = f"--hierarchy {before[name]}" if name == "hierarchy" else "the same options"
            raise RunFolderError(
                f"this run was started with another {name} ({before.get(name)!r}, now {now.get(name)!r}); "
                f"resume with {same}, or start again with --overwrite"
            )


def _identity(manifest: Manifest) -> dict[str, Any]:
    """What cannot change while a run is continued. Where images lie can: running out of memory asks for it."""
    values = asdict(manifest)
    for name in ("records", "created", "created_by"):
        values.pop(name)
    settings = values.pop("settings")
    backbone = {name: value for name, value in settings.pop("backbone", {}).items() if name != "arguments"}
    settings.pop("images_on", None)
    # Earlier runs do not say what all of them were.
    residuals = Hierarchy.LAPLACIAN.value
    before = {
        "hierarchy": residuals,
        "protocol": "default",
        "prune": 0.0,
        "residual_threshold": 1.0,
        "residual_resets": settings.get("hierarchy", residuals) == residuals,
    }
    return {**before, **values, **settings, **backbone}
