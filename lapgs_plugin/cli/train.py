"""Train with the built-in trainer: `lapgs train`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lapgs_plugin.cli.bridge import given_options, takes_settings
from lapgs_plugin.cli.config_file import RUN_CONFIG, ConfigOption, extend_config, write_config
from lapgs_plugin.cli.output import make_console
from lapgs_plugin.cli.rehearsal import Rehearsal
from lapgs_plugin.cli.viewing import ViewOption, ViewPortOption, keep_preview, watching
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.options import option_values
from lapgs_plugin.scenes.options import SceneOptions
from lapgs_plugin.training.saved_settings import settings_from_manifest
from lapgs_plugin.training.settings import TrainingControl, TrainSettings

if TYPE_CHECKING:
    from rich.console import Console

    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.runs.manifest import SceneReference
    from lapgs_plugin.runs.watcher import Watcher
    from lapgs_plugin.scenes import Scene

MAY_CHANGE = ("images_on", "prediction_precision")
"""Settings that may change when a run is continued."""
CHOSEN_ONCE = ("rasterizer", "strategy")
"""Options whose value "auto" stands for the choice that the run was started with when it is continued."""

LONG_ON_A_CPU = 4e9
"""Pixels to render, over all iterations, from which the command says that a CPU takes long."""


@takes_settings
def train(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Folder of a COLMAP or Blender-style scene.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Run folder to write.")],
    photos: SceneOptions,
    settings: TrainSettings,
    control: TrainingControl,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue the run in --out with its settings. A finished run is extended to --iterations, a larger "
            "number than it has.",
        ),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run in --out.")] = False,
    view: ViewOption = False,
    view_port: ViewPortOption = None,
    config: ConfigOption = None,
) -> None:
    """Train a scene coarse to fine with the built-in trainer, on a GPU (gsplat) or a CPU.

    Each level trains at twice the image size of the level before.

    Examples:

        lapgs train data/garden -o runs/garden --eval

        lapgs train data/garden -o runs/small --resolution 1/4 --iterations 3000

        lapgs train data/garden -o runs/plain --levels 1    (a single field)

        lapgs train data/garden -o runs/nested --hierarchy nested    (one PLY)

        lapgs train data/garden -o runs/garden --resume    (after Ctrl-C)

        lapgs train data/garden -o runs/garden --resume --iterations 40000

        lapgs train --config runs/garden/run.toml -o runs/again --seed 1
    """
    from rich.markup import escape

    from lapgs_plugin.runs.gpu_busy import require_cuda
    from lapgs_plugin.runs.manifest import SceneReference
    from lapgs_plugin.scenes.masks import resolve_masks
    from lapgs_plugin.training.backend import choose_rasterizer, training_rasterizer
    from lapgs_plugin.training.tensorboard import require_tensorboard

    if resume and overwrite:
        raise UserInputError("--resume and --overwrite contradict each other; give one of them")
    watcher = context.with_resource(watching(view, view_port, out.absolute().name))
    reference = SceneReference(
        *(str(scene.absolute()), photos.resolution, photos.eval, photos.background_color),
        images=photos.images,
        kind="",
        masks=photos.masks,
    )
    if isinstance(context.obj, Rehearsal):
        context.obj.train(settings, reference, control.rasterizer)
        return
    reference = replace(reference, masks=resolve_masks(scene, photos.masks))
    if control.log is not None:
        require_tensorboard()
    if control.gpu_busy:
        require_cuda(training_rasterizer(choose_rasterizer(control.rasterizer), settings).device)
    console = make_console(stderr=True)
    if resume:
        given = {name for name in given_options(context) if name not in CHOSEN_ONCE or context.params[name] != AUTO}
        archive, loaded, settings = _resume(out, scene, _wanted(reference, settings, control.rasterizer), given)
    else:
        archive, loaded = _create(out, reference, settings, choose_rasterizer(control.rasterizer), overwrite)
        write_config(archive.path(RUN_CONFIG), context, masks=reference.masks)
    with archive:
        _run(archive, loaded, settings, control, console, resume=resume, watcher=watcher)
        if resume and settings.extended:
            strategy = settings.densification.strategy
            extend_config(archive.path(RUN_CONFIG), settings.iterations, settings.extended, strategy)
    keep_preview(out.absolute())
    name, word = escape(str(out)), escape(shlex.quote(str(out)))
    console.print(
        f"[bold]{name}[/bold] holds the run; next: `lapgs eval {word}`, `lapgs render {word}` or `lapgs view {word}`",
        soft_wrap=True,
    )


def _wanted(reference: SceneReference, settings: TrainSettings, rasterizer: str) -> dict[str, Any]:
    """Return the values that a run's result depends on, by option name."""
    return {
        "resolution": reference.resolution,
        "images": reference.images,
        "eval": reference.eval,
        "masks": reference.masks,
        "background": reference.background,
        "rasterizer": rasterizer,
        **option_values(settings),
    }


def _resume(
    out: Path, scene: Path, wanted: Mapping[str, Any], given: set[str]
) -> tuple[RunArchive, Scene, TrainSettings]:
    """Open a run to continue it.

    Args:
        out: the run folder.
        scene: the scene folder, which may have been moved.
        wanted: as `_wanted`.
        given: names of the options on the command line.

    Returns:
        The run, its scene, and its settings, with those of `MAY_CHANGE` that were given, or more iterations.

    Raises:
        UserInputError: the scene or an option differs from those that the run was started with.
    """
    from lapgs_plugin.files import MANIFEST
    from lapgs_plugin.rendering.run import require_same_scene
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.training.backend import training_rasterizer
    from lapgs_plugin.training.planning import check_storage

    archive = RunArchive.open(out, resume=True)
    try:
        manifest = archive.manifest
        before = Path(manifest.scene.path)
        if before.exists() and scene.exists() and not before.samefile(scene):
            raise UserInputError(
                f"{scene}: the run in {out} was started with the scene {before}; give that one to continue it, or "
                "start again with --overwrite"
            )
        settings = settings_from_manifest(manifest, str(archive.path(MANIFEST)))
        if manifest.complete:
            settings = _extended(archive, settings, int(wanted["iterations"]) if "iterations" in given else None)
            given = given - {"iterations"}
        started_with = _wanted(manifest.scene, settings, manifest.rasterizer)
        for name in sorted(given & wanted.keys() - set(MAY_CHANGE)):
            if name not in started_with:  # another strategy's
                raise UserInputError(
                    f"--{name.replace('_', '-')} is no option of --strategy {started_with['strategy']}, with which the "
                    f"run in {out} was started; leave it out to continue it, or start again with --overwrite"
                )
            if wanted[name] != started_with[name]:
                raise UserInputError(
                    f"--{name.replace('_', '-')} asks for {wanted[name]}, but the run in {out} was started with "
                    f"{started_with[name]}; leave the option out to continue it, or start again with --overwrite"
                )
        anew = {name: wanted[name] for name in MAY_CHANGE if name in given}
        settings = replace(settings, **anew)
        try:
            check_storage(settings, training_rasterizer(manifest.rasterizer, settings).device)
        except UserInputError as error:
            if anew:
                raise
            raise UserInputError(f"{archive.path(MANIFEST)}: {error}") from error
        loaded = _load(replace(manifest.scene, path=str(scene.absolute())))
        require_same_scene(archive, scene, loaded.smallest_size)
    except BaseException:
        archive.close()
        raise
    return archive, loaded, settings


def _extended(archive: RunArchive, settings: TrainSettings, asked: int | None) -> TrainSettings:
    """Return the settings of a finished run with the iterations to which it is extended, if it is.

    Raises:
        UserInputError: not more iterations than it has, or others than those of its interrupted extension.
    """
    from lapgs_plugin.runs.archive import CHECKPOINT

    begun, done, run = archive.extends_to, settings.iterations, archive.path()
    if asked is not None and begun not in (None, asked):
        raise UserInputError(
            f"--iterations {asked}: the run in {run} is being extended to {begun}; leave the option out to continue "
            f"that, or delete {archive.path(CHECKPOINT)} to extend the finished run anew"
        )
    if asked is not None and asked <= done:
        raise UserInputError(f"--iterations {asked}: the run in {run} is finished with {done}; give more to extend it")
    goal = asked or begun or done
    return replace(settings, iterations=goal, extended=settings.extended + goal - done)


def _load(reference: SceneReference) -> Scene:
    from lapgs_plugin.scenes import load_scene

    return load_scene(
        reference.path,
        resolution=reference.resolution,
        images=reference.images,
        eval=reference.eval,
        masks=reference.masks,
        background=reference.background,
    )


def _create(
    out: Path, reference: SceneReference, settings: TrainSettings, rasterizer: str, overwrite: bool
) -> tuple[RunArchive, Scene]:
    """Read the scene and check the settings before the run folder is made."""
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.runs.manifest import Manifest
    from lapgs_plugin.training.backend import training_rasterizer
    from lapgs_plugin.training.planning import check_storage, make_plan

    RunArchive.require_room(out, overwrite)
    check_storage(settings, training_rasterizer(rasterizer, settings).device)
    loaded = _load(reference)
    make_plan(loaded.smallest_size, settings, len(loaded.train))
    manifest = Manifest(
        scene=replace(reference, kind=loaded.kind),
        rasterizer=rasterizer,
        **settings.for_manifest(),
    )
    return RunArchive.create(out, manifest, overwrite), loaded


def _run(
    archive: RunArchive,
    scene: Scene,
    settings: TrainSettings,
    control: TrainingControl,
    console: Console,
    *,
    resume: bool,
    watcher: Watcher,
) -> None:
    """Train with a progress display."""
    import torch

    from lapgs_plugin.jit.threads import one_pool
    from lapgs_plugin.scenes.masks import share_inside
    from lapgs_plugin.training.backend import training_rasterizer
    from lapgs_plugin.training.monitor import Monitor, ProgressMonitor
    from lapgs_plugin.training.planning import make_plan
    from lapgs_plugin.training.tensorboard import TensorboardMonitor
    from lapgs_plugin.training.trainer import Trainer

    if control.threads is not None:
        torch.set_num_threads(control.threads)
    manifest = archive.manifest
    masks = [view.mask for view in (*scene.train, *scene.test)]
    if any(mask is not None for mask in masks):
        console.print(
            f"masks ({manifest.scene.masks}): {share_inside(masks):.0%} of the pixels are trained on and measured",
            highlight=False,
            markup=False,
        )
    placed = training_rasterizer(manifest.rasterizer, settings)
    if placed.device.type == "cpu" and (hint := long_on_a_cpu(scene.smallest_size, settings.iterations)):
        console.print(hint, highlight=False, soft_wrap=True)
    with one_pool(), ExitStack() as opened:
        monitor: Monitor = opened.enter_context(ProgressMonitor(console, manifest.levels))
        if control.log is not None:
            plan = make_plan(scene.smallest_size, settings, len(scene.train))
            monitor = opened.enter_context(TensorboardMonitor(archive.path("tensorboard"), plan, monitor))
        trainer = Trainer(
            scene=scene,
            settings=settings,
            archive=archive,
            rasterizer=placed.rasterizer,
            device=placed.device,
            monitor=monitor,
            checkpoint_every=control.checkpoint_every,
            test_every=control.test_every,
            breakdown=control.breakdown,
            gpu_busy=control.gpu_busy,
            watcher=watcher,
        )
        trainer.run(resume)


def long_on_a_cpu(size: tuple[int, int], iterations: int) -> str:
    """Return what to try where training takes hours on a CPU, else nothing."""
    width, height = size
    if iterations * width * height <= LONG_ON_A_CPU:
        return ""
    return (
        f"without a GPU {iterations:,} iterations of {width}x{height} pixels can take hours; "
        "--resolution 1/4 --iterations 3000 takes minutes"
    )
