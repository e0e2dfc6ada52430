"""`lapgs bench ops` at a small size."""

from __future__ import annotations

import pytest
import torch

from lapgs_bench.app import app
from lapgs_bench.kernels.operations import TORCH, benchmark
from lapgs_plugin.errors import UserInputError
from tests.cli.commands import succeeding

SMALL = ("--device", "cpu", "--width", 36, "--height", 24, "--gaussians", 50, "--repeats", 1)


def test_every_version_gives_what_pytorch_gives() -> None:
    times = benchmark(torch.device("cpu"), 36, 24, 50, 1)
    versions = {(time.op, time.version): time.difference for time in times}
    assert {op for op, _ in versions} == {
        "upsample", "photometric loss", "Adam", "densification statistics", "colour transform", "residual's loss",
        "regularization", "position noise", "bilateral grid", "variation of 50 grids",
    }  # fmt: skip
    for op in ("upsample", "photometric loss", "Adam"):
        # Sums in other orders, of values of about 1; worst seen: 3e-6, of the loss's gradient.
        assert versions[op, "Numba"] < 2e-5
    assert versions["upsample", "kornia.pyrup"] < 2e-5
    assert versions["Adam", "torch.optim.Adam"] < 2e-5
    assert all(time.ratio == 1 for time in times if time.version == TORCH)
    assert all(time.milliseconds > 0 and time.busy is None for time in times)
    assert {time.op for time in benchmark(torch.device("cpu"), 36, 24, 50, 1, "colour")} == {"colour transform"}


def test_sides_that_kornia_cannot_double_leave_it_out() -> None:
    assert "kornia.pyrup" not in {time.version for time in benchmark(torch.device("cpu"), 35, 24, 50, 1)}


def test_table() -> None:
    table = succeeding(app, 120)("ops", *SMALL)
    assert "Operations at 36x24 with 50 Gaussians on cpu" in table
    for word in ("upsample", "densification statistics", "Numba", "kornia.pyrup", "speed-up"):
        assert word in table


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(UserInputError, match="--device tpu: expected auto, cuda, cpu"):
        succeeding(app, 120)("ops", "--device", "tpu")


def test_a_text_that_no_operation_has_is_refused() -> None:
    with pytest.raises(UserInputError, match="--only grod: no operation's name has this text"):
        succeeding(app, 120)("ops", *SMALL, "--only", "grod")
