"""Drive any checkout of the 3DGS family, and describe a backbone to the runner, which knows none by name.

An adapter says how a checkout is recognised, which of its symbols are replaced besides the common ones, how a stage's
arguments differ from the run's, and how a field gets in and out of its model. What can be found out from the checkout
itself is in its profile, so an adapter overrides only what is particular about its backbone.

Imports no torch before a method needs it, so that checkouts are recognised quickly.
"""

from __future__ import annotations

import copy
import inspect
import logging
import sys
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

from lapgs_plugin.adapters.info import BackboneInfo
from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.checkouts.profile import Profile
from lapgs_plugin.checkouts.script import Script
from lapgs_plugin.checkouts.source import readable_source
from lapgs_plugin.checkouts.training_call import CHECKPOINTS, StageWindow, TrainingCall
from lapgs_plugin.errors import UserInputError, typed_line

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

OF_A_CALL = {
    "image_height", "image_width", "tanfovx", "tanfovy", "bg", "viewmatrix", "projmatrix", "sh_degree", "campos",
    "scale_modifier", "prefiltered", "debug", "lambda_dssim", "depth_threshold",
}  # fmt: skip
"""Settings of rasterizers that are no property of a run."""

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

FLAT_AXES = 2
"""Number of scales of flat Gaussians."""

FLAT_SCALE = -14.0
"""Logarithm of the third scale of Gaussians that have two: thinner than a millionth of the scene's unit."""


class BackboneAdapter:
    """Drive a checkout, given the definitions of its training script.

    Args:
        script: its train.py, whose definitions have been executed.
    """

    info: ClassVar[BackboneInfo]

    def __init__(self, script: Script) -> None:
        self.script = script

    @cached_property
    def profile(self) -> Profile:
        """What was found in the checkout; to be asked for before any of its symbols is replaced."""
        return Profile(self.script)

    @property
    def root(self) -> Path:
        """Folder of the checkout."""
        return self.profile.source.root

    @property
    def rasterizer(self) -> str:
        """Module that the training loop renders with."""
        rasterizers = self.profile.rasterizers
        return rasterizers[0].use.module if rasterizers else self.info.rasterizer

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        """Return whether `folder` is the root of a checkout of this backbone.

        A fork that kept a file of this one but renders with other settings is not.
        """
        if not cls.info.recognises(folder):
            return False
        source = readable_source(folder)
        passed = set[str]() if source is None else {name for use in source.rasterizers for name in use.settings}
        return not passed or passed >= cls.info.raster_defaults.keys()

    @classmethod
    def stand_in_for(cls, checkout: Path, arguments: Sequence[str]) -> str:
        """Return the variant of `family` for a checkout's rasterizer.

        Args:
            checkout: root of the checkout.
            arguments: arguments of its script.

        Raises:
            MissingExtraError: there is none; see `fitting_stand_in`.
        """
        from lapgs_plugin.checkouts.stand_in import fitting_stand_in

        return fitting_stand_in(checkout, cls.info.stand_in)

    @classmethod
    def rasterizer_semantics(cls) -> Semantics | None:
        """Return where the CUDA module departs from the oracle by design; None if another backbone describes it."""
        return None

    @classmethod
    def saved_field(cls, path: Path) -> GaussianField:
        """Return the field in a PLY that the backbone wrote, as its own render shows it.

        Raises:
            FieldError: as `GaussianField.load_ply`.
        """
        from lapgs_plugin.fields.gaussian_field import GaussianField

        return GaussianField.load_ply(path)

    @property
    def train(self) -> ModuleType:
        """The training script's namespace."""
        return self.script.module

    def render(self, call: TrainingCall, view: Any, gaussians: Any, background: Tensor) -> None:
        """Render a view as the script's training loop does. The runner takes the image at the rasterizer."""
        # Exposure is left out: images are taken before it is applied.
        self.profile.render(call.values, view, gaussians, background, use_trained_exp=False)

    def raster_settings(self, call: TrainingCall) -> dict[str, Any]:
        """Return the settings of the rasterizer that the script has options for, such as antialiasing."""
        names = {name for use in self.profile.source.rasterizers for name in use.settings} - OF_A_CALL
        values = {
            name: getattr(of, name) for of in (call.dataset, call.opt, call.pipe) for name in names if hasattr(of, name)
        }
        return {name: value for name, value in sorted(values.items()) if isinstance(value, (bool, int, float))}

    def refuse(self, call: TrainingCall, residuals: bool) -> None:
        """Refuse options of this call that a hierarchy cannot honour; `residuals` says whether it has any.

        Raises:
            UserInputError: there is one; the line says why, and what to do.
        """
        if call.checkpoint:
            raise UserInputError(
                f"--start_checkpoint {call.checkpoint}: a checkpoint holds one field, not a hierarchy; "
                "continue a run of ours with `lapgs run --resume`, or train with `lapgs run --off`"
            )
        if residuals and getattr(call.opt, "random_background", False):
            raise UserInputError(
                "--random_background: residual stages build on images rendered over one background; "
                "leave it out, or train with --levels 1 or --hierarchy nested"
            )
        model = sys.modules[self.profile.model.__module__]
        if getattr(call.opt, "optimizer_type", "default") == "sparse_adam" and not hasattr(model, SPARSE_ADAM):
            raise UserInputError(
                f"--optimizer_type sparse_adam: {model.__name__} found no {SPARSE_ADAM} to import; install a "
                "rasterizer that has it, as the checkout's README says, or leave the option out"
            )
        if getattr(call.pipe, "convert_SHs_python", False) and self._passes_dc_apart(call):
            raise UserInputError(
                "--convert_SHs_python: this checkout's render passes on SH that it has not read with that option, and "
                "fails without lapgs too; leave it out"
            )
        self._try_lpips(call)

    def _try_lpips(self, call: TrainingCall) -> None:
        """Compute an LPIPS if reports will: the first one downloads networks, and would do so hours into training."""
        import torch

        due = [i for i in call.test_iterations if 0 < i <= call.opt.iterations]
        lpips = getattr(self.train, "lpips", None)
        if not due or not inspect.isfunction(lpips):  # a module of that name has classes of its own
            return
        image = torch.zeros(1, 3, 64, 64)
        try:
            with torch.no_grad(), torch.random.fork_rng():  # initial weights are random
                lpips(image, image, net_type="vgg")
        except Exception as error:  # a missing package, a failed download, a damaged file: any would stop training
            raise UserInputError(
                f"--test_iterations {' '.join(map(str, due))}: the checkout computes LPIPS then, which fails now "
                f"already ({typed_line(error)}); "
                "mend that, or leave these reports out with --test_iterations -1 if the script adds none of its own: "
                "`lapgs eval` measures the run"
            ) from error

    def _passes_dc_apart(self, call: TrainingCall) -> bool:
        """Return whether the checkout's render passes the first SH coefficient (DC) as an input of its own."""
        if not any("dc" in rasterizer.use.inputs for rasterizer in self.profile.rasterizers[:1]):
            return False
        asked = self.profile.loop_argument("separate_sh", call.values)
        return bool(getattr(call.pipe, "separate_sh", True) if asked is None else asked)

    def densify_thresholds(self, opt: Any) -> list[str]:
        """Return the names of options that are thresholds on screen-space gradients for densification."""
        return list(self.info.densify_thresholds or _options(opt, "grad", "thresh"))

    def stage_call(self, call: TrainingCall, window: StageWindow, model_path: str) -> TrainingCall:
        """Return the call for one stage: schedule scaled to its length, its own output folder, its learning rates."""
        call = (self.call_of_residuals(call) if window.stage.signed else call).copied(parsed=True)
        dataset, opt, pipe = call.dataset, call.opt, call.pipe
        dataset.model_path = model_path
        opt.iterations = window.stage.iterations
        for name in ("densify_until_iter", "position_lr_max_steps"):
            if hasattr(opt, name):
                setattr(opt, name, window.scaled(getattr(opt, name)))
        for name in self.densify_thresholds(opt):
            if not hasattr(opt, name):
                raise UserInputError(
                    f"--backbone {self.info.name}: the script has no option {name}, which densify_thresholds names; "
                    "correct the adapter, or choose another with --backbone"
                )
            setattr(opt, name, getattr(opt, name) * window.threshold_factor)
        if window.stage.signed:
            # A white background would be added a second time, and would trigger an opacity reset of its own.
            dataset.white_background = False
            # A residual's opacity says where detail is missing, not where surfaces are.
            for options in (opt, *(value for value in call.values.values() if isinstance(value, Namespace))):
                for name in _options(options, "depth", "weight"):
                    setattr(options, name, 0.0)
            for name in _options(opt, "feature", "_lr"):
                setattr(opt, name, getattr(opt, name) * window.residual_color_rate)
        debug_from = call.values.get("debug_from", -1)
        pipe.debug = getattr(pipe, "debug", False) or 0 <= debug_from < window.start
        debug_from = debug_from - window.start if debug_from >= window.start else -1
        return call.changed(debug_from=debug_from, **dict.fromkeys(CHECKPOINTS)).listing(window.local)

    def call_of_residuals(self, call: TrainingCall) -> TrainingCall:
        """Return the call by which residuals are rendered."""
        pipe = copy.copy(call.pipe)
        # The checkout's own conversion of SH in Python has no signed colour.
        pipe.convert_SHs_python = False
        return call.changed(pipe=pipe)

    def replacements(self, in_residual: Callable[[], bool]) -> list[Replacement]:
        """Return the symbols to replace besides those that the runner replaces in every backbone.

        Args:
            in_residual: returns whether a residual is being trained, by a call of its own.
        """
        return []

    def level_view(self, view: Any, original: Any, size: tuple[int, int], signed: bool) -> None:
        """Bring attributes of a view to a level's size that `make_level_view` does not know.

        Args:
            view: a copy of `original` with the level's width and height, to be changed.
            original: the checkout's camera of the full-size image.
            size: (width, height) of the level.
            signed: whether a residual is trained.
        """

    def first_points(self, count: int) -> None:
        """Receive the number of points of the scene, before the first stage."""

    def resume(self, call: TrainingCall, gaussians: Any, iteration: int) -> None:
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
        return self.profile.make_model(call.values)

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
        from lapgs_plugin.checkouts.level_views import make_level_view, without_depth

        view = make_level_view(camera, size, image)
        if signed:
            without_depth(view)
        self.level_view(view, camera, size, signed)
        return view

    def export_field(self, gaussians: Any, signed: bool) -> GaussianField:
        """Return the model's parameters as `snapshot` does, and warn of opacities that a PLY cannot hold."""
        import torch

        with torch.no_grad():
            if _activation(gaussians) is not torch.sigmoid:
                opacity = gaussians.get_opacity
                if cut := int((opacity > LARGEST_OPACITY).sum()):
                    logger.warning(
                        "%d of %d Gaussians have opacities above 1, which a 3DGS PLY cannot hold: archived as 1",
                        cut,
                        len(opacity),
                    )
            return self.snapshot(gaussians, signed)

    @classmethod
    def archived_parameters(cls) -> tuple[str, ...]:
        """Return the parameters that a model needs to be archived; none if the adapter makes fields in its own way."""
        return tuple(PARAMETERS) if cls.snapshot is BackboneAdapter.snapshot else ()

    def snapshot(self, gaussians: Any, signed: bool) -> GaussianField:
        """Return a copy of the model's parameters as a field on their device."""
        import torch

        from lapgs_plugin.fields.gaussian_field import GaussianField

        with torch.no_grad():
            plain = _activation(gaussians) is torch.sigmoid
            logits = gaussians._opacity if plain else logits_of(gaussians.get_opacity)
            return GaussianField(
                means=gaussians._xyz.detach().clone(),
                quaternions=gaussians._rotation.detach().clone(),
                log_scales=_three_axes(gaussians),
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
            value = PARAMETERS[name](field).detach().clone()
            if name == "_scaling" and len(value):
                value = value[:, (value != FLAT_SCALE).any(0)]
            setattr(gaussians, name, torch.nn.Parameter(value.contiguous()))
        gaussians.max_radii2D = torch.zeros(len(field), device=field.means.device)

    def carried_over(self, gaussians: Any) -> dict[str, Any]:
        """Return what the next stage's model takes over besides Gaussians, by attribute: exposures of the photos."""
        if not hasattr(gaussians, "_exposure"):
            return {}
        import torch

        return {"_exposure": torch.nn.Parameter(gaussians._exposure.detach().clone())}

    def optimizers(self, gaussians: Any) -> list[torch.optim.Optimizer]:
        """Return the optimizers that step Gaussians."""
        candidates = (getattr(gaussians, name, None) for name in ("optimizer", "shoptimizer"))
        return [optimizer for optimizer in candidates if optimizer is not None]


def logits_of(opacities: Tensor) -> Tensor:
    """Return the logits of opacities, which may be 0, 1 or more."""
    import torch

    return torch.logit(opacities.clamp(1 - LARGEST_OPACITY, LARGEST_OPACITY))


def _options(opt: Any, *words: str) -> Iterator[str]:
    """Yield the names of numeric options that contain all the words."""
    for name, value in vars(opt).items():
        if isinstance(value, (int, float)) and all(word in name for word in words):
            yield name


def _activation(gaussians: Any) -> Any:
    """Return the function from stored opacities to opacities."""
    import torch

    return getattr(gaussians, "opacity_activation", torch.sigmoid)


def _three_axes(gaussians: Any) -> Tensor:
    """Return logarithms of a model's scales (n, 3): flat Gaussians get one for the axis that the model has without."""
    import torch

    log_scales: Tensor = gaussians._scaling.detach().clone()
    if log_scales.shape[1] != FLAT_AXES:
        return log_scales
    scales: Tensor = gaussians.get_scaling.detach()
    if scales.shape[1] != FLAT_AXES:
        return scales.log().clamp_min(FLAT_SCALE)
    return torch.nn.functional.pad(log_scales, (0, 1), value=FLAT_SCALE)
