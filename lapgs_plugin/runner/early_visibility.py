"""Find the Gaussians that a view shows while its image is still being blended.

Renderers of the family return `(radii > 0).nonzero()`, which waits for everything that the GPU was given, so for the
image as well; the loss is given to the GPU afterwards. Radii are there before: rasterizers count the pairs of Gaussians
and tiles, whose number they return, from the same projection. So the indices are found in a stream of their own.
"""

from __future__ import annotations

import ast
import logging
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.rewriting import made_again, tree_of

logger = logging.getLogger(__name__)

VISIBLE = "_lapgs_visible"
"""Name of what takes the place of `(radii > 0).nonzero()`."""
COUNTED = "num_rendered"
"""Attribute in which the family's rasterizers keep the number of pairs for their backward pass."""
MARK = "_lapgs_projected"
"""Attribute of radii that are there; it holds their version."""

COMPARED = 20
"""Renders at first of which the indices are compared with those that are waited for."""


class EarlyVisibility:
    """Find visible Gaussians early in the renders of a checkout."""

    def __init__(self) -> None:
        self._stream: torch.cuda.Stream | None = None
        self._compared, self._works = 0, True
        self._made: dict[Callable[..., Any], Callable[..., Any]] = {}

    def applied(self, renderer: Callable[..., Any]) -> Callable[..., Any]:
        """Return a renderer that finds visible Gaussians early, or as it is if it looks for them in another way."""
        if renderer not in self._made:  # several modules hold it
            self._made[renderer] = self._changed(renderer)
        return self._made[renderer]

    def _changed(self, renderer: Callable[..., Any]) -> Callable[..., Any]:
        tree = tree_of(renderer)
        if tree is None or not any(_radii(node) for node in ast.walk(tree)):
            return renderer
        logger.info("%s finds the Gaussians that it shows while it blends the image", renderer.__name__)
        return made_again(renderer, _Visible().visit(tree), {VISIBLE: self.indices})

    def note(self, outputs: Any) -> None:
        """Note the radii among the outputs of a rasterizer that has counted its pairs."""
        found = [each for each in outputs if isinstance(each, Tensor)] if isinstance(outputs, tuple) else []
        if any(type(getattr(each.grad_fn, COUNTED, None)) is int for each in found):
            for each in found:
                if each.ndim == 1 and each.dtype == torch.int32 and each.is_cuda:
                    setattr(each, MARK, each._version)

    def indices(self, radii: Tensor) -> Tensor:
        """Return `(radii > 0).nonzero()`."""
        version = getattr(radii, MARK, None)
        if version is None or version != radii._version or not self._works:
            return (radii > 0).nonzero()
        found = self._found_early(radii)
        if self._compared < COMPARED:
            self._compared += 1
            waited_for = (radii > 0).nonzero()
            if not torch.equal(found, waited_for):
                self._works = False
                logger.warning("visible Gaussians are waited for: this rasterizer counts before its radii are there")
                return waited_for
        return found

    def _found_early(self, radii: Tensor) -> Tensor:
        if self._stream is None:
            # Ahead of the image's blocks that wait.
            self._stream = torch.cuda.Stream(radii.device, priority=-1)  # type: ignore[no-untyped-call]  # torch's
        with torch.cuda.stream(self._stream):
            found = (radii > 0).nonzero()  # waits for this stream
        found.record_stream(torch.cuda.current_stream(radii.device))
        return found


class _Visible(ast.NodeTransformer):
    """Replace `(radii > 0).nonzero()`."""

    def visit_Call(self, node: ast.Call) -> ast.AST:  # as NodeTransformer has it
        self.generic_visit(node)
        radii = _radii(node)
        if radii is None:
            return node
        made = ast.Call(ast.Name(VISIBLE, ast.Load()), [radii], [])
        return ast.fix_missing_locations(ast.copy_location(made, node))


def _radii(node: ast.AST) -> ast.Name | None:
    """Return the variable of `(radii > 0).nonzero()`."""
    match node:
        case ast.Call(
            func=ast.Attribute(ast.Compare(ast.Name() as radii, [ast.Gt()], [ast.Constant(0)]), "nonzero"),
            args=[],
            keywords=[],
        ):
            return radii
    return None
