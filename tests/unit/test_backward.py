"""Losses propagated back past PyTorch's own Python, and what training does not import."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lapgs_plugin.ops.backward import backward
from tests.cli.run_folder import write_scene

COMPILERS = "torch._dynamo", "sympy"
"""PyTorch's compiler, and what it needs; both take seconds to import."""


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1.0, 8.0])
def test_gradients_are_pytorchs(dtype: torch.dtype, scale: float) -> None:
    first = torch.randn(5, 3, dtype=dtype, requires_grad=True)
    second = first.detach().clone().requires_grad_()
    for _ in range(2):  # gradients add up
        backward(first.sin().mean(), scale)
        (scale * second.sin().mean()).backward()
    assert first.grad is not None
    assert second.grad is not None
    assert torch.equal(first.grad, second.grad)


def test_a_graph_is_freed_and_a_constant_refused() -> None:
    loss = torch.ones(3, requires_grad=True).exp().sum()
    backward(loss)
    with pytest.raises(RuntimeError, match="second time"):
        backward(loss)
    with pytest.raises(RuntimeError, match="does not require grad"):
        backward(torch.ones(()))


def test_training_does_not_import_pytorchs_compiler(tmp_path: Path) -> None:
    words = [
        "train",
        write_scene(tmp_path / "scene"),
        "-o",
        tmp_path / "run",
        "--iterations",
        8,
        "--appearance",
        "affine",
    ]
    lines = [
        "import sys",
        "from lapgs_plugin.cli.app import app",
        f"app({[*map(str, words), '--rasterizer', 'cpu', '--strategy', 'mcmc']}, standalone_mode=False)",
        f"assert not {{*{COMPILERS}}} & {{*sys.modules}}",
    ]
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True)


def test_numba_is_imported_by_its_kernels_alone() -> None:
    """Commands that train and render on a GPU have no use for it."""
    modules = (
        "training.preparation",
        "training.trainer",
        "rendering.run",
        "evaluation.metrics",
        "viewer.preview",
        "runner.driver",
        "reference_raster.pipeline",
    )
    lines = [
        "import sys",
        *(f"import lapgs_plugin.{module}" for module in modules),
        "assert 'numba' not in sys.modules",
        "import lapgs_plugin.reference_raster.tile_kernels",
        "assert 'numba' in sys.modules",
    ]
    subprocess.run([sys.executable, "-c", "\n".join(lines)], check=True)
