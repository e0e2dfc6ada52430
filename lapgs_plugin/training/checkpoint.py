"""Check a checkpoint's state, and the optimizer state of a coarser level, before training continues from them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import (
    AllowInfNan,
    ConfigDict,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveInt,
    TypeAdapter,
    ValidationError,
)
from torch import Tensor
from typing_extensions import NotRequired, TypedDict

from lapgs_plugin.errors import FieldError, RunFolderError, first_line
from lapgs_plugin.fields.gaussian_field import SPLAT_NAMES, GaussianField, field_from_splats
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.training.settings import PLANNED, TrainSettings
from lapgs_plugin.untrusted import problem

ADVICE = "delete it to continue from the last finished level"
MOMENTS = {"step", "exp_avg", "exp_avg_sq"}
"""Adam's state of a parameter after its first step."""
_STRICT = ConfigDict(strict=True, extra="forbid", arbitrary_types_allowed=True)

Moments = dict[str, dict[str, Tensor]]
Seconds = Annotated[NonNegativeFloat, AllowInfNan(False)]


class _State(TypedDict):
    __pydantic_config__ = _STRICT  # type: ignore[misc]  # what pydantic documents


class CountsState(_State):
    """Values of a `stages.record.LoopCounts`."""

    iteration: NonNegativeInt
    seconds: Seconds
    peak_gaussians: NonNegativeInt
    gaussian_steps: NonNegativeInt
    start_gaussians: NonNegativeInt | None


class BudgetState(_State):
    """Result of `time_budget.StageBudget.state`; seconds are below 0 after the end."""

    planned: PositiveInt
    stage_seconds: Annotated[float, AllowInfNan(False)]
    run_seconds: Annotated[float, AllowInfNan(False)]


class GainsState(_State):
    """Result of `gains.StageGains.state`."""

    planned: PositiveInt
    looks: list[tuple[PositiveInt, list[Annotated[float, AllowInfNan(False)]]]]
    decided: PositiveInt | None
    expected: Annotated[float, AllowInfNan(False)] | None


class ModelState(_State):
    """Result of `model.TrainableField.state`."""

    params: dict[str, Tensor]
    moments: Moments
    signed: bool


class TransformsState(_State):
    """Result of `stages.view_transforms.ViewTransforms.state`."""

    transforms: Tensor
    gradient: Tensor | None
    moments: dict[str, Tensor]


class BestState(_State):
    """The best state of a stage so far, with --keep best."""

    psnr: float
    iteration: PositiveInt
    model: ModelState
    joint: dict[int, ModelState] | None
    appearance: TransformsState | None
    poses: NotRequired[TransformsState | None]


class StageState(_State):
    """Result of `stage.StageRun.state`, and the overhead so far; the loss is NaN before the first iteration."""

    level: NonNegativeInt
    counts: CountsState
    loss: float
    most_views: PositiveInt | None
    least_sh_degree: NotRequired[NonNegativeInt]
    breakdown: dict[str, Seconds]
    budget: BudgetState | None
    gains: GainsState | None
    model: ModelState
    densifier: dict[str, Any]
    joint: NotRequired[dict[int, ModelState] | None]
    appearance: NotRequired[TransformsState | None]
    poses: NotRequired[TransformsState | None]
    best: NotRequired[BestState]
    random: Tensor
    random_gpu: NotRequired[Tensor]
    overhead: dict[str, Seconds]


def check_checkpoint(
    state: dict[str, Any], path: Path, stage: Stage, settings: TrainSettings, finished: Collection[int]
) -> None:
    """Check that a stage can continue from a checkpoint.

    Args:
        state: of the checkpoint.
        path: of its file, for the message.
        stage: to continue, as planned.
        settings: of the run.
        finished: levels of the run.

    Raises:
        RunFolderError: it is damaged, or of another stage.
    """
    try:
        _STATE.validate_python(state)
        _check_state(state, stage, settings, finished)
    except ValidationError as error:
        raise RunFolderError(f"{path} is damaged: {problem(error)}; {ADVICE}") from None
    except (FieldError, ValueError) as error:
        raise RunFolderError(f"{path} is damaged: {error}; {ADVICE}") from error


def check_densifier(state: Mapping[str, Any], fresh: Mapping[str, Any], count: int, path: Path) -> None:
    """Check the state of density control against the state that it starts with.

    Args:
        state: from a checkpoint.
        fresh: of the same strategy before its first iteration.
        count: number of Gaussians in the field.
        path: of the checkpoint, for the message.

    Raises:
        RunFolderError: it belongs to another strategy or field.
    """
    right = state.keys() == fresh.keys()
    for name in fresh if right else ():
        value, first = state[name], fresh[name]
        if first is None:
            right = right and (value is None or _has_rows(value, count))
        else:
            right = right and type(value) is type(first) and math.isfinite(value)
    if not right:
        raise RunFolderError(
            f"{path} is damaged: densifier is not the state of this run's density control for {count} Gaussians; "
            f"{ADVICE}"
        )


def check_transforms(state: TransformsState | None, shape: torch.Size | None, name: str, path: Path) -> None:
    """Check the state of the learned transforms of the training views.

    Args:
        state: from a checkpoint; None without transforms.
        shape: of the transforms; None if the run has none.
        name: of the state in the checkpoint, for the message.
        path: of the checkpoint, for the message.

    Raises:
        RunFolderError: it is of another number of views, or damaged.
    """
    if state is None and shape is None:
        return
    right = (
        state is not None
        and _is_finite(state["transforms"], shape, torch.float32)
        and (state["gradient"] is None or _is_finite(state["gradient"], shape, torch.float32))
        and state["moments"].keys() in (set(), MOMENTS)
        and all(_is_moment(key, tensor, shape) for key, tensor in state["moments"].items())
    )
    if not right:
        raise RunFolderError(
            f"{path} is damaged: {name} is not the state of transforms for {shape[0] if shape else 0} views; {ADVICE}"
        )


def check_moments(moments: Any, field: GaussianField, path: Path) -> None:
    """Check the optimizer state of a finished level against its field.

    Raises:
        RunFolderError: it is damaged, or belongs to another field.
    """
    try:
        _MOMENTS.validate_python(moments)
        _check_moments(moments, _shapes(field))
    except ValidationError as error:
        raise RunFolderError(f"{path} is damaged: {problem(error)}; start again with --overwrite") from None
    except ValueError as error:
        raise RunFolderError(f"{path} is damaged: {error}; start again with --overwrite") from error


def _check_state(state: dict[str, Any], stage: Stage, settings: TrainSettings, finished: Collection[int]) -> None:
    """Check the parts of a state against each other and the run; raises ValueError."""
    decided = _decided_length(state, stage, settings)
    if decided is not None:
        stage = replace(stage, iterations=decided)
    iteration, joint_from = state["counts"]["iteration"], settings.joint_from(stage)
    if state["level"] != stage.level:
        raise ValueError(f"level is {state['level']}, expected {stage.level}")
    if iteration > (most := stage.iterations + settings.extension_of(stage)):
        raise ValueError(f"counts.iteration is {iteration}, expected at most {most}")
    _check_model(state["model"], "model", stage.signed, settings.sh_degree_of(stage.level))
    joint = state.get("joint") or {}
    began = iteration >= joint_from if joint_from is not None else False
    if decided is not None and joint_from is not None:
        began = bool(joint)  # the stage may have become longer or shorter since
    wanted = set(finished) - {stage.level} if began else set()
    if joint.keys() != wanted:
        raise ValueError(f"joint has levels {sorted(joint)}, expected {sorted(wanted)}")
    _check_joint(joint, "joint", settings)
    if (best := state.get("best")) is not None:
        if best["iteration"] > iteration:
            raise ValueError(f"best.iteration is {best['iteration']}, expected at most {iteration}")
        _check_model(best["model"], "best.model", stage.signed, settings.sh_degree_of(stage.level))
        _check_joint(best["joint"] or {}, "best.joint", settings)
    random = state["random"]
    if random.dtype != torch.uint8 or random.shape != torch.get_rng_state().shape:
        raise ValueError(f"random is {_described(random)}, expected a state of PyTorch's generator")
    try:
        torch.Generator().set_state(random)
    except RuntimeError as error:
        raise ValueError(f"random is no state of PyTorch's generator ({first_line(error)})") from error


def _decided_length(state: dict[str, Any], stage: Stage, settings: TrainSettings) -> int | None:
    """Return the stage's length so far, if it is decided while it trains; raises ValueError."""
    budget, gains = state["budget"], state["gains"]
    if budget is not None and settings.time is None:
        raise ValueError(f"budget is {budget}, expected none without --time")
    if gains is not None and settings.stop == PLANNED:
        raise ValueError("gains has measurements, expected none without --stop auto")
    if gains is None and settings.stops_early and stage.level == settings.levels - 1:
        raise ValueError("gains is None, expected measurements with --stop auto")
    last = budget or gains
    return None if last is None else int(last["planned"])


def _check_joint(models: Mapping[int, dict[str, Any]], name: str, settings: TrainSettings) -> None:
    """Check the fields of coarser levels."""
    for level, model in models.items():
        _check_model(model, f"{name}.{level}", model["signed"], settings.sh_degree_of(level))


def _check_model(model: dict[str, Any], name: str, signed: bool, sh_degree: int) -> None:
    """Check a field and Adam's state of it."""
    params = model["params"]
    field = field_from_splats(params, model["signed"])
    shapes = _shapes(field)
    if field.signed != signed or field.sh_degree != sh_degree:
        raise ValueError(
            f"{name} is {'a residual' if field.signed else 'no residual'} of SH degree {field.sh_degree}, expected "
            f"{'a residual' if signed else 'none'} of degree {sh_degree}"
        )
    for part, tensor in params.items():
        if not _is_finite(tensor, shapes.get(part), torch.float32):
            expected = f"finite float32 {shapes.get(part)}"
            raise ValueError(f"{name}.params.{part} is {_described(tensor)}, expected {expected}")
    try:
        _check_moments(model["moments"], {part: shapes[part] for part in params})
    except ValueError as error:
        raise ValueError(f"{name}.moments: {error}") from error


def _check_moments(moments: Moments, shapes: Mapping[str, torch.Size]) -> None:
    """Check Adam's state against the shapes of the parameters; SH may be one tensor or two."""
    others = set(SPLAT_NAMES)
    if moments.keys() not in ({*others, "sh"}, {*others, "sh0", "shN"}) or not moments.keys() <= shapes.keys():
        raise ValueError(f"Adam's state is of {', '.join(sorted(map(str, moments)))}, expected {', '.join(shapes)}")
    for name, state in moments.items():
        if state and state.keys() != MOMENTS:
            raise ValueError(f"{name} has {', '.join(sorted(state))}, expected {', '.join(sorted(MOMENTS))}")
        for key, tensor in state.items():
            if not _is_moment(key, tensor, shapes[name]):
                shape = () if key == "step" else tuple(shapes[name])
                raise ValueError(f"{name}.{key} is {_described(tensor)}, expected finite float32 {shape}")


def _shapes(field: GaussianField) -> dict[str, torch.Size]:
    """Return the shape of each parameter by gsplat's names."""
    values = {theirs: field.parameters[ours].shape for theirs, ours in SPLAT_NAMES.items()}
    return {**values, "sh": field.sh.shape, "sh0": field.sh[:, :1].shape, "shN": field.sh[:, 1:].shape}


def _is_moment(key: str, value: Tensor, shape: torch.Size | None) -> bool:
    """Return whether a tensor can be an entry of Adam's state of a parameter of that shape."""
    fits = _is_finite(value, torch.Size([]) if key == "step" else shape, torch.float32)
    return fits and (key == "exp_avg" or not bool((value < 0).any()))


def _is_finite(value: Any, shape: torch.Size | None, dtype: torch.dtype) -> bool:
    """Return whether it is a tensor of that shape and type without NaN and inf."""
    return (
        isinstance(value, Tensor)
        and value.shape == shape
        and value.dtype == dtype
        and bool(torch.isfinite(value).all())
    )


def _has_rows(value: Any, count: int) -> bool:
    """Return whether it is a tensor of so many rows, of any type, without NaN and inf."""
    return isinstance(value, Tensor) and value.shape[:1] == (count,) and bool(torch.isfinite(value).all())


def _described(value: Tensor) -> str:
    """Return type and shape of a tensor for a message."""
    return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"


_STATE: TypeAdapter[Any] = TypeAdapter(StageState)
_MOMENTS: TypeAdapter[Any] = TypeAdapter(Moments, config=_STRICT)
