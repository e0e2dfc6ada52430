"""Prepare a run of the built-in trainer: decide and check what a user asked for, before anything is written."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from statistics import fmean
from typing import Any
from zlib import crc32

import torch

from lapgs_plugin import __version__
from lapgs_plugin.errors import RunFolderError, UserInputError, counted, errors_about
from lapgs_plugin.files import MANIFEST, one_line_errors
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.hooks import hooks_line
from lapgs_plugin.options import option_values
from lapgs_plugin.rasterizers.choice import PlacedRasterizer
from lapgs_plugin.rendering.run import load_reference, require_same_scene
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.gpu_busy import require_cuda
from lapgs_plugin.runs.layout import CHECKPOINT, require_place, require_room
from lapgs_plugin.runs.manifest import Manifest, SceneReference
from lapgs_plugin.scenes.depth import load_depth, resolve_depth
from lapgs_plugin.scenes.masks import NONE, resolve_masks, resolve_sky, share_inside
from lapgs_plugin.scenes.normals import load_normals, resolve_normals
from lapgs_plugin.scenes.options import SceneOptions
from lapgs_plugin.scenes.scene import Scene, View, count_photos, held_views
from lapgs_plugin.training.backend import long_on_a_cpu, training_rasterizer
from lapgs_plugin.training.planning import make_plan, require_pruning
from lapgs_plugin.training.prepared_run import PreparedRun, own_names, split_aside
from lapgs_plugin.training.ranks.archive import open_for
from lapgs_plugin.training.ranks.equality import require_same, source_checksum
from lapgs_plugin.training.ranks.group import ALONE, Ranks
from lapgs_plugin.training.ranks.steps import steps_of
from lapgs_plugin.training.rate import views_per_second
from lapgs_plugin.training.saved_settings import settings_from_manifest
from lapgs_plugin.training.settings import BEST, TrainingControl, TrainSettings
from lapgs_plugin.training.tensorboard import require_tensorboard
from lapgs_plugin.training.time_budget import LEAST_LEFT, cost_of, parse_duration, require_time_left

MAY_CHANGE = ("images_on", "prediction_precision", "time")
"""Settings that may change when a run is continued."""

logger = logging.getLogger(__name__)

Say = Callable[[str], None]
"""Receives one line of text for the user."""


@dataclass(frozen=True)
class TrainRequest:
    """Hold what a user asks of a run.

    Attributes:
        scene: the scene folder.
        out: the run folder.
        settings: of the run. One that is continued keeps its own, but for more iterations and `MAY_CHANGE`.
        photos: how the scene is read.
        control: how the run is executed and observed.
        resume: continue the run in `out`; a finished one is extended if there are more iterations than it has, and an
            unfinished one that gets a time ends with it.
        overwrite: replace the run in `out`.
        chosen: options that the user chose, by parameter name. A run that is continued must have been started with the
            same. A new run on few photos gets fewer iterations if they are not among them, and one for a time or on
            large photos the strategy that auto means there.
        began: when the seconds of --time began, by `time.monotonic`.
        ranks: the processes that train it; all make the same request.
        shard: divide the Gaussians over them.

    Raises:
        UserInputError: two options contradict each other.
    """

    scene: Path | str
    out: Path | str
    settings: TrainSettings = field(default_factory=TrainSettings)
    photos: SceneOptions = field(default_factory=SceneOptions)
    control: TrainingControl = field(default_factory=TrainingControl)
    resume: bool = False
    overwrite: bool = False
    chosen: frozenset[str] = frozenset({"iterations", "strategy"})
    began: float = field(default_factory=time.monotonic)
    ranks: Ranks = ALONE
    shard: bool = False

    def __post_init__(self) -> None:
        if self.resume and self.overwrite:
            raise UserInputError("--resume and --overwrite contradict each other; give one of them")
        if (text := self.settings.time) is not None:
            if {"time", "iterations"} <= self.chosen:
                raise UserInputError(f"--time {text} with --iterations: both say how long to train; give one of them")
            if {"time", "stop"} <= self.chosen and self.settings.stop == AUTO:
                raise UserInputError(f"--time {text} with --stop auto: both say when to end; give one of them")
        open_end = "--stop auto" if self.settings.stops_early else None if text is None else f"--time {text}"
        if open_end is not None and self.control.gpu_busy:
            raise UserInputError(f"--gpu-busy with {open_end}: is measured in stages of a known length; leave it out")


def prepare(request: TrainRequest, say: Say = logger.info) -> AbstractContextManager[PreparedRun]:
    """Yield a run that is ready to train. Its folder is locked for writing inside the block.

    Everything that can be refused without the photos is refused before they are read. The folder of a new run is made
    last, with its manifest.

    Args:
        request: what the user asks for.
        say: receives what the user should know, such as fewer iterations for few photos.

    Raises:
        LapgsError: the request, the scene, the run folder or the machine does not allow the run.
    """
    photos, settings, ranks = request.photos, request.settings, request.ranks
    _require_one_process(ranks, settings)
    say = say if ranks.leads else _silent
    _require_same_command(request)
    depth = resolve_depth(Path(request.scene), settings.depth)
    normals = resolve_normals(Path(request.scene), settings.normals)
    if normals != NONE and depth == NONE:
        raise UserInputError(
            f"--normals {normals} without depth: normals alone leave surfaces where they are and make their distances "
            "worse; add --depth with a folder of maps, or --depth points"
        )
    request = replace(
        request, settings=replace(settings, depth=depth, normals=normals, ranks=max(settings.ranks, ranks.size))
    )
    masks = resolve_masks(Path(request.scene), photos.masks)
    reference = SceneReference(
        path=str(request.scene),
        resolution=photos.resolution,
        eval=photos.eval,
        background=photos.background_color,
        kind="",
        images=photos.images,
        masks=masks,
        sky=resolve_sky(Path(request.scene), photos.sky),
        distorted=settings.distorted,
    )
    if request.control.log is not None:
        require_tensorboard()
    return (_continued_run if request.resume else _new_run)(request, reference, say)


@contextmanager
def _new_run(request: TrainRequest, reference: SceneReference, say: Say) -> Iterator[PreparedRun]:
    """Yield a new run."""
    out, settings, ranks = Path(request.out), request.settings, request.ranks
    if ranks.leads:  # others would see the folder that it makes to try, and takes away
        require_room(out, request.overwrite)
        require_place(out)
    _require_shardable(request, settings, reference)
    placed = training_rasterizer(request.control.rasterizer, settings)
    _check_busy(request.control, placed, settings)
    ranks.use(placed.device)

    def decide(size: tuple[int, int], photos: int) -> None:
        nonlocal settings
        _require_views(ranks, photos)
        if (asked := settings.asked_views) is not None and not request.shard:
            _require_view_of_each(ranks, asked)
        if "iterations" not in request.chosen and (fewer := settings.for_photos(photos)) != settings:
            settings = fewer
            most = "at most " if settings.stops_early else ""
            say(
                f"{photos} training photos: {most}{settings.iterations:,} iterations, {settings.iterations // photos} "
                "passes over them; more gain little, and --iterations asks for another number"
            )
        if settings.time is not None:  # how long it may be is measured once the photos are read
            make_plan(size, settings, photos)
            return
        settings = settings.for_size(size, choose="strategy" not in request.chosen)
        require_pruning(make_plan(size, settings, photos), settings)

    scene = load_reference(reference, decide, **_reading(request, settings))
    _require_points(request, scene)
    if ranks.size > 1:  # before a run is replaced, too
        trained, aside = split_aside(scene, settings)
        steps = steps_of(
            len(trained.train), settings.seed, 0, settings.ranks, ranks, placed.device, sharded=request.shard
        )
        scene = _with_photos(scene, own_names(trained, aside, steps, ranks), settings, ranks)
    if settings.time is not None:
        settings = _fitted_into_time(request, scene, placed, say)
    depth = load_depth(scene, settings.depth, reference.images, say)
    normals = load_normals(scene, settings.normals, say)
    reference = replace(reference, path=str(scene.path.absolute()), kind=scene.kind, unit=scene.unit)
    manifest = Manifest(scene=reference, rasterizer=placed.rasterizer.name, **settings.for_manifest())
    _require_same_run(ranks, scene, settings)
    with open_for(ranks, out, lambda kind: kind.create(out, manifest, request.overwrite)) as archive:
        run = PreparedRun.of(
            scene,
            settings,
            archive,
            placed,
            request.control,
            began=request.began,
            depth=depth,
            normals=normals,
            ranks=ranks,
            shard=request.shard,
        )
        _require_views_of_steps(run)
        _say_about_photos(run, say)
        yield run


def _fitted_into_time(request: TrainRequest, scene: Scene, placed: PlacedRasterizer, say: Say) -> TrainSettings:
    """Return settings with about as many iterations as --time allows, from which the strategy and the split follow.

    Raises:
        UserInputError: too little time is left for training, or the settings do not go with so few iterations.
    """
    settings = request.settings
    assert settings.time is not None
    ranks, seconds = request.ranks, parse_duration(settings.time)
    rate = ranks.from_leader(ranks.size * views_per_second(scene, settings, placed))
    spent = ranks.from_leader(time.monotonic() - request.began)
    require_time_left(settings.time, spent, LEAST_LEFT)
    size = scene.smallest_size
    split = make_plan(size, settings.for_size(size))
    iterations = max(settings.levels, round(rate * (seconds - spent) * split.iterations / cost_of(split)))
    choose = "strategy" not in request.chosen
    settings = settings.lasting(iterations, choose).for_size(size, choose)
    require_pruning(make_plan(size, settings, len(scene.train)), settings)
    say(
        f"--time {settings.time}: {seconds - spent:.1f} s are left for training, about {iterations:,} iterations of "
        f"{rate:.3g} views a second measured on the points; the length of each level follows its rate"
    )
    return settings


@contextmanager
def _continued_run(request: TrainRequest, reference: SceneReference, say: Say) -> Iterator[PreparedRun]:
    """Yield the run in a folder, with those settings of `MAY_CHANGE` that the user chose, or with more iterations."""
    out, scene_folder = Path(request.out), Path(request.scene)
    with one_line_errors(out, "read"):
        begun = (out / MANIFEST).is_file()
    if not begun:
        raise RunFolderError(f"{out} is not a run, so there is nothing to continue; leave --resume out to start one")
    ranks = request.ranks
    with open_for(ranks, out, lambda kind: kind.open(out, resume=True)) as archive:
        manifest, file = archive.manifest, archive.path(MANIFEST)
        _require_same_folder(out, Path(manifest.scene.path), scene_folder)
        settings, changed = _continued_settings(request, reference, archive, say)
        began = request.began if changed.get("time") != settings.time and "time" in changed else None
        settings = replace(settings, **changed)
        _require_shardable(request, settings, manifest.scene)
        with nullcontext() if changed else errors_about(file):
            placed = training_rasterizer(manifest.rasterizer, settings)
        _check_busy(request.control, placed, settings)
        ranks.use(placed.device)
        with errors_about(file):
            here = replace(manifest.scene, path=str(scene_folder))
            scene = load_reference(here, lambda _, photos: _require_views(ranks, photos), **_reading(request, settings))
        require_same_scene(archive, scene_folder, scene.smallest_size)
        with errors_about(file):
            run = PreparedRun.of(
                scene,
                settings,
                archive,
                placed,
                request.control,
                resumes=True,
                began=began,
                depth=load_depth(scene, settings.depth, manifest.scene.images, say),
                normals=load_normals(scene, settings.normals, say),
                ranks=ranks,
                shard=request.shard,
            )
        _require_same_run(ranks, scene, settings)
        _require_views_of_steps(run)
        if ranks.size > 1:
            trained, aside = split_aside(_with_photos(scene, run.own, settings, ranks), settings)
            run = replace(run, scene=trained, aside=aside)
        if began is not None:
            archive.change_settings({"time": settings.time})
        if "ranks" in changed:
            archive.change_settings({"ranks": settings.ranks})
        _say_about_photos(run, say)
        yield run


def _continued_settings(
    request: TrainRequest, reference: SceneReference, archive: RunArchive, say: Say
) -> tuple[TrainSettings, dict[str, Any]]:
    """Return the settings with which a run continues, and those that change then.

    Raises:
        RunFolderError, UserInputError: the manifest is damaged, or the run was started with other options.
    """
    out, manifest, chosen = Path(request.out), archive.manifest, request.chosen
    settings = settings_from_manifest(manifest, str(archive.path(MANIFEST)))
    _require_one_process(request.ranks, settings)
    if manifest.complete:
        asked = request.settings.iterations if "iterations" in chosen else None
        _require_untimed(out, settings, request.settings, asked)
        if settings.stops_early:
            say(f"{out} is finished: its views set aside have ended it")
        elif settings.time is None:
            settings = extended_settings(archive, settings, asked, say)
        else:
            say(f"{out} is finished: its --time {settings.time} is over")
        chosen -= {"iterations"}
    wanted = _options(reference, request.settings, request.control.rasterizer)
    _require_same(out, chosen, wanted, _options(manifest.scene, settings, manifest.rasterizer))
    changed = {name: wanted[name] for name in MAY_CHANGE if name in chosen}
    if settings.ranks == 1 < request.ranks.size:  # from here on its sums are those of ranks
        changed["ranks"] = request.ranks.size
    return settings, changed


def _silent(_: str) -> None:
    """Tell the user nothing: rank 0 does."""


def _reading(request: TrainRequest, settings: TrainSettings) -> dict[str, bool]:
    """Return how `load_reference` reads photos: of several ranks, each reads its own later."""
    alone = request.ranks.size == 1
    return {"hold": alone and settings.images_on != "disk", "read": alone}


def _with_photos(scene: Scene, own: frozenset[str], settings: TrainSettings, ranks: Ranks) -> Scene:
    """Return the scene with the photos of this rank's `own` views in memory; those on the disk are only checked."""
    views = [view for view in (*scene.train, *scene.test) if view.name in own]
    held = held_views(views, hold=settings.images_on != "disk", progress=ranks.leads)
    by_name = {view.name: view for view in held}

    def read(views: Iterable[View]) -> tuple[View, ...]:
        return tuple(by_name.get(view.name, view) for view in views)

    return replace(scene, train=read(scene.train), test=read(scene.test))


def _require_views_of_steps(run: PreparedRun) -> None:
    """Check that every rank has a view of each step."""
    if run.ranks.size > 1:
        _require_view_of_each(run.ranks, min(run.schedule_of(stage).views for stage in run.plan))


def _require_shardable(request: TrainRequest, settings: TrainSettings, scene: SceneReference) -> None:
    """Refuse what a rank with some of the Gaussians cannot do."""
    if not request.shard:
        return
    if request.ranks.size == 1:
        raise UserInputError("--shard: divides the Gaussians over several ranks; add --gpus 2 or more")
    strategy = settings.densification
    unable = {
        f"--strategy {strategy.strategy}": not strategy.options.shards,
        f"--keep {settings.keep}": settings.keep == BEST,
        f"--prune {settings.prune:g}": settings.prune > 0.0,
        f"--depth {settings.depth}": settings.depth != NONE,
        f"--sky {scene.sky}": scene.sky != NONE,
        f"--time {settings.time}": settings.time is not None,
        "--distorted": settings.distorted,
        "--refine-poses": settings.refine_poses,
        "--sparse-adam": settings.sparse_adam,
        f"--hooks {settings.hooks} of installed packages": hooks_line(settings.hooks) is not None,
    }
    if asked := [option for option, given in unable.items() if given]:
        raise UserInputError(
            f"{', '.join(asked)} with --shard: cannot be done with Gaussians that are divided over ranks; leave one out"
        )


def _require_points(request: TrainRequest, scene: Scene) -> None:
    """Refuse more ranks than Gaussians to begin with."""
    if request.shard and (count := len(scene.points)) < request.ranks.size:
        raise UserInputError(
            f"{request.ranks.together} with --shard: the scene has {counted(count, 'point')} to start from; give at "
            "most so many ranks"
        )


def require_startable(ranks: Ranks, scene: Path, settings: TrainSettings, shard: bool) -> None:
    """Refuse ranks that `prepare` would refuse in each of them, as far as that is known before they are started.

    Raises:
        UserInputError: there are more of them than photos or views of a step, or an option is for one process.
    """
    _require_one_process(ranks, settings)
    if settings.asked_views is not None and not shard:
        _require_view_of_each(ranks, settings.asked_views)
    if (photos := count_photos(scene)) is not None and ranks.size > photos:
        raise UserInputError(
            f"{ranks.together}: the scene has {counted(photos, 'photo')}, and each rank needs one to train on; give "
            "fewer ranks"
        )


def _require_views(ranks: Ranks, photos: int) -> None:
    """Refuse more ranks than training photos."""
    if ranks.size > photos:
        raise UserInputError(f"{ranks.together}: the scene has {photos} training photos; give at most so many ranks")


def _require_view_of_each(ranks: Ranks, views: int) -> None:
    """Refuse more ranks than the views of a step."""
    if ranks.size > views:
        raise UserInputError(
            f"{ranks.together}: a step of this run has {counted(views, 'view')}, fewer than ranks; give at most so "
            "many ranks, or more --views-per-step"
        )


def _require_one_process(ranks: Ranks, settings: TrainSettings) -> None:
    """Refuse ranks with --stop auto: views that are given back would belong to other ranks than before."""
    if settings.stops_early and ranks.size > 1:
        raise UserInputError(f"{ranks.together} with --stop auto: ends runs of one process alone; leave one out")


def _require_same_command(request: TrainRequest) -> None:
    """Refuse ranks of other versions or options than rank 0; see `_require_same_run` for what follows from them."""
    if request.ranks.size == 1:
        return
    options = {
        **asdict(request.photos),
        **asdict(request.control),
        "out": str(request.out),
        "resume": request.resume,
        "overwrite": request.overwrite,
        "shard": request.shard,
    }
    versions = {"version": __version__, "checksum of its files": source_checksum()}
    require_same(request.ranks, {"lapgs_plugin": versions, "PyTorch": torch.__version__, "options": options})


def _require_same_run(ranks: Ranks, scene: Scene, settings: TrainSettings) -> None:
    """Refuse ranks whose scene or settings are not those of rank 0."""
    names = [(view.name, view.camera.size) for view in (*scene.train, *scene.test)]
    points = len(scene.points), crc32(scene.points.numpy().tobytes())
    require_same(ranks, {"photos": names, "points": points, "settings": settings.for_manifest()})


def _require_untimed(out: Path, settings: TrainSettings, wanted: TrainSettings, asked: int | None) -> None:
    """Refuse to extend a finished run by a time, or one that was trained for a time by iterations."""
    if wanted.time not in (None, settings.time):
        raise UserInputError(
            f"--time {wanted.time}: the run in {out} is finished; extend it by --iterations, or start again with "
            "--overwrite"
        )
    ended = "with --stop auto" if settings.stops_early else f"for --time {settings.time}"
    if asked is not None and (settings.time is not None or settings.stops_early):
        raise UserInputError(
            f"--iterations {asked}: the run in {out} was trained {ended}, and its schedule is over; "
            "start again with --overwrite"
        )


def _options(reference: SceneReference, settings: TrainSettings, rasterizer: str) -> dict[str, Any]:
    """Return the values that a run's result depends on, by option name."""
    return {**vars(reference), "rasterizer": rasterizer, **option_values(settings)}


def _check_busy(control: TrainingControl, placed: PlacedRasterizer, settings: TrainSettings) -> None:
    """Check that the GPU's busy time can be measured if that is asked."""
    if control.gpu_busy:
        require_cuda(placed.device)
        if settings.extended:
            raise UserInputError("--gpu-busy: is measured in whole stages, not when a run is extended; leave it out")


def _say_about_photos(run: PreparedRun, say: Say) -> None:
    """Say the share of their pixels inside masks and in the sky, and whether a CPU takes hours for so many."""
    views, scene = (*run.scene.train, *run.aside, *run.scene.test), run.archive.manifest.scene

    def mean(shares: Iterable[float]) -> tuple[float, int]:
        """Return the mean and the number of some shares of the views of all ranks."""
        known = list(chain.from_iterable(run.ranks.gathered([*shares])))
        return fmean(known), len(known)

    own = run.owned(views)  # masks of others would be read once more
    if scene.sky != NONE:
        share, count = mean(share_inside([sky]) for view in own if (sky := view.sky) is not None)
        say(f"sky ({scene.sky}): {count} of {len(views)} photos have a mask, {share:.0%} of their pixels are sky")
    if any(view.masked for view in views):
        share, _ = mean(share_inside([view.mask]) for view in own)
        masks = scene.masks if scene.sky == NONE else "and sky"
        masks = "of lenses" if masks == NONE else masks
        say(f"masks ({masks}): {share:.0%} of the pixels are trained on and measured")
    if scene.distorted:
        say(_about_lenses(run))
    size = run.plan[0].image_size
    if run.device.type == "cpu" and (hint := long_on_a_cpu(size, run.settings.iterations)):
        say(hint)


def _about_lenses(run: PreparedRun) -> str:
    """Return a line about what training on distorted photos costs."""
    views = (*run.scene.train, *run.aside, *run.scene.test)
    lenses = [view.camera.lens for view in views]
    fisheyes = sum(lens is not None and lens.fisheye for lens in lenses)
    others = sum(lens is not None for lens in lenses) - fisheyes
    by = "gsplat's unscented transform" if run.device.type == "cuda" else "a reference that is for small images"
    return (
        f"--distorted: {fisheyes} photos of fisheye and {others} of perspective lenses are trained on as they are. "
        f"Gaussians are evaluated along the rays of pixels by {by}, view by view, several times slower than pinholes; "
        "nothing is shown at 90 degrees from the axis and more"
    )


def _require_same_folder(out: Path, before: Path, scene: Path) -> None:
    """Refuse another scene than that of the run, which may have been moved."""
    if before.exists() and scene.exists() and not before.samefile(scene):
        raise UserInputError(
            f"{scene}: the run in {out} was started with the scene {before}; give that one to continue it, or start "
            "again with --overwrite"
        )


def _require_same(out: Path, chosen: frozenset[str], wanted: dict[str, Any], started_with: dict[str, Any]) -> None:
    """Refuse chosen options that are not those of the run."""
    for name in sorted(chosen & wanted.keys() - set(MAY_CHANGE)):
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


def extended_settings(
    archive: RunArchive, settings: TrainSettings, asked: int | None, say: Say = logger.info
) -> TrainSettings:
    """Return the settings of a finished run with the iterations to which it is extended, if it is.

    Args:
        archive: the finished run.
        settings: of its manifest.
        asked: iterations of the longer run; None continues an interrupted extension.
        say: receives a line if the run stays as it is.

    Raises:
        UserInputError: fewer iterations than it has, or others than those of its interrupted extension.
    """
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
        say(f"{run} is finished with {done:,} iterations; --resume --iterations and a larger number extends it")
    return replace(settings, iterations=goal, extended=settings.extended + goal - done)
