"""Compile a function of a checkout again from its changed syntax tree; its file stays as it is. Imports no torch."""

from __future__ import annotations
import __future__

import ast
import copy
import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

from lapgs_plugin.checkouts.syntax import parsed_quietly

FACTORY = "_lapgs_recompiled"
"""Name of the function that defines the function again; what its tree calls beside its globals are its arguments."""

FUNCTION = "_lapgs_function"
"""Name of the function inside of that: by its own it would be found where its body names a global."""

RESTORED = "_lapgs_restored"
"""Name of the decorator that gives it back its name, defaults and annotations."""

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
    module = ast.parse(f"def {FACTORY}({', '.join((RESTORED, *names))}):\n    return {FUNCTION}")
    factory = module.body[0]
    assert isinstance(factory, ast.FunctionDef), "as it was written"
    factory.body.insert(0, ast.fix_missing_locations(_without_name_and_defaults(tree)))
    # The checkout's future statements, and not those of this file.
    flags = original.__code__.co_flags & FUTURE
    compiled = compile(module, original.__code__.co_filename, "exec", flags, dont_inherit=True)
    defined: dict[str, Any] = {}
    exec(compiled, original.__globals__, defined)
    recompiled_function: Callable[..., Any] = defined[FACTORY](partial(_restored, original), *names.values())
    recompiled_function.__qualname__ = function.__qualname__
    setattr(recompiled_function, RECOMPILATION, _Recompilation(tree, names))
    return recompiled_function


def _without_name_and_defaults(tree: ast.FunctionDef) -> ast.FunctionDef:
    """Return the definition of a function with what `_restored` gives back left out.

    Defaults and annotations may name what only the body of a class knows, and may not be evaluated a second time.
    """
    definition, arguments = copy.copy(tree), copy.deepcopy(tree.args)
    arguments.defaults = [ast.Constant(None) for _ in arguments.defaults]
    arguments.kw_defaults = [None if default is None else ast.Constant(None) for default in arguments.kw_defaults]
    for argument in ast.walk(arguments):
        if isinstance(argument, ast.arg):
            argument.annotation = None
    definition.name, definition.args, definition.returns = FUNCTION, arguments, None
    definition.decorator_list = [*tree.decorator_list, ast.Name(RESTORED, ast.Load())]
    return definition


def _restored(original: FunctionType, function: FunctionType) -> FunctionType:
    """Give a recompiled function the name, the defaults and the annotations of the original."""
    function.__code__ = function.__code__.replace(co_name=original.__code__.co_name)
    function.__name__, function.__qualname__ = original.__name__, original.__qualname__
    function.__defaults__, function.__kwdefaults__ = original.__defaults__, original.__kwdefaults__
    function.__annotations__ = original.__annotations__
    return function
