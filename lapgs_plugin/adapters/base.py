"""What every backbone of the 3DGS family has in common, and what an adapter has to say about one of them.

An adapter answers for one code base: how to recognise it, which of its symbols are wrapped and who uses them, what a
stage's arguments are, how a field gets in and out. `driver.py` does the rest and knows no backbone by name.
"""

from __future__ import annotations

import copy
import inspect
import logging
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.level_views import make_level_view
from lapgs_plugin.checkouts.script import Script
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.plan import Hierarchy, Stage, continues_field, nested_densify_until

logger = logging.getLogger(__name__)

LARGEST_OPACITY = 1 - 1e-6
"""Opacities are archived as logits; an activation without an upper limit is cut here."""

SPARSE_ADAM = "SparseGaussianAdam"
"""What the family's GaussianModel imports for `--optimizer_type sparse_adam`, if its rasterizer has it."""

PARAMETERS: dict[str, Callable[[GaussianField], Tensor]] = {
    "_xyz": lambda field: field.means,
    "_rotation": lambda field: field.quaternions,
    "_scaling": lambda field: field.log_scales,
    "_opacity": lambda field: field.opacity_logits[:, None],
    "_features_dc": lambda field: field.sh[:, :1],
    "_features_rest": lambda field: field.sh[:, 1:],
}
"""Attributes of the family's GaussianModel that hold parameters, and what they are of a GaussianField."""

GROUPS = {
    "xyz": "_xyz",
    "f_dc": "_features_dc",
    "f_rest": "_features_rest",
    "opacity": "_opacity",
    "scaling": "_scaling",
    "rotation": "_rotation",
}
"""The same attributes by the names of their groups in the family's optimizers."""


@dataclass(frozen=True)
class BackboneInfo:
    """What identifies a backbone.

    Attributes:
        name: for `--backbone` and the manifest.
        title: as its authors write it.
        rasterizer: the CUDA module it renders with.
        stand_in: the variant of `reference_raster.standins` that takes the module's place on a CPU.
        density_control: methods of its GaussianModel that add, remove or reset Gaussians.
        density_scores: functions of its script or utilities by whose scores density control decides.
        color_rates: its options that are learning rates of SH coefficients.
        densify_thresholds: its options that are thresholds on screen-space gradients for densification.
        raster_defaults: what its options set in the rasterizer unless a user says otherwise, where that changes the
            image and is not in `extensions.CONSTANTS`.
        telling_options: of the model, in the `cfg_args` that it writes and no other backbone does.
    """

    name: str
    title: str
    rasterizer: str
    stand_in: str
    density_control: tuple[str, ...]
    color_rates: tuple[str, ...]
    densify_thresholds: tuple[str, ...]
    density_scores: tuple[str, ...] = ()
    raster_defaults: Mapping[str, Any] = field(default_factory=dict)
    telling_options: tuple[str, ...] = ()


@dataclass(frozen=True)
class TrainingCall:
    """A call of the script's `training`, by parameter name."""

    function: Callable[..., Any]
    values: Mapping[str, Any]

    @classmethod
    def bind(cls, function: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> TrainingCall:
        bound = inspect.signature(function).bind(*args, **kwargs)
        bound.apply_defaults()
        return cls(function, dict(bound.arguments))

    @property
    def dataset(self) -> Any:
        return self.values["dataset"]

    @property
    def opt(self) -> Any:
        return self.values["opt"]

    @property
    def pipe(self) -> Any:
        return self.values["pipe"]

    def changed(self, **values: Any) -> TrainingCall:
        return replace(self, values={**self.values, **values})

    def run(self) -> None:
        self.function(**self.values)


@dataclass(frozen=True)
class StageWindow:
    """A stage and its place in the whole run.

    Attributes:
        stage: what is trained.
        start: iterations of the stages before it.
        total: iterations of the whole run, as the user asked for.
        levels: of the whole run.
        residual_color_rate: factor on the SH learning rates of residual stages.
        threshold_factor: factor on densification thresholds in this stage.
    """

    stage: Stage
    start: int
    total: int
    levels: int
    residual_color_rate: float
    threshold_factor: float

    @property
    def continues_field(self) -> bool:
        """Whether the field of the level before is trained on."""
        return continues_field(self.stage, self.levels)

    def scaled(self, iterations: int) -> int:
        """A constant of the whole run's schedule, as the same share of this stage."""
        return round(iterations * self.stage.iterations / self.total)

    def local(self, iterations: Iterable[int]) -> list[int]:
        """Those iterations of the whole run that fall into this stage, counted from its beginning."""
        return [i - self.start for i in iterations if self.start < i <= self.start + self.stage.iterations]


class BackboneAdapter(ABC):
    """One backbone, driven through the definitions of its training script.

    Args:
        script: its train.py, definitions executed.
    """

    info: ClassVar[BackboneInfo]

    def __init__(self, script: Script) -> None:
        self.script = script

    @classmethod
    def stand_in_for(cls, checkout: Path, arguments: Sequence[str]) -> str:
        """The variant of `reference_raster.standins` that a checkout wants.

        Args:
            checkout: its folder.
            arguments: of its script.
        """
        return cls.info.stand_in

    @staticmethod
    def saved_logits(stored: Tensor) -> Tensor:
        """(n,) logits of opacities from what a PLY that the backbone wrote calls opacity, (n,)."""
        return stored

    @property
    def train(self) -> ModuleType:
        """The training script's namespace."""
        return self.script.module

    @abstractmethod
    def render(self, call: TrainingCall, view: Any, gaussians: Any, background: Tensor) -> None:
        """Render a view as the script's training loop does; the image is picked up at the rasterizer."""

    @abstractmethod
    def raster_settings(self, call: TrainingCall) -> dict[str, Any]:
        """Settings of the rasterizer that the images depend on, for whoever renders the run later."""

    @abstractmethod
    def passes_dc_apart(self, call: TrainingCall) -> bool:
        """Whether the checkout's render gives its rasterizer the first SH coefficient by itself."""

    def refuse(self, call: TrainingCall, levels: int, hierarchy: Hierarchy) -> None:
        """Check that a hierarchy can honour the options of this call.

        Raises:
            UserInputError: it cannot; names the option, why, and what to do.
        """
        if call.values.get("checkpoint"):
            raise UserInputError(
                f"--start_checkpoint {call.values['checkpoint']}: a checkpoint holds one field, not a hierarchy; "
                "continue a run of ours with `lapgs run --resume`, or train with `lapgs run --off`"
            )
        adds = levels > 1 and hierarchy is Hierarchy.LAPLACIAN
        if adds and getattr(call.opt, "random_background", False):
            raise UserInputError(
                "--random_background: residual stages build on images rendered over one background; "
                "leave it out, or train with --levels 1 or --hierarchy nested"
            )
        model = sys.modules[self.train.GaussianModel.__module__]
        if getattr(call.opt, "optimizer_type", "default") == "sparse_adam" and not hasattr(model, SPARSE_ADAM):
            raise UserInputError(
                f"--optimizer_type sparse_adam: {model.__name__} found no {SPARSE_ADAM} to import; install a "
                "rasterizer that has it, as the checkout's README says, or leave the option out"
            )
        if call.pipe.convert_SHs_python and self.passes_dc_apart(call):
            raise UserInputError(
                "--convert_SHs_python: this checkout's render passes on SH that it has not read with that option, and "
                "fails without lapgs too; leave it out"
            )

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        """The arguments of one stage: the schedule scaled to its length, its own output folder, its color rates."""
        dataset, opt, pipe = copy.copy(call.dataset), copy.copy(call.opt), copy.copy(call.pipe)
        dataset.model_path = model_path
        opt.iterations = window.stage.iterations
        until = window.scaled(opt.densify_until_iter)
        opt.densify_until_iter = nested_densify_until(until) if window.continues_field else until
        opt.position_lr_max_steps = window.scaled(opt.position_lr_max_steps)
        for name in self.info.densify_thresholds:
            setattr(opt, name, getattr(opt, name) * window.threshold_factor)
        if window.stage.signed:
            # A white background would be added a second time, and would trigger an opacity reset of its own.
            dataset.white_background = False
            # The checkout's own conversion of SH in Python has no signed colour.
            pipe.convert_SHs_python = False
            for name in self.info.color_rates:
                setattr(opt, name, getattr(opt, name) * window.residual_color_rate)
        values: dict[str, Any] = {"dataset": dataset, "opt": opt, "pipe": pipe, "checkpoint": None}
        for name in ("testing_iterations", "saving_iterations", "checkpoint_iterations"):
            values[name] = window.local(call.values[name])
        debug_from = call.values["debug_from"]
        pipe.debug = pipe.debug or 0 <= debug_from < window.start
        values["debug_from"] = debug_from - window.start if debug_from >= window.start else -1
        return call.changed(**values)

    def replacements(self, window_of: Callable[[], StageWindow | None]) -> list[Replacement]:
        """Symbols to replace besides those that the driver replaces in every backbone.

        Args:
            window_of: gives the running stage, None between stages.
        """
        return []

    def level_view(  # noqa: B027 - most backbones have nothing else in a view
        self, view: Any, original: Any, size: tuple[int, int], signed: bool
    ) -> None:
        """Bring everything of a view besides its image to a level's size.

        Args:
            view: a copy of `original` with the level's width and height, to be changed.
            original: the checkout's camera of the full-size image.
            size: (width, height) of the level.
            signed: whether a residual is trained.
        """

    def first_points(self, count: int) -> None:  # noqa: B027 - few need it
        """Told how many points the scene comes with, before the first stage."""

    def stage_scene(self, scene: Any) -> None:  # noqa: B027 - few need it
        """Told of the scene that a stage trains on, before its first iteration."""

    def new_model(self, call: TrainingCall) -> Any:
        """A GaussianModel without Gaussians, as the script makes it."""
        return self.train.GaussianModel(call.dataset.sh_degree, *self.model_options(call))

    def model_of(self, call: TrainingCall, field: GaussianField) -> Any:
        """A GaussianModel of an archived field, to be rendered; its optimizer is not set up."""
        gaussians = self.new_model(call)
        self.import_field(gaussians, field)
        gaussians.active_sh_degree = field.sh_degree
        return gaussians

    def view_at(self, camera: Any, size: tuple[int, int], signed: bool, image: Callable[[], Tensor]) -> Any:
        """A camera of the checkout at a level's size.

        Args:
            camera: of the full-size image; left as it is.
            size: (width, height) of the level.
            signed: whether a residual is trained.
            image: gives the level's (3, height, width).
        """
        view = make_level_view(camera, size, image)
        self.level_view(view, camera, size, signed)
        return view

    def model_options(self, call: TrainingCall) -> tuple[Any, ...]:
        """What the script gives its GaussianModel after the SH degree."""
        return (call.opt.optimizer_type,)

    @torch.no_grad()
    def export_field(self, gaussians: Any, signed: bool) -> GaussianField:
        """The model's parameters as `snapshot` gives them, to be archived: says how many a PLY cannot hold."""
        if gaussians.opacity_activation is not torch.sigmoid:
            opacity = gaussians.get_opacity
            if cut := int((opacity > LARGEST_OPACITY).sum()):
                logger.warning(
                    "%d of %d Gaussians have opacities above 1, which a 3DGS PLY cannot hold: archived as 1",
                    cut,
                    len(opacity),
                )
        return self.snapshot(gaussians, signed)

    @torch.no_grad()
    def snapshot(self, gaussians: Any, signed: bool) -> GaussianField:
        """The model's parameters as a field on their device; shares no memory with the model."""
        if gaussians.opacity_activation is torch.sigmoid:
            logits = gaussians._opacity
        else:
            logits = torch.logit(gaussians.get_opacity.clamp(1e-6, LARGEST_OPACITY))
        return GaussianField(
            means=gaussians._xyz.detach().clone(),
            quaternions=gaussians._rotation.detach().clone(),
            log_scales=gaussians._scaling.detach().clone(),
            opacity_logits=logits.detach().clone().squeeze(-1),
            sh=torch.cat([gaussians._features_dc, gaussians._features_rest], dim=1),
            signed=signed,
        )

    @torch.no_grad()
    def import_field(self, gaussians: Any, field: GaussianField, attributes: Iterable[str] = tuple(PARAMETERS)) -> None:
        """Make parameters of the model those of a field.

        Args:
            gaussians: its optimizer is not set up yet.
            attributes: which, of `PARAMETERS`.
        """
        for name in attributes:
            setattr(
                gaussians,
                name,
                nn.Parameter(PARAMETERS[name](field).detach().clone().contiguous().requires_grad_(True)),
            )
        gaussians.max_radii2D = torch.zeros(len(field), device=field.means.device)

    def carried_over(self, gaussians: Any) -> dict[str, Any]:
        """Parameters that the next stage's model takes over besides its Gaussians."""
        return {}

    def optimizers(self, gaussians: Any) -> list[torch.optim.Optimizer]:
        """The optimizers that step Gaussians."""
        found = (getattr(gaussians, name, None) for name in ("optimizer", "shoptimizer"))
        return [optimizer for optimizer in found if optimizer is not None]
