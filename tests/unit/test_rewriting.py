"""Functions that are compiled again from their changed trees do what they did otherwise."""

from __future__ import annotations

import ast
import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from lapgs_plugin.checkouts.rewriting import Change, rewritten

MODULE = """
SIZE = 3


def total(values):
    return sum(values)


def count(n):
    return n if n == 0 else count(n - 1) + 1


class Model:
    LEVELS = 2

    class Mode:
        pass

    def total(self, values):
        return total(values) + 1

    def levels(self, more=LEVELS, *, mode: Mode = None):
        return more + 1

    def noted(self, value, notes=[]):
        notes.append(value + 1)
        return notes
"""


class _OneIsTen(Change):
    """Replace the number 1 in additions by 10."""

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        if isinstance(node.right, ast.Constant) and isinstance(node.op, ast.Add):
            self.changes += 1
            node.right = ast.copy_location(ast.Constant(10), node.right)
        return node


def changed(function: Callable[..., Any]) -> Callable[..., Any]:
    result = rewritten(function, lambda _: _OneIsTen(), {"_lapgs_unused": len})
    assert result is not function
    return result


@pytest.fixture
def module(tmp_path: Path) -> Iterator[ModuleType]:
    path = tmp_path / "rewritten_module.py"
    path.write_text(MODULE)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    loaded = sys.modules[path.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    yield loaded
    del sys.modules[path.stem]


def test_a_method_still_calls_the_function_of_its_module_that_has_its_name(module: ModuleType) -> None:
    assert changed(module.Model.total)(module.Model(), [1, 2]) == 13


def test_a_function_that_calls_itself_calls_what_took_its_place_in_its_module(module: ModuleType) -> None:
    function = changed(module.count)
    assert function(2) == 1 + 10  # the inner call is of the module's own
    vars(module)["count"] = function
    assert function(2) == 20


def test_defaults_and_annotations_are_those_of_the_definition(module: ModuleType) -> None:
    """They may name what only the body of a class knows, and a list among them is the same list."""
    levels, noted = changed(module.Model.levels), changed(module.Model.noted)
    assert levels(None) == 12
    assert levels.__annotations__ == {"mode": module.Model.Mode}
    assert levels.__kwdefaults__ == {"mode": None}
    module.Model().noted(0)
    assert noted(None, 1) == [1, 11]


def test_a_name_and_lines_in_a_traceback_are_those_of_the_file(module: ModuleType) -> None:
    function = changed(module.Model.total)
    assert (function.__name__, function.__qualname__) == ("total", "Model.total")
    assert function.__code__.co_firstlineno == module.Model.total.__code__.co_firstlineno
    with pytest.raises(TypeError) as raised:
        function(module.Model(), 3)
    lines = MODULE.splitlines()
    named = [(entry.name, lines[entry.lineno].strip()) for entry in raised.traceback[1:]]
    assert named == [("total", "return total(values) + 1"), ("total", "return sum(values)")]
