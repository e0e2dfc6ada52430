"""Tiles of a scene's ground, and what views see of them."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.reference_raster import CpuRasterizer
from lapgs_plugin.runs.layout import TILES
from lapgs_plugin.scenes.scene import Scene, View
from lapgs_plugin.stages.appearance import ViewColors
from lapgs_plugin.tiles.grid import TileGrid, read_grid
from lapgs_plugin.tiles.options import TileOptions
from lapgs_plugin.tiles.visibility import views_of_tile
from tests.training_scene import ring_camera, ring_scene

SIZE = 64


def street(views: int = 12) -> Scene:
    """A street along x with its points, whose cameras look across it; y points down."""
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(500, 3, generator=generator) * torch.tensor([40.0, 2.0, 6.0])
    cameras = [_camera(torch.tensor([40.0 * index / (views - 1), 0.0, -3.0 + 0.1 * index])) for index in range(views)]
    train = tuple(View(f"{index}.png", camera, torch.zeros(3, SIZE, SIZE)) for index, camera in enumerate(cameras))
    return replace(ring_scene(), train=train, test=(), points=points)


def _camera(position: Tensor) -> Camera:
    """A camera that looks along z."""
    pose = torch.eye(4)
    pose[:3, 3] = -position
    return Camera(SIZE, SIZE, SIZE * 1.0, SIZE * 1.0, SIZE / 2, SIZE / 2, pose)


def blobs(places: list[tuple[float, float, float]], scale: float) -> GaussianField:
    """Opaque round Gaussians."""
    count = len(places)
    quaternions = torch.zeros(count, 4)
    quaternions[:, 0] = 1.0
    return GaussianField(
        means=torch.tensor(places),
        quaternions=quaternions,
        log_scales=torch.full((count, 3), math.log(scale)),
        opacity_logits=torch.full((count,), 8.0),
        sh=torch.zeros(count, 1, 3),
    )


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 2)])
def test_each_point_is_in_one_tile_and_tiles_have_about_as_many(shape: tuple[int, int]) -> None:
    scene = street()
    grid = TileGrid.of(scene, shape)
    tiles = [grid.contains(tile, scene.points) for tile in grid]
    assert len(tiles) == shape[0] * shape[1]
    assert torch.stack(tiles).sum(0).eq(1).all()
    even = len(scene.points) / len(tiles)
    assert all(abs(int(tile.sum()) - even) <= 2 + 0.02 * even for tile in tiles)
    far = 1e6 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    assert torch.stack([grid.contains(tile, far) for tile in grid]).sum(0).eq(1).all()


def test_columns_follow_the_longer_side() -> None:
    grid = TileGrid.of(street(), (1, 2))
    assert abs(grid.across[0]) > 0.99
    left, right = (street().points[grid.contains(tile, street().points), 0] for tile in grid)
    assert left.max() < right.min() + 0.5 or right.max() < left.min() + 0.5  # the axis is not exactly x


def test_points_far_from_the_cameras_share_out_nothing() -> None:
    scene = street()
    far = torch.randn(2 * len(scene.points), 3, generator=torch.Generator().manual_seed(0))
    grid = TileGrid.of(replace(scene, points=torch.cat([scene.points, 1e4 + far])), (2, 3))
    assert grid == TileGrid.of(scene, (2, 3))
    alone = TileGrid.of(replace(scene, points=1e4 + far), (2, 3))  # as no others are near
    assert {int(alone.contains(tile, 1e4 + far).sum()) for tile in alone} <= {len(far) // 6, len(far) // 6 + 1}


def test_height_divides_nothing() -> None:
    points = street().points
    grid = TileGrid.of(street(), (2, 2))
    up = torch.linalg.cross(torch.tensor(grid.across), torch.tensor(grid.along)).float()
    for tile in grid:
        assert torch.equal(grid.contains(tile, points), grid.contains(tile, points + 100.0 * up))


@pytest.mark.parametrize(("views", "count"), [(12, 1), (401, 2), (1700, 5)])
def test_auto_makes_tiles_by_the_views(views: int, count: int) -> None:
    rows, columns = TileGrid.of(street(views), None).shape
    assert rows * columns >= count
    assert rows * (columns - 1) < count


def test_memory_does_not_grow_with_the_square_of_the_views() -> None:
    scene = street(1700)
    tracemalloc.start()
    try:
        TileGrid.of(scene, (2, 2))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 8 * len(scene.train) ** 2 / 4  # bytes; 1e6 seen


def test_a_grid_is_read_as_it_was_written(tmp_path: Path) -> None:
    grid = replace(TileGrid.of(street(), (2, 3)), only=(1, 2))
    grid.save(tmp_path)
    assert read_grid(tmp_path) == grid
    (tmp_path / TILES).write_text("{}")
    with pytest.raises(RunFolderError, match=r"tiles\.json"):
        read_grid(tmp_path)


def test_a_tile_behind_another_is_not_seen() -> None:
    wall = [(0.3 * x, 0.3 * y, 3.0) for x in range(-9, 10) for y in range(-9, 10)]
    field = blobs([*wall, (0.0, 0.0, 8.0), (0.0, 0.0, -6.0)], 0.2)
    inside = field.means[:, 2] > 5.0
    ahead, behind = _camera(torch.zeros(3)), _camera(torch.tensor([0.0, 0.0, 4.0]))
    cameras = {"hidden.png": ahead, "open.png": behind}
    seen = views_of_tile(cameras, field, inside, CpuRasterizer(), torch.device("cpu"))
    assert set(seen.masks) == {"open.png"}
    assert seen.seen.tolist() == [*[False] * len(wall), True, False]


@pytest.mark.parametrize(("opacity", "seen"), [(0.015, False), (0.05, True)])
def test_what_the_base_hardly_shows_is_not_seen(opacity: float, seen: bool) -> None:
    field = replace(blobs([(0.0, 0.0, 4.0)], 0.5), opacity_logits=torch.tensor([opacity]).logit())
    cameras, inside = {"a.png": _camera(torch.zeros(3))}, torch.tensor([True])
    assert bool(views_of_tile(cameras, field, inside, CpuRasterizer(), torch.device("cpu")).masks) == seen


def test_masks_are_where_a_tile_is() -> None:
    field = blobs([(-1.0, 0.0, 4.0), (1.0, 0.0, 4.0)], 0.3)
    view = View("a.png", _camera(torch.zeros(3)), torch.zeros(3, SIZE, SIZE))
    seen = views_of_tile(
        {"a.png": view.camera}, field, torch.tensor([True, False]), CpuRasterizer(), torch.device("cpu")
    )
    (masked,) = seen.of([view, replace(view, name="b.png")])
    mask = masked.mask
    assert mask is not None
    assert mask.shape == (1, SIZE, SIZE)
    assert mask[0, SIZE // 2, SIZE // 2 - SIZE // 4]  # x = -1 at depth 4 with a focal length of SIZE
    assert not mask[0, :, SIZE // 2 + 4 :].any()
    assert 0.0 < seen.share < 0.5


def test_a_mask_of_the_photo_stays() -> None:
    own = torch.zeros(1, SIZE, SIZE, dtype=torch.bool)
    own[:, :, :20] = True
    view = View("a.png", ring_camera(0.0, SIZE, SIZE), torch.zeros(3, SIZE, SIZE), own)
    other = torch.zeros_like(own)
    other[:, :10] = True
    both = view.within(lambda: other).mask
    assert both is not None
    assert torch.equal(both, own & other)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tiles": "0x2"}, "expected auto or RxC"),
        ({"tiles": "-1x2"}, "expected auto or RxC"),
        ({"tiles": "2"}, "expected auto or RxC"),
        ({"tiles": "100x100"}, "at most 1024"),
        ({"tile": "0,1"}, "--tile without --base"),
        ({"base": Path("run")}, "--base without --tile"),
        ({"tile": "1", "base": Path("run")}, "expected R,C"),
        ({"tiles": "1x2", "tile": "0,1", "base": Path("run")}, "give one of them"),
        ({"only_base": True}, "--only-base without --tiles"),
    ],
)
def test_options_that_cannot_be_meant(options: dict[str, object], message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        TileOptions(**options)  # type: ignore[arg-type]  # by name


def test_colours_of_some_photos_keep_the_mean_that_they_had() -> None:
    start = torch.eye(3, 4).repeat(3, 1, 1) * torch.tensor([1.1, 1.2, 0.9])[:, None, None]
    colors = ViewColors.create(["a", "b", "c"], start, torch.device("cpu"), 0, 100)
    colors.centre = start.mean(dim=0)
    gains = torch.tensor([0.5, -2.0, 1.0])
    colors.transforms.grad = gains[:, None, None].expand(3, 3, 4).clone()
    colors.after_step(3, 1)
    assert not torch.equal(colors.transforms, start)
    assert torch.allclose(colors.transforms.mean(dim=0), start.mean(dim=0), rtol=0, atol=1e-6)  # worst 3e-10
