"""Stored images are returned as they were put, from every place, also while a GPU is busy."""

from __future__ import annotations

import gc
import math
import mmap
import os
import random
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from torch import Tensor

from lapgs_plugin.errors import RunFolderError, SceneError, TrainingDivergedError, UserInputError
from lapgs_plugin.runs import image_store
from lapgs_plugin.runs.image_store import AHEAD, ImageStore, PageLocked, choose_place
from tests.waiting import wait_for

ITEM_SIZE = {"float32": 4, "float16": 2, "uint8": 1}

KEPT = [("cpu", "memory"), ("cpu", "disk"), ("cuda", "gpu"), ("cuda", "memory"), ("cuda", "disk")]

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")

on_every_device = pytest.mark.parametrize(
    ("device", "where"),
    [
        pytest.param(device, where, marks=[pytest.mark.gpu, needs_cuda] if device == "cuda" else [])
        for device, where in KEPT
    ],
)
in_every_precision = pytest.mark.parametrize("precision", ITEM_SIZE)


def store(folder: Path, where: str, precision: str, device: str = "cpu") -> ImageStore:
    return ImageStore(where, precision, device=device, folder=folder / "images")


def eight_bit(*shape: int) -> Tensor:
    return torch.randint(0, 256, shape, dtype=torch.uint8)


@on_every_device
@in_every_precision
@settings(deadline=None, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(values=arrays(np.float32, array_shapes(min_dims=3, max_dims=3, max_side=5), elements=st.floats(-3, 3, width=32)))
def test_images_are_returned_within_their_precision(
    tmp_path: Path, device: str, where: str, precision: str, values: np.ndarray
) -> None:
    with store(tmp_path, where, precision, device) as kept:
        kept.put("dir/view 1.jpg", torch.from_numpy(values))
        got = kept.get("dir/view 1.jpg")
        assert (got.dtype, got.device.type) == (torch.float32, device)
        result = got.cpu().numpy()
        if precision == "float32":
            np.testing.assert_array_equal(result, values)
        elif precision == "float16":  # half a unit in the last of 11 bits, or half a subnormal step
            np.testing.assert_allclose(result, values, rtol=2**-11, atol=2**-25)
        else:  # half of one of 255 steps over the image's own range, and float32 rounding of values up to 3
            assert np.abs(result - values).max() <= np.ptp(values) / 510 + 1e-6


@on_every_device
def test_photographs_are_returned_as_codebases_decode_them(tmp_path: Path, device: str, where: str) -> None:
    every = torch.arange(256, dtype=torch.uint8).view(1, 16, 16)
    for number, stored in enumerate(
        [every, eight_bit(3, 7, 9), every[:, 3:4], torch.zeros(3, 1, 1, dtype=torch.uint8)]
    ):
        image = stored / 255  # on the CPU, where PIL images are decoded
        with store(tmp_path, where, "uint8", device) as kept:
            kept.put("cpu", image)
            assert torch.equal(kept.get("cpu").cpu(), image), number
            kept.put("moved", image.to(device))
            assert torch.equal(kept.get("moved").cpu(), image), number
            kept.put("decoded there", stored.to(device) / 255)  # a GPU multiplies, and misses by an ulp
            assert torch.equal(kept.get("decoded there").cpu(), image), number


def test_images_that_are_nearly_eight_bit_are_not_taken_for_photographs() -> None:
    image = eight_bit(3, 8, 8) / 255
    image[1, 2, 3] += 0.4 / 255
    with ImageStore("memory", "uint8") as kept:
        kept.put("a", image)
        low, high = image.min(), image.max()
        steps = (kept.get("a") - low) / (high - low) * 255
        torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-4)  # its own 256 steps, worst seen 2e-5
        assert float((kept.get("a") - image).abs().max()) <= float(high - low) / 510 + 1e-6


@on_every_device
@in_every_precision
def test_an_image_is_copied_and_can_be_replaced(tmp_path: Path, device: str, where: str, precision: str) -> None:
    with store(tmp_path, where, precision, device) as kept:
        image = torch.full((3, 2, 2), -0.25, requires_grad=True, device=device)
        kept.put("a", image)
        image.data.zero_()
        assert torch.equal(kept.get("a").cpu(), torch.full((3, 2, 2), -0.25)), "constants are exact"
        kept.prefetch("a")
        kept.put("a", torch.full((3, 3, 1), 2.0, dtype=torch.float64))
        assert torch.equal(kept.get("a").cpu(), torch.full((3, 3, 1), 2.0))
        assert len(kept) == 1
        transposed = eight_bit(5, 4, 3).permute(2, 0, 1) / 255
        kept.put("b", transposed)
        torch.testing.assert_close(kept.get("b").cpu(), transposed, rtol=2**-11, atol=0)


@on_every_device
def test_prefetching_changes_no_image(tmp_path: Path, device: str, where: str) -> None:
    images = {f"{i}": torch.rand(3, 6 + i, 5) for i in range(4 * AHEAD)}
    with store(tmp_path, where, "float32", device) as kept:
        for name, image in images.items():
            kept.put(name, image)
        kept.prefetch("3")
        kept.prefetch("3")
        assert torch.equal(kept.get("3").cpu(), images["3"])
        assert torch.equal(kept.get("3").cpu(), images["3"])
        for name in images:  # more than may be under way
            kept.prefetch(name)
        for name, image in images.items():
            assert torch.equal(kept.get(name).cpu(), image)
        order = random.Random(0).choices(list(images), k=100)
        for name, following in zip(order, [*order[1:], "0"], strict=True):
            kept.prefetch(following)
            assert torch.equal(kept.get(name).cpu(), images[name])
        kept.prefetch("5")
    for ask in (kept.get, kept.prefetch):
        with pytest.raises(KeyError):
            ask("5")


@pytest.mark.parametrize(("room", "kept_images"), [(1, 1), (3, 3), (100, AHEAD)])
def test_prefetched_images_are_few_and_of_few_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int, kept_images: int
) -> None:
    shape = (3, 37, 41)
    monkeypatch.setattr(image_store, "AHEAD_BYTES", room * 4 * math.prod(shape))
    with store(tmp_path, "disk", "float32") as kept:
        for number in range(3 * AHEAD):
            kept.put(str(number), torch.full(shape, float(number)))
        for number in range(3 * AHEAD):
            kept.prefetch(str(number))

        def images_in_memory() -> int:
            alive = (one for one in gc.get_objects() if type(one) is torch.Tensor and one.shape == shape)
            return len({one.data_ptr() for one in alive})

        wait_for(lambda: images_in_memory() == kept_images)  # reading those that were dropped has ended
        assert all(kept.get(str(number))[0, 0, 0] == number for number in range(3 * AHEAD))


@on_every_device
@in_every_precision
def test_bytes_on_a_gpu_are_counted(tmp_path: Path, device: str, where: str, precision: str) -> None:
    size = 3 * 4 * 5 * ITEM_SIZE[precision]
    with store(tmp_path, where, precision, device) as kept:
        for name in "abc":
            kept.put(name, torch.rand(3, 4, 5))
        at_rest = 3 * size if where == "gpu" else 0
        assert kept.bytes_on_device == at_rest
        kept.prefetch("b")
        assert kept.bytes_on_device == (size if device == "cuda" and where != "gpu" else at_rest)
        kept.get("b")
        assert kept.bytes_on_device == at_rest
        if where == "disk":
            assert sum(file.stat().st_size for file in (tmp_path / "images").iterdir()) == 3 * size
    assert not (tmp_path / "images").exists()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, needs_cuda])])
@pytest.mark.parametrize("precision", ["uint8", "float32"])
def test_functions_take_the_place_of_images(tmp_path: Path, device: str, precision: str) -> None:
    """They are called by threads at each use, and nothing of them is in memory or on the disk in between."""
    sizes = {f"{i}": (5 + i % 3, 4) for i in range(3 * AHEAD)}
    levels = {name: eight_bit(*size, 3).permute(2, 0, 1) for name, size in sizes.items()}  # channels last in memory
    callers: dict[str, list[threading.Thread]] = {name: [] for name in sizes}

    def reader(name: str) -> Callable[[], Tensor]:
        def read() -> Tensor:
            callers[name].append(threading.current_thread())
            return levels[name] if precision == "uint8" else levels[name] / 255

        return read

    def gone() -> Tensor:
        raise SceneError("gone")

    with store(tmp_path, "disk", precision, device) as kept:
        for name, (height, width) in sizes.items():
            kept.put_reader(name, (3, height, width), reader(name))
        assert not any(callers.values())
        for _ in range(2):
            for name in sizes:
                kept.prefetch(name)
            for name in sizes:
                assert torch.equal(kept.get(name).cpu(), levels[name] / 255)
                stored = kept.get_stored(name)
                assert stored.dtype == getattr(torch, precision)
                assert stored.is_contiguous()
        assert all(len(threads) >= 4 for threads in callers.values())
        assert threading.main_thread() not in {thread for threads in callers.values() for thread in threads}
        alike = [name for name, size in sizes.items() if size == sizes["0"]]
        assert torch.equal(kept.get(*alike).cpu(), torch.stack([levels[name] for name in alike]) / 255)
        kept.put_reader("0", (3, 2, 2), gone)
        with pytest.raises(SceneError, match="gone"):
            kept.get("0")
        assert not (tmp_path / "images").exists()
        kept.put("0", torch.ones(3, 2, 2))
        assert torch.equal(kept.get("0").cpu(), torch.ones(3, 2, 2))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_the_disk_is_read_in_the_background(tmp_path: Path) -> None:
    """While one reader waits for the bytes of a pipe, another image can be returned."""
    with store(tmp_path, "disk", "float32") as kept:
        kept.put("slow", torch.ones(3, 2, 2))
        kept.put("other", torch.zeros(3, 2, 2))
        pipe = tmp_path / "images" / "000000.bin"
        contents = pipe.read_bytes()
        pipe.unlink()
        os.mkfifo(pipe)
        kept.prefetch("slow")
        with pipe.open("wb") as stream:  # opens when the reader has opened it
            pipe.unlink()
            assert torch.equal(kept.get("other"), torch.zeros(3, 2, 2))
            sent = threading.Event()

            def send() -> None:
                sent.set()
                stream.write(contents)
                stream.flush()

            threading.Timer(0.05, send).start()
            kept.put("slow", torch.full((3, 2, 2), 5.0))  # waits for the reader, and never mixes with its image
            assert sent.is_set()
        assert torch.equal(kept.get("slow"), torch.full((3, 2, 2), 5.0))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, needs_cuda])])
def test_files_that_are_gone_or_cut_short(tmp_path: Path, device: str) -> None:
    with store(tmp_path, "disk", "float16", device) as kept:
        for name in "abc":
            kept.put(name, torch.rand(3, 4, 5))
        kept.prefetch("c")
        time.sleep(0.05)
        (tmp_path / "images" / "000000.bin").write_bytes(b"x")
        (tmp_path / "images" / "000001.bin").unlink()
        for name, number in (("a", 0), ("b", 1)):
            for _ in range(2):
                with pytest.raises(RunFolderError, match=rf"00000{number}\.bin cannot be read: .*; expected"):
                    kept.get(name)
        kept.put("b", torch.ones(3, 4, 5))
        assert torch.equal(kept.get("b").cpu(), torch.ones(3, 4, 5))


def test_a_full_disk_is_one_line_and_leaves_no_half_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, data: Any) -> int:
        with path.open("wb") as stream:
            stream.write(bytes(data)[:7])
        raise OSError(28, "No space left on device")

    with store(tmp_path, "disk", "float32") as kept:
        kept.put("a", torch.ones(3, 2, 2))
        with monkeypatch.context() as patched:
            patched.setattr(Path, "write_bytes", full)
            with pytest.raises(RunFolderError, match=r"000001\.bin cannot be written: No space left .*free some space"):
                kept.put("b", torch.ones(3, 2, 2))
        assert [file.name for file in (tmp_path / "images").iterdir()] == ["000000.bin"]
        assert len(kept) == 1


@pytest.mark.parametrize("precision", ITEM_SIZE)
def test_images_that_diverged_are_refused(precision: str) -> None:
    with ImageStore("memory", precision) as kept:
        for bad in (torch.nan, torch.inf, -torch.inf):
            with pytest.raises(TrainingDivergedError, match=r"view a\.jpg holds NaN"):
                kept.put("a.jpg", torch.tensor([0.0, bad]).view(1, 1, 2))
        if precision == "float16":
            with pytest.raises(TrainingDivergedError, match="beyond 65504"):
                kept.put("a.jpg", torch.full((1, 1, 2), 1e5))
        assert len(kept) == 0


def test_unknown_places_and_precisions_are_named(tmp_path: Path) -> None:
    for where in ("tape", "gpu"):
        with pytest.raises(UserInputError, match=f"cannot be kept on {where}: expected memory or disk$"):
            ImageStore(where, "float32")
    with pytest.raises(UserInputError, match=r"cannot be kept on tape: expected gpu or memory or disk$"):
        ImageStore("tape", "float32", device="cuda")
    with pytest.raises(UserInputError, match="cannot be stored as int4: expected float32, float16, uint8"):
        ImageStore("memory", "int4")


@pytest.mark.parametrize(("memory", "limit"), [(8 << 30, (8 << 30) // 10), (80 << 30, 1 << 30)])
def test_a_gpu_keeps_images_that_are_small_beside_its_memory(
    monkeypatch: pytest.MonkeyPatch, memory: int, limit: int
) -> None:
    class Properties:
        total_memory = memory

    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: Properties)
    assert [choose_place(limit + more, "cuda") for more in (-1, 0, 1)] == ["gpu", "gpu", "memory"]
    assert choose_place(1, "cpu") == "memory"


class Runtime:
    """Stand in for the CUDA runtime: it keeps an error until a launch of this thread reads it.

    Attributes:
        full: whether it refuses to register more memory.
        registered: bytes by address.
        last_error: 0 for none.
    """

    def __init__(self) -> None:
        self.full, self.registered, self.last_error = False, dict[int, int](), 0

    def cudaHostRegister(self, address: int, length: int, flags: int) -> int:
        assert address % mmap.PAGESIZE == length % mmap.PAGESIZE == 0
        assert flags == 1
        if self.full:
            self.last_error = 2
            return 2
        for other, other_length in self.registered.items():
            assert address + length <= other or other + other_length <= address
        self.registered[address] = length
        return 0

    def cudaHostUnregister(self, address: int) -> int:
        if self.registered.pop(address, None) is None:
            self.last_error = 713
            return 713
        return 0

    def cudaGetErrorString(self, error: int) -> str:
        return {2: "out of memory"}[error]

    def launch(self, *_: object, **__: object) -> None:
        error, self.last_error = self.last_error, 0
        if error:
            raise RuntimeError("CUDA error")


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> Runtime:
    stand_in = Runtime()
    monkeypatch.setattr(torch.cuda, "cudart", lambda: stand_in)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(torch, "ones", stand_in.launch)
    return stand_in


@pytest.mark.parametrize("num_bytes", [1, mmap.PAGESIZE - 1, mmap.PAGESIZE, mmap.PAGESIZE + 1, 1_000_003])
def test_whole_pages_are_locked_and_released_once(runtime: Runtime, num_bytes: int) -> None:
    every = [PageLocked(num_bytes, torch.device("cpu")) for _ in range(4)]
    addresses = [memory.view(torch.Size([num_bytes]), torch.uint8).data_ptr() for memory in every]
    assert list(runtime.registered) == addresses
    assert all(num_bytes <= length < num_bytes + mmap.PAGESIZE for length in runtime.registered.values())
    del every
    gc.collect()
    assert (runtime.registered, runtime.last_error) == ({}, 0)


def test_a_refusal_of_the_driver_is_one_line_and_its_error_is_cleared(runtime: Runtime) -> None:
    runtime.full = True
    with pytest.raises(
        UserInputError, match=r"5,000 more bytes .* \(out of memory\); expected room .* lower precision$"
    ):
        PageLocked(5_000, torch.device("cpu"))
    assert runtime.last_error == 0
    runtime.full = False
    kept = PageLocked(5_000, torch.device("cpu"))
    runtime.registered.clear()  # so that it refuses to release it
    del kept
    gc.collect()
    assert runtime.last_error == 0


# On a GPU


@pytest.mark.gpu
@needs_cuda
@pytest.mark.parametrize("where", ["memory", "disk", "gpu"])
@in_every_precision
def test_a_busy_gpu_gets_no_torn_and_no_stale_image(tmp_path: Path, where: str, precision: str) -> None:
    """The processor runs far ahead of the GPU and reuses the memory of images before the GPU has read them."""
    size, names = (3, 600, 800), [f"{i}" for i in range(24)]
    base = eight_bit(*size).cuda()
    load = torch.rand(2048, 2048, device="cuda")

    def image(name: str) -> Tensor:
        return ((base.int() * (2 * int(name) + 1) + int(name)) % 256).to(torch.uint8).cpu() / 255

    expected = {name: image(name).cuda() for name in names}
    with store(tmp_path, where, precision, "cuda") as kept:
        for name in names:
            kept.put(name, image(name))
        order = random.Random(0).choices(names, k=300)
        wrong = torch.zeros((), dtype=torch.int64, device="cuda")
        for i, name in enumerate(order):
            for following in order[i + 1 : i + 4]:
                kept.prefetch(following)
            got = kept.get(name)
            for _ in range(4):
                load = (load @ load).clamp_(-1, 1)
            tolerance = 0.0 if precision != "float16" else 2**-12
            wrong += ((got - expected[name]).abs().amax() > tolerance).long()
            del got
        assert wrong.item() == 0


@pytest.mark.gpu
@needs_cuda
def test_images_are_returned_to_the_current_stream(tmp_path: Path) -> None:
    image = eight_bit(3, 600, 800) / 255
    for where in ("gpu", "memory", "disk"):
        with store(tmp_path, where, "uint8", "cuda") as kept:
            kept.put("a", image)
            other = torch.cuda.Stream()
            with torch.cuda.stream(other):
                got = kept.get("a")
                doubled = got * 2
            other.synchronize()
            assert torch.equal(doubled.cpu(), image * 2)


@pytest.mark.gpu
@needs_cuda
def test_memory_is_page_locked_and_released() -> None:
    kept = PageLocked(3 * 1001 * 701, torch.device("cuda"))
    stored = kept.view(torch.Size([3, 1001, 701]), torch.uint8)
    assert is_page_locked(stored)
    del kept
    gc.collect()
    assert not is_page_locked(stored)  # memory that is still there, and is not registered any more


@pytest.mark.gpu
@needs_cuda
def test_a_refusal_of_the_driver_is_not_reported_by_the_next_launch(monkeypatch: pytest.MonkeyPatch) -> None:
    device = torch.device("cuda")
    kept = PageLocked(10_000, device)
    pages = kept.view(torch.Size([10_000]), torch.uint8)
    with monkeypatch.context() as patched:
        patched.setattr(torch, "empty", lambda *size, dtype: pages)
        with pytest.raises(UserInputError, match="page-locked"):
            PageLocked(5_000, device)
    assert float(torch.ones(3, device=device).sum()) == 3
    assert int(torch.cuda.cudart().cudaHostUnregister(pages.data_ptr())) == 0
    del kept  # the driver refuses to release it again
    gc.collect()
    assert float(torch.ones(3, device=device).sum()) == 3


def is_page_locked(stored: Tensor) -> bool:
    # `is_pinned` asks about the first byte of a tensor's storage, and ours begins before the pages that are locked.
    return torch.from_numpy(stored.numpy()).is_pinned()
