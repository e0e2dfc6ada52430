"""Compile a function of a checkout again with some of its expressions replaced; its file stays as it is."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

from lapgs_plugin.checkouts.syntax import parsed_quietly

FACTORY = "_lapgs_made_again"
"""Name of the function that defines the function again; what replaces expressions are its arguments."""


def tree_of(function: Callable[..., Any]) -> ast.FunctionDef | None:
    """Return the syntax tree of a plain function at the top of its module, not to be changed; None for others.

    Decorated functions and closures are others: they hold what their sources do not say.
    """
    if not isinstance(function, FunctionType) or function.__closure__ is not None:
        return None
    code = function.__code__
    definitions = [node for node in parsed_quietly(Path(code.co_filename)).body if isinstance(node, ast.FunctionDef)]
    for node in definitions:
        if (node.name, node.lineno) == (code.co_name, code.co_firstlineno) and not node.decorator_list:
            return node
    return None


def made_again(
    function: Callable[..., Any], tree: ast.FunctionDef, names: Mapping[str, Callable[..., Any]]
) -> Callable[..., Any]:
    """Return a function by its changed tree, with the globals, defaults and line numbers of the original.

    Args:
        function: one that has a `tree_of`.
        tree: a changed copy of that tree.
        names: what the tree calls beside the original's variables.
    """
    assert isinstance(function, FunctionType), "others have no tree"
    tree.args.defaults, tree.args.kw_defaults = [], [None] * len(tree.args.kwonlyargs)  # evaluated by the original
    tree.returns = None
    for given in ast.walk(tree.args):
        if isinstance(given, ast.arg):
            given.annotation = None
    module = ast.parse(f"def {FACTORY}({', '.join(names)}):\n    return {tree.name}")
    factory = module.body[0]
    assert isinstance(factory, ast.FunctionDef), "as it was written"
    factory.body.insert(0, tree)
    code = next(_functions(compile(module, function.__code__.co_filename, "exec", dont_inherit=True)))
    made = FunctionType(code, function.__globals__)(*names.values())
    assert isinstance(made, FunctionType), "the factory defines one"
    made.__defaults__, made.__kwdefaults__ = function.__defaults__, function.__kwdefaults__
    made.__annotations__, made.__dict__ = function.__annotations__, dict(function.__dict__)
    made.__qualname__, made.__doc__, made.__module__ = function.__qualname__, function.__doc__, function.__module__
    return made


def _functions(code: CodeType) -> Iterator[CodeType]:
    return (each for each in code.co_consts if inspect.iscode(each))
