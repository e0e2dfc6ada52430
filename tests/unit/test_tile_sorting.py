"""Sorting into tiles against pairs by brute force, interpreted or compiled; room for pairs that does not suffice."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import DeviceMemoryError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.gpu_raster import bindings, tiles
from lapgs_plugin.gpu_raster.cameras import CameraCache
from lapgs_plugin.rasterizers.gsplat import direct
from tests.gsplat_on_cpu import blend_forward, direct_on_cpu, sort_by_tile
from tests.training_scene import blob_field
from tests.unit.test_blend_kernels import run_checks

CHECKS = """
import sys
import numpy as np
import torch
from hypothesis import HealthCheck, Phase, example, given, settings, strategies as st
from lapgs_plugin.gpu_raster import tile_kernels
from lapgs_plugin.rasterizers.gsplat import direct
from lapgs_plugin.gpu_raster.tile_kernels import sort_by_depth, sort_by_tile

def expected(radii, means, depths, images, across, down):
    # All tiles whose inside a footprint reaches, for every Gaussian: (tile, depth, Gaussian).
    x, y = np.arange(across) * 16.0, np.arange(down) * 16.0
    pairs = []
    for i in np.flatnonzero((radii > 0).all(1)):
        columns = (means[i, 0] + radii[i, 0] > x) & (means[i, 0] - radii[i, 0] < x + 16)
        rows = (means[i, 1] + radii[i, 1] > y) & (means[i, 1] - radii[i, 1] < y + 16)
        touched = images[i] * down * across + np.flatnonzero(rows[:, None] & columns)
        pairs += [(tile, depths[i], i) for tile in touched]
    return sorted(pairs)

@settings(max_examples=EXAMPLES, deadline=None, database=None, derandomize=True,
          phases=[Phase.explicit, Phase.generate], suppress_health_check=list(HealthCheck))
@given(
    st.integers(1, 3), st.integers(1, 40), st.tuples(st.integers(1, 20), st.integers(1, 9)),
    st.sampled_from([0, 3, 30, 2000]), st.integers(0, 2**20), st.sampled_from([1, 4, 10**6]), st.booleans(),
    st.sampled_from([0, 1, 300, -5]),
)
@example(1, 1, (1, 1), 0, 0, 1, False, 0)  # nothing is visible, in an image of one tile
@example(2, 3, (17, 16), 10**6, 1, 1, False, 0)  # each covers everything; tile numbers of 16 bits
@example(1, 2, (300, 220), 20, 1, 4, False, 7)  # of 32 bits
@example(1, 40, (6, 5), 60, 3, 4, False, 0)  # many in each tile, some at the same depth
@example(3, 40, (4, 3), 60, 5, 10**6, True, 300)  # in one list
@example(2, 20, (5, 2), 60, 7, 4, False, -5)
def check(cameras, count, grid, most, seed, depths, listed, spare):
    across, down = grid
    rng = np.random.default_rng(seed)
    total = cameras * count
    radii = rng.integers(0, most + 1, (total, 2)).astype(np.int32)
    means = rng.uniform(-40, [16 * across + 40, 16 * down + 40], (total, 2)).astype(np.float32)
    means[::3] = np.round(means[::3] / 16) * 16  # on borders of tiles
    far = rng.integers(1, depths + 1, total).astype(np.float32)  # with ties
    images = np.repeat(np.arange(cameras), count)
    if listed:
        images = np.sort(rng.integers(0, cameras, total))
    culled = ~(radii > 0).all(1)
    means[culled], far[culled] = np.nan, rng.choice([np.nan, -1.0, np.inf])  # memory that nobody wrote
    pairs = expected(radii, means, far, images, across, down)
    shape = (total,) if listed else (cameras, count)
    seen = [torch.from_numpy(each).reshape(*shape, *each.shape[1:]).to(DEVICE) for each in (radii, means, far)]
    order, ends = sort_by_depth(*seen, grid)
    assert int(ends[-1]) == len(pairs)
    room = max(1, len(pairs) + spare)
    of_image = torch.from_numpy(images).to(DEVICE) if listed else None
    offsets, flat = (each.cpu() for each in sort_by_tile(*seen[:2], order, ends, of_image, cameras, grid, room))
    borders = np.arange(cameras * across * down + 1)
    if spare >= 0:
        assert flat[: len(pairs)].tolist() == [pair[2] for pair in pairs]
        assert (offsets.numpy() == np.searchsorted([pair[0] for pair in pairs], borders)).all()
        return
    # Too little room: pairs of the farthest Gaussians are left out, and nothing else is wrong.
    kept = {(int(np.searchsorted(offsets, i, "right")) - 1, int(flat[i])) for i in range(int(offsets[-1]))}
    assert len(kept) == int(offsets[-1]) == min(room, len(pairs))
    assert kept <= {(pair[0], pair[2]) for pair in pairs}

check()
assert not any(name.partition(".")[0] == "gsplat" for name in sys.modules)
"""


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only")
def test_interpreted() -> None:
    run_checks("cpu", f"EXAMPLES = 4\n{CHECKS}", TRITON_INTERPRET="1")


@pytest.mark.gpu
def test_compiled() -> None:
    run_checks("cuda", f"EXAMPLES = 200\n{CHECKS}")


CAMERA = Camera(70, 50, 60.0, 60.0, 35.0, 25.0, torch.eye(4))
BLACK = torch.zeros(3)


class Rooms:
    """Stand-ins of our kernels that write down how many pairs there was room for."""

    def __init__(self) -> None:
        self.sorted: list[int] = []
        self.blended = 0

    def sort_by_tile(self, *arguments: Any) -> tuple[Tensor, Tensor]:
        self.sorted.append(arguments[-1])
        return sort_by_tile(*arguments)

    def blend_forward(self, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        self.blended += 1
        return blend_forward(*arguments)


@pytest.fixture
def rooms(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rooms]:
    monkeypatch.setattr(tiles, "_rooms", {})
    monkeypatch.setattr(tiles, "LEAST_ROOM", 8)
    rooms = Rooms()
    with direct_on_cpu(sort_by_tile=rooms.sort_by_tile, blend_forward=rooms.blend_forward):
        yield rooms


def image_and_gradient(count: int) -> tuple[Tensor, Tensor]:
    field = blob_field(count)
    field.means.requires_grad_()
    image = direct.render_images(field, CameraCache().get([CAMERA], field.means), BLACK, 0)
    image.square().sum().backward()  # type: ignore[no-untyped-call]  # torch's
    assert field.means.grad is not None
    return image.detach(), field.means.grad


def test_an_image_for_which_there_was_too_little_room_is_made_again(rooms: Rooms) -> None:
    image_and_gradient(3)  # which teaches a room
    few, rooms.sorted = rooms.sorted[0], []
    rooms.blended = 0
    late = image_and_gradient(60)
    assert rooms.sorted[0] <= few < rooms.sorted[1]
    assert rooms.blended == 2
    tiles._rooms.clear()
    expected = image_and_gradient(60)
    for one, other in zip(late, expected, strict=True):
        assert torch.equal(one, other)
    assert float(expected[0].max()) > 0.1


def test_room_is_kept_for_the_next_image_and_given_up_slowly(rooms: Rooms) -> None:
    for count in (60, 60, *[3] * 60):
        image_and_gradient(count)
    assert rooms.blended == 62
    assert rooms.sorted[0] == rooms.sorted[1] == rooms.sorted[2]
    assert rooms.sorted[-1] < rooms.sorted[0] / 2


@pytest.mark.parametrize("pairs", [1, 7, 1000, 10**6, 123_456_789, tiles.MOST_PAIRS])
def test_room_is_enough_and_not_much_more(pairs: int) -> None:
    assert pairs <= tiles._rounded(pairs) <= max(tiles.LEAST_ROOM, 1.07 * pairs)


def test_more_pairs_than_can_be_numbered_are_refused(rooms: Rooms, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "MOST_PAIRS", 20)
    with pytest.raises(DeviceMemoryError, match=r"pairs of Gaussians and tiles.* 20 at most.*fewer or smaller Gauss"):
        image_and_gradient(60)
    assert rooms.blended == 0


def test_an_image_of_too_many_pairs_does_not_forbid_the_next_one(rooms: Rooms, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles, "MOST_PAIRS", 20)
    expected = image_and_gradient(3)
    with pytest.raises(DeviceMemoryError, match="20 at most"):
        image_and_gradient(60)
    for one, other in zip(image_and_gradient(3), expected, strict=True):
        assert torch.equal(one, other)


def test_gsplats_sorting_is_used_only_if_nothing_has_to_be_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    bindings.compiled_functions.cache_clear()
    monkeypatch.setattr(bindings, "gsplat_built", lambda: None)
    assert bindings.compiled_functions() is None
    bindings.compiled_functions.cache_clear()
    monkeypatch.setattr(bindings, "gsplat_built", lambda: True)
    monkeypatch.setattr(bindings, "installed_version", lambda name: "1.6.0")
    assert bindings.compiled_functions() is None
    bindings.compiled_functions.cache_clear()
