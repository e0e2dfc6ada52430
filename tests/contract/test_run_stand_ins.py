"""Test the choice of the stand-in for a checkout's rasterizer with `--device cpu`."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from lapgs_plugin.adapters.registry import adapter_class
from tests.contract.stub_runs import STUBS


@pytest.mark.parametrize(
    ("name", "arguments", "variant"),
    [
        ("fastgs", (), "fastgs"),
        ("taming", ("--optimizer_type", "sparse_adam"), "taming"),
        ("graphdeco", (), "graphdeco-aa"),
        ("graphdeco", ("--optimizer_type", "default"), "graphdeco-aa"),
        ("graphdeco", ("--optimizer_type", "sparse_adam"), "graphdeco-accel"),
        ("graphdeco", ("--optimizer_type=sparse_adam", "--antialiasing"), "graphdeco-accel"),
    ],
)
def test_the_stand_in_is_that_of_checkout_and_options(name: str, arguments: tuple[str, ...], variant: str) -> None:
    checkout = STUBS[name].script.parent
    assert adapter_class(checkout).stand_in_for(checkout, arguments) == variant


def test_a_checkout_from_before_antialiasing(tmp_path: Path) -> None:
    """The renderer lacks the setting, so its rasterizer does, too."""
    checkout = Path(shutil.copytree(STUBS["graphdeco"].script.parent, tmp_path / "graphdeco"))
    renderer = checkout / "gaussian_renderer" / "__init__.py"
    text = renderer.read_text(encoding="utf-8")
    renderer.write_text(text.replace("        antialiasing=pipe.antialiasing,\n", ""), encoding="utf-8")
    assert adapter_class(checkout).stand_in_for(checkout, ()) == "graphdeco"
