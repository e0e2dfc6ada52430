"""Find where a training function adds the mean opacity and size to its loss (MCMC). Imports no torch, executes nothing.

loss = loss + args.opacity_reg * torch.abs(gaussians.get_opacity).mean()
loss = loss + args.scale_reg * torch.abs(gaussians.get_scaling).mean()
"""

from __future__ import annotations

import ast
import copy
from itertools import pairwise
from typing import NamedTuple

from lapgs_plugin.checkouts.rewriting import STATEMENTS, Change, call

REGULARIZED = "_lapgs_regularized"
"""Name of the function that returns the loss with both terms, or None if the statements have to be executed.

Its arguments are the loss, the model, and the weights of opacity and size.
"""
VALUE = "_lapgs_regularized_loss"
"""Name of the variable of its result."""
PROPERTIES = "get_opacity", "get_scaling"


class _Term(NamedTuple):
    """Describe a statement that adds a mean: the loss, the model, its property, and the weight."""

    loss: str
    model: str
    property: str
    weight: ast.expr


class RegularizerStatements(Change):
    """Replace two neighbours that add a mean of `PROPERTIES` each, where one function can do the same.

    if (VALUE := REGULARIZED(loss, gaussians, args.opacity_reg, args.scale_reg)) is not None:
        loss = VALUE
    else:
        ... (the statements)
    """

    def generic_visit(self, node: ast.AST) -> ast.AST:
        """Return the node with both terms in the places of their statements."""
        super().generic_visit(node)
        for name in STATEMENTS:
            statements = getattr(node, name, None)
            if isinstance(statements, list):
                setattr(node, name, self._replaced(statements))
        return node

    def _replaced(self, statements: list[ast.stmt]) -> list[ast.stmt]:
        for index, pair in enumerate(pairwise(statements)):
            terms = {term.property: term for term in map(_term, pair) if term is not None}
            if len(terms) != len(PROPERTIES) or len({term[:2] for term in terms.values()}) != 1:
                continue
            loss, model, *_ = terms[PROPERTIES[0]]
            weights = [copy.deepcopy(terms[name].weight) for name in PROPERTIES]
            value = call(REGULARIZED, *(ast.Name(name, ast.Load()) for name in (loss, model)), *weights)
            test = ast.Compare(ast.NamedExpr(ast.Name(VALUE, ast.Store()), value), [ast.IsNot()], [ast.Constant(None)])
            taken = ast.Assign([ast.Name(loss, ast.Store())], ast.Name(VALUE, ast.Load()))
            self.changes += 1
            replaced = ast.copy_location(ast.If(test, [taken], list(pair)), pair[0])
            return [*statements[:index], replaced, *statements[index + 2 :]]
        return statements


def _term(statement: ast.stmt) -> _Term | None:
    match statement:
        case ast.Assign(
            [ast.Name(loss)],
            ast.BinOp(
                ast.Name(before),
                ast.Add(),
                ast.BinOp(
                    ast.Name() | ast.Attribute() as weight,
                    ast.Mult(),
                    ast.Call(
                        ast.Attribute(
                            ast.Call(
                                ast.Attribute(ast.Name("torch"), "abs"), [ast.Attribute(ast.Name(model), name)], []
                            ),
                            "mean",
                        ),
                        [],
                        [],
                    ),
                ),
            ),
        ) if before == loss and name in PROPERTIES:
            root: ast.expr = weight
            while isinstance(root, ast.Attribute):
                root = root.value
            if isinstance(root, ast.Name) and loss not in (root.id, model):
                return _Term(loss, model, name, weight)
    return None
