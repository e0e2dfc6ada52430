"""Find where a training function computes the photometric loss. Imports no torch, executes nothing.

    Ll1 = l1_loss(image, gt_image)
    loss = (1.0 - opt.lambda_dssim) * Ll1 + opt.lambda_dssim * (1.0 - ssim(image, gt_image))

SSIM may be a variable, too, set by one function or by either of two: `if FUSED_SSIM_AVAILABLE: ... else: ...`.
And where the gradient of a loss begins, `loss.backward()`.
"""

from __future__ import annotations

import ast
import copy
from collections import Counter
from typing import NamedTuple

from lapgs_plugin.checkouts.rewriting import StatementsChange, call

LOSSES = "_lapgs_losses"
"""Name of the function that returns L1 and the loss, or None if the statements have to be executed."""
BACKWARD = "_lapgs_backward"
"""Name of the function that takes the place of `loss.backward()`."""
VALUES = "_lapgs_l1_and_loss"
"""Name of the variable of its result."""
L1 = "_lapgs_l1"
"""Name of the variable of L1 where the function has none."""


class _Term(NamedTuple):
    """Describe a comparison of two images, as expressions: the function, whether it gets batches, the images."""

    function: ast.expr
    batched: ast.expr
    images: tuple[str, str]


class _Loss(NamedTuple):
    """Describe the statement of a loss: its variable, and the expressions of lambda, L1 and SSIM."""

    name: str
    weight: ast.expr
    l1: ast.expr
    ssim: ast.expr

    @property
    def variables(self) -> set[str]:
        """Variables that hold terms."""
        return {term.id for term in (self.l1, self.ssim) if isinstance(term, ast.Name)}


class LossStatements(StatementsChange):
    """Replace the statements of a photometric loss, where one function can compute its terms together.

    if VALUES := LOSSES(l1_loss, ssim, False, image, gt_image, opt.lambda_dssim):
        Ll1, loss = VALUES
    else:
        ... (the statements)

    Args:
        function: the tree of a training function, for `visit`, which changes it.
    """

    def __init__(self, function: ast.FunctionDef) -> None:
        names = (node for node in ast.walk(function) if isinstance(node, ast.Name))
        self._uses = Counter(node.id for node in names if not isinstance(node.ctx, ast.Store))

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        """Return the statement, or a call of `BACKWARD`."""
        match node.value:
            case ast.Call(ast.Attribute(ast.Name() as loss, "backward"), [], []):
                node.value = ast.copy_location(call(BACKWARD, loss), node.value)
                self.changes += 1
        return node

    def _replaced(self, statements: list[ast.stmt]) -> list[ast.stmt]:
        replaced: list[ast.stmt] = []
        for statement in statements:
            replaced.append(statement)
            if (loss := _loss(statement)) is None:
                continue
            count = 1 + len(loss.variables)
            terms = dict(filter(None, map(_set_term, replaced[-count:-1])))
            if (values := self._values(loss, terms)) is not None:
                original = replaced[-count:]
                replaced[-count:] = [ast.copy_location(ast.If(*values, original), original[0])]
                self.changes += 1
        return replaced

    def _values(self, loss: _Loss, terms: dict[str, _Term]) -> tuple[ast.expr, list[ast.stmt]] | None:
        """Return the test whether one function computes a loss, and the statement that takes its values."""
        l1, ssim = (terms.get(term.id) if isinstance(term, ast.Name) else _term(term) for term in (loss.l1, loss.ssim))
        if l1 is None or ssim is None or terms.keys() != loss.variables or l1.images != ssim.images:
            return None
        names = {node.id for node in ast.walk(loss.weight) if isinstance(node, ast.Name)}
        is_read = isinstance(loss.ssim, ast.Name) and self._uses[loss.ssim.id] > 1  # it has no value then
        if is_read or loss.variables & {*l1.images, *names}:
            return None
        images = [ast.Name(image, ast.Load()) for image in l1.images]
        arguments = copy.deepcopy([l1.function, ssim.function, ssim.batched, *images, loss.weight])
        l1_name = loss.l1.id if isinstance(loss.l1, ast.Name) else L1
        targets = ast.Tuple([ast.Name(name, ast.Store()) for name in (l1_name, loss.name)], ast.Store())
        test = ast.NamedExpr(ast.Name(VALUES, ast.Store()), call(LOSSES, *arguments))
        return test, [ast.Assign([targets], ast.Name(VALUES, ast.Load()))]


def _loss(statement: ast.stmt) -> _Loss | None:
    match statement:
        case ast.Assign(
            [ast.Name(name)],
            ast.BinOp(
                ast.BinOp(ast.BinOp(ast.Constant(1), ast.Sub(), weight), ast.Mult(), l1),
                ast.Add(),
                ast.BinOp(same_weight, ast.Mult(), ast.BinOp(ast.Constant(1), ast.Sub(), ssim)),
            ),
        ) if isinstance(weight, (ast.Name, ast.Attribute)) and ast.unparse(weight) == ast.unparse(same_weight):
            return _Loss(name, weight, l1, ssim)
    return None


def _set_term(statement: ast.stmt) -> tuple[str, _Term] | None:
    """Return the variable that a statement sets to a term, and the term."""
    match statement:
        case ast.Assign([ast.Name(name)], value):
            term = _term(value)
            return None if term is None else (name, term)
        case ast.If(ast.Name() as test, [one], [other]):
            first, second = _set_term(one), _set_term(other)
            if first is None or second is None or first[0] != second[0] or first[1].images != second[1].images:
                return None
            choices = zip(first[1][:2], second[1][:2], strict=True)
            function, batched = (ast.IfExp(test, *choice) for choice in choices)
            return first[0], _Term(function, batched, first[1].images)
    return None


def _term(value: ast.expr) -> _Term | None:
    """Return a call of a function of two images, or of batches of one image each."""
    match value:
        case ast.Call(ast.Name() as function, [ast.Name(one), ast.Name(other)], []):
            return _Term(function, ast.Constant(False), (one, other))
        case ast.Call(ast.Name() as function, [one, other], []):
            batches = [_in_batch(image) for image in (one, other)]
            if all(batches):
                return _Term(function, ast.Constant(True), (batches[0], batches[1]))
    return None


def _in_batch(image: ast.expr) -> str:
    """Return the variable x of `x.unsqueeze(0)`, or nothing."""
    match image:
        case ast.Call(ast.Attribute(ast.Name(name), "unsqueeze"), [ast.Constant(0)], []):
            return name
    return ""
