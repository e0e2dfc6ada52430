"""Find the strings in the sources of the package: what it may say."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]


@cache
def said() -> tuple[tuple[str, str], ...]:
    """Return the strings of the package with their places; of its docstrings those of commands, which --help prints."""
    found = []
    for path in sorted((ROOT / "lapgs_plugin").rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        functions = [node for node in nodes if isinstance(node, ast.FunctionDef) and path.parent.name == "cli"]
        printed = {id(function.body[0]) for function in functions}
        silent = {id(node.value) for node in nodes if isinstance(node, ast.Expr) and id(node) not in printed}
        found += [
            (f"{path.relative_to(ROOT)}:{node.lineno}", node.value)
            for node in nodes
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in silent
        ]
    return tuple(found)
