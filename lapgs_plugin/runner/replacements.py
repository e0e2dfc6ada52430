"""Replace a checkout's symbols by calls of the running stage."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

from lapgs_plugin.adapters.base import StageWindow, TrainingCall
from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.runner.active_stage import ActiveStage
from lapgs_plugin.runner.context import RunContext
from lapgs_plugin.runner.installed_rasterizer import require_matching_rasterizer

OPACITY_RESET = "reset_opacity"
"""Method of the family's GaussianModel that is density control and can be skipped by itself."""
SIZE_LIMIT = "max_screen_size"
"""Parameter of the family's density control: with None it removes no Gaussian for its size."""


class StageReplacements:
    """Make the replacements that every backbone needs.

    Args:
        context: shared objects of the run.
        running: returns the running stage, None between stages.
        train: called in place of the script's `training`.

    Attributes:
        scene_class: the checkout's own Scene, once its name is replaced.
    """

    scene_class: Callable[..., Any]

    def __init__(
        self,
        context: RunContext,
        running: Callable[[], ActiveStage | None],
        train: Callable[[TrainingCall], None],
    ) -> None:
        self._context, self._running, self._train = context, running, train

    def all(self) -> list[Replacement]:
        """Return the replacements in the order in which they are made.

        Raises:
            UserInputError: the checkout lacks a symbol, or another rasterizer than its own is installed.
        """
        adapter, parts = self._context.adapter, self._context.parts
        renderer, loader = self._imported("gaussian_renderer"), self._imported("utils.camera_utils")
        require_matching_rasterizer(renderer, adapter.info.rasterizer, adapter.info.title)
        return [
            *self._in_training(),
            Replacement(loader, "Camera", self._context.images.adopting, None, "the scene's loader, for every image"),
            *parts.inner_replacements(renderer),
            *self._in_rendering(renderer),
            *self._in_model(),
            *adapter.replacements(self._window),
            *parts.outer_replacements(adapter.train, adapter.info),
        ]

    def _window(self) -> StageWindow | None:
        """Return the running stage if its schedule is not the checkout's own."""
        stage = self._running()
        return None if stage is None or stage.keeps_schedule else stage.window

    def _imported(self, name: str) -> ModuleType:
        """Return a module that the script has imported."""
        if name not in sys.modules:
            self._refuse(f"does not import {name}")
        return sys.modules[name]

    def _refuse(self, problem: str) -> None:
        adapter = self._context.adapter
        raise UserInputError(
            f"{adapter.script.path} {problem}, expected of {adapter.info.title}; choose another --backbone, or train "
            "with `lapgs run --off`"
        )

    def _in_training(self) -> list[Replacement]:
        train = self._context.adapter.train
        for name in ("GaussianModel", "Scene"):
            if not hasattr(train, name):
                self._refuse(f"has no {name}")
        return [
            Replacement(train, "training", self._make_training, ("dataset", "opt", "pipe"), "the main block"),
            Replacement(train, "Scene", self._make_scene, ("args", "gaussians"), "training()"),
            Replacement(train.Scene, "save", self._make_save, ("self", "iteration"), "training() at --save_iterations"),
        ]

    def _in_rendering(self, renderer: ModuleType) -> list[Replacement]:
        consumer = "render(), and through it the training loop, score functions and reports"
        wrapper = self._context.wrapper
        return [
            Replacement(renderer, "GaussianRasterizationSettings", wrapper.settings, None, consumer),
            Replacement(renderer, "GaussianRasterizer", wrapper.rasterizer, None, consumer),
        ]

    def _in_model(self) -> list[Replacement]:
        model = self._context.adapter.train.GaussianModel
        start, after_densifying = "training() at the start of every iteration", self._then(ActiveStage.densified)
        prepare = self._then(ActiveStage.optimizers_made)
        control = dict.fromkeys(self._context.adapter.info.density_control, after_densifying)
        if not self._context.options.prune_by_size:
            limited = [name for name in control if SIZE_LIMIT in inspect.signature(getattr(model, name)).parameters]
            if not limited:
                raise UserInputError(
                    f"--no-prune-by-size: densification of {self._context.adapter.info.title} has no {SIZE_LIMIT} to "
                    "leave out; leave the option out"
                )
            for name in limited:
                control[name] = lambda original: after_densifying(_without_size_limit(original))
        if OPACITY_RESET in control:
            control[OPACITY_RESET] = self._make_opacity_reset
        return [
            Replacement(model, "update_learning_rate", self._before_iteration, ("self", "iteration"), start),
            Replacement(model, "training_setup", prepare, ("self", "training_args"), "training()"),
            *(Replacement(model, name, make, ("self",), "training()") for name, make in control.items()),
        ]

    def _make_training(self, original: Callable[..., None]) -> Callable[..., None]:
        def training(*args: Any, **kwargs: Any) -> None:
            self._train(TrainingCall.bind(original, args, kwargs))

        return training

    def _make_scene(self, original: Callable[..., Any]) -> Callable[..., Any]:
        self.scene_class = original

        def make_scene(args: Any, gaussians: Any, *rest: Any, **kwargs: Any) -> Any:
            stage = self._running()
            assert stage is not None, "training() makes its scene inside a stage"
            return stage.scene_for(gaussians)

        return make_scene

    def _make_save(self, original: Callable[[Any, int], None]) -> Callable[[Any, int], None]:
        def save(scene: Any, iteration: int) -> None:
            if (stage := self._running()) is None:
                original(scene, iteration)
                return
            with stage.record.outside("saving"):
                original(scene, iteration)

        return save

    def _before_iteration(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def update_learning_rate(gaussians: Any, iteration: int) -> Any:
            if (stage := self._running()) is not None:
                stage.iteration_begins(gaussians)
            return original(gaussians, iteration)

        return update_learning_rate

    def _then(self, react: Callable[[ActiveStage, Any], None]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        """Return a maker of replacements that call `react(stage, gaussians)` after a method of the model."""

        def make(original: Callable[..., Any]) -> Callable[..., Any]:
            def method(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
                result = original(gaussians, *args, **kwargs)
                if (stage := self._running()) is not None:
                    react(stage, gaussians)
                return result

            return method

        return make

    def _make_opacity_reset(self, original: Callable[..., Any]) -> Callable[..., Any]:
        control = self._then(ActiveStage.densified)(original)

        def reset_opacity(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
            stage = self._running()
            if stage is None or stage.resets_opacities:
                return control(gaussians, *args, **kwargs)
            return None

        return reset_opacity


def _without_size_limit(original: Callable[..., Any]) -> Callable[..., Any]:
    """Return a density control method that removes no Gaussian for its size."""
    signature = inspect.signature(original)

    def method(*args: Any, **kwargs: Any) -> Any:
        bound = signature.bind(*args, **kwargs)
        bound.arguments[SIZE_LIMIT] = None
        return original(*bound.args, **bound.kwargs)

    return method
