"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

SHARED_DATA = Path(os.environ.get("LAPGS_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture
def shared_data() -> Path:
    """The folder with the real scenes (fox, bonsai, south-building); the test is skipped by name without it."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"needs the real scenes: {SHARED_DATA} does not exist (set LAPGS_TEST_DATA)")
    return SHARED_DATA


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with tests of pages: a browser that draws in software takes longest beside other processes."""
    items.sort(key=lambda item: item.get_closest_marker("browser") is None)


@pytest.fixture(autouse=True)
def _seeded_and_in_one_thread() -> None:
    """On tensors this small, a second thread of PyTorch only spins."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
