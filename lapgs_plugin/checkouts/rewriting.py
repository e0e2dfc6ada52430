"""Compile a function of a checkout again from its changed syntax tree; its file stays as it is. Imports no torch."""

from __future__ import annotations
import __future__

import ast
import copy
import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

from lapgs_plugin.checkouts.syntax import parsed_quietly

FACTORY = "_lapgs_recompiled"
"""Name of the function that defines the function again; what its tree calls beside its globals are its arguments."""

RECOMPILATION = "_lapgs_recompilation"
"""Attribute of recompiled functions: their `_Recompilation`."""

STATEMENTS = ("body", "orelse", "finalbody")
"""Names of lists of statements in the nodes of a tree."""

FUTURE = reduce(lambda flags, name: flags | getattr(__future__, name).compiler_flag, __future__.all_feature_names, 0)
"""Flags of all future statements."""


class _Recompilation(NamedTuple):
    """Hold the tree of a recompiled function, and what it calls beside its globals."""

    tree: ast.FunctionDef
    names: Mapping[str, Callable[..., Any]]


class Change(ast.NodeTransformer):
    """Change the tree of a function.

    Attributes:
        changes: their number, known when the tree was visited.
    """

    changes = 0


class StatementsChange(Change):
    """Change lists of statements, from the innermost outwards."""

    def generic_visit(self, node: ast.AST) -> ast.AST:
        """Return the node with other statements in the places of some."""
        super().generic_visit(node)
        for name in STATEMENTS:
            statements = getattr(node, name, None)
            if isinstance(statements, list):
                setattr(node, name, self._replaced(statements))
        return node

    def _replaced(self, statements: list[ast.stmt]) -> list[ast.stmt]:
        """Return the statements, some of which may be others; `changes` counts these."""
        raise NotImplementedError


def call(name: str, *arguments: ast.expr) -> ast.Call:
    """Return a call of a function by its name, without a place in the source."""
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


def rewritten(
    function: Callable[..., Any],
    change: Callable[[ast.FunctionDef], Change],
    names: Mapping[str, Callable[..., Any]],
) -> Callable[..., Any]:
    """Return a function with a change to its tree, or as it is if that finds nothing or there is no tree.

    Args:
        function: the function.
        change: returns the change to a tree.
        names: what the changed tree calls beside the function's globals.
    """
    tree = tree_of(function)
    if tree is None:
        return function
    visitor = change(tree)
    changed = visitor.visit(tree)
    return recompiled(function, changed, names) if visitor.changes else function


def tree_of(function: Callable[..., Any]) -> ast.FunctionDef | None:
    """Return a copy of the syntax tree of a plain function or method of a module; None for others.

    Decorated and wrapped functions, closures and methods that use `super()` or private names are others: they do more
    than their trees say.
    """
    if not isinstance(function, FunctionType) or hasattr(function, "__wrapped__"):
        return None
    recompilation: _Recompilation | None = getattr(function, RECOMPILATION, None)
    if recompilation is not None:
        return copy.deepcopy(recompilation.tree)
    path = Path(function.__code__.co_filename)
    if function.__closure__ is not None or not path.is_file():
        return None
    definition = _definition(function, parsed_quietly(path).body)
    return None if definition is None or definition.decorator_list else copy.deepcopy(definition)


def _definition(function: FunctionType, body: Sequence[ast.stmt]) -> ast.FunctionDef | None:
    *classes, name = function.__qualname__.split(".")
    for class_name in classes:
        bodies = (node.body for node in body if isinstance(node, ast.ClassDef) and node.name == class_name)
        body = next(bodies, ())
    declared = name, function.__code__.co_firstlineno
    functions = (node for node in body if isinstance(node, ast.FunctionDef) and (node.name, node.lineno) == declared)
    definition = next(functions, None)
    is_private = definition is not None and any(map(_is_private, ast.walk(definition)))
    return None if classes and is_private else definition


def _is_private(node: ast.AST) -> bool:
    """Return whether Python gives a name another one inside a class."""
    name = getattr(node, "id", getattr(node, "attr", ""))
    return isinstance(name, str) and name.startswith("__") and not name.endswith("__")


def recompiled(
    function: Callable[..., Any], tree: ast.FunctionDef, names: Mapping[str, Callable[..., Any]] | None = None
) -> Callable[..., Any]:
    """Return a function by its changed tree, with the globals and line numbers of the original.

    Args:
        function: the original.
        tree: a changed `tree_of` it.
        names: what the tree calls beside the original's globals and the names with which it was recompiled before.
    """
    before: _Recompilation | None = getattr(function, RECOMPILATION, None)
    names = {**({} if before is None else before.names), **(names or {})}
    original = inspect.unwrap(function)
    assert isinstance(original, FunctionType), "as it has a tree"
    module = ast.parse(f"def {FACTORY}({', '.join(names)}):\n    return {tree.name}")
    factory = module.body[0]
    assert isinstance(factory, ast.FunctionDef), "as it was written"
    factory.body.insert(0, ast.fix_missing_locations(tree))
    # The checkout's future statements, and not those of this file.
    flags = original.__code__.co_flags & FUTURE
    compiled = compile(module, original.__code__.co_filename, "exec", flags, dont_inherit=True)
    defined: dict[str, Any] = {}
    exec(compiled, original.__globals__, defined)
    recompiled_function: Callable[..., Any] = defined[FACTORY](*names.values())
    recompiled_function.__qualname__ = function.__qualname__
    setattr(recompiled_function, RECOMPILATION, _Recompilation(tree, names))
    return recompiled_function
