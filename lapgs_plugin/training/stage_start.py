"""Make the things a stage starts with: field, images, finished fields to train jointly, colours and poses of photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.inheritance import field_from_points
from lapgs_plugin.hierarchy.plan import Stage, continues_field
from lapgs_plugin.hierarchy.settings import AFFINE, AUTO, BILATERAL
from lapgs_plugin.ops.mixed_sizes import largest_size
from lapgs_plugin.registry import NONE
from lapgs_plugin.rendering.hierarchy_renderer import HierarchyRenderer
from lapgs_plugin.rendering.run import refined_views
from lapgs_plugin.runs.image_store import eight_bit_levels
from lapgs_plugin.runs.layout import OPTIMIZER
from lapgs_plugin.runs.profiling import Overhead
from lapgs_plugin.runs.run_files import Falloffs
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from lapgs_plugin.scenes.exposure import SparseColors, colors_at, measure_exposure, sparse_colors
from lapgs_plugin.scenes.parallel import MOST_READERS, ahead, readers_of
from lapgs_plugin.scenes.scene import View
from lapgs_plugin.scenes.vignetting import measure_vignetting
from lapgs_plugin.stages.appearance import DIFFERENT, KINDS, ViewAppearance, ViewColors, from_gains, identities
from lapgs_plugin.stages.geometry import StageGeometry, at_level, depths_of, skies_of
from lapgs_plugin.stages.images import StageImages
from lapgs_plugin.training.checkpoint import check_moments
from lapgs_plugin.training.joint import JointFields
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.monitor import Monitor
from lapgs_plugin.training.poses import ViewPoses
from lapgs_plugin.training.prepared_run import PreparedRun
from lapgs_plugin.training.views import level_views


def first_model(run: PreparedRun, stage: Stage) -> TrainableField:
    """Return the field that a stage starts from: its own to be extended, the previous level's or the point cloud's."""
    archive, settings = run.archive, run.settings
    if run.record_to_extend(stage) is not None:
        return run.model(archive.field(stage.level))
    if continues_field(stage, run.plan.levels):
        field = archive.field(stage.level + 1)
        model = run.model(field)
        model.adopt_moments(_moments(run, stage.level + 1, field), run.sharding.rows(len(field)))
        return model
    if not stage.signed:
        return run.model(_field_of_points(run, stage) if run.first_field is None else run.first_field)
    coarser = archive.field(stage.level + 1)
    field, kept = run.inherited(coarser, settings.sh_degree)
    model = run.model(field)
    if settings.inherit_mode == "full":
        model.adopt_moments(_moments(run, stage.level + 1, coarser), kept[run.sharding.rows(len(kept))])
    return model


def _field_of_points(run: PreparedRun, stage: Stage) -> GaussianField:
    scene, settings = run.scene, run.settings
    points = field_from_points(scene.points, scene.colors, settings.sh_degree_of(stage.level))
    # Along rays nothing blurs Gaussians, and tiny ones, as many photos start with, would be between most rays.
    photos = 0 if settings.distorted else len(scene.train)
    return settings.densification.options.start(points, photos)


def _moments(run: PreparedRun, level: int, field: GaussianField) -> dict[str, Any]:
    """Return Adam's state that the next level inherits from a finished one with its field."""
    moments = run.archive.optimizer_state(level)
    check_moments(moments, field, run.archive.path(f"level_{level}", OPTIMIZER))
    return moments


def photos_of(run: PreparedRun, stage: Stage) -> StageImages:
    """Return the images of a stage with the photos of its training views, on a CPU as float32.

    Photos on the disk stay in their own files where a stage needs no more than what they hold.
    """
    views, on_gpu = run.owned(run.scene.train), run.device.type == "cuda"
    files = {view.name: file for view in views if (file := view.photo_file) is not None}
    on_disk = len(files) == len(views)
    has_levels = on_gpu and on_disk and all(ahead(lambda file: file.has_levels, files.values(), most=MOST_READERS))
    eight_bit = on_gpu and stage.level == 0 and (has_levels or _are_eight_bit(views))
    masked = any(view.masked for view in run.scene.train)  # on every rank or on none
    images = StageImages(run, stage, sizes_of(views), eight_bit=eight_bit, masked=masked, exact=not on_gpu)
    if images.photos.takes_readers and on_disk and has_levels == on_gpu:
        for view in views:
            file = files[view.name]
            images.photos.put_reader(view.name, view.camera.size, file.levels if has_levels else file)
        return images

    def pixels(view: View) -> tuple[str, Tensor, Tensor | None]:
        return view.name, files[view.name].levels() if has_levels else view.image, view.mask

    for name, image, mask in ahead(pixels, views, most=readers_of(view.camera.size for view in views)):
        images.photos.put(name, image, mask)
    return images


def _are_eight_bit(views: Sequence[View]) -> bool:
    readers = readers_of(view.camera.size for view in views)
    return all(ahead(lambda view: eight_bit_levels(view.image) is not None, views, most=readers))


def predict_views(run: PreparedRun, stage: Stage, images: StageImages, overhead: Overhead) -> None:
    """Cache predictions I_hat^(l+1) of all views, at their refined poses, for the residual stage of level l."""
    coarser, whole = stage.level + 1, HierarchyRenderer.from_archive(run.archive, run.rasterizer, run.device)
    renderer = replace(whole, fields={level: run.sharding.dealt(field) for level, field in whole.fields.items()})

    def cached(views: Sequence[View], name: str, where: str) -> UpsampledImages:
        cameras = {view.name: view.camera for view in refined_views(run.archive, views)}
        idle = run.sharding.idle_rounds(len(views))
        predictions = images.cache(
            coarser, name, sizes_of(views), lambda view: renderer.images([cameras[view]], coarser)[0], where
        )
        for _ in range(idle):  # other ranks have more views
            renderer.images([run.scene.train[0].camera], coarser)
        return predictions

    where = run.settings.images_on
    with overhead.timed("cache"):
        images.predictions = cached(run.owned(run.scene.train), "train", where)
    # Held-out views are rarely used, outside the clock: a GPU needs its memory for others.
    with overhead.timed("evaluation"):
        images.held_out = cached(run.owned((*run.scene.test, *run.aside)), "test", "memory" if where == AUTO else where)


def sizes_of(views: Sequence[View]) -> dict[str, tuple[int, int]]:
    """Return (width, height) of views by name."""
    return {view.name: view.camera.size for view in views}


def joint_fields(run: PreparedRun, poses: ViewPoses | None, states: dict[int, dict[str, Any]] | None) -> JointFields:
    """Return the finished fields for joint training, from a checkpoint's `JointFields.state` or the archive."""

    def model(level: int) -> TrainableField:
        return run.model(run.archive.field(level)) if states is None else run.restored_model(states[level])

    views = (*run.scene.train, *run.scene.test, *run.aside)
    levels = [level for level in run.archive.available_levels if level > 0]
    return JointFields(
        models={level: model(level) for level in levels},
        cameras={view.name: view.camera for view in views},
        rasterizer=run.rasterizer,
        background=run.background,
        poses=poses,
        skies={level: sky for level in levels if (sky := _geometry(run, run.plan[level], jointly=True)) is not None},
    )


def first_poses(run: PreparedRun, stage: Stage) -> ViewPoses | None:
    """Return the corrections of poses that a stage starts with; None if the run does not refine poses."""
    if not run.settings.refine_poses:
        return None
    levels, scene, done = run.archive.available_levels, run.scene, run.plan.iterations_before(stage.level)
    start = (run.archive.poses(levels[-1]) if levels else None) or {}
    return ViewPoses.create(scene.train, start, scene.extent, run.device, done, run.plan.iterations)


def stage_geometry(run: PreparedRun, stage: Stage) -> StageGeometry | None:
    """Return the supervision of depth, normals and sky in a stage, if there is any; a residual has no depth."""
    return _geometry(run, stage, jointly=False)


def _geometry(run: PreparedRun, stage: Stage, *, jointly: bool) -> StageGeometry | None:
    views = run.owned(run.scene.train)
    cameras = {view.name: view.camera for view in level_views(views, stage.level)}
    with_depth = not (stage.signed or jointly)
    depths = depths_of(run.depth, cameras, run.device) if with_depth and run.depth is not None else {}
    normals = at_level(run.normals, cameras, run.device) if with_depth else {}
    skies = skies_of(views, cameras, run.device)
    return StageGeometry(run.rasterizer, depths, normals, skies) if depths or normals or skies else None


def first_appearance(
    run: PreparedRun, stage: Stage, checkpoint: dict[str, Any] | None, overhead: Overhead, monitor: Monitor
) -> tuple[ViewAppearance | None, Falloffs]:
    """Return the transforms of the training views' images that a stage starts with, and the falloffs of all views.

    None without transforms.
    """
    names, levels, choice = (
        [view.name for view in run.scene.train],
        run.archive.available_levels,
        run.settings.appearance,
    )
    if choice == NONE or not run.supervision.composes:
        return None, {}
    kind, falloffs = KINDS[AFFINE if choice == AUTO else choice], run.archive.vignetting()
    size = largest_size([view.camera.size for view in run.scene.train])
    start: Tensor | None
    if levels:
        start = kind.read(run.archive, levels[-1], names)
    elif checkpoint is not None:  # `StageRun.restore` has the values
        start = None if checkpoint.get("appearance") is None else kind.uniform(identities(len(names)), size)
    else:
        with overhead.timed("appearance"):
            seen = _sparse_colors(run)
            colors = _measured_colors(run, seen, monitor)
            # Where nothing else is compensated, the field stays one that photos can be compared with as they are.
            falloffs = {} if colors is None else _measured_falloffs(run, seen, monitor)
        start = None if colors is None else kind.uniform(colors, size)
    if start is None:
        return None, falloffs
    done = run.plan.iterations_before(stage.level)
    appearance = kind.create(names, start, run.device, done, run.plan.iterations)
    if run.part_of_views and isinstance(appearance, ViewColors):  # the identity is the mean of all views
        appearance.centre = start.mean(dim=0).to(run.device)
    return appearance, falloffs


def _sparse_colors(run: PreparedRun) -> SparseColors | None:
    """Look up sparse points in the photos of all ranks."""

    def look_up(points: Tensor) -> list[tuple[Tensor, Tensor]]:
        views = run.owned(run.scene.train)
        readers = readers_of(view.camera.size for view in views)
        names = [view.name for view in views]
        own = dict(zip(names, ahead(partial(colors_at, points=points), views, most=readers), strict=True))
        seen = {name: colors for one in run.ranks.gathered(own) for name, colors in one.items()}
        return [seen[view.name] for view in run.scene.train]

    return sparse_colors(run.scene, look_up)


def _measured_falloffs(run: PreparedRun, seen: SparseColors | None, monitor: Monitor) -> Falloffs:
    """Measure how much the photos' corners are darker, and archive it."""
    falloffs = measure_vignetting(run.scene, seen)
    run.archive.write_vignetting(falloffs)
    if falloffs:
        most = -min(falloffs.values())
        monitor.say(
            f"the corners of photos are darker by {most:.2f} stops: levels are trained without that; --appearance none "
            "trains them with it"
        )
    return falloffs


def _measured_colors(run: PreparedRun, seen: SparseColors | None, monitor: Monitor) -> Tensor | None:
    """Return the photos' colour transforms (v, 3, 4) by their measured exposure; None if none are to be learned."""
    choice, measured = run.settings.appearance, measure_exposure(run.scene, seen)
    spread, differ = f"{measured.spread:.2f} stops between photos", measured.spread >= DIFFERENT
    if choice == AUTO and not differ:
        return None
    learned = "a bilateral grid" if choice == BILATERAL else "a colour transform"
    monitor.say(
        f"exposure differs by {spread}: each photo gets {learned}; --appearance none trains without"
        if differ
        else f"exposure differs by {spread}, hardly at all; each photo gets {learned} all the same"
    )
    return from_gains(measured.gains) if differ else identities(len(run.scene.train))
