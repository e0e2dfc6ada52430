"""Find the strings in the sources of the packages: what they may say."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("lapgs_plugin", "lapgs_bench")


@cache
def said() -> tuple[tuple[str, str], ...]:
    """Return the strings of the packages with their places; of docstrings those of commands, which --help prints."""
    strings = []
    for path in sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        of_commands = path.parent.name == "cli" or path.name in ("app.py", "commands.py")
        functions = [node for node in nodes if isinstance(node, ast.FunctionDef) and of_commands]
        printed = {id(function.body[0]) for function in functions}
        silent = {id(node.value) for node in nodes if isinstance(node, ast.Expr) and id(node) not in printed}
        strings += [
            (f"{path.relative_to(ROOT)}:{node.lineno}", node.value)
            for node in nodes
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in silent
        ]
    return tuple(strings)
