"""Train with the built-in trainer: `lapgs train`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lapgs_plugin.cli.bridge import given_options, takes_settings
from lapgs_plugin.cli.config_file import ConfigOption, extended_config, write_config
from lapgs_plugin.cli.output import log_to_stderr, make_console
from lapgs_plugin.cli.rehearsal import Rehearsal
from lapgs_plugin.cli.viewing import ViewOptions, watching
from lapgs_plugin.errors import RunFolderError, UserInputError, errors_about
from lapgs_plugin.files import write_text
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.options import option, option_values
from lapgs_plugin.runs.layout import RUN_CONFIG, TENSORBOARD, require_place
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
MINUTES_ON_A_CPU = "--resolution 1/4 --iterations 3000"
"""Options that are proposed there."""


@dataclass(frozen=True)
class StartOptions:
    """Choose whether a run is new, continued or replaced, and whether it is shown meanwhile.

    Raises:
        UserInputError: options that contradict each other.
    """

    resume: bool = option(
        False,
        "Continue the run in --out with its settings. A finished run is extended if --iterations is more than it has.",
    )
    overwrite: bool = option(False, "Replace the run in --out.")
    viewing: ViewOptions = field(default_factory=ViewOptions)

    def __post_init__(self) -> None:
        if self.resume and self.overwrite:
            raise UserInputError("--resume and --overwrite contradict each other; give one of them")


@takes_settings
def train(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene folder: COLMAP, Blender or nerfstudio.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Run folder to write.")],
    *,
    settings: TrainSettings,
    photos: SceneOptions,
    start: StartOptions,
    config: ConfigOption = None,
    control: TrainingControl,
) -> None:
    """Train a scene coarse to fine with the built-in trainer, on a GPU (gsplat) or a CPU.

    Each level trains at twice the image size of the level before.

    Examples:

        lapgs train data/garden -o runs/garden --eval

        lapgs train data/garden -o runs/small --resolution 1/4 --iterations 3000

        lapgs train data/garden -o runs/plain --levels 1    # a single field

        lapgs train data/garden -o runs/nested --hierarchy nested    # one PLY

        lapgs train data/garden -o runs/garden --resume    # after Ctrl-C

        lapgs train data/garden -o runs/garden --resume --iterations 40000

        lapgs train --config runs/garden/run.toml -o runs/again --seed 1
    """
    from lapgs_plugin.scenes.masks import resolve_masks

    log_to_stderr("%(message)s")
    watcher = context.with_resource(watching(start.viewing, out.absolute().name))
    reference = _reference(scene, photos)
    if isinstance(context.obj, Rehearsal):
        context.obj.train(settings, reference, control.rasterizer)
        return
    reference = replace(reference, masks=resolve_masks(scene, photos.masks))
    _require_measuring(settings, control)
    given = given_options(context)
    if start.resume:
        given = {name for name in given if name not in CHOSEN_ONCE or context.params[name] != AUTO}
        archive, loaded, settings = _resume(out, scene, _wanted(reference, settings, control.rasterizer), given)
    else:
        choose = "iterations" not in given
        archive, loaded, settings = _create(out, reference, settings, control.rasterizer, start.overwrite, choose)
        write_config(archive.path(RUN_CONFIG), context, masks=reference.masks, iterations=settings.iterations)
    with archive:
        _run(archive, loaded, settings, control, resume=start.resume, watcher=watcher)
    _finish(out, scene)


def _reference(scene: Path, photos: SceneOptions) -> SceneReference:
    """Return the scene's folder as it was typed, and how it is read; the scene is not read yet."""
    from lapgs_plugin.runs.manifest import SceneReference

    return SceneReference(
        *(str(scene), photos.resolution, photos.eval, photos.background_color),
        images=photos.images,
        kind="",
        masks=photos.masks,
    )


def _require_measuring(settings: TrainSettings, control: TrainingControl) -> None:
    """Check that this machine can log and measure as asked."""
    from lapgs_plugin.runs.gpu_busy import require_cuda
    from lapgs_plugin.training.backend import choose_rasterizer, training_rasterizer
    from lapgs_plugin.training.tensorboard import require_tensorboard

    if control.log is not None:
        require_tensorboard()
    if control.gpu_busy:
        require_cuda(training_rasterizer(choose_rasterizer(control.rasterizer), settings).device)


def _finish(out: Path, scene: Path) -> None:
    """Render a preview of the run from its scene's folder, and say what can be done with it."""
    from rich.markup import escape

    from lapgs_plugin.viewer.preview import save_run_preview

    save_run_preview(out, moved_to=scene)
    name, word = escape(str(out)), escape(shlex.quote(str(out)))
    make_console(stderr=True).print(
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
    from lapgs_plugin.files import MANIFEST, one_line_errors
    from lapgs_plugin.rendering.run import load_reference, require_same_scene
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.training.backend import training_rasterizer
    from lapgs_plugin.training.planning import check_storage, make_plan

    with one_line_errors(out, "read"):
        begun = (out / MANIFEST).is_file()
    if not begun:
        raise RunFolderError(f"{out} is not a run, so there is nothing to continue; leave --resume out to start one")
    archive = RunArchive.open(out, resume=True)
    try:
        manifest = archive.manifest
        _require_same_folder(out, Path(manifest.scene.path), scene)
        settings = settings_from_manifest(manifest, str(archive.path(MANIFEST)))
        if manifest.complete:
            settings = _extended(archive, settings, int(wanted["iterations"]) if "iterations" in given else None)
            given = given - {"iterations"}
        _require_same(out, given, wanted, _wanted(manifest.scene, settings, manifest.rasterizer))
        anew = {name: wanted[name] for name in MAY_CHANGE if name in given}
        settings = replace(settings, **anew)
        try:
            check_storage(settings, training_rasterizer(manifest.rasterizer, settings).device)
        except UserInputError as error:
            if anew:
                raise
            raise UserInputError(f"{archive.path(MANIFEST)}: {error}") from error
        with errors_about(archive.path(MANIFEST)):
            loaded = load_reference(replace(manifest.scene, path=str(scene)), hold=settings.images_on != "disk")
        require_same_scene(archive, scene, loaded.smallest_size)
        with errors_about(archive.path(MANIFEST)):
            make_plan(loaded.smallest_size, settings, len(loaded.train))
    except BaseException:
        archive.close()
        raise
    return archive, loaded, settings


def _require_same_folder(out: Path, before: Path, scene: Path) -> None:
    """Refuse another scene than that of the run, which may have been moved."""
    if before.exists() and scene.exists() and not before.samefile(scene):
        raise UserInputError(
            f"{scene}: the run in {out} was started with the scene {before}; give that one to continue it, or start "
            "again with --overwrite"
        )


def _require_same(out: Path, given: set[str], wanted: Mapping[str, Any], started_with: Mapping[str, Any]) -> None:
    """Refuse given options that are not those of the run."""
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


def _extended(archive: RunArchive, settings: TrainSettings, asked: int | None) -> TrainSettings:
    """Return the settings of a finished run with the iterations to which it is extended, if it is.

    Raises:
        UserInputError: not more iterations than it has, or others than those of its interrupted extension.
    """
    from lapgs_plugin.runs.layout import CHECKPOINT

    begun, done, run = archive.extends_to, settings.iterations, archive.path()
    if asked is not None and begun not in (None, asked):
        raise UserInputError(
            f"--iterations {asked}: the run in {run} is being extended to {begun}; leave the option out to continue "
            f"that, or delete {archive.path(CHECKPOINT)} to extend the finished run anew"
        )
    if asked is not None and asked < done:  # a run killed after its last iteration has `asked`
        raise UserInputError(f"--iterations {asked}: the run in {run} is finished with {done}; give more to extend it")
    goal = asked or begun or done
    if goal == done:
        make_console(stderr=True).print(
            f"{run} is finished with {done:,} iterations; --resume --iterations and a larger number extends it",
            markup=False,
            soft_wrap=True,
        )
    return replace(settings, iterations=goal, extended=settings.extended + goal - done)


def _create(
    out: Path,
    reference: SceneReference,
    settings: TrainSettings,
    rasterizer: str,
    overwrite: bool,
    choose_iterations: bool,
) -> tuple[RunArchive, Scene, TrainSettings]:
    """Read the scene, choose iterations if that is asked, and check the settings before the run folder is made."""
    from lapgs_plugin.rendering.run import load_reference
    from lapgs_plugin.runs.archive import RunArchive
    from lapgs_plugin.runs.manifest import Manifest
    from lapgs_plugin.training.backend import choose_rasterizer, training_rasterizer
    from lapgs_plugin.training.planning import check_storage, make_plan, require_pruning

    RunArchive.require_room(out, overwrite)
    require_place(out)
    rasterizer = choose_rasterizer(rasterizer)
    check_storage(settings, training_rasterizer(rasterizer, settings).device)
    chosen = settings

    def check(size: tuple[int, int], photos: int) -> None:
        nonlocal chosen
        chosen = (_for_photos(photos, settings) if choose_iterations else settings).for_size(size)
        require_pruning(make_plan(size, chosen, photos), chosen)

    loaded = load_reference(reference, check, hold=settings.images_on != "disk")
    found = replace(reference, path=str(Path(reference.path).absolute()), kind=loaded.kind, unit=loaded.unit)
    manifest = Manifest(scene=found, rasterizer=rasterizer, **chosen.for_manifest())
    return RunArchive.create(out, manifest, overwrite), loaded, chosen


def _for_photos(photos: int, settings: TrainSettings) -> TrainSettings:
    """Return `TrainSettings.for_photos`, and say if a run on few photos gets shorter by it."""
    chosen = settings.for_photos(photos)
    if chosen != settings:
        make_console(stderr=True).print(
            f"{photos} training photos: {chosen.iterations:,} iterations, {chosen.iterations // photos} passes over "
            "them; more gain little with so few photos, and --iterations asks for another number",
            soft_wrap=True,
        )
    return chosen


def _run(
    archive: RunArchive,
    scene: Scene,
    settings: TrainSettings,
    control: TrainingControl,
    *,
    resume: bool,
    watcher: Watcher,
) -> None:
    """Train with a progress display."""
    import torch

    from lapgs_plugin.jit.threads import one_pool
    from lapgs_plugin.training.backend import training_rasterizer
    from lapgs_plugin.training.monitor import Monitor, ProgressMonitor
    from lapgs_plugin.training.planning import make_plan
    from lapgs_plugin.training.tensorboard import TensorboardMonitor
    from lapgs_plugin.training.trainer import Trainer

    if control.threads is not None:
        torch.set_num_threads(control.threads)
    console, manifest = make_console(stderr=True), archive.manifest
    _say_masked(console, scene, manifest.scene.masks)
    placed = training_rasterizer(manifest.rasterizer, settings)
    if placed.device.type == "cpu" and (hint := long_on_a_cpu(scene.smallest_size, settings.iterations)):
        console.print(hint, soft_wrap=True)
    config = extended_config(archive.path(RUN_CONFIG), settings) if resume and settings.extended else None
    with one_pool(), ExitStack() as opened:
        monitor: Monitor = opened.enter_context(ProgressMonitor(console, manifest.levels))
        if control.log is not None:
            plan = make_plan(scene.smallest_size, settings, len(scene.train))
            monitor = opened.enter_context(TensorboardMonitor(archive.path(TENSORBOARD), plan, monitor))
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
    if config is not None:
        write_text(archive.path(RUN_CONFIG), config)


def _say_masked(console: Console, scene: Scene, masks_from: str) -> None:
    """Print the share of the pixels inside masks, if there are masks."""
    from lapgs_plugin.scenes.masks import share_inside

    views = (*scene.train, *scene.test)
    if any(view.masked for view in views):
        share = share_inside(view.mask for view in views)
        console.print(f"masks ({masks_from}): {share:.0%} of the pixels are trained on and measured", markup=False)


def long_on_a_cpu(size: tuple[int, int], iterations: int) -> str:
    """Return what to try where training takes hours on a CPU, else nothing."""
    width, height = size
    if iterations * width * height <= LONG_ON_A_CPU:
        return ""
    return (
        f"without a GPU {iterations:,} iterations of {width}x{height} pixels can take hours; "
        f"{MINUTES_ON_A_CPU} takes minutes"
    )
