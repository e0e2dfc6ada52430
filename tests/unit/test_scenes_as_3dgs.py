"""`--resolution 3dgs:N` gives the sizes, pixels and cameras that the loaders of 3DGS codebases give."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from lapgs_plugin.errors import SceneError, UserInputError
from lapgs_plugin.scenes.images import image_size, read_as_3dgs, read_image
from lapgs_plugin.scenes.resolution import parse_resolution
from tests.refusals import refuses
from tests.unit.test_scenes_colmap import Model, load, make_scene

WHITE = (1.0, 1.0, 1.0)


def loader_size(option: int, width: int, height: int) -> tuple[int, int]:
    """Option -r of graphdeco 3DGS, FastGS and Taming-3DGS, as their common function computes it, at scale 1."""
    if option in (1, 2, 4, 8):
        return round(width / (1.0 * option)), round(height / (1.0 * option))
    shrink_large = width / 1600 if width > 1600 else 1
    scale = float(shrink_large if option == -1 else width / option) * 1.0
    return int(width / scale), int(height / scale)


@given(st.sampled_from([-1, 1, 2, 4, 8, 3, 5, 16, 800, 1000, 1600, 3000]), st.integers(16, 9000), st.integers(16, 9000))
@example(-1, 1601, 900)
@example(-1, 1602, 900)
def test_sizes_are_the_loaders(option: int, width: int, height: int) -> None:
    expected = loader_size(option, width, height)
    actual = parse_resolution(f"3dgs:{option}").size_for(width, height)
    assert actual == tuple(max(1, side) for side in expected)  # they stop at a side of 0


def test_the_float_factor_can_lose_a_pixel() -> None:
    assert 1599 in {parse_resolution("3dgs:-1").size_for(width, 900)[0] for width in range(1601, 2000)}
    assert parse_resolution("3dgs:1600").size_for(800, 600) == (1600, 1200)  # they enlarge, too


@pytest.mark.parametrize("text", ["3dgs:", "3dgs:0", "3dgs:-2", "3dgs:1/2", "3dgs:1k", "3dgs:2.5"])
def test_what_is_no_option_of_theirs_is_refused(text: str) -> None:
    refuses(UserInputError, r"expected -1, 1, 2, 4, 8 or a width in pixels after 3dgs:", parse_resolution, text)


@pytest.fixture
def photo() -> Image.Image:
    return Image.fromarray(np.random.default_rng(0).integers(0, 256, (43, 61, 3), dtype=np.uint8))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("size", [(61, 43), (30, 22), (17, 12), (80, 60)])
def test_pixels_are_pillows_to_the_byte(tmp_path: Path, photo: Image.Image, suffix: str, size: tuple[int, int]) -> None:
    path = tmp_path / f"photo{suffix}"
    photo.save(path)
    expected = torch.from_numpy(np.array(Image.open(path).resize(size))).permute(2, 0, 1) / 255.0
    image = read_as_3dgs(path, size, None)
    assert image.is_contiguous()
    assert torch.equal(image, expected)


def test_alpha_of_a_colmap_scene_is_left_out_and_of_a_transforms_scene_blended(tmp_path: Path) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (20, 24, 4), dtype=np.uint8)
    path = tmp_path / "cut_out.png"
    Image.fromarray(pixels).save(path)
    assert torch.equal(read_as_3dgs(path, (24, 20), None) * 255, torch.from_numpy(pixels[..., :3]).permute(2, 0, 1))

    alpha = pixels[..., 3:] / 255.0
    over_white = pixels[..., :3] / 255.0 * alpha + (1 - alpha)
    rounded_down = Image.fromarray(np.floor(over_white * 255.0).astype(np.uint8))
    expected = torch.from_numpy(np.array(rounded_down.resize((12, 10)))).permute(2, 0, 1) / 255.0
    assert torch.equal(read_as_3dgs(path, (12, 10), WHITE), expected)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA", "L", "P", "CMYK"])
@pytest.mark.parametrize("size", [(24, 20), (24, 11), (13, 20), (7, 9), (31, 40)])
def test_strips_are_the_image_that_pillow_resizes_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str, size: tuple[int, int]
) -> None:
    path = tmp_path / "a.tiff"
    colours = np.random.default_rng(2).integers(0, 256, (20, 24, 4), dtype=np.uint8)
    Image.fromarray(colours).convert("RGB" if mode in ("P", "CMYK") else "RGBA").convert(mode).save(path)
    with Image.open(path) as source:
        assert source.mode == mode
        whole = source.convert("RGBA" if mode != "RGB" else "RGB").resize(size)
    expected = torch.from_numpy(np.array(whole)[..., :3]).permute(2, 0, 1) / 255.0
    monkeypatch.setattr("lapgs_plugin.scenes.images.STRIP_VALUES", 4 * 24 * 3)  # three rows
    assert torch.equal(read_as_3dgs(path, size, None), expected)


def test_grey_becomes_rgb(tmp_path: Path) -> None:
    grey = Image.fromarray(np.arange(96, dtype=np.uint8).reshape(8, 12) * 2)
    grey.save(tmp_path / "grey.png")
    expected = torch.from_numpy(np.array(grey.resize((6, 4)))) / 255.0
    assert torch.equal(read_as_3dgs(tmp_path / "grey.png", (6, 4), None), expected.expand(3, 4, 6))


def test_damaged_and_missing_images_are_named(tmp_path: Path, photo: Image.Image) -> None:
    path = tmp_path / "photo.png"
    photo.save(path)
    path.write_bytes(path.read_bytes()[:2000])
    refuses(SceneError, r"photo\.png: Pillow, with which .* cannot read it", read_as_3dgs, path, (61, 43), None)
    refuses(SceneError, r"none\.png: no such image", read_as_3dgs, tmp_path / "none.png", (61, 43), None)


def test_cameras_look_through_the_middle_of_the_image(tmp_path: Path) -> None:
    path = make_scene(tmp_path, Model(cameras={1: "PINHOLE 96 64 80 82 47.3 33.1"}))
    camera = load(path, resolution="3dgs:2").train[0].camera
    assert camera.size == (48, 32)
    assert (camera.cx, camera.cy) == (24.0, 16.0)
    assert (camera.fx, camera.fy) == pytest.approx((40.0, 41.0))
    assert load(path, resolution="1/2").train[0].camera.cx == pytest.approx(47.3 / 2)


def test_both_readers_see_the_same_photo(shared_data: Path) -> None:
    photo = min((shared_data / "fox" / "images").iterdir())
    width, height = image_size(photo)
    size = width // 4, height // 4
    difference = read_as_3dgs(photo, size, None) - read_image(photo, size=size)
    assert float(difference.abs().max()) < 1.5 / 255  # rounded once a direction; worst seen 1.08 / 255
