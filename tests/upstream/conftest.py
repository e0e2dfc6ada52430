"""Make a scene for the real checkouts."""

from __future__ import annotations

from pathlib import Path

import pytest

from lapgs_plugin.scenes.sample import make_sample_scene
from tests.upstream.checkouts import checkout

POINTS = 1500


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test without its checkout before the scene is made."""
    call = getattr(item, "callspec", None)
    if call is not None and "variable" in call.params:
        checkout(call.params["variable"])


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a scene of 21 training views, more than FastGS draws for its scores, and three held-out views."""
    folder = tmp_path_factory.mktemp("upstream") / "scene"
    make_sample_scene(folder, width=240, height=160, views=24, points=POINTS, progress=False)
    return folder
