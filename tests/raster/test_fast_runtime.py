"""Check how the fast rasterizer runs: the same bits always, many threads, reused memory, one compilation."""

from __future__ import annotations

import gc
import multiprocessing
import os
import shutil
import subprocess
import sys
import textwrap
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

from lapgs_plugin.jit import buffers, compiler
from lapgs_plugin.jit.threads import num_threads, one_pool, parallel
from lapgs_plugin.reference_raster import pipeline
from lapgs_plugin.reference_raster.fast import CpuRasterizer
from tests.raster import scenes
from tests.raster.scenes import Case

CPU = CpuRasterizer()


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    yield
    torch.set_num_threads(before)


def everything(case: Case) -> dict[str, Tensor]:
    """All that one forward and backward pass returns."""
    case = case.with_leaves()
    result = case.render(CPU)
    (result.image * scenes.pixel_weights(case)).sum().backward()
    assert result.absgrad2d is not None
    assert result.means2d.grad is not None
    outputs = {name: value.grad for name, value in case.field.parameters.items() if value.grad is not None}
    assert len(outputs) == 5
    outputs |= {"image": result.image.detach(), "transmittance": result.transmittance.detach(), "radii": result.radii}
    return outputs | {"means2d": result.means2d.grad, "absgrad2d": result.absgrad2d}


def assert_same_bits(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    for name, value in expected.items():
        assert torch.equal(actual[name], value), name


# ------------------------------------------------------------------------------------------------ determinism


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_same_bits_for_any_number_of_threads_and_in_every_run(dtype: torch.dtype) -> None:
    case = scenes.random_case(700, 150, 90, seed=1, pixels=(0.5, 12.0)).to(dtype)
    with torch_threads(1):
        expected = everything(case)
    for threads in (1, 2, 2, 3, 7):
        with torch_threads(threads):
            assert num_threads() == threads
            assert_same_bits(everything(case), expected)


def test_several_python_threads_render_at_once() -> None:
    cases = [scenes.random_case(150, 60 + i, 50, seed=i).to(torch.float32) for i in range(6)]
    with torch_threads(2):
        expected = [everything(case) for case in cases]
        with ThreadPoolExecutor(4) as pool:
            for _ in range(3):
                for outputs, wanted in zip(pool.map(everything, cases), expected, strict=True):
                    assert_same_bits(outputs, wanted)


def _render_in_child(case: Case, expected: dict[str, Tensor]) -> None:
    assert_same_bits(everything(case), expected)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked on this system")
def test_a_forked_process_renders() -> None:
    case = scenes.random_case(200, 64, 64, seed=2).to(torch.float32)
    with torch_threads(2), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns of any fork beside threads
        expected = everything(case)
        child = multiprocessing.get_context("fork").Process(target=_render_in_child, args=(case, expected))
        child.start()
        child.join(60)
    assert child.exitcode == 0


# ------------------------------------------------------------------------------------------------ threads


def test_parallel_waits_for_all_and_passes_errors_on() -> None:
    seen: list[int] = []

    def work(counter: NDArray[np.int64], label: str) -> None:
        seen.append(threading.get_ident())
        if label == "fail" and len(seen) == 2:
            raise ValueError("broken kernel")
        barrier.wait(10)

    with torch_threads(3):
        barrier = threading.Barrier(3)  # passes only if three threads are inside at once
        parallel(work, "fine")
        assert len(set(seen)) == 3
        seen.clear()
        barrier = threading.Barrier(2)
        with pytest.raises(ValueError, match="broken kernel"):
            parallel(work, "fail")


def test_one_pool_puts_torch_on_one_thread_and_kernels_on_as_many_as_before() -> None:
    with torch_threads(2):
        with one_pool():
            assert torch.get_num_threads() == 1
            assert num_threads() == 2
            with pytest.raises(KeyError), one_pool():
                raise KeyError
            assert torch.get_num_threads() == 1
            assert num_threads() == 2
        assert torch.get_num_threads() == 2
        assert num_threads() == 2


# ------------------------------------------------------------------------------------------------ memory


def test_results_survive_later_calls() -> None:
    first, second = (scenes.random_case(100, 40, 40, seed=i).to(torch.float32) for i in range(2))
    kept = everything(first)
    copies = {name: value.clone() for name, value in kept.items()}
    for _ in range(3):
        everything(second)
    assert_same_bits(kept, copies)


@pytest.mark.parametrize("size", [1, 1000, buffers.SMALL // 4])
def test_memory_is_aligned_and_writable(size: int) -> None:
    array = buffers.empty(size, np.float32)
    array[:] = 3.0
    assert array.shape == (size,)
    assert array.ctypes.data % buffers.ALIGNMENT == 0


def test_large_memory_comes_back_when_its_last_user_is_gone() -> None:
    array = buffers.empty(buffers.SMALL, np.float32)
    address = array.ctypes.data
    tensor = torch.from_numpy(array[8:].reshape(-1, 4)[::2])
    del array
    held = buffers.empty(buffers.SMALL, np.float32)
    assert held.ctypes.data != address  # the tensor of a view still needs it
    del tensor
    gc.collect()
    again = [buffers.empty(buffers.SMALL, np.float32) for _ in range(2)]
    assert address in {a.ctypes.data for a in again}


def test_sizes_that_vary_from_view_to_view_share_memory() -> None:
    addresses = set()
    for size in (1_100_000, 1_090_000, 1_120_000, 1_100_001):
        array = buffers.empty(size, np.float32)
        addresses.add(array.ctypes.data)
        del array
    assert len(addresses) == 1


def test_idle_memory_is_given_back() -> None:
    before = len(buffers._store._free)
    first = [buffers.empty(buffers.SMALL * i, np.float32) for i in range(1, 6)]
    del first
    assert len(buffers._store._free) >= before
    for _ in range(buffers.PATIENCE + 1):
        buffers.empty(buffers.SMALL * 10, np.float32)
    assert [block.size for block in buffers._store._free] == [buffers.SMALL * 40]


def test_optimizers_own_gradients_without_a_copy(monkeypatch: pytest.MonkeyPatch) -> None:
    handed_out = set()

    def watched(size: int, dtype: DTypeLike) -> NDArray[Any]:
        array = buffers.empty(size, dtype)
        handed_out.add(array.ctypes.data)
        return array

    monkeypatch.setattr(pipeline, "empty", watched)
    case = scenes.random_case(100, 30, 30, seed=3).to(torch.float32).with_leaves()
    case.render(CPU).image.sum().backward()
    for name, value in case.field.parameters.items():
        assert value.grad is not None
        assert value.grad.data_ptr() in handed_out, name


def test_backward_twice_and_gradients_that_add_up() -> None:
    case = scenes.random_case(60, 30, 30, seed=4).to(torch.float32).with_leaves()
    image = case.render(CPU).image
    image.sum().backward(retain_graph=True)
    assert case.field.means.grad is not None
    once = case.field.means.grad.clone()
    image.sum().backward()
    assert torch.equal(case.field.means.grad, once + once)
    with pytest.raises(RuntimeError, match="backward through the graph a second time"):
        image.sum().backward()


def test_parameters_changed_between_forward_and_backward_are_noticed() -> None:
    case = scenes.random_case(60, 30, 30, seed=5).to(torch.float32).with_leaves()
    image = case.render(CPU).image
    with torch.no_grad():
        case.field.means.add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


def test_second_derivatives_are_refused() -> None:
    case = scenes.random_case(10, 20, 20, seed=6).with_leaves()
    (gradient,) = torch.autograd.grad(case.render(CPU).image.square().sum(), [case.field.means], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_only_some_parameters_require_gradients() -> None:
    case = scenes.random_case(60, 30, 30, seed=7).to(torch.float32)
    whole = everything(case)
    parameters = {name: value.detach().clone() for name, value in case.field.parameters.items()}
    parameters["opacity_logits"].requires_grad_()
    partial = replace(case, field=case.field.with_parameters(parameters))
    (partial.render(CPU).image * scenes.pixel_weights(case)).sum().backward()
    assert parameters["opacity_logits"].grad is not None
    assert torch.equal(parameters["opacity_logits"].grad, whole["opacity_logits"])
    assert parameters["means"].grad is None


# ------------------------------------------------------------------------------------------------ compilation

MESSAGE = "compiling CPU kernels"
PACKAGE = Path(__file__).parents[2] / "lapgs_plugin"


def run_python(code: str, path: Path) -> str:
    """Return the stderr of a fresh process that imports from `path` first."""
    environment = dict(os.environ)
    if path != PACKAGE.parent:  # a copy is compiled again, even if an earlier one was at the same place
        environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        cwd=path,
        env={**environment, "PYTHONPATH": str(path)},
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    return done.stderr


def test_a_second_process_does_not_compile() -> None:
    everything(scenes.random_case(5, 20, 20).to(torch.float32))  # compiles here if nobody has yet
    code = """
        import torch
        from tests.raster import scenes
        from lapgs_plugin.reference_raster import CpuRasterizer

        case = scenes.random_case(5, 20, 20).to(torch.float32).with_leaves()
        case.render(CpuRasterizer()).image.sum().backward()
        assert case.field.means.grad is not None
    """
    assert MESSAGE not in run_python(code, PACKAGE.parent)


@pytest.fixture
def copied_package(tmp_path: Path) -> Path:
    """Copy the kernels' sources, without compiled code and with an `__init__` that does not import torch."""
    shutil.copytree(PACKAGE, tmp_path / PACKAGE.name, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / PACKAGE.name / "reference_raster" / "__init__.py").write_text("")
    return tmp_path


TWO_TYPES_OF_A_SMALL_KERNEL = """
import numpy as np
from lapgs_plugin.reference_raster.ordering_kernels import count_pairs

for kind in (np.int32, np.int64):
    first_pair = np.zeros(3, np.int64)
    assert count_pairs(2, np.array([0, 0, 2, 3, 1, 1, 1, 5], kind), first_pair) == 1
    assert first_pair.tolist() == [0, 6, 6]
"""


def test_compilation_is_reported_once_and_repeated_only_after_a_change(copied_package: Path) -> None:
    assert run_python(TWO_TYPES_OF_A_SMALL_KERNEL, copied_package).count(MESSAGE) == 1
    assert run_python(TWO_TYPES_OF_A_SMALL_KERNEL, copied_package) == ""
    with (copied_package / "lapgs_plugin" / "jit" / "lanes.py").open("a") as file:
        file.write("# a change\n")
    assert MESSAGE in run_python(TWO_TYPES_OF_A_SMALL_KERNEL, copied_package)


@pytest.mark.parametrize("name", ["layout.py", "in_torch.py", "tile_kernels.py"])
@pytest.mark.parametrize("folder", ["", "inside"])
def test_compiled_code_is_as_old_as_what_it_was_compiled_from(name: str, folder: str, tmp_path: Path) -> None:
    """SSIM's constants, for example, are in `in_torch`; compiled kernels hold their values."""
    stamp = compiler._helpers_stamp.__wrapped__
    (tmp_path / "inside").mkdir()
    file = tmp_path / folder / name
    file.write_text("A = 1")
    before = stamp(tmp_path / "inside")
    assert stamp(tmp_path / "inside") == before
    file.write_text("A = 2")
    assert stamp(tmp_path / "inside") != before


NOWHERE = """
from numba.core import caching
for locator in caching.CacheImpl._locator_classes:
    locator.from_function = classmethod(lambda cls, function, file: None)
"""
FULL_DISK = """
from numba.core import caching
def save(self, key, data):
    raise OSError(28, "No space left on device")
caching.IndexDataCacheFile.save = save
"""


@pytest.mark.parametrize("trouble", [NOWHERE, FULL_DISK])
def test_no_place_for_a_cache_is_no_error(trouble: str, copied_package: Path) -> None:
    assert MESSAGE in run_python(trouble + TWO_TYPES_OF_A_SMALL_KERNEL, copied_package)
    assert not list(copied_package.rglob("*.nbc"))
