"""Make a scene for the stub checkouts."""

from __future__ import annotations

from pathlib import Path

import pytest

from lapgs_plugin.scenes.sample import make_sample_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a scene of ten training views, which FastGS needs for its scores, and two held-out views."""
    path = tmp_path_factory.mktemp("scene") / "sample"
    make_sample_scene(path, width=64, height=48, views=12, points=300, progress=False)
    return path
