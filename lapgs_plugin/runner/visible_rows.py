"""Update the statistics of visible Gaussians in a checkout's loop without waiting for the GPU.

Statements such as `denom[shown] += 1` list the rows of a mask each time, for which the GPU has to finish the backward
pass, and renderers that return `(radii > 0).nonzero()` list them before the loss is computed. Where the rows of whole
tensors can be updated by the mask, they are; where not, the statement is executed as it stands in the checkout.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from types import CodeType
from typing import Any

import torch

from lapgs_plugin.checkouts.masked_statements import UPDATE, VISIBLE, MaskedUpdates, VisibleIndices, keeps_masks
from lapgs_plugin.checkouts.rewriting import rewritten, tree_of
from lapgs_plugin.ops.masked_updates import update_rows

Place = tuple[str, str, int]


class VisibleRows:
    """Change the functions of a checkout that return or use the visible Gaussians of a render."""

    def __init__(self) -> None:
        self._loop: Place | None = None  # the training function, if it needs no indices
        self._changed: dict[Callable[..., Any], Callable[..., Any]] = {}

    def updating(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a training function or a method of a model that updates rows by their mask."""
        if getattr(function, "__globals__", {}).get("torch") is not torch:
            return function
        return rewritten(function, lambda _: MaskedUpdates(), {UPDATE: _update})

    def note_loop(
        self, training: Callable[..., Any], renderers: Collection[str], methods: Mapping[str, Callable[..., Any]]
    ) -> None:
        """Note whether the loop needs indices, or masks do.

        Args:
            training: the script's training function.
            renderers: names by which it may call renderers.
            methods: of its model, by name, that get a render's indices.
        """
        tree, trees = tree_of(training), {name: tree_of(method) for name, method in methods.items()}
        known = {name: method for name, method in trees.items() if method is not None}
        if tree is not None and keeps_masks(tree, renderers, known):
            self._loop = _place(training.__code__)

    def is_for_masks(self, caller: CodeType) -> bool:
        """Return whether a function that calls a renderer needs no indices."""
        return self._loop == _place(caller)

    def in_renderer(self, renderer: Callable[..., Any], by_mask: Callable[[], bool]) -> Callable[..., Any]:
        """Return a renderer that returns `radii > 0` in the place of its indices.

        Args:
            renderer: of the checkout.
            by_mask: whether the running call is one by a function that needs no indices.
        """

        def visible(radii: Any) -> Any:
            mask = radii > 0
            return mask if by_mask() else mask.nonzero()

        if renderer not in self._changed:  # several modules hold it
            self._changed[renderer] = rewritten(renderer, lambda _: VisibleIndices(), {VISIBLE: visible})
        return self._changed[renderer]


def _update(mask: Any, *updates: Any) -> bool:
    return update_rows(mask, updates)


def _place(code: CodeType) -> Place:
    """Return where a function is defined: schedules compile it again for each stage."""
    return code.co_filename, code.co_name, code.co_firstlineno
