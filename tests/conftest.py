"""What all tests share."""

from __future__ import annotations

import gc
import os
import re
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

# Python's default looks for garbage among all that is imported again and again, and there is none. At once, because
# collecting the tests imports most of it.
gc.set_threshold(10_000, 20, 20)

SHARED_DATA = Path(os.environ.get("LAPGS_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))
MODULES_OF_EXTRAS = (
    "cv2",
    "imageio_ffmpeg",
    "mkdocs",
    "pillow_heif",
    "playwright",
    "pyarrow",
    "safetensors",
    "viser",
    "zstandard",
)


@pytest.fixture
def shared_data() -> Path:
    """The folder with the real scenes (fox, bonsai, south-building); the test is skipped by name without it."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"needs the real scenes: {SHARED_DATA} does not exist (set LAPGS_TEST_DATA)")
    return SHARED_DATA


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with tests of pages: a browser that draws in software takes longest beside other processes."""
    items.sort(key=lambda item: item.get_closest_marker("browser") is None)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Skip files by name that need a package of the extras, when only GPU tests are asked for.

    GPU machines often have PyTorch and little else. Everywhere else a missing package is an error.
    """
    report = yield
    if report.failed and "gpu" in collector.config.option.markexpr:
        missing = re.search(rf"No module named '({'|'.join(MODULES_OF_EXTRAS)})", str(report.longrepr))
        if missing:
            report.outcome, report.longrepr = "skipped", (str(collector.path), 1, f"Skipped: needs {missing[1]}")
    return report


def pytest_unconfigure() -> None:
    """Let what was frozen be freed: native modules complain about what is left when the process ends."""
    gc.unfreeze()


@pytest.fixture(autouse=True, scope="session")
def _without_waiting_for_the_disk() -> Iterator[None]:
    """Files of tests need not outlive a power cut. What is asked of the disk and when is asked all the same."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(autouse=True, scope="module")
def _garbage_of_a_file() -> Iterator[None]:
    """Free what a file leaves behind when it is finished, and never look again at what stays."""
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _seeded_and_in_one_thread(request: pytest.FixtureRequest) -> None:
    """On tensors this small, a second thread of PyTorch only spins. Tests that are marked `gpu` need a GPU."""
    import torch  # not with this file, which the process that starts the others reads first

    if request.node.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    torch.manual_seed(0)
    torch.set_num_threads(1)
