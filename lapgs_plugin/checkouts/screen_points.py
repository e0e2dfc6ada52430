"""Find zeros that a renderer makes in each call and that nothing changes. Imports no torch, executes nothing.

The tensor by which it asks for gradients of projected centres; rasterizers give it one and never read it:

    screenspace_points = torch.zeros_like(pc.get_xyz, requires_grad=True, device="cuda") + 0
    screenspace_points.retain_grad()

And settings of rasterizers that say nothing about the pixels:

    if metric_map == None:
        metric_map = torch.zeros(height * width, dtype=torch.int, device="cuda")
    raster_settings = GaussianRasterizationSettings(..., metric_map=metric_map)
"""

from __future__ import annotations

import ast

from lapgs_plugin.checkouts.rewriting import Change

POINTS = "_lapgs_screen_points"
"""Name of the function that makes the tensor, called with PyTorch's function of zeros and its arguments."""
SETTINGS_ZEROS = "_lapgs_settings_zeros"
"""Name of the function that makes zeros of settings, called in the same way."""
HARMLESS = {"grad", "requires_grad", "retain_grad"}
"""Attributes of the tensor that do not change it."""
OPTIONS = {"requires_grad", "dtype", "device"}
"""Keyword arguments by which renderers ask for zeros; `input=` would be a tensor that is kept."""
SETTINGS = "Settings"
"""End of the names of classes of settings."""


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
            ) if name not in self._changed and _are_plain(keywords, requires_grad=True):
                make.func, make.args = ast.copy_location(ast.Name(POINTS, ast.Load()), zeros), [zeros, *args]
                node.value = make
                self.changes += 1
        return node


class SettingsZeros(Change):
    """Replace `torch.zeros(...)` by `SETTINGS_ZEROS(torch.zeros, ...)`, where nothing but settings gets it.

    Args:
        renderer: the tree of a renderer, for `visit`, which changes it.
    """

    def __init__(self, renderer: ast.FunctionDef) -> None:
        nodes = list(ast.walk(renderer))
        harmless: set[ast.expr] = set()
        for node in nodes:
            match node:
                case ast.Compare(ast.Name() as value, [_], [ast.Constant(None)]):
                    harmless.add(value)
                case ast.Call(ast.Name(name) | ast.Attribute(attr=name)) if name.endswith(SETTINGS):
                    harmless |= {keyword.value for keyword in node.keywords}
        changed = {node.target for node in nodes if isinstance(node, ast.AugAssign)}
        read = {node for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
        self._others = {node.id for node in (read - harmless) | changed if isinstance(node, ast.Name)}

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        """Return the statement with another value, if it makes such zeros."""
        match node:
            case ast.Assign(
                [ast.Name(name)],
                ast.Call(ast.Attribute(ast.Name("torch"), "zeros" | "zeros_like") as zeros, args, keywords) as make,
            ) if name not in self._others and _are_plain(keywords, requires_grad=False):
                make.func, make.args = ast.copy_location(ast.Name(SETTINGS_ZEROS, ast.Load()), zeros), [zeros, *args]
                self.changes += 1
        return node


def _are_plain(keywords: list[ast.keyword], requires_grad: bool) -> bool:
    """Return whether they ask for nothing but `OPTIONS`, and whether for gradients as given."""
    asks = "requires_grad=True" in map(ast.unparse, keywords)
    return {k.arg for k in keywords} <= OPTIONS and asks == requires_grad
