"""Replace a checkout's symbols by calls of the running stage."""

from __future__ import annotations

import ast
import inspect
import logging
from collections.abc import Callable
from functools import wraps
from types import FunctionType
from typing import Any, TypeGuard

from lapgs_plugin.checkouts.attachment import Replacement, of_class
from lapgs_plugin.checkouts.concurrent_runs import beside_other_runs
from lapgs_plugin.checkouts.profile import OPACITY_RESET, Profile, held_by
from lapgs_plugin.checkouts.rewriting import tree_of
from lapgs_plugin.checkouts.syntax import called_methods, called_name, called_names
from lapgs_plugin.checkouts.training_call import TrainingCall
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.runner import checkout_filters, checkout_loss, checkout_noise, checkout_rotations
from lapgs_plugin.runner.context import CheckoutContext
from lapgs_plugin.runner.installed_packages import require_matching_rasterizer
from lapgs_plugin.runner.late_numbers import reading_late
from lapgs_plugin.runner.running_stage import RunningStage
from lapgs_plugin.runner.step_clock import timing_replacements
from lapgs_plugin.runner.visible_rows import VisibleRows
from lapgs_plugin.scenes.masks import NONE

logger = logging.getLogger(__name__)

DENSIFICATION = "densif"
"""Part of the names of the methods that densify a field, of all density control."""

STATISTICS = "add_densification_stats"
"""Method of the family's models that sums gradients of the Gaussians that a view shows."""

SIZE_LIMIT = "max_screen_size"
"""Parameter of the family's density control: with None it removes no Gaussian for its size."""


class StageReplacements:
    """Make the replacements that every backbone needs.

    Args:
        context: shared objects of the run.
        train: called in place of the script's `training`.
    """

    def __init__(self, context: CheckoutContext, train: Callable[[TrainingCall], Any]) -> None:
        self._context, self._stages, self._train = context, context.stages, train
        self._controlling = False  # whether a method of density control is running

    def in_script(self) -> list[Replacement]:
        """Return the replacements for the script's main block, in the order in which they are made.

        Raises:
            UserInputError: this is no 3DGS checkout, or another rasterizer than its own is installed.
        """
        profile = self._context.adapter.profile
        require_matching_rasterizer(profile, self._context.adapter.info.title)
        return [
            *beside_other_runs(profile),
            Replacement(profile.script.module, profile.training.__name__, self._make_training, "the main block"),
        ]

    def in_training(self) -> list[Replacement]:
        """Return the further replacements for a call of the script's `training`, when the class of its model is known.

        Raises:
            UserInputError: an option has nothing to act on.
        """
        adapter, parts, profile = self._context.adapter, self._context.parts, self._context.adapter.profile
        scenes = profile.script_names(profile.scene)
        return [
            *(Replacement(profile.script.module, name, self._make_scene, "training()") for name in scenes),
            *(
                Replacement(camera, "__init__", self._context.images.adopting, "the scene's loader, for every image")
                for camera in profile.cameras
            ),
            *self._context.wrapper.replacements(profile, "the training loop, score functions and reports"),
            *timing_replacements(profile, lambda: self._stages.running),
            *self._in_model(profile),
            *adapter.replacements(self._in_residual),
            *self._in_scores(profile),
            *self._in_losses(profile),
            *self._in_reports(profile),
            *self._in_rotations(profile),
            *checkout_filters.replacements(profile.model, "training() when it renders and densifies"),
            *parts.replacements(profile, adapter.info),
        ]

    def _in_residual(self) -> bool:
        """Return whether the running stage trains a residual."""
        stage = self._stages.running
        return stage is not None and stage.stage.signed

    def _in_model(self, profile: Profile) -> list[Replacement]:
        """Return replacements of the model's methods that set up training, control density or gather its statistics."""
        control = dict.fromkeys(profile.density_control, self._make_density_control)
        if not self._context.request.settings.prune_by_size:
            methods = {name: inspect.signature(getattr(profile.model, name)) for name in control}
            limited = [name for name, signature in methods.items() if SIZE_LIMIT in signature.parameters]
            if not limited:
                raise UserInputError(
                    f"--no-prune-by-size: densification of {self._context.adapter.info.title} has no {SIZE_LIMIT} to "
                    "leave out; leave the option out"
                )
            for name in limited:
                control[name] = lambda original: self._make_density_control(_without_size_limit(original))
        if OPACITY_RESET in control:
            control[OPACITY_RESET] = self._make_opacity_reset
        replaced: dict[str, Callable[..., Any]] = {"training_setup": self._make_training_setup, **control}
        if (rows := self._context.wrapper.rows) is not None:
            self._note_callers(rows, profile)
            replaced[STATISTICS] = rows.updating
        return [
            replacement
            for name, make in replaced.items()
            for replacement in of_class(profile.model, name, make, "training()")
        ]

    @staticmethod
    def _note_callers(rows: VisibleRows, profile: Profile) -> None:
        """Note which functions of the script, and of modules that import a renderer, need no indices of Gaussians."""
        holders = [holder for renderer in profile.renderers for holder in profile.holders(renderer)]
        names = {name for _, name in holders} | {renderer.__name__ for renderer in profile.renderers}
        functions = [value for module, _ in holders for _, value in held_by(module) if isinstance(value, FunctionType)]
        callers: list[Callable[..., Any]] = [f for f in functions if names & set(f.__code__.co_names)]
        methods = _statistics(profile)
        for function in dict.fromkeys([profile.training, *callers]):
            rows.note_caller(function, names, methods)

    def _in_scores(self, profile: Profile) -> list[Replacement]:
        """Return replacements of score functions, after the adapter's of the same functions."""
        hooks, names = self._context.hooks, self._context.adapter.info.density_scores
        consumer = "training() when it densifies and prunes"
        scores = profile.named(names) if hooks or self._context.request.settings.depth != NONE else []
        return [Replacement(owner, name, hooks.pausing, consumer) for owner, name in scores]

    def _in_losses(self, profile: Profile) -> list[Replacement]:
        """Return replacements of the checkout's SSIM by ours, if the settings ask for it."""
        if not self._context.request.settings.fused_ssim:
            return []
        holders = [holder for holder in profile.named([checkout_loss.NAME]) if inspect.isfunction(getattr(*holder))]
        return [Replacement(*holder, checkout_loss.in_our_kernels, "training() in its loss") for holder in holders]

    def _in_reports(self, profile: Profile) -> list[Replacement]:
        """Return replacements of TensorBoard's writers, and of functions that read numbers for them."""
        if self._context.wrapper.rows is None:
            return []
        script, called = profile.script.module, called_names(ast.walk(profile.source.training))
        names = [name for name in dict.fromkeys(called) if _logs_scalars(vars(script).get(name))]
        reports = [Replacement(script, name, reading_late, "training() when it reports") for name in names]
        return [*reports, *self._context.scalars.replacements()]

    @staticmethod
    def _in_rotations(profile: Profile) -> list[Replacement]:
        """Return the replacement of the function that makes scaled rotations, if the script itself calls it."""
        script, name = profile.script.module, checkout_rotations.NAME
        replacement = Replacement(script, name, checkout_rotations.in_our_kernel, "training() in its noise")
        return [replacement] if inspect.isfunction(vars(script).get(name)) else []

    def _make_training(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of the script's `training`, which hands its call to `train` instead of running it."""
        rows = self._context.wrapper.rows
        changed = original
        if rows is not None:
            changed = rows.updating(reading_late(original), _statistics(self._context.adapter.profile))
        if self._context.request.settings.fused_ssim:
            changed = checkout_loss.in_one_kernel(changed)
        changed = checkout_noise.in_one_kernel(changed)

        @wraps(original)
        def training(*args: Any, **kwargs: Any) -> Any:
            return self._train(TrainingCall.bind(changed, args, kwargs))

        return training

    def _make_scene(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the replacement of the scene's class, which returns the running stage's scene."""

        def make_scene(*args: Any, **kwargs: Any) -> Any:
            stage = self._stages.running
            assert stage is not None, "training() makes its scene inside a stage"
            model = self._context.adapter.profile.model
            gaussians = next((value for value in (*args, *kwargs.values()) if isinstance(value, model)), None)
            assert gaussians is not None, "training() makes its scene with a model"
            return stage.scene_for(gaussians)

        return make_scene

    def _make_training_setup(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return a model's `training_setup` that tells the running stage once its optimizers are made."""

        @wraps(original)
        def training_setup(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
            result = original(gaussians, *args, **kwargs)
            if (stage := self._stages.running) is not None:
                if stage.trains(gaussians):
                    stage.optimizers_made(gaussians)
                elif stage.stage.signed:
                    raise UserInputError(
                        f"{self._context.adapter.profile.source.model[1]}: training() sets up the optimizers of more "
                        "than one model, and a residual is one, added to what was finished; nested levels train all of "
                        "them, and keep that of the scene: --hierarchy nested"
                    )
            return result

        return training_setup

    def _make_density_control(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return a method of density control that tells the stage once the outermost of such calls is done.

        Densification in the last iteration is left out: what it adds, on top of what it copies, is never trained.
        Scripts of the family save their own model before it, which does not have it either.
        """
        name = original.__name__
        can_be_left_out = DENSIFICATION in name and _returns_nothing_used(name, self._context.adapter.profile)

        @wraps(original)
        def control(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
            outermost, self._controlling = not self._controlling, True
            stage = self._stages.running
            if outermost and can_be_left_out and _is_last(stage) and stage.trains(gaussians):
                self._controlling = False
                logger.info(
                    "level %d: %s() of its last iteration is left out, nothing trains what it adds",
                    stage.stage.level,
                    name,
                )
                return None
            try:
                result = original(gaussians, *args, **kwargs)
            finally:
                self._controlling = not outermost
            if outermost and stage is not None and stage.trains(gaussians):
                stage.densified(gaussians)
            return result

        return control

    def _make_opacity_reset(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return the model's opacity reset, which does nothing in residuals unless the settings ask for it."""
        control = self._make_density_control(original)

        @wraps(original)
        def reset_opacity(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
            # Against floaters near cameras, the base's resets are enough.
            if self._context.request.settings.residual_resets or not self._in_residual():
                return control(gaussians, *args, **kwargs)
            return None

        return reset_opacity


def _is_last(stage: RunningStage | None) -> TypeGuard[RunningStage]:
    """Return whether a stage runs in the last iteration of its call of `training`."""
    return stage is not None and not stage.has_more


def _statistics(profile: Profile) -> dict[str, Callable[..., Any]]:
    """Return the model's method that gathers statistics of the Gaussians that a view shows, by its name."""
    method = getattr(profile.model, STATISTICS, None)
    return {} if method is None else {STATISTICS: method}


def _returns_nothing_used(name: str, profile: Profile) -> bool:
    """Return whether the loop calls a method, and drops what it returns."""
    nodes = list(ast.walk(profile.source.training))
    calls = [node for node in nodes if isinstance(node, ast.Call) and called_name(node) == name]
    dropped = [node.value for node in nodes if isinstance(node, ast.Expr)]
    return bool(calls) and all(call in dropped for call in calls)


def _logs_scalars(function: Any) -> bool:
    """Return whether a value of a script is a function that gives numbers to a TensorBoard writer."""
    tree = tree_of(function)
    return tree is not None and "add_scalar" in called_methods(ast.walk(tree))


def _without_size_limit(original: Callable[..., Any]) -> Callable[..., Any]:
    """Return a density control method that removes no Gaussian for its size."""
    signature = inspect.signature(original)

    @wraps(original)
    def method(*args: Any, **kwargs: Any) -> Any:
        bound = signature.bind(*args, **kwargs)
        bound.arguments[SIZE_LIMIT] = None
        return original(*bound.args, **bound.kwargs)

    return method
