"""Parts of the fast rasterizer by themselves: vectors, exponentials, sorting, and that culling is exact."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lapgs_plugin.jit import lanes
from lapgs_plugin.jit.compiler import jit
from lapgs_plugin.jit.lanes import Floats
from lapgs_plugin.jit.threads import parallel
from lapgs_plugin.reference_raster import layout, ordering_kernels, pipeline, projection_kernels, tile_kernels
from lapgs_plugin.reference_raster.fast import CpuRasterizer
from tests.raster import scenes

KINDS = [np.float32, np.float64]

# ------------------------------------------------------------------------------------------------ vectors


@jit
def arithmetic(a: Floats, b: Floats, out: Floats) -> int:
    x, y = lanes.load(a, 0), lanes.load(b, 0)
    lanes.store(out, 0, lanes.fma(x, y, 1.0) + 2.0 * x - y / x)
    lanes.store(out, 16, lanes.select((x >= y) | ((x < 0.5) & (y > 0.0)), x, -1.0))
    lanes.store(out, 32, lanes.minimum(x, 0.25) + lanes.maximum(-y, x))
    lanes.store(out, 48, lanes.sqrt(lanes.absolute(y)) + lanes.floor(3.0 * y) - lanes.ceil(y))
    lanes.store_sums(out, 64, x, y, x * y, lanes.splat(a, 2))
    x += y
    x -= 1.0
    x *= y
    x /= 2.0
    lanes.store(out, 80, x)
    return lanes.bits(y <= 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_arithmetic_is_that_of_numpy(kind: type[np.floating[Any]]) -> None:
    generator = np.random.default_rng(0)
    x, y = (generator.normal(size=16).astype(kind) for _ in range(2))
    out = np.zeros(96, kind)
    assert arithmetic(x, y, out) == sum(int(value <= 0) << lane for lane, value in enumerate(y))
    expected = [
        x * y + 1 + 2 * x - y / x,
        np.where((x >= y) | ((x < 0.5) & (y > 0)), x, -1),
        np.minimum(x, 0.25) + np.maximum(-y, x),
        np.sqrt(np.abs(y)) + np.floor(3 * y) - np.ceil(y),
        [x.sum(), y.sum(), (x * y).sum(), 32, *[0] * 12],
        (x + y - 1) * y / 2,
    ]
    np.testing.assert_allclose(out.reshape(6, 16), expected, rtol=40 * np.finfo(kind).eps, atol=40 * np.finfo(kind).eps)


@jit
def rearranged(a: Floats, out: Floats, whole: NDArray[np.int32]) -> None:
    three, four = lanes.load_columns(a, 1, 3), lanes.load_columns(a, 2, 4)
    for i in range(3):
        lanes.store(out, 16 * i, three[i])
    lanes.store_columns(out, 48, four[3], four[2], four[1], four[0])
    rows = lanes.load_rows(a, 5, 20)
    for i in range(16):
        lanes.store(out, 112 + 16 * i, rows[i])
    lanes.store_rows(out, 368, 18, rows[0], rows[1], rows[2])
    lanes.store_whole(whole, 0, three[0], three[2])
    there, here = lanes.borrowed(out), lanes.borrowed(a)
    there[700] = here[7]
    lanes.store(there, 701, lanes.splat(here, here[9]))


@pytest.mark.parametrize("kind", KINDS)
def test_rows_and_columns_are_rearranged_as_numpy_would(kind: type[np.floating[Any]]) -> None:
    a, out, whole = np.arange(400).astype(kind), np.full(720, -1).astype(kind), np.zeros(32, np.int32)
    rearranged(a, out, whole)
    three, four = a[1:49].reshape(16, 3), a[2:66].reshape(16, 4)
    rows = np.stack([a[5 + 20 * row : 21 + 20 * row] for row in range(16)])
    np.testing.assert_array_equal(out[:48].reshape(3, 16), three.T)
    np.testing.assert_array_equal(out[48:112].reshape(16, 4), four[:, ::-1])
    np.testing.assert_array_equal(out[112:368].reshape(16, 16), rows.T)
    for row in range(16):
        np.testing.assert_array_equal(out[368 + 18 * row :][:16], [*rows[row, :3], *[0] * 13])
    np.testing.assert_array_equal(whole.reshape(16, 2), three[:, [0, 2]])
    assert out[700] == 7
    np.testing.assert_array_equal(out[701:717], 9)


@jit
def exponentials(a: Floats, powers: Floats, exponentials: Floats) -> None:
    for start in range(0, a.size, 16):
        lanes.store(powers, start, lanes.exp2(lanes.load(a, start)))
        lanes.store(exponentials, start, lanes.exp(lanes.load(a, start)))


# Worst 2.3e-7 and 1.7e-16, where long double is longer than double.
@pytest.mark.parametrize(("kind", "bound"), [(np.float32, 3e-7), (np.float64, 8e-16)])
def test_exponentials_are_accurate(kind: type[np.floating[Any]], bound: float) -> None:
    a = np.concatenate([np.linspace(-20, 20, 16000), np.arange(-80, 80) / 2]).astype(kind)
    powers, exps = np.empty_like(a), np.empty_like(a)
    exponentials(a, powers, exps)
    exact = a.astype(np.longdouble)
    assert np.abs(powers / np.exp2(exact) - 1).max() < bound
    assert np.abs(exps / np.exp(exact) - 1).max() < bound


@pytest.mark.parametrize("kind", KINDS)
def test_exp_of_anything_is_finite_and_positive(kind: type[np.floating[Any]]) -> None:
    a = np.array([math.nan, math.inf, -math.inf, 1e30, -1e30, 800, -800, 89, -89, 0, *[1] * 6], kind)
    powers, exps = np.empty_like(a), np.empty_like(a)
    exponentials(a, powers, exps)
    assert np.isfinite(exps).all()
    assert (exps > 0).all()
    assert exps[0] == exps[1] == exps.max()  # what is not a number turns huge, and is culled for it
    assert abs(exps[9] - 1) < 2e-7


# ------------------------------------------------------------------------------------------------ sorting


@st.composite
def splats_on_tiles(draw: st.DrawFn) -> tuple[NDArray[np.int32], NDArray[np.float64], int, int]:
    """Boxes (n, 4), depths with ties (n,), and the grid's tiles across and down."""
    tiles_x, tiles_y, n = draw(st.integers(1, 7)), draw(st.integers(1, 5)), draw(st.integers(0, 60))
    generator = np.random.default_rng(draw(st.integers(0, 10_000)))
    x = np.sort(generator.integers(0, tiles_x + 1, (n, 2)), axis=1)
    y = np.sort(generator.integers(0, tiles_y + 1, (n, 2)), axis=1)
    depths = np.exp(generator.normal(size=n) * draw(st.sampled_from([0.0, 1e-6, 3.0])))
    boxes = np.stack([x[:, 0], y[:, 0], x[:, 1], y[:, 1]], axis=1).astype(np.int32)
    return boxes, depths[generator.integers(0, n, n)] if n else depths, tiles_x, tiles_y


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=60)
@given(case=splats_on_tiles())
def test_tiles_list_their_splats_front_to_back(kind: type[np.floating[Any]], case: Any) -> None:
    boxes, depths, tiles_x, tiles_y = case
    depths = depths.astype(kind)
    first_pair, places, tile_start, members = pipeline.list_tiles(
        len(boxes), boxes.reshape(-1), depths, tiles_x, tiles_x * tiles_y
    )
    order = np.argsort(depths, kind="stable")
    for tile in range(tiles_x * tiles_y):
        y, x = divmod(tile, tiles_x)
        expected = [i for i in order if boxes[i, 0] <= x < boxes[i, 2] and boxes[i, 1] <= y < boxes[i, 3]]
        assert members[tile_start[tile] : tile_start[tile + 1]].tolist() == expected
    for i in range(len(boxes)):
        mine = places[first_pair[i] : first_pair[i + 1]]
        assert (members[mine] == i).all()
        assert (np.diff(mine) > 0).all()
    assert sorted(places.tolist()) == list(range(len(members)))


def test_many_splats_are_sorted_in_all_digits() -> None:
    depths = np.exp(np.random.default_rng(1).uniform(-60, 60, 5000))
    boxes = np.tile(np.array([0, 0, 1, 1], np.int32), 5000)
    for kind in KINDS:
        members = pipeline.list_tiles(5000, boxes, depths.astype(kind), 1, 1)[3]
        np.testing.assert_array_equal(members, np.argsort(depths.astype(kind), kind="stable"))


# ------------------------------------------------------------------------------------------------ exact culling


def without_culling(tiles_x: int, tiles_y: int) -> Callable[..., None]:
    """`parallel`, with every splat offered to all tiles of its three-sigma rectangle and to all blocks of those."""

    def run(kernel: Any, *arguments: Any) -> None:
        parallel(kernel, *arguments)
        if kernel is projection_kernels.project:
            splats, boxes, radii, _, centres = arguments[-5:]
            splats.reshape(-1, layout.SPLAT)[:, layout.REACH] = np.inf
            centre, radius = centres.reshape(-1, 2), radii[:, None].astype(centres.dtype)
            first = np.floor((centre - radius) / layout.TILE).clip(0, [tiles_x, tiles_y])
            last = np.floor((centre + radius + 15) / layout.TILE).clip(0, [tiles_x, tiles_y])
            boxes.reshape(-1, 4)[:] = np.concatenate([first, last], axis=1) * (radius > 0)

    return run


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["random", "needles", "pancakes", "giants", "specks", "crowd", "saturated"])
def test_culling_changes_no_bit(name: str, kind: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    random = scenes.random_case(400, 130, 70, seed=2, pixels=(0.05, 20.0))
    case = (random if name == "random" else scenes.ADVERSARIAL[name]()).to(kind)
    culled = case.render(CpuRasterizer())
    tiles = -(-case.camera.width // layout.TILE), -(-case.camera.height // layout.TILE)
    monkeypatch.setattr(pipeline, "parallel", without_culling(*tiles))
    whole = case.render(CpuRasterizer())
    assert torch.equal(culled.image, whole.image)
    assert torch.equal(culled.transmittance, whole.transmittance)


def test_constants_are_those_of_the_method() -> None:
    assert layout.BLOCKS == lanes.WIDTH == layout.BLOCK**2
    assert tile_kernels.pixel_offsets(np.float32).size == (2 * layout.BLOCKS + 2) * lanes.WIDTH
    assert ordering_kernels.DIGITS == 2**ordering_kernels.DIGIT_BITS
    assert math.isclose(2**layout.LOG2_MIN_ALPHA, 1 / 255)
