"""The striped scene of `run_folder` and a run of it, for whoever has none of their own."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.run_folder import write_run, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture
def run(scene: Path, tmp_path: Path) -> Path:
    return write_run(tmp_path / "run", scene)
