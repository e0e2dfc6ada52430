"""Make what a stage starts with: its field, the finished fields to train jointly, colours and poses of photos."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.inheritance import field_from_points, inherit
from lapgs_plugin.hierarchy.plan import Stage, continues_field
from lapgs_plugin.hierarchy.settings import AUTO
from lapgs_plugin.runs.layout import OPTIMIZER
from lapgs_plugin.runs.profiling import Overhead
from lapgs_plugin.scenes.exposure import measure_exposure
from lapgs_plugin.training.checkpoint import check_moments
from lapgs_plugin.training.context import RunContext
from lapgs_plugin.training.exposure import DIFFERENT, ViewExposures, from_gains, identities, start_from
from lapgs_plugin.training.joint import JointFields
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.poses import ViewPoses
from lapgs_plugin.training.settings import OFF


def first_model(context: RunContext, stage: Stage) -> TrainableField:
    """Return the field that a stage starts from: its own to be extended, the previous level's or the point cloud's."""
    archive, settings = context.archive, context.settings
    if context.record_to_extend(stage) is not None:
        return context.model(archive.field(stage.level))
    if continues_field(stage, context.plan.levels):
        field = archive.field(stage.level + 1)
        model = context.model(field)
        model.adopt_moments(_moments(context, stage.level + 1, field), torch.arange(len(field)))
        return model
    if not stage.signed:
        return context.model(_field_of_points(context, stage) if context.first_field is None else context.first_field)
    generator = torch.Generator().manual_seed(settings.seed)
    coarser = archive.field(stage.level + 1)
    field, kept = inherit(coarser, settings.inherit_mode, settings.inherit_ratio, generator, settings.sh_degree)
    model = context.model(field)
    if settings.inherit_mode == "full":
        model.adopt_moments(_moments(context, stage.level + 1, coarser), kept)
    return model


def _field_of_points(context: RunContext, stage: Stage) -> GaussianField:
    scene, settings = context.scene, context.settings
    points = field_from_points(scene.points, scene.colors, settings.sh_degree_of(stage.level))
    return settings.densification.options.start(points, len(scene.train))


def _moments(context: RunContext, level: int, field: GaussianField) -> dict[str, Any]:
    """Return Adam's state that the next level inherits from a finished one with its field."""
    moments = context.archive.optimizer_state(level)
    check_moments(moments, field, context.archive.path(f"level_{level}", OPTIMIZER))
    return moments


def joint_fields(context: RunContext, poses: ViewPoses | None, states: dict[int, dict[str, Any]] | None) -> JointFields:
    """Return the finished fields for joint training, from a checkpoint's `JointFields.state` or the archive."""

    def model(level: int) -> TrainableField:
        return context.model(context.archive.field(level)) if states is None else context.restored_model(states[level])

    views = (*context.scene.train, *context.scene.test, *context.aside)
    return JointFields(
        models={level: model(level) for level in context.archive.available_levels if level > 0},
        cameras={view.name: view.camera for view in views},
        rasterizer=context.rasterizer,
        background=context.background,
        pyramid=context.pyramid,
        poses=poses,
    )


def first_poses(context: RunContext, stage: Stage) -> ViewPoses | None:
    """Return the corrections of poses that a stage starts with; None if the run does not refine poses."""
    if not context.settings.refine_poses:
        return None
    levels, scene, done = context.archive.available_levels, context.scene, context.plan.iterations_before(stage.level)
    start = (context.archive.poses(levels[-1]) if levels else None) or {}
    return ViewPoses.create(scene.train, start, scene.extent, context.device, done, context.plan.iterations)


def first_exposures(
    context: RunContext, stage: Stage, checkpoint: dict[str, Any] | None, overhead: Overhead
) -> ViewExposures | None:
    """Return the colour transforms that a stage starts with; None if the run does not compensate exposure."""
    names, levels = [view.name for view in context.scene.train], context.archive.available_levels
    start: Tensor | None
    if levels:
        archived = context.archive.exposure(levels[-1])
        start = None if archived is None else start_from(archived, names)
    elif checkpoint is not None:  # `StageRun.restore` has the values
        start = None if checkpoint.get("exposure") is None else identities(len(names))
    else:
        with overhead.timed("exposure"):
            start = _measured_exposures(context)
    if start is None:
        return None
    done = context.plan.iterations_before(stage.level)
    return ViewExposures.create(names, start, context.device, done, context.plan.iterations)


def _measured_exposures(context: RunContext) -> Tensor | None:
    """Return the colour transforms (v, 3, 4) that a run starts with, as --exposure says and the photos differ."""
    choice = context.settings.exposure
    if choice == OFF or not context.supervision.composes:
        return None
    measured = measure_exposure(context.scene)
    found, differ = f"{measured.spread:.2f} stops between photos", measured.spread >= DIFFERENT
    if choice == AUTO and not differ:
        return None
    context.monitor.say(
        f"exposure differs by {found}: each photo gets a colour transform; --exposure off trains without"
        if differ
        else f"exposure differs by {found}, hardly at all; each photo gets a colour transform all the same"
    )
    return from_gains(measured.gains) if differ else identities(len(context.scene.train))
