"""Find in a checkout's sources what its model is rendered with besides the parameters of a field. Executes nothing."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator, Mapping

from lapgs_plugin.checkouts.source import CheckoutSource, methods_of
from lapgs_plugin.checkouts.syntax import called_names, parsed_quietly

START = "create_from_pcd"
"""Method of the family's models that makes Gaussians of a scene's points."""

OF_ANY_FIELD = {"active_sh_degree", "max_radii2D"}
"""Attributes that a model made from a field has, too."""


def explain_values_beside(source: CheckoutSource, parameters: Collection[str]) -> str | None:
    """Return why a model made from a finished field cannot be rendered; None if the sources do not say.

    Args:
        source: the checkout.
        parameters: attributes of the model that are made from a field.
    """
    classes = source.classes
    methods, _ = methods_of(classes[source.model[0]], classes)
    if START not in methods:
        return None
    made = _attributes(_executed(methods[START]), ast.Store)
    beside = sorted(made.intersection(_rendered(source, methods)).difference(parameters, OF_ANY_FIELD))
    if not beside:
        return None
    names = ", ".join(beside)
    return f"its Gaussians ({source.model[1]}) are rendered with {names}, which {START}() makes and fields do not have"


def _rendered(source: CheckoutSource, methods: Mapping[str, ast.FunctionDef]) -> set[str]:
    """Return names of attributes that the loop's renderers read whatever the options, also through model methods."""
    called = set(called_names(ast.walk(source.training)))
    functions, waiting = dict(methods), list[str]()
    for use in source.rasterizers:
        holder = ast.walk(parsed_quietly(source.modules[use.holder]))
        functions |= {node.name: node for node in holder if isinstance(node, ast.FunctionDef)}
        waiting += [name for name in use.functions if name in called]
    read, seen = set[str](), {START}
    while waiting:
        name = waiting.pop()
        if name in seen or name not in functions:
            continue
        seen.add(name)
        nodes = list(_executed(functions[name]))
        found = _attributes(nodes, ast.Load)
        read |= found
        waiting += [*found, *called_names(nodes)]
    return read


def _attributes(nodes: Iterable[ast.AST], context: type[ast.expr_context]) -> set[str]:
    """Return the names of attributes that are read or set."""
    return {node.attr for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.ctx, context)}


def _executed(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """Yield the nodes of a function that are executed whichever way branches take; loops are taken to run."""
    waiting: list[ast.AST] = [*function.body]
    while waiting:
        node = waiting.pop()
        if isinstance(node, (ast.Try, ast.FunctionDef, ast.Lambda)):
            continue
        yield node
        waiting += [node.test] if isinstance(node, (ast.If, ast.IfExp)) else ast.iter_child_nodes(node)
