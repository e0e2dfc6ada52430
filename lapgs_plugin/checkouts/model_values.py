"""Find in a checkout's sources what its model is rendered with besides the parameters of a field. Executes nothing."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Mapping

from lapgs_plugin.checkouts.source import START, CheckoutSource, methods_of
from lapgs_plugin.checkouts.syntax import called_name, called_names, parsed_quietly

OF_ANY_FIELD = {"active_sh_degree", "max_radii2D"}
"""Attributes that a model made from a field has, too."""


def explain_values_beside(source: CheckoutSource, parameters: Collection[str], *, surely: bool = True) -> str | None:
    """Return why a model made from a finished field cannot be rendered; None if the sources do not say.

    Args:
        source: the checkout.
        parameters: attributes of the model that are made from a field.
        surely: whether branches that default options do not decide are left out.
    """
    classes = source.classes
    methods, _ = methods_of(classes[source.model[0]], classes)
    if START not in methods:
        return None
    attributes = _attributes(source.branches.executed(methods[START], {}, surely=surely), ast.Store)
    beside = sorted(attributes.intersection(_rendered(source, methods, surely)).difference(parameters, OF_ANY_FIELD))
    return values_beside(source.model[1], beside) if beside else None


def values_beside(location: str, names: Iterable[str]) -> str:
    """Return a clause that says which attributes of a model at a place in a checkout fields do not have."""
    return (
        f"its Gaussians ({location}) are rendered with {', '.join(names)}, which {START}() makes and fields do not have"
    )


def _rendered(source: CheckoutSource, methods: Mapping[str, ast.FunctionDef], surely: bool) -> set[str]:
    """Return names of attributes that the loop's renderers read by default, also through model methods."""
    branches = source.branches
    calls = {called_name(node): node for node in ast.walk(source.training) if isinstance(node, ast.Call)}
    functions, waiting = dict(methods), list[str]()
    for use in source.rasterizers:
        holder = ast.walk(parsed_quietly(source.modules[use.holder]))
        functions |= {node.name: node for node in holder if isinstance(node, ast.FunctionDef)}
        waiting += [name for name in use.functions if name in calls]
    read, seen = set[str](), {START}
    while waiting:
        name = waiting.pop()
        if name in seen or name not in functions:
            continue
        seen.add(name)
        known = branches.arguments(functions[name], calls[name]) if name in calls else {}
        nodes = list(branches.executed(functions[name], known, surely=surely))
        loaded = _attributes(nodes, ast.Load)
        read |= loaded
        waiting += [*loaded, *called_names(nodes)]
    return read


def _attributes(nodes: Iterable[ast.AST], context: type[ast.expr_context]) -> set[str]:
    """Return the names of attributes that are read or set."""
    return {node.attr for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.ctx, context)}
