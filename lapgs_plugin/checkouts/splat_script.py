"""Recognise a script whose class trains splats through gsplat's `rasterization`. Executes nothing, imports no torch."""

from __future__ import annotations

import ast
import sys
from dataclasses import dataclass
from pathlib import Path

from lapgs_plugin.checkouts.syntax import called_names, executed_on_import, parsed

RASTERIZATION = "rasterization"
"""Function of gsplat that the script imports by name."""
RASTERIZE = "rasterize_splats"
"""Method that calls it."""
METHODS = {"__init__", "train", RASTERIZE}


@dataclass(frozen=True)
class SplatScript:
    """Name the class of a script that trains splats, as those of gsplat's examples and of programs made from them.

    Attributes:
        path: of the script.
        trainer: name of its class with `METHODS`.
        packages: that it imports besides Python's own and those beside it, by name.
    """

    path: Path
    trainer: str
    packages: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: Path) -> SplatScript | None:
        """Return the description of a script; None if it is of another kind.

        Raises:
            UserInputError: it is not Python.
        """
        tree = parsed(path)
        statements = list(executed_on_import(tree.body, surely=True))
        froms = [node for node in statements if isinstance(node, ast.ImportFrom) and node.module and not node.level]
        plain = [alias.name for node in statements if isinstance(node, ast.Import) for alias in node.names]
        modules = {name.partition(".")[0] for name in (*plain, *(str(node.module) for node in froms))}
        beside = {entry.stem for entry in path.parent.iterdir()}
        packages = tuple(sorted(modules - sys.stdlib_module_names - beside))
        rasterizes = any(
            str(node.module).startswith("gsplat") and RASTERIZATION in {alias.name for alias in node.names}
            for node in froms
        )
        trainers = [node for node in tree.body if isinstance(node, ast.ClassDef) and _trains(node)]
        return cls(path, trainers[0].name, packages) if rasterizes and trainers else None


def _trains(node: ast.ClassDef) -> bool:
    """Return whether a class has the methods, of which the one that rasterizes calls `RASTERIZATION`."""
    methods = {method.name: method for method in node.body if isinstance(method, ast.FunctionDef)}
    return methods.keys() >= METHODS and RASTERIZATION in called_names(ast.walk(methods[RASTERIZE]))
