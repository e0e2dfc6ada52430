"""SH coefficients that a renderer joins for its rasterizer alone are handed over in parts."""

from __future__ import annotations

import ast
from collections.abc import Callable
from types import ModuleType

import pytest

from lapgs_plugin.checkouts.whole_sh import WholeSh, joined_attributes

MODEL = """
import torch

class Model:
    @property
    def get_features(self):
        {}
"""


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("return torch.cat((self.first, self.rest), dim=1)", ("first", "rest")),
        ("a = self.first\n        b = self.rest\n        return torch.cat((a, b), dim=1)", ("first", "rest")),
        ("'''Join.'''\n        a = self.first\n        return torch.cat((a, self.rest), dim=1)", ("first", "rest")),
        ("return torch.cat((self.first, self.rest), dim=2)", None),
        ("return torch.cat((self.first, self.rest.detach()), dim=1)", None),
        ("return torch.cat((self.first, self.rest * 2), dim=1)", None),
        ("return torch.cat((self.first, other.rest), dim=1)", None),
        ("a = self.first\n        if a is None: return None\n        return torch.cat((a, self.rest), dim=1)", None),
        ("return self.first", None),
    ],
)
def test_what_a_model_joins(load_module: Callable[[str], ModuleType], body: str, expected: object) -> None:
    model = load_module(MODEL.format(body)).Model
    assert joined_attributes(model) == expected
    assert joined_attributes(type("Derived", (model,), {})) == expected


def test_models_without_such_a_property() -> None:
    assert joined_attributes(int) is None
    assert joined_attributes(type("Model", (), {"get_features": 1})) is None
    assert joined_attributes(type("Model", (), {"get_features": property(len)})) is None


@pytest.mark.parametrize(
    ("line", "changes"),
    [
        ("rasterizer(means3D=means, shs=shs)", 1),
        ("rasterizer(means3D=means, shs=shs) if means else other(means3D=means, shs=shs)", 1),
        ("rasterizer(means3D=means, shs=None)", 1),
        ("rasterizer(means3D=means, shs=pc.get_features)", 2),
        ("rasterizer(means, shs)", 0),
        ("other(shs=shs)", 0),
        ("rasterizer(means3D=means, shs=shs, degree=shs.shape[1])", 0),
        ("rasterizer(means3D=means, shs=shs[mask])", 0),
    ],
)
def test_where_a_renderer_joins_for_its_rasterizer(line: str, changes: int) -> None:
    text = (
        f"def render(pc, rasterizer, means, other, mask):\n    shs = None\n    shs = pc.get_features\n    return {line}"
    )
    (tree,) = ast.parse(text).body
    assert isinstance(tree, ast.FunctionDef)
    change = WholeSh(tree)
    changed = ast.unparse(ast.fix_missing_locations(change.visit(tree)))
    assert change.changes == changes
    assert (changed == ast.unparse(ast.parse(text))) == (not changes)
