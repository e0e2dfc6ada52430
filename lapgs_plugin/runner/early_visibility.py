"""Find the Gaussians that a view shows without waiting for the GPU's other work.

Renderers of the family return `(radii > 0).nonzero()`, which waits for everything that the GPU was given, so for the
image as well; the loss is given to the GPU afterwards. Most forks return the mask `radii > 0`, and their loops index
with it several times after the backward pass, `x[mask]`: each time waits, and finds the same indices again. Radii are
there before: rasterizers count the pairs of Gaussians and tiles, whose number they return, from the same projection.
So the indices are found in a stream of their own, once a render.
"""

from __future__ import annotations

import ast
import logging
from collections.abc import Callable, Collection
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.rewriting import Change, call, rewritten
from lapgs_plugin.checkouts.syntax import stored_names

logger = logging.getLogger(__name__)

VISIBLE = "_lapgs_visible"
"""Name of the function that takes the place of `(radii > 0).nonzero()`."""
MASK = "_lapgs_mask"
"""Name of the function that takes the place of `radii > 0`."""
INDEX = "_lapgs_index"
"""Name of the function that is called with the mask of `x[mask]`."""
COUNTED = "num_rendered"
"""Attribute in which the family's rasterizers keep the number of pairs for their backward pass."""
KEY = "visibility_filter"
"""Name of the mask or the indices in the results of the family's renderers."""
PROJECTED = "_lapgs_projected"
"""Attribute of radii that are there: their version."""
RADII = "_lapgs_radii"
"""Attribute of a mask: the radii that it was made of."""
INDICES = "_lapgs_indices"
"""Attribute of a mask: its indices."""

COMPARED = 20
"""Renders at first of which the indices are compared with those that are waited for."""


class EarlyVisibility:
    """Find visible Gaussians early in the renders of a checkout."""

    def __init__(self) -> None:
        self._stream: torch.cuda.Stream | None = None
        self._compared, self._works = 0, True
        self._made: dict[Callable[..., Any], Callable[..., Any]] = {}

    def in_renderer(self, renderer: Callable[..., Any]) -> Callable[..., Any]:
        """Return a renderer whose indices and masks of visible Gaussians are those of this object."""
        if renderer not in self._made:  # several modules hold it
            names = {VISIBLE: self.indices, MASK: self.mask}
            self._made[renderer] = rewritten(renderer, lambda _: _Visible(), names)
        return self._made[renderer]

    def in_loop(self, training: Callable[..., Any]) -> Callable[..., Any]:
        """Return a training function that indexes by the indices of a renderer's masks."""
        return rewritten(training, lambda tree: _Indexed(_filters(tree)), {INDEX: self.index})

    def in_statistics(self, method: Callable[..., Any]) -> Callable[..., Any]:
        """Return a method that indexes by the indices of the masks that it is called with."""
        return rewritten(method, lambda tree: _Indexed({node.arg for node in tree.args.args}), {INDEX: self.index})

    def note(self, outputs: Any) -> None:
        """Note the radii among the outputs of a rasterizer that has counted its pairs."""
        tensors = [tensor for tensor in outputs if isinstance(tensor, Tensor)] if isinstance(outputs, tuple) else []
        if any(type(getattr(tensor.grad_fn, COUNTED, None)) is int for tensor in tensors):
            for tensor in tensors:
                if tensor.ndim == 1 and tensor.dtype == torch.int32 and tensor.is_cuda:
                    setattr(tensor, PROJECTED, tensor._version)

    def indices(self, radii: Any) -> Any:
        """Return `(radii > 0).nonzero()`."""
        if not (self._works and _is_noted(radii)):
            return (radii > 0).nonzero()
        early = self._found_early(radii)
        if self._compared < COMPARED:
            self._compared += 1
            waited_for = (radii > 0).nonzero()
            if not torch.equal(early, waited_for):
                self._works = False
                logger.warning("visible Gaussians are waited for: this rasterizer counts before its radii are there")
                return waited_for
        return early

    def mask(self, radii: Any) -> Any:
        """Return `radii > 0`."""
        mask = radii > 0
        if self._works and _is_noted(radii):
            setattr(mask, RADII, radii)
        return mask

    def index(self, mask: Any) -> Any:
        """Return the indices (k,) of a mask that `mask` noted, or the mask if it or its radii have changed since."""
        radii = getattr(mask, RADII, None)
        if radii is None or mask._version > 0 or not _is_noted(radii):  # any of them may be changed in place
            return mask
        if getattr(mask, INDICES, None) is None:
            setattr(mask, INDICES, self.indices(radii).squeeze(1))
        return getattr(mask, INDICES)

    def _found_early(self, radii: Tensor) -> Tensor:
        if self._stream is None:
            # Ahead of the blocks of other work that wait.
            self._stream = torch.cuda.Stream(radii.device, priority=-1)  # type: ignore[no-untyped-call]  # torch's
        with torch.cuda.stream(self._stream):
            indices = (radii > 0).nonzero()  # waits for this stream
        indices.record_stream(torch.cuda.current_stream(radii.device))
        return indices


def _is_noted(radii: Any) -> bool:
    """Return whether radii are there, as they were when the rasterizer returned them."""
    version = getattr(radii, PROJECTED, None)
    return version is not None and bool(version == radii._version)


class _Replacing(Change):
    """Replace expressions by calls."""

    def _call(self, name: str, argument: ast.expr) -> ast.Call:
        self.changes += 1
        return ast.copy_location(call(name, argument), argument)


class _Visible(_Replacing):
    """Replace `(radii > 0).nonzero()` and `radii > 0`."""

    def visit(self, node: ast.AST) -> ast.AST:
        """Return the node or its replacement."""
        match node:
            case ast.Call(func=ast.Attribute(ast.Compare() as compared, "nonzero"), args=[], keywords=[]):
                radii = _above_zero(compared)
                return self.generic_visit(node) if radii is None else self._call(VISIBLE, radii)
            case ast.Compare() if (radii := _above_zero(node)) is not None:
                return self._call(MASK, radii)
        return self.generic_visit(node)


def _above_zero(node: ast.Compare) -> ast.Name | None:
    """Return the variable of `variable > 0`."""
    match node:
        case ast.Compare(left=ast.Name() as radii, ops=[ast.Gt()], comparators=[ast.Constant(0)]):
            return radii
    return None


class _Indexed(_Replacing):
    """Replace masks in `x[mask]` and `x[mask, ...]`.

    Args:
        names: variables that may be masks.
    """

    def __init__(self, names: Collection[str]) -> None:
        self._names = names

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        """Return the node with the indices."""
        self.generic_visit(node)
        match node.slice:
            case ast.Name(id=name) as mask if name in self._names:
                node.slice = self._call(INDEX, mask)
            case ast.Tuple(elts=[ast.Name(id=name) as mask, *others], ctx=context) if name in self._names:
                node.slice = ast.copy_location(ast.Tuple([self._call(INDEX, mask), *others], context), mask)
        return node


def _filters(training: ast.FunctionDef) -> set[str]:
    """Return the variables of a training function that are assigned in a statement that reads `KEY`."""
    statements = [node for node in ast.walk(training) if isinstance(node, ast.Assign)]
    setting = [node for node in statements if any(_is_key(part) for part in ast.walk(node.value))]
    return {name for node in setting for name in stored_names(node)}


def _is_key(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and node.value == KEY
