"""Find the tensor by which a renderer asks for gradients of projected centres. Imports no torch, executes nothing.

    screenspace_points = torch.zeros_like(pc.get_xyz, requires_grad=True, device="cuda") + 0
    screenspace_points.retain_grad()

Rasterizers give it a gradient and never read its zeros.
"""

from __future__ import annotations

import ast

from lapgs_plugin.checkouts.rewriting import Change

POINTS = "_lapgs_screen_points"
"""Name of the function that makes the tensor, called with PyTorch's function of zeros and its arguments."""
HARMLESS = {"grad", "requires_grad", "retain_grad"}
"""Attributes of the tensor that do not change it."""
OPTIONS = {"requires_grad", "dtype", "device"}
"""Keyword arguments by which renderers ask for it; `input=` would be a tensor that is kept."""


class ScreenPoints(Change):
    """Replace `torch.zeros(..., requires_grad=True) + 0` by `POINTS(torch.zeros, ...)`, where it is not changed later.

    Args:
        renderer: the tree of a renderer, for `visit`, which changes it.
    """

    def __init__(self, renderer: ast.FunctionDef) -> None:
        nodes = list(ast.walk(renderer))
        changed: list[ast.expr] = [node.target for node in nodes if isinstance(node, ast.AugAssign)]
        changed += [node.value for node in nodes if isinstance(node, ast.Attribute) and node.attr not in HARMLESS]
        changed += [node.value for node in nodes if isinstance(node, ast.Subscript)]
        self._changed = {node.id for node in changed if isinstance(node, ast.Name)}

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        """Return the statement with another value, if it makes such a tensor."""
        match node:
            case ast.Assign(
                [ast.Name(name)],
                ast.BinOp(
                    ast.Call(ast.Attribute(ast.Name("torch"), "zeros" | "zeros_like") as zeros, args, keywords) as make,
                    ast.Add(),
                    ast.Constant(0),
                ),
            ) if name not in self._changed and _are_plain(keywords):
                make.func, make.args = ast.copy_location(ast.Name(POINTS, ast.Load()), zeros), [zeros, *args]
                node.value = make
                self.changes += 1
        return node


def _are_plain(keywords: list[ast.keyword]) -> bool:
    """Return whether they ask for gradients, and for nothing but `OPTIONS`."""
    return {k.arg for k in keywords} <= OPTIONS and "requires_grad=True" in map(ast.unparse, keywords)
