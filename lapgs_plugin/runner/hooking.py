"""Users' hooks in a checkout's training loop, which knows nothing of them.

The loop renders, makes its loss, goes backward and densifies; the hooks' methods are called where those happen:

    before_render, compose, loss    when the rasterizer has rendered a training view with gradients
    after_backward                  when the gradients of that image's graph are there
    on_densify                      after density control

A hook's loss is added without touching the loop's: the image passes through a function whose backward pass gives the
hook's term a gradient of one, as if it had been added to the loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.level_views import view_name
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.hooks import HookDispatcher, StageContext, StageHook, entry_point_hooks

if TYPE_CHECKING:
    from lapgs_plugin.runner.shim import StageRendering


class HookCaller:
    """Calls users' hooks; false when there are none, so that a run without hooks pays nothing.

    Args:
        hooks: given besides those registered by entry point.

    Raises:
        UserInputError: a hook is not usable.
    """

    def __init__(self, hooks: Sequence[StageHook] = ()) -> None:
        found = (*entry_point_hooks(), *hooks)
        self._hooks = HookDispatcher(found) if found else None
        self._stage: Stage | None = None
        self._rendering: StageRendering | None = None
        self._iteration = 0
        self._context: StageContext | None = None

    def __bool__(self) -> bool:
        return self._hooks is not None

    def stage_begins(self, stage: Stage, rendering: StageRendering) -> None:
        self._stage, self._rendering = stage, rendering
        if self._hooks is not None:
            self._hooks.on_stage_start(stage)

    def stage_ends(self, stage: Stage) -> None:
        if self._hooks is not None:
            self._hooks.on_stage_end(stage)

    def iteration_begins(self, iteration: int) -> None:
        self._iteration = iteration

    def on_image(self, key: str, image: Tensor, below: Tensor | None) -> Tensor:
        """(3, h, w) what a training view's render gives the loop, as hooks and their terms make it.

        Args:
            key: of the view.
            image: (3, h, w) as it would be without hooks.
            below: (3, h, w) what the finished levels gave to it; None where the image is a field's alone.
        """
        assert self._hooks is not None
        context = self._context = self._make_context(key, below)
        # Hooks see composed images; where the loop is to see the residual alone, it is taken apart again behind them.
        apart = context.accumulated if below is None else None
        if apart is not None:
            image = image + apart
        self._hooks.before_render(context)
        image = self._hooks.compose(context, image)
        term = self._hooks.extra_loss(context, image)
        result: Tensor = _WithTerm.apply(image, term, self._after_backward)  # type: ignore[no-untyped-call]  # torch's
        return result if apart is None else result - apart

    def _make_context(self, key: str, below: Tensor | None) -> StageContext:
        assert self._stage is not None
        assert self._rendering is not None
        targets, accumulated, coarse = self._rendering.targets, self._rendering.accumulated, self._rendering.coarse
        assert targets is not None, "a stage that is trained has something to be compared with"
        if below is None and accumulated is not None:
            below = accumulated.get(key)
        return StageContext(
            stage=self._stage,
            iteration=self._iteration,
            view=view_name(key),
            target=targets.get(key),
            accumulated=below,
            coarse_target=None if coarse is None else coarse.get(key),
        )

    def densified(self) -> None:
        if self._hooks is not None and self._context is not None:
            self._hooks.on_densify(self._context)

    def _after_backward(self) -> None:
        assert self._hooks is not None
        assert self._context is not None
        self._hooks.after_backward(self._context)


class _WithTerm(torch.autograd.Function):
    """(image, term) -> image; backward gives the term a gradient of one."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, term: Tensor | None, done: Any) -> Tensor:
        ctx.term, ctx.done = term is not None, done
        return image.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        # Runs the callback when this whole backward pass has ended, as data-parallel training does.
        torch.autograd.Variable._execution_engine.queue_callback(ctx.done)
        return gradient, gradient.new_ones(()) if ctx.term else None, None
