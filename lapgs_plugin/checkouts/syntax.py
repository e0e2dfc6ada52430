"""Parse scripts and modules of checkouts, and name places in them."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path

from lapgs_plugin.errors import UserInputError


def file_of_script(path: Path) -> Path:
    """Return the absolute path of a script; if it is a link, of its target, beside which Python looks for modules."""
    return (path.parent / path.readlink() if path.is_symlink() else path).absolute()


def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a script or module, not to be changed: it is kept until the file changes.

    Raises:
        UserInputError: it is not Python.
    """
    try:
        return _parsed_version(path, path.stat().st_mtime_ns)
    except (SyntaxError, ValueError) as error:
        raise UserInputError(f"{path} is not a Python script ({error}); expected a checkout's train.py") from error


@lru_cache(maxsize=512)
def _parsed_version(path: Path, changed: int) -> ast.Module:
    return ast.parse(path.read_bytes(), str(path))


def parsed_quietly(path: Path) -> ast.Module:
    """Return the syntax tree of an imported module, empty if it is broken: importing it says so."""
    try:
        return parsed(path)
    except UserInputError:
        return ast.Module(body=[], type_ignores=[])


def executed_on_import(body: Iterable[ast.AST], *, surely: bool = False) -> Iterator[ast.AST]:
    """Yield statements that importing a module may execute; with `surely` those that it does, whatever fails."""
    excused = (ast.Try, ast.With, ast.If) if surely else ()  # `with suppress(ImportError)`
    for node in body:
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, *excused)):
            yield node
            for part in ("body",) if surely else ("body", "orelse", "finalbody", "handlers"):
                yield from executed_on_import(getattr(node, part, []), surely=surely)


def returns_value(function: ast.FunctionDef) -> bool:
    """Return whether a function itself, not one that is defined in it, returns something else than None."""
    nodes: list[ast.AST] = [*function.body]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Return) and not (node.value is None or _is_none(node.value)):
            return True
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)):
            nodes += ast.iter_child_nodes(node)
    return False


def _is_none(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def plain_assignments(function: ast.FunctionDef) -> list[ast.stmt]:
    """Return the statements of a function's body that set local variables to values without calling anything.

    Variables that other statements set too, such as those of a loop, are left out.
    """
    plain = [node for node in function.body if _only_assigns(node)]
    others = {name for node in function.body if node not in plain for name in stored_names(node)}
    return [node for node in plain if not stored_names(node) & others]


def _only_assigns(node: ast.stmt) -> bool:
    nodes = list(ast.walk(node))
    kept = (ast.Assign, ast.AnnAssign, ast.If, ast.Pass)
    acts = any(isinstance(part, (ast.Call, ast.Await, ast.Yield, ast.YieldFrom)) for part in nodes)
    targets = [target for target in nodes if isinstance(getattr(target, "ctx", None), ast.Store)]
    return (
        not acts
        and all(isinstance(statement, kept) for statement in nodes if isinstance(statement, ast.stmt))
        and all(isinstance(target, (ast.Name, ast.Tuple)) for target in targets)
    )


def stored_names(node: ast.AST) -> set[str]:
    """Return the names of variables that a node sets or imports."""
    nodes = list(ast.walk(node))
    imported = {(alias.asname or alias.name).partition(".")[0] for alias in nodes if isinstance(alias, ast.alias)}
    return imported | {name.id for name in nodes if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)}


def location(path: Path, root: Path, line: int) -> str:
    """Return a line of a file as `file:line`, relative to the checkout's root if the file is below it."""
    return f"{path.relative_to(root) if path.is_relative_to(root) else path}:{line}"


def called_name(call: ast.Call) -> str:
    """Return the name that is called, without the module or object before it; empty for other expressions."""
    return str(getattr(call.func, "id", None) or getattr(call.func, "attr", ""))


def called_names(nodes: Iterable[ast.AST]) -> list[str]:
    """Return the names of functions that are called by their names alone, one for each call."""
    return [n.func.id for n in nodes if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]


def called_methods(nodes: Iterable[ast.AST]) -> set[str]:
    """Return the names of methods that are called, of whatever object or module."""
    return {n.func.attr for n in nodes if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)}
