"""Prepare a run of a script that trains splats: what is asked for is decided and checked before a folder is made."""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch

from lapgs_plugin.checkouts.packages import AUTO, OURS
from lapgs_plugin.checkouts.script import Script
from lapgs_plugin.checkouts.splat_script import SplatScript
from lapgs_plugin.checkouts.training_call import StageWindow
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.hierarchy.plan import Stage, StagePlan
from lapgs_plugin.hierarchy.supervision import RECONSTRUCTED
from lapgs_plugin.options import option_name
from lapgs_plugin.rasterizers.choice import RASTER_SETTINGS
from lapgs_plugin.reference_raster.layout import NEAR_DEPTH
from lapgs_plugin.registry import HOOKS, NONE, chosen_entries
from lapgs_plugin.runner.dry_run import full_gpu_told
from lapgs_plugin.runner.manifest import require_same_run
from lapgs_plugin.runner.rasterizer_choice import CHOICE, Decision, recorded_choice
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runner.splats.schedule import THRESHOLD
from lapgs_plugin.runner.splats.signed import Rasterizer
from lapgs_plugin.runner.splats.views import SplatView, read_views
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import require_place, require_room, require_utf8
from lapgs_plugin.runs.manifest import Manifest, SceneReference, read_manifest
from lapgs_plugin.runs.options import MeasuringOptions
from lapgs_plugin.runs.trained_cameras import TrainedCameras
from lapgs_plugin.runs.watcher import Watcher
from lapgs_plugin.scenes.scene import load_cameras, smallest_of
from lapgs_plugin.stages.run import StagedRun

logger = logging.getLogger(__name__)

NEEDED = ("cfg", "parser", "trainset", "valset", "splats", "optimizers")
"""Attributes of a script's trainer that are read or replaced."""
RESULTS = "--result_dir"
"""Option of the scripts that names the output folder."""
OTHERWISE = "`lapgs run --off` runs the script as it is"
"""Advice where levels cannot be trained."""
HELD_OUT_EVERY = 8
"""Views of which one is held out where a manifest says that some are."""


@dataclass(frozen=True)
class SplatRequest:
    """Hold what a user asks of a run; the script's own options say the rest.

    Attributes:
        script: its definitions have been executed.
        described: what its syntax tree says.
        settings: of the hierarchy.
        device: "cuda", or "cpu" inside `cpu_device.cuda_on_cpu`.
        rasterizer: one of `packages.CHOICES`, of no effect on a CPU.
        resume: continue the run in the output folder.
        overwrite: replace the run in the output folder.
        measuring: which figures are measured.
        watcher: may look at the fields between iterations.
    """

    script: Script
    described: SplatScript
    settings: RunSettings = field(default_factory=RunSettings)
    device: str = "cuda"
    rasterizer: str = AUTO
    resume: bool = False
    overwrite: bool = False
    measuring: MeasuringOptions = field(default_factory=MeasuringOptions)
    watcher: Watcher = field(default_factory=Watcher)


@dataclass(frozen=True)
class SplatRun(StagedRun):
    """Hold a run that is ready to train.

    Attributes:
        settings: those of the request, with the defaults for the photos' size.
        request: what the user asks for.
        rasterizer: renders the script's calls.
        trainer: the script's object whose `train` was called.
        config: its settings, for the whole run.
        train, test: views of its datasets.
        folder: path of the run folder as the user typed it.
    """

    settings: RunSettings
    request: SplatRequest
    rasterizer: Rasterizer
    trainer: Any
    config: Any
    train: tuple[SplatView, ...]
    test: tuple[SplatView, ...]
    folder: Path

    def window(self, stage: Stage) -> StageWindow:
        """Return the place of a stage in the run."""
        settings, start = self.settings, self.plan.iterations_before(stage.level)
        factors = settings.color_factor, settings.threshold_factor(stage)
        return StageWindow(stage, start, self.plan.iterations, self.plan.levels, *factors)


@contextmanager
def prepare(request: SplatRequest, own: Rasterizer, trainer: Any, began: int) -> Iterator[SplatRun]:
    """Yield a run that is ready to train. Its folder is locked for writing inside the block.

    Args:
        request: what the user asks for.
        own: the script's rasterizer.
        trainer: the script's object whose `train` was called.
        began: file-system time (ns) just before the script's main block.

    Raises:
        LapgsError: the script, its options, the scene, the run folder and the hierarchy do not go together.
    """
    name = type(trainer).__name__
    if missing := [attribute for attribute in NEEDED if not hasattr(trainer, attribute)]:
        raise UserInputError(f"{name} of {request.script.path} has no {', '.join(missing)}; {OTHERWISE}")
    settings, config = request.settings, trainer.cfg
    refuse_settings(request)
    refuse_options(config, settings.has_residuals)
    if (
        request.device == "cpu"
        and hasattr(config.strategy, THRESHOLD)
        and (size := getattr(config, "batch_size", 1)) > 1
    ):
        raise UserInputError(
            f"--batch_size {size}: on a CPU the strategy by gradients gets those of one view; leave it out, or use mcmc"
        )
    folder = Path(config.result_dir)
    if not request.resume:
        require_room(folder, request.overwrite, began)
        require_place(folder, RESULTS)
        require_utf8(folder, RESULTS)
    elif not settings.has_residuals:
        raise UserInputError(
            f"--resume: {name}.train() starts at its first step, and nested levels are trained by one call of it; "
            "start again with --overwrite"
        )
    reference = scene_reference(trainer)
    train, test = (
        tuple(read_views(dataset, names_of(trainer, dataset))) for dataset in (trainer.trainset, trainer.valset)
    )
    size = smallest_of(view.camera for view in (*train, *test))
    settings = settings.for_size(size)
    plan = StagePlan.create(size, config.max_steps, settings.levels, settings.shares, settings.kind)
    with full_gpu_told():
        rasterizer, decision = _choose_rasterizer(request, own, trainer, train, plan, folder)
    manifest = _manifest(request, settings, config, plan, reference, decision)
    with _open_archive(request, folder, manifest, began) as archive:
        for attribute, value in vars(trainer).items():
            if attribute.endswith("_dir"):  # those of an earlier run are removed, the script's new ones with them
                Path(value).mkdir(parents=True, exist_ok=True)
        run = SplatRun(
            settings=settings,
            plan=plan,
            archive=archive,
            device=torch.device(request.device),
            request=request,
            rasterizer=rasterizer,
            trainer=trainer,
            config=config,
            train=train,
            test=test,
            folder=folder,
        )
        write_cameras(run)
        yield run


def _choose_rasterizer(
    request: SplatRequest,
    own: Rasterizer,
    trainer: Any,
    views: Sequence[SplatView],
    plan: StagePlan,
    folder: Path,
) -> tuple[Rasterizer, Decision | None]:
    """Return what renders a run, and why; on a CPU the stand-in, without a reason."""
    if request.device == "cpu":
        return own, None
    from lapgs_plugin.runner.splats.choice import OurRasterizer, decided, sample_calls

    kept = recorded_choice(read_manifest(folder)) if request.resume else None
    levels = sorted({stage.level for stage in plan})
    calls = sample_calls(trainer, views, levels, torch.device(request.device))
    decision = kept or decided(request.rasterizer, own, calls, tries=request.settings.dry_run)
    logger.info("rasterizer: %s", decision.why)
    return (OurRasterizer.instead_of(own) if decision.rasterizer == OURS else own), decision


def _open_archive(request: SplatRequest, folder: Path, manifest: Manifest, began: int) -> RunArchive:
    """Create the run folder, or open it to continue the run."""
    if not request.resume:
        return RunArchive.create(folder.absolute(), manifest, request.overwrite, began)
    archive = RunArchive.open(folder.absolute(), resume=True)
    try:
        require_same_run(archive.manifest, manifest)
    except BaseException:
        archive.close()
        raise
    return archive


def refuse_settings(request: SplatRequest) -> None:
    """Refuse options of `lapgs run` that have no effect on such a script.

    Raises:
        UserInputError: there is one.
    """
    settings, kind = request.settings, "scripts around gsplat's rasterization()"
    idle = {
        **{"supervision": RECONSTRUCTED, "prune": 0.0, "appearance": NONE},
        **{"prune_by_size": True, "fused_ssim": True, "run_ahead": True},
    }
    declared = {setting.name: setting for setting in fields(settings)}
    for name, value in idle.items():
        if (chosen := getattr(settings, name)) != value:
            option = option_name(declared[name])
            raise UserInputError(f"{option} {chosen} has no effect with {kind}; leave it out, or use `lapgs train`")
    if settings.has_residuals and settings.inherit_mode == "full":
        raise UserInputError(f"--inherit full: of {kind} only geometry and xyz are inherited; choose one of them")
    if settings.masks not in ("auto", "none"):
        raise UserInputError(f"--masks {settings.masks}: {kind} read masks themselves; leave it out")
    if settings.depth != "none":
        raise UserInputError(
            f"--depth {settings.depth}: {kind} have a depth loss of their own (--depth_loss); leave it out"
        )
    if request.measuring.breakdown:
        raise UserInputError(f"--breakdown: the parts of an iteration are not measured in {kind}; leave it out")
    if hooks := chosen_entries("--hooks", HOOKS, settings.hooks):
        names = ", ".join(hook.name for hook in hooks)
        raise UserInputError(f"--hooks: {names} cannot take part in {kind}; add --hooks none, or use `lapgs train`")


def refuse_options(config: Any, residuals: bool) -> None:
    """Refuse options of a script that a hierarchy cannot honour.

    Args:
        config: the script's settings.
        residuals: whether there are any.

    Raises:
        UserInputError: there is one; the line says why, and what to do.
    """
    if (kind := getattr(config, "data_type", "colmap")) != "colmap":
        raise UserInputError(f"--data_type {kind}: levels are made of COLMAP scenes; {OTHERWISE}")
    if (size := getattr(config, "patch_size", None)) is not None:
        raise UserInputError(f"--patch_size {size}: levels train whole images; leave it out, or {OTHERWISE}")
    if (model := getattr(config, "camera_model", "pinhole")) != "pinhole":
        raise UserInputError(f"--camera_model {model}: levels are made for pinhole cameras; {OTHERWISE}")
    reasons = {
        "random_bkgd": "residual stages build on images rendered over one background",
        "depth_loss": "a residual covers a part of the scene only, so its depths are not those of the whole",
        "app_opt": "the colours of its network are no residuals",
        "compression": "it compresses one field, not a hierarchy",
    }
    for name, why in reasons.items():
        if residuals and getattr(config, name, None):
            raise UserInputError(f"--{name}: {why}; leave it out, or train with --hierarchy nested")


def names_of(trainer: Any, dataset: Any) -> list[str]:
    """Return the names of a dataset's images in its order.

    Raises:
        UserInputError: the script's parser and datasets do not say them.
    """
    try:
        return [str(trainer.parser.image_names[index]) for index in dataset.indices]
    except (AttributeError, IndexError, TypeError) as error:
        raise UserInputError(
            f"the parser of {type(trainer).__name__} has no image_names by the indices of its datasets ({error}), "
            f"which a run folder needs; {OTHERWISE}"
        ) from error


def scene_reference(trainer: Any) -> SceneReference:
    """Return the scene of a run as the manifest has it.

    Raises:
        SceneError: `lapgs eval` could not read it, because its photos are distorted or not there.
    """
    config, names = trainer.cfg, set(map(str, trainer.parser.image_names))
    path, paths = Path(config.data_dir).absolute(), trainer.parser.image_paths
    first, name = Path(paths[0]).absolute(), Path(str(trainer.parser.image_names[0]))
    images = first.parents[len(name.parts) - 1].relative_to(path).as_posix()
    known = load_cameras(path, images=images)[0]
    if lacking := names - known.keys():
        raise UserInputError(
            f"{min(lacking)} has another name in the scene {path}, expected one of {len(known)} names such as "
            f"{min(known)}; {OTHERWISE}"
        )
    near = float(getattr(config, "near_plane", NEAR_DEPTH))
    return SceneReference(
        path=str(path),
        resolution="full",
        eval=getattr(config, "test_every", HELD_OUT_EVERY) == HELD_OUT_EVERY,
        background=(0.0, 0.0, 0.0),
        kind="colmap",
        images=images,
        unit=2.0 ** math.floor(math.log2(near / NEAR_DEPTH)),
    )


def _manifest(
    request: SplatRequest,
    settings: RunSettings,
    config: Any,
    plan: StagePlan,
    scene: SceneReference,
    decision: Decision | None,
) -> Manifest:
    script = request.script.path
    return Manifest(
        scene=scene,
        levels=plan.levels,
        grid=settings.grid,
        supervision=settings.supervision,
        inherit=settings.resolved()["inherit"],
        sh_degree=config.sh_degree,
        rasterizer="gsplat",
        seed=settings.seed,
        settings={
            "backbone": {"name": script.stem, "checkout": str(script.parent), "arguments": sys.argv[1:]},
            RASTER_SETTINGS: {"antialiasing": True} if getattr(config, "antialiased", False) else {},
            **({} if decision is None else {CHOICE: decision.for_manifest()}),
            "iterations": plan.iterations,
            **settings.for_manifest(),
        },
    )


@torch.no_grad()
def write_cameras(run: SplatRun, refined: Callable[[int], Camera] | None = None) -> None:
    """Write the cameras of all views; `refined` returns that of a training view by index where the script moved it."""
    train = {view.name: view.camera if refined is None else refined(index) for index, view in enumerate(run.train)}
    run.archive.write_cameras(TrainedCameras(train, {view.name: view.camera for view in run.test}))
