"""Make a scene for the real checkouts."""

from __future__ import annotations

from pathlib import Path

import pytest

from lapgs_plugin.scenes.sample import make_sample_scene

POINTS = 1500


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a scene of 21 training views, more than FastGS draws for its scores, and three held-out views."""
    folder = tmp_path_factory.mktemp("upstream") / "scene"
    make_sample_scene(folder, width=240, height=160, views=24, points=POINTS, progress=False)
    return folder
