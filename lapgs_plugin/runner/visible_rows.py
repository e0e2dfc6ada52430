"""Update the statistics of visible Gaussians in a checkout's loop without waiting for the GPU.

Statements such as `denom[shown] += 1` list the rows of a mask each time, for which the GPU has to finish the backward
pass, and renderers that return `(radii > 0).nonzero()` list them before the loss is computed. Where the rows of whole
tensors can be updated by the mask, they are; where not, the statement is executed as it stands in the checkout.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Collection, Mapping
from types import CodeType
from typing import Any

import torch

from lapgs_plugin.checkouts.masked_statements import (
    KNOWN,
    UPDATE,
    VISIBLE,
    MaskedUpdates,
    VisibleIndices,
    keeps_masks,
)
from lapgs_plugin.checkouts.rewriting import rewritten, tree_of
from lapgs_plugin.ops.masked_updates import update_rows

Place = tuple[str, str, int]
Methods = Mapping[str, Callable[..., Any]]


class VisibleRows:
    """Change the functions of a checkout that return or use the visible Gaussians of a render."""

    def __init__(self) -> None:
        self._for_masks: set[Place] = set()  # functions that need no indices
        self._changed: dict[Callable[..., Any], Callable[..., Any]] = {}

    def updating(self, function: Callable[..., Any], methods: Methods | None = None) -> Callable[..., Any]:
        """Return a training function or a method of a model that updates rows by their mask.

        Args:
            function: the function.
            methods: of the model, which do nothing but such updates, as a rule. Where the function calls one after
                others, all are one update.
        """
        if getattr(function, "__globals__", {}).get("torch") is not torch:
            return function
        trees = _trees(methods or {})
        known = {_place(method.__code__) for name, method in (methods or {}).items() if name in trees}

        def is_known(method: Any) -> bool:  # not that of a subclass, or another one in its place
            code = getattr(method, "__code__", None)
            return code is not None and _place(code) in known

        return rewritten(function, lambda _: MaskedUpdates(trees), {UPDATE: _update, KNOWN: is_known})

    def note_caller(self, function: Callable[..., Any], renderers: Collection[str], methods: Methods) -> None:
        """Note whether a function that calls renderers needs indices, or masks do.

        Args:
            function: the script's training function, or a score function.
            renderers: names by which it may call renderers.
            methods: of the model, by name, that get a render's indices.
        """
        tree = tree_of(function)
        if tree is not None and keeps_masks(tree, renderers, _trees(methods)):
            self._for_masks.add(_place(function.__code__))

    def is_for_masks(self, caller: CodeType) -> bool:
        """Return whether a function that calls a renderer needs no indices."""
        return _place(caller) in self._for_masks

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


def _trees(methods: Methods) -> dict[str, ast.FunctionDef]:
    """Return the syntax trees of those methods that have one."""
    return {name: tree for name, method in methods.items() if (tree := tree_of(method)) is not None}


def _place(code: CodeType) -> Place:
    """Return where a function is defined: schedules compile it again for each stage."""
    return code.co_filename, code.co_name, code.co_firstlineno
