"""Find the local variables of a training function that are known outside of its loop."""

from __future__ import annotations

import ast
from typing import Any

from lapgs_plugin.checkouts.syntax import plain_assignments

TRAINING = """
def training(opt, options):
    writer = make_writer(opt)
    if options["ours"] or opt.old:
        ratio = 0.7
    else:
        ratio = 0.8
    print(ratio)
    if opt.checkpoint:
        first, seen = restore(opt.checkpoint)
    first = 0
    opt.changed = True
    color = [1, 1, 1] if opt.white else [0, 0, 0]
    stack = None
    a, b = color[:2]
    for iteration in range(first, 10):
        stack = [iteration]
"""


def test_local_variables_that_nothing_else_sets_are_plain() -> None:
    """As RAIN-GS's ratio, which its model is made with."""
    (function,) = ast.parse(TRAINING).body
    assert isinstance(function, ast.FunctionDef)
    statements = plain_assignments(function)
    names: dict[str, Any] = {"opt": type("Opt", (), {"white": True}), "options": {"ours": True}}
    exec(compile(ast.Module(statements, []), "train.py", "exec"), {}, names)
    assert names.keys() - {"opt", "options"} == {"ratio", "color", "a", "b"}
    assert (names["ratio"], names["color"], names["b"]) == (0.7, [1, 1, 1], 1)
    assert not hasattr(names["opt"], "changed")
