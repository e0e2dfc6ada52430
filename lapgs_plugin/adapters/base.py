"""Describe a backbone of the 3DGS family to the runner, which drives all of them and knows none by name.

An adapter says how a checkout is recognised, which of its symbols are replaced besides the common ones, how a stage's
arguments differ from the run's, and how a field gets in and out of its model.

Imports no torch before a method needs it, so that checkouts are recognised quickly.
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
from typing import TYPE_CHECKING, Any, ClassVar

from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.script import Script
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.plan import Hierarchy, Stage

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from lapgs_plugin.fields.gaussian_field import GaussianField
    from lapgs_plugin.fields.rasterizer import Semantics

logger = logging.getLogger(__name__)

LARGEST_OPACITY = 1 - 1e-6
"""Opacity above which a field's opacities are cut: they are archived as logits."""

SPARSE_ADAM = "SparseGaussianAdam"
"""Name that the family's GaussianModel imports for `--optimizer_type sparse_adam`, if its rasterizer has it."""

FAMILY_FILES = ("train.py", "gaussian_renderer/__init__.py", "scene/gaussian_model.py")
"""Files of every checkout of the family, relative to its root."""

FAMILY_EXTENSIONS = {"simple_knn._C": "nearest neighbours", "fused_ssim": "fast SSIM"}
"""Compiled modules besides the rasterizer that training scripts of the family import, each with its purpose."""

PARAMETERS: dict[str, Callable[[GaussianField], Tensor]] = {
    "_xyz": lambda field: field.means,
    "_rotation": lambda field: field.quaternions,
    "_scaling": lambda field: field.log_scales,
    "_opacity": lambda field: field.opacity_logits[:, None],
    "_features_dc": lambda field: field.sh[:, :1],
    "_features_rest": lambda field: field.sh[:, 1:],
}
"""Parameters of the family's GaussianModel by attribute, each as a GaussianField has it."""

GROUPS = {
    "xyz": "_xyz",
    "f_dc": "_features_dc",
    "f_rest": "_features_rest",
    "opacity": "_opacity",
    "scaling": "_scaling",
    "rotation": "_rotation",
}
"""The same attributes by the names of their parameter groups in the family's optimizers."""


@dataclass(frozen=True)
class BackboneInfo:
    """Hold the facts about a backbone.

    Attributes:
        name: for `--backbone` and the manifest.
        title: as its authors write it.
        rasterizer: the CUDA module it renders with.
        stand_in: the variant of `reference_raster.standins` that takes the module's place on a CPU.
        density_control: methods of its GaussianModel that add, remove or reset Gaussians.
        color_rates: its options that are learning rates of SH coefficients.
        densify_thresholds: its options that are thresholds on screen-space gradients for densification.
        own_files: files of its checkout that tell it from other code bases, relative to the checkout's root.
        fork_of: names of backbones that may recognise its checkout, too, because it has files of theirs.
        density_scores: functions of its script or utilities whose scores density control uses.
        raster_defaults: settings of the rasterizer that its options have by default, where these change the image and
            differ from `extensions.CONSTANTS`.
        telling_options: options in the `cfg_args` file that no other backbone writes.
        unscaled: its options that count iterations in a stage of any length; see `checkouts.schedule`.
    """

    name: str
    title: str
    rasterizer: str
    stand_in: str
    density_control: tuple[str, ...]
    color_rates: tuple[str, ...]
    densify_thresholds: tuple[str, ...]
    own_files: tuple[str, ...] = ()
    fork_of: tuple[str, ...] = ()
    density_scores: tuple[str, ...] = ()
    raster_defaults: Mapping[str, Any] = field(default_factory=dict)
    telling_options: tuple[str, ...] = ()
    unscaled: tuple[str, ...] = ()

    @property
    def files(self) -> tuple[str, ...]:
        """Files that a checkout must have to be recognised."""
        return (*FAMILY_FILES, *self.own_files)

    @property
    def extensions(self) -> Mapping[str, str]:
        """Compiled modules that its training script imports, each with its purpose."""
        return {self.rasterizer: "rasterizer", **FAMILY_EXTENSIONS}

    def recognises(self, folder: Path) -> bool:
        """Return whether `folder` has all files of a checkout."""
        return all((folder / name).is_file() for name in self.files)

    def is_fork_of(self, other: BackboneInfo) -> bool:
        """Return whether a checkout that both recognise is this one's."""
        return other.name in self.fork_of or set(other.files) < set(self.files)


@dataclass(frozen=True)
class TrainingCall:
    """Hold a call of the script's `training` with its arguments by parameter name."""

    function: Callable[..., Any]
    values: Mapping[str, Any]

    @classmethod
    def bind(cls, function: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> TrainingCall:
        """Return the call `function(*args, **kwargs)`, defaults included."""
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
        """Return the call with other values of some arguments."""
        return replace(self, values={**self.values, **values})

    def run(self) -> None:
        """Make the call."""
        self.function(**self.values)


@dataclass(frozen=True)
class StageWindow:
    """Place a stage in the whole run.

    Attributes:
        stage: the stage.
        start: number of iterations before it.
        total: number of iterations of the whole run, as the user asked for.
        levels: number of levels of the whole run.
        residual_color_rate: factor on the SH learning rates of residual stages.
        threshold_factor: factor on densification thresholds in this stage.
    """

    stage: Stage
    start: int
    total: int
    levels: int
    residual_color_rate: float
    threshold_factor: float

    def scaled(self, iterations: int) -> int:
        """Return a number of iterations of the whole run's schedule as the same share of this stage."""
        return round(iterations * self.stage.iterations / self.total)

    def local(self, iterations: Iterable[int]) -> list[int]:
        """Return the iterations of the whole run that fall into this stage, counted from its beginning."""
        return [i - self.start for i in iterations if self.start < i <= self.start + self.stage.iterations]


class BackboneAdapter(ABC):
    """Adapt one backbone, given the definitions of its training script.

    Args:
        script: its train.py, whose definitions have been executed.
    """

    info: ClassVar[BackboneInfo]

    def __init__(self, script: Script) -> None:
        self.script = script

    @classmethod
    def stand_in_for(cls, checkout: Path, arguments: Sequence[str]) -> str:
        """Return the variant of `reference_raster.standins` for a checkout's rasterizer.

        Args:
            checkout: the checkout's folder.
            arguments: arguments of its script.
        """
        return cls.info.stand_in

    @classmethod
    def rasterizer_semantics(cls) -> Semantics | None:
        """Return where the CUDA module departs from the oracle by design; None if another backbone describes it."""
        return None

    @staticmethod
    def saved_logits(stored: Tensor) -> Tensor:
        """Return the logits of opacities (n,), given the property "opacity" (n,) of a PLY that the backbone wrote."""
        return stored

    @property
    def train(self) -> ModuleType:
        """The training script's namespace."""
        return self.script.module

    @abstractmethod
    def render(self, call: TrainingCall, view: Any, gaussians: Any, background: Tensor) -> None:
        """Render a view as the script's training loop does. The runner takes the image at the rasterizer."""

    @abstractmethod
    def raster_settings(self, call: TrainingCall) -> dict[str, Any]:
        """Return the settings of the rasterizer that change images, to render the run later."""

    @abstractmethod
    def passes_dc_apart(self, call: TrainingCall) -> bool:
        """Return whether the checkout's render passes the first SH coefficient (DC) as an argument of its own."""

    def refuse(self, call: TrainingCall, levels: int, hierarchy: Hierarchy) -> None:
        """Refuse options of this call that a hierarchy cannot honour.

        Raises:
            UserInputError: there is one; the line says why, and what to do.
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
        """Return the call for one stage: schedule scaled to its length, its own output folder, its learning rates."""
        dataset, opt, pipe = copy.copy(call.dataset), copy.copy(call.opt), copy.copy(call.pipe)
        dataset.model_path = model_path
        opt.iterations = window.stage.iterations
        opt.densify_until_iter = window.scaled(opt.densify_until_iter)
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
        """Return the symbols to replace besides those that the runner replaces in every backbone.

        Args:
            window_of: returns the running stage, None between stages.
        """
        return []

    def level_view(  # noqa: B027 - most backbones have nothing else in a view
        self, view: Any, original: Any, size: tuple[int, int], signed: bool
    ) -> None:
        """Bring everything of a view but its image to a level's size.

        Args:
            view: a copy of `original` with the level's width and height, to be changed.
            original: the checkout's camera of the full-size image.
            size: (width, height) of the level.
            signed: whether a residual is trained.
        """

    def first_points(self, count: int) -> None:  # noqa: B027 - few need it
        """Receive the number of points of the scene, before the first stage."""

    def stage_scene(self, scene: Any) -> None:  # noqa: B027 - few need it
        """Receive the scene that a stage trains on, before its first iteration."""

    def resume(self, call: TrainingCall, gaussians: Any, iteration: int) -> None:  # noqa: B027 - few need it
        """Bring a model to the state that its class has after an iteration of the whole run, besides its parameters.

        Args:
            call: the call of the script's `training` that continues after `iteration`.
            gaussians: the checkout's model, with parameters, optimizer state and SH degree of that iteration.
            iteration: the last finished one.

        Raises:
            UserInputError: the checkout cannot continue there.
        """

    def new_model(self, call: TrainingCall) -> Any:
        """Return a GaussianModel without Gaussians, made as the script makes it."""
        return self.train.GaussianModel(call.dataset.sh_degree, *self.model_options(call))

    def model_of(self, call: TrainingCall, field: GaussianField) -> Any:
        """Return a GaussianModel of a field for rendering; its optimizer is not set up."""
        gaussians = self.new_model(call)
        self.import_field(gaussians, field)
        gaussians.active_sh_degree = field.sh_degree
        return gaussians

    def view_at(self, camera: Any, size: tuple[int, int], signed: bool, image: Callable[[], Tensor]) -> Any:
        """Return a copy of a checkout's camera at a level's size.

        Args:
            camera: the camera of the full-size image.
            size: (width, height) of the level.
            signed: whether a residual is trained.
            image: returns the level's image (3, height, width).
        """
        from lapgs_plugin.checkouts.level_views import make_level_view

        view = make_level_view(camera, size, image)
        self.level_view(view, camera, size, signed)
        return view

    def model_options(self, call: TrainingCall) -> tuple[Any, ...]:
        """Return the arguments of the script's GaussianModel after the SH degree."""
        return (call.opt.optimizer_type,)

    def export_field(self, gaussians: Any, signed: bool) -> GaussianField:
        """Return the model's parameters as `snapshot` does, and warn of opacities that a PLY cannot hold."""
        import torch

        with torch.no_grad():
            if gaussians.opacity_activation is not torch.sigmoid:
                opacity = gaussians.get_opacity
                if cut := int((opacity > LARGEST_OPACITY).sum()):
                    logger.warning(
                        "%d of %d Gaussians have opacities above 1, which a 3DGS PLY cannot hold: archived as 1",
                        cut,
                        len(opacity),
                    )
            return self.snapshot(gaussians, signed)

    def snapshot(self, gaussians: Any, signed: bool) -> GaussianField:
        """Return a copy of the model's parameters as a field on their device."""
        import torch

        from lapgs_plugin.fields.gaussian_field import GaussianField

        with torch.no_grad():
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

    def import_field(self, gaussians: Any, field: GaussianField, attributes: Iterable[str] = tuple(PARAMETERS)) -> None:
        """Set parameters of the model to those of a field.

        Args:
            gaussians: the model, whose optimizer is not set up yet.
            field: the field.
            attributes: parameters to set, of `PARAMETERS`.
        """
        import torch

        for name in attributes:
            value = PARAMETERS[name](field).detach().clone().contiguous()
            setattr(gaussians, name, torch.nn.Parameter(value))
        gaussians.max_radii2D = torch.zeros(len(field), device=field.means.device)

    def carried_over(self, gaussians: Any) -> dict[str, Any]:
        """Return parameters besides its Gaussians that the next stage's model takes over, by attribute."""
        return {}

    def optimizers(self, gaussians: Any) -> list[torch.optim.Optimizer]:
        """Return the optimizers that step Gaussians."""
        found = (getattr(gaussians, name, None) for name in ("optimizer", "shoptimizer"))
        return [optimizer for optimizer in found if optimizer is not None]
