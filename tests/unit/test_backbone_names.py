"""A backbone is named in its own files alone: code elsewhere treats all backbones alike."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from lapgs_plugin.adapters.registry import OWN
from tests.package_strings import PACKAGES, ROOT

EXCEPTIONS = {
    "lapgs_plugin/family": "the backbones' CUDA modules on a CPU, one table of settings for all",
}
"""Folders whose files may name any backbone, and why."""


def names_in(source: str) -> Iterator[tuple[int, str]]:
    """Identifiers and strings of a module that contain a backbone's name, with their lines; docstrings do not count."""
    tree = ast.parse(source)
    alone = [node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)]
    documentation = {id(value) for value in alone if isinstance(value, ast.Constant)}
    for node in ast.walk(tree):
        if id(node) in documentation:
            continue
        for value in vars(node).values():
            if isinstance(value, str) and any(name in value.lower() for name in OWN):
                yield getattr(node, "lineno", 0), value


def modules() -> list[Path]:
    """Modules of the packages that may name no backbone, or only their own."""
    paths = [path.relative_to(ROOT) for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return [path for path in paths if not any(path.is_relative_to(folder) for folder in EXCEPTIONS)]


def test_no_module_names_a_backbone_that_is_not_its_own() -> None:
    own = {Path("lapgs_plugin/adapters", f"{name}.py") for name in OWN}
    assert len(own) == 8
    mentions = {
        f"{path}:{line}: {text}"
        for path in modules()
        if path not in own
        for line, text in names_in((ROOT / path).read_text(encoding="utf-8"))
    }
    assert mentions == set()


@pytest.mark.parametrize(
    "source",
    [
        "def render_fastgs(): ...",
        "from lapgs_plugin.adapters import taming",
        "x = 'the fork of FastGS'",
        "x = f'{y} Graphdeco'",
        "render(fastgs=1)",
        "module.taming_utils",
    ],
)
def test_a_name_is_found(source: str) -> None:
    assert list(names_in(source))


def test_documentation_may_name_them() -> None:
    assert not list(names_in('"""As FastGS."""\nx = 1  # as Taming-3DGS\n"""As graphdeco."""\n'))
