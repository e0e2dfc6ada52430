"""The noise that our Triton kernel draws, interpreted on a CPU."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import pytest

CHECKS = """
import torch
from lapgs_plugin.ops import position_noise
position_noise.triton_works = lambda means: True
n = 20_000

def drawn():
    means = torch.zeros(n, 3)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1)
    position_noise.add_noise(means, upright, torch.zeros(n, 3), torch.full((n,), -20.0), 1.0)
    return means / torch.sigmoid(torch.tensor(0.5))

torch.manual_seed(3)
state = torch.get_rng_state()
first, second = drawn(), drawn()
torch.set_rng_state(state)  # as a resumed run does
assert torch.equal(drawn(), first)
both = torch.cat([first, second], 1)
assert both.mean(0).abs().max() < 0.03, both.mean(0)  # worst seen 0.012
covariance = torch.cov(both.T)
assert (covariance - torch.eye(6)).abs().max() < 0.04, covariance  # worst seen 0.022
assert (both.pow(4).mean(0) - 3).abs().max() < 0.3  # a normal distribution's; worst seen 0.16
"""


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only")
def test_it_is_normal_and_repeats_with_the_state_of_the_generator() -> None:
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    command = [sys.executable, "-c", CHECKS]
    done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
