"""Make a scene for the stub checkouts."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lapgs_plugin.scenes.sample import make_sample_scene
from tests.contract.stub_runs import SAVING, STUBS, Result, run_bare


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a scene of ten training views, which FastGS needs for its scores, and two held-out views."""
    path = tmp_path_factory.mktemp("scene") / "sample"
    make_sample_scene(path, width=64, height=48, views=12, points=300, progress=False)
    return path


@pytest.fixture(scope="session")
def big(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a scene for three levels, with odd sizes at the second."""
    path = tmp_path_factory.mktemp("big") / "scene"
    make_sample_scene(path, width=96, height=66, views=12, points=300, progress=False)
    return path


@pytest.fixture(scope="session")
def bare_run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Result, Tensor]]:
    """Return a function that runs a stub once as Python does, and the random number that comes after its run."""

    @cache
    def run(name: str) -> tuple[Result, Tensor]:
        torch.manual_seed(0)
        return run_bare(STUBS[name], scene, tmp_path_factory.mktemp(name) / "bare", *SAVING), torch.rand(1)

    return run
