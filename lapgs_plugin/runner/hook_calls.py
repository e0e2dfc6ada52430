"""Call users' hooks from a checkout's training loop, which does not know them.

    before_render, compose, loss    after the rasterizer has rendered a training view with gradients
    after_backward                  after the backward pass through that image
    on_densify                      after density control

A hook's loss leaves the loop's own unchanged: the image passes through a function whose backward pass gives the hook's
term a gradient of one, as if the loop had added it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.level_views import view_name
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hooks import HookDispatcher, StageContext, StageHook, entry_point_hooks, hooks_line
from lapgs_plugin.registry import ALL
from lapgs_plugin.runner.running_stage import Stages

logger = logging.getLogger(__name__)


class HookCaller(HookDispatcher):
    """Call users' hooks; false without hooks, so that a run without them has no overhead.

    Args:
        stages: hold the stage whose images the hooks get.
        hooks: hooks besides those registered by entry point.
        registered: which of those take part, as of `entry_point_hooks`.

    Raises:
        UserInputError: a hook is not usable.
    """

    def __init__(self, stages: Stages, hooks: Sequence[StageHook] = (), registered: str = ALL) -> None:
        super().__init__((*entry_point_hooks(registered), *hooks))
        if (line := hooks_line(registered)) is not None:
            logger.info("%s", line)
        self._stages = stages
        self._context: StageContext | None = None
        self._paused = False

    def __bool__(self) -> bool:
        return bool(self._hooks)

    def on_stage_start(self, stage: Stage) -> None:
        self._context = None
        super().on_stage_start(stage)

    def pausing(self, original: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function during which no hook is called for an image.

        Scores of density control may be gradients of images. These are no iterations, and a hook's term is no part of
        a score.
        """

        @wraps(original)
        def score(*args: Any, **kwargs: Any) -> Any:
            outer, self._paused = self._paused, True
            try:
                return original(*args, **kwargs)
            finally:
                self._paused = outer

        return score

    def on_image(self, key: str, image: Tensor, below: Tensor | None) -> Tensor:
        """Call `before_render`, `compose` and `loss`, and return the image (3, h, w) for the loop.

        Args:
            key: key of the view.
            image: (3, h, w) image for the loop without hooks.
            below: (3, h, w) upsampled prediction in the image; None if the image is not composed.
        """
        if self._paused:
            return image
        context = self._context = self._make_context(key, below)
        # Hooks get composed images, even where the loop's loss is about the residual alone.
        added = context.accumulated if below is None else None
        if added is not None:
            image = image + added
        self.before_render(context)
        image = self.compose(context, image)
        term = self.extra_loss(context, image)
        done = partial(self.after_backward, context)
        result = with_term(image, term, done)
        return result if added is None else result - added

    @property
    def paused(self) -> bool:
        """Whether a score of density control is being computed."""
        return self._paused

    def _make_context(self, key: str, below: Tensor | None) -> StageContext:
        running = self._stages.running
        assert running is not None, "hooks get the images of a stage"
        images, accumulated = running.rendering.images, running.rendering.accumulated
        assert images is not None, "a stage that is trained has targets"
        target, coarse = images.get(key)
        if below is None and accumulated is not None:
            below = accumulated.get(key)
        iteration = max(1, running.iteration)  # loops without a clock begin the first with its step, after its render
        weight = images.get_weights(key)
        return StageContext(running.stage, iteration, view_name(key), target, below, coarse, weight)

    def densified(self) -> None:
        """Call `on_densify`."""
        if self._context is not None:
            self.on_densify(self._context)


def with_term(image: Tensor, term: Tensor | None, done: Callable[[], None] | None = None) -> Tensor:
    """Return the image unchanged; a backward pass through it adds the gradients of a term of the loss.

    Args:
        image: (3, h, w).
        term: weighted; None for none.
        done: called at the end of that backward pass.
    """
    result: Tensor = _WithTerm.apply(image, term, done)  # type: ignore[no-untyped-call]  # torch's
    return result


class _WithTerm(torch.autograd.Function):
    """Return the image unchanged; the backward pass gives the term a gradient of one."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, term: Tensor | None, done: Any) -> Tensor:
        ctx.term, ctx.done = term is not None, done
        return image.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        if ctx.done is not None:
            # The engine calls it at the end of this backward pass; data-parallel training relies on the same.
            torch.autograd.Variable._execution_engine.queue_callback(ctx.done)
        return gradient, gradient.new_ones(()) if ctx.term else None, None
