"""Let tests render by gsplat without a GPU."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.gsplat_on_cpu import direct_on_cpu, gsplat_on_cpu


@pytest.fixture
def gsplat_kernels() -> Iterator[None]:
    """Put gsplat's kernels on the CPU in the place of its CUDA part."""
    with gsplat_on_cpu(), direct_on_cpu():
        yield
