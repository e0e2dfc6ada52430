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


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)
