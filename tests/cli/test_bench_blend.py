"""`lapgs bench blend` where there is no GPU, and its options."""

from __future__ import annotations

import importlib.util

import pytest
import torch

from lapgs_bench.app import app
from lapgs_plugin.errors import UserInputError
from tests.cli.commands import succeeding


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--views", "1,no"), "--views '1,no': expected numbers of views such as 1,8"),
        (("--views", "²"), "--views '²': expected numbers of views such as 1,8"),
        (("--sizes", "800"), "--sizes '800': expected"),
    ],
)
def test_bad_options_are_one_line(options: tuple[str, ...], message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        succeeding(app, 120)("blend", *options)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is here")
def test_it_needs_a_gpu() -> None:
    with pytest.raises(UserInputError, match="PyTorch finds no CUDA device"):
        succeeding(app, 120)("blend")


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only")
def test_shapes() -> None:
    from lapgs_bench.kernels.blend import parse_shapes
    from lapgs_plugin.gpu_raster.blend_kernels import SHAPE, Shape

    assert list(parse_shapes("8, 4x1").values()) == [Shape(8), Shape(4, 1)]
    assert list(parse_shapes(None).values()) == [SHAPE]
    for shapes in ("1", "8x3", "8x4", "32", "axa", "²x2", "8x1x2"):
        with pytest.raises(UserInputError, match=f"--shapes '{shapes}': expected"):
            parse_shapes(shapes)
