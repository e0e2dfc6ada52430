"""Find where renderers join a model's SH coefficients for their rasterizer alone. Imports no torch, executes nothing.

@property
def get_features(self):
    return torch.cat((self._features_dc, self._features_rest), dim=1)

def render(...):
    shs = pc.get_features
    ...
    rasterizer(means3D=means3D, shs=shs, ...)
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable, Iterator
from typing import Any

from lapgs_plugin.checkouts.rewriting import Change, call

WHOLE = "get_features"
"""Property of the family's models that joins the first SH coefficients with the others."""
SH = "_lapgs_sh"
"""Name of the function that takes the place of the property, called with the model."""


class WholeSh(Change):
    """Replace `model.get_features` where nothing but a rasterizer gets it: `sh = SH(model)`.

    Args:
        renderer: the tree of a renderer, for `visit`, which changes it.
    """

    def __init__(self, renderer: ast.FunctionDef) -> None:
        nodes = list(ast.walk(renderer))
        loads = [node for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)]
        passed = {value for node in nodes if isinstance(node, ast.Call) for value in _sh_arguments(node)}
        self._others = {node.id for node in loads if node not in passed}

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        """Return the statement or what takes its place."""
        self.generic_visit(node)
        match node.targets:
            case [ast.Name(name)] if name not in self._others:
                node.value = self._replaced(node.value)
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        """Return the call with another argument, if the property is one of a rasterizer's."""
        self.generic_visit(node)
        passed = set(_sh_arguments(node))
        for keyword in node.keywords:
            if keyword.value in passed:
                keyword.value = self._replaced(keyword.value)
        return node

    def _replaced(self, value: ast.expr) -> ast.expr:
        match value:
            case ast.Attribute(ast.Name() as model, attribute) if attribute == WHOLE:
                self.changes += 1
                return ast.copy_location(call(SH, model), value)
        return value


def _sh_arguments(node: ast.Call) -> Iterator[ast.expr]:
    """Yield the SH argument of a call if it is one of a rasterizer."""
    named = {keyword.arg: keyword.value for keyword in node.keywords}
    if {"means3D", "shs"} <= named.keys():
        yield named["shs"]


def joined_attributes(model: type) -> tuple[str, str] | None:
    """Return the attributes that a class of models joins along the second axis in `WHOLE`; None if it does more."""
    getter: Callable[..., Any] | None = getattr(inspect.getattr_static(model, WHOLE, None), "fget", None)
    try:
        module = ast.parse(textwrap.dedent(inspect.getsource(getter)))  # type: ignore[arg-type]  # None has no source
    except (OSError, TypeError, SyntaxError):
        return None
    match module.body:
        case [ast.FunctionDef(args=ast.arguments(args=[ast.arg(model_name)]), body=body)]:
            *before, last = [statement for statement in body if not isinstance(statement, ast.Expr)] or [ast.Pass()]
            values = {ast.unparse(s.targets[0]): s.value for s in before if isinstance(s, ast.Assign)}
            match last:
                case ast.Return(
                    ast.Call(
                        ast.Attribute(ast.Name("torch"), "cat"),
                        [ast.Tuple([one, other])],
                        [ast.keyword("dim", ast.Constant(1))],
                    )
                ) if len(values) == len(before):
                    parts = [values.get(ast.unparse(part), part) for part in (one, other)]
                    names = [
                        part.attr
                        for part in parts
                        if isinstance(part, ast.Attribute) and ast.unparse(part.value) == model_name
                    ]
                    return (names[0], names[1]) if len(names) == len(parts) else None
    return None
