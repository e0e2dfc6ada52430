"""Let tests render by gsplat without a GPU, and load modules that they write."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

from tests.gsplat_on_cpu import direct_on_cpu, gsplat_on_cpu


@pytest.fixture
def gsplat_kernels() -> Iterator[None]:
    """Put gsplat's kernels on the CPU in the place of its CUDA part."""
    with gsplat_on_cpu(), direct_on_cpu():
        yield


@pytest.fixture
def load_module(tmp_path: Path) -> Callable[[str], ModuleType]:
    """Return a function that writes a module, outside of `sys.modules`, and loads it."""

    def load(text: str) -> ModuleType:
        path = tmp_path / "written.py"
        path.write_text(text)
        spec = importlib.util.spec_from_file_location("written", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load
