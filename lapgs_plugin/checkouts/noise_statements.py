"""Find where a training function shakes positions by noise (MCMC). Imports no torch, executes nothing.

    L = build_scaling_rotation(gaussians.get_scaling, gaussians.get_rotation)
    covariance = L @ L.transpose(1, 2)
    noise = torch.randn_like(gaussians._xyz) * fading(1 - gaussians.get_opacity) * args.noise_lr * xyz_lr
    noise = torch.bmm(covariance, noise.unsqueeze(-1)).squeeze(-1)
    gaussians._xyz.add_(noise)

The function of opacities may be defined between them.
"""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from lapgs_plugin.checkouts.rewriting import StatementsChange, call

SHAKE = "_lapgs_shake"
"""Name of the function that shakes positions, and returns whether it did.

Its arguments are the function of scales and quaternions, that of opacities, the model, and factors of the noise.
"""
COUNT = 5
"""Statements of the noise."""


class _Noise(NamedTuple):
    """Describe the statements of noise: the arguments of `SHAKE`, and the variables that they set."""

    arguments: list[ast.expr]
    variables: set[str]


class NoiseStatements(StatementsChange):
    """Replace the statements of noise, where one function can do the same.

    def fading(x): ...
    if not SHAKE(build_scaling_rotation, fading, gaussians, args.noise_lr, xyz_lr):
        ... (the other statements)

    Args:
        function: the tree of a training function, for `visit`, which changes it.
    """

    def __init__(self, function: ast.FunctionDef) -> None:
        self._uses = _uses([function])

    def _replaced(self, statements: list[ast.stmt]) -> list[ast.stmt]:
        for start in range(len(statements)):
            for end in (start + COUNT, start + COUNT + 1):
                run = statements[start:end]
                functions = [statement for statement in run if isinstance(statement, ast.FunctionDef)]
                others = [statement for statement in run if statement not in functions]
                noise = _noise(others) if len(others) == COUNT and statements[start] is others[0] else None
                if noise is None or not self._are_alone(noise.variables, others) or not all(map(_is_plain, functions)):
                    continue
                self.changes += 1
                done = call(SHAKE, *copy.deepcopy(noise.arguments))
                replaced = ast.copy_location(ast.If(ast.UnaryOp(ast.Not(), done), others, []), others[0])
                return [*statements[:start], *functions, replaced, *statements[end:]]
        return statements

    def _are_alone(self, variables: set[str], statements: Sequence[ast.stmt]) -> bool:
        """Return whether no other statement of the function reads, sets or deletes the variables."""
        within = _uses(statements)
        return all(self._uses[name] == within[name] for name in variables)


def _uses(nodes: Sequence[ast.AST]) -> Counter[str]:
    """Return how often variables are read, set or deleted."""
    return Counter(inner.id for node in nodes for inner in ast.walk(node) if isinstance(inner, ast.Name))


def _is_plain(function: ast.FunctionDef) -> bool:
    """Return whether defining a function does nothing else."""
    defaults = [*function.args.defaults, *filter(None, function.args.kw_defaults)]
    return not function.decorator_list and all(isinstance(default, ast.Constant) for default in defaults)


def _noise(statements: Sequence[ast.stmt]) -> _Noise | None:
    first, second, third, *last = statements
    match first, second, third:
        case (
            ast.Assign(
                [ast.Name(matrices)],
                ast.Call(ast.Name() as build, [ast.Attribute(ast.Name() as model, "get_scaling"), ast.Attribute()], []),
            ),
            ast.Assign([ast.Name(covariances)]),
            ast.Assign([ast.Name(noise)], product),
        ):
            shaken = f"{model.id}._xyz"
        case _:
            return None
    drawn, *factors = _factors(product)
    if not factors or not all(map(_is_read, factors[1:])):
        return None
    match factors[0]:
        case ast.Call(ast.Name() as fading, [of_opacities], []):
            written = [*map(ast.unparse, (first, second, drawn, of_opacities, *last))]
        case _:
            return None
    expected = [
        f"{matrices} = {build.id}({model.id}.get_scaling, {model.id}.get_rotation)",
        f"{covariances} = {matrices} @ {matrices}.transpose(1, 2)",
        f"torch.randn_like({shaken})",
        f"1 - {model.id}.get_opacity",
        f"{noise} = torch.bmm({covariances}, {noise}.unsqueeze(-1)).squeeze(-1)",
        f"{shaken}.add_({noise})",
    ]
    names = {matrices, covariances, noise}
    others = {build.id, model.id, fading.id}
    if written != expected or len(names | others) != len(names) + 3 or names & _uses(factors[1:]).keys():
        return None
    return _Noise([build, fading, model, *factors[1:]], names)


def _is_read(factor: ast.expr) -> bool:
    """Return whether a factor is a constant, a variable or an attribute of one, so that reading it does nothing."""
    while isinstance(factor, ast.Attribute):
        factor = factor.value
    return isinstance(factor, (ast.Name, ast.Constant))


def _factors(product: ast.expr) -> list[ast.expr]:
    """Return the factors of a product, in the order in which they are multiplied."""
    match product:
        case ast.BinOp(left, ast.Mult(), right):
            return [*_factors(left), right]
    return [product]
