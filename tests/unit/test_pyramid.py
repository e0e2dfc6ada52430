"""Compare Down and Up with OpenCV, SciPy and geometry, and pyramids with their laws."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import correlate1d, map_coordinates
from torch import Tensor

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.settings import GRIDS
from lapgs_plugin.ops.composition import compose
from lapgs_plugin.reference_raster.oracle import OracleRasterizer

SIZES = [(37, 52), (64, 48), (1, 1), (2, 2), (1, 2), (3, 5), (2, 7), (5, 1), (4, 4), (17, 16)]
BINOMIAL = np.array([1, 4, 6, 4, 1]) / 16

sides = st.integers(1, 24)
grids = st.sampled_from(GRIDS)


def picture(*shape: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> Tensor:
    """Make an image of any values: between levels images are not limited to [0, 1]."""
    return (torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 3 - 1).to(dtype)


def scipy_blur(image: np.ndarray) -> np.ndarray:
    for axis in (1, 2):
        image = correlate1d(image, BINOMIAL, axis=axis, mode="mirror")
    return image


def scipy_resample(image: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    grid = np.meshgrid(rows, columns, indexing="ij")
    return np.stack([map_coordinates(channel, grid, order=1, mode="nearest") for channel in image])


def centres(grid: str, fine: int) -> tuple[np.ndarray, np.ndarray]:
    """Return coarse centres in fine pixels and fine centres in coarse pixels, by the definition of each grid."""
    coarse = -(-fine // 2)
    if grid == "even":
        return 2.0 * np.arange(coarse), np.arange(fine) / 2.0
    scale = fine / coarse
    return (np.arange(coarse) + 0.5) * scale - 0.5, (np.arange(fine) + 0.5) / scale - 0.5


@pytest.mark.parametrize("size", SIZES)
def test_down_on_the_even_grid_is_opencvs_pyrdown(size: tuple[int, int]) -> None:
    image = picture(3, *size)
    expected = cv2.pyrDown(np.ascontiguousarray(image.permute(1, 2, 0).numpy()))
    got = Pyramid("even").down(image).permute(1, 2, 0).numpy()
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6)  # worst seen 2.4e-7


@pytest.mark.parametrize("size", [size for size in SIZES if min(size) > 1])
@pytest.mark.parametrize("grid", GRIDS)
def test_down_is_blur_then_resampling_at_the_grids_centres(grid: str, size: tuple[int, int]) -> None:
    image = picture(3, *size, dtype=torch.float64)
    rows, columns = (centres(grid, side)[0] for side in size)
    expected = scipy_resample(scipy_blur(image.numpy()), rows, columns)
    np.testing.assert_allclose(Pyramid(grid).down(image).numpy(), expected, rtol=0, atol=1e-14)  # worst seen 3e-15


@pytest.mark.parametrize("size", [size for size in SIZES if min(size) > 1])
@pytest.mark.parametrize("grid", GRIDS)
def test_up_is_resampling_at_the_grids_centres_then_blur(grid: str, size: tuple[int, int]) -> None:
    height, width = size
    image = picture(3, (height + 1) // 2, (width + 1) // 2, dtype=torch.float64)
    rows, columns = (centres(grid, side)[1] for side in size)
    expected = scipy_blur(scipy_resample(image.numpy(), rows, columns))
    np.testing.assert_allclose(Pyramid(grid).up(image, size).numpy(), expected, rtol=0, atol=1e-14)  # worst seen 3e-15


def test_halving_an_even_side_on_the_camera_grid_averages_pairs() -> None:
    image = picture(1, 8, 8, dtype=torch.float64)
    pairs = scipy_blur(image.numpy()).reshape(1, 4, 2, 4, 2).mean(axis=(2, 4))
    np.testing.assert_allclose(Pyramid("camera").down(image).numpy(), pairs, atol=1e-14)


@settings(deadline=None, max_examples=60)
@given(grid=grids, height=sides, width=sides, levels=st.integers(1, 7), seed=st.integers(0, 9))
def test_reconstruction_is_exact(grid: str, height: int, width: int, levels: int, seed: int) -> None:
    pyramid, image = Pyramid(grid), picture(3, height, width, seed=seed)
    bands = pyramid.laplacian(image, levels)
    assert len(bands) == levels
    composed = compose(pyramid, reversed(list(enumerate(bands)))).image
    assert (composed - image).abs().max() <= 1e-6  # worst seen 1.8e-7


@settings(deadline=None, max_examples=60)
@given(grid=grids, height=sides, width=sides, value=st.floats(-2, 2, width=32))
def test_constants_stay_constant(grid: str, height: int, width: int, value: float) -> None:
    pyramid, image = Pyramid(grid), torch.full((3, height, width), value)
    coarse = pyramid.down(image)
    torch.testing.assert_close(coarse, torch.full_like(coarse, value), rtol=1e-6, atol=0)
    torch.testing.assert_close(pyramid.up(coarse, (height, width)), image, rtol=1e-6, atol=0)


@settings(deadline=None, max_examples=40)
@given(grid=grids, height=sides, width=sides, factor=st.floats(-3, 3))
def test_both_directions_are_linear_and_treat_rows_as_columns(
    grid: str, height: int, width: int, factor: float
) -> None:
    pyramid, size = Pyramid(grid), (height, width)
    one, other = (picture(3, height, width, dtype=torch.float64, seed=seed) for seed in (1, 2))
    small, little = pyramid.down(one), pyramid.down(other)
    torch.testing.assert_close(pyramid.down(one + factor * other), small + factor * little)
    up = pyramid.up(small, size)
    torch.testing.assert_close(pyramid.up(small + factor * little, size), up + factor * pyramid.up(little, size))
    torch.testing.assert_close(pyramid.down(one.mT), small.mT)
    torch.testing.assert_close(pyramid.up(small.mT, (width, height)), up.mT)


@settings(deadline=None, max_examples=40)
@given(grid=grids, fine=st.integers(1, 40))
def test_a_mirrored_image_has_a_mirrored_pyramid_on_the_camera_grid(grid: str, fine: int) -> None:
    """The camera grid is symmetric; the even grid is so only for odd sides."""
    pyramid, image = Pyramid(grid), picture(1, 1, fine, dtype=torch.float64)
    mirrored = torch.allclose(pyramid.down(image.flip(-1)), pyramid.down(image).flip(-1), atol=1e-12)
    assert mirrored or (grid == "even" and fine % 2 == 0)


@pytest.mark.parametrize("fine", [64, 63])
@pytest.mark.parametrize("grid", GRIDS)
def test_a_ramp_keeps_its_place(grid: str, fine: int) -> None:
    """Both filters preserve straight lines, so a ramp shows the position of each coarse pixel."""
    coarse, back = centres(grid, fine)
    ramp = torch.arange(fine, dtype=torch.float64).expand(1, 20, fine)
    pyramid, inside = Pyramid(grid), slice(3, -3)
    np.testing.assert_allclose(pyramid.down(ramp)[0, 5].numpy()[inside], coarse[inside], atol=1e-12)  # 0 seen
    small = torch.arange(len(coarse), dtype=torch.float64).expand(1, 10, len(coarse))
    # 3.6e-15 seen.
    np.testing.assert_allclose(pyramid.up(small, (20, fine))[0, 9].numpy()[inside], back[inside], atol=1e-12)


def blob_centre(image: Tensor) -> tuple[float, float]:
    """Return the centre of mass of a blob in pixels, x then y, with the centre of pixel 0 at 0.5 as in `Camera`."""
    weights = image.double().sum(0)
    x = (weights.sum(0) * (torch.arange(weights.shape[1]) + 0.5)).sum() / weights.sum()
    y = (weights.sum(1) * (torch.arange(weights.shape[0]) + 0.5)).sum() / weights.sum()
    return x.item(), y.item()


@pytest.mark.parametrize("size", [(64, 80), (63, 81)])
@pytest.mark.parametrize("grid", GRIDS)
def test_down_against_a_camera_of_the_coarse_size(grid: str, size: tuple[int, int]) -> None:
    """The same Gaussian rendered at both sizes: on the camera grid Down of the fine image is where the coarse camera
    sees it. On the even grid it is half a fine pixel too far right and down for even sides; for odd sides that shift
    falls linearly to minus a half at the far end.
    """
    height, width = size
    fine_camera = Camera(width, height, 90.0, 90.0, width / 2, height / 2, torch.eye(4))
    coarse_camera = fine_camera.resized((width + 1) // 2, (height + 1) // 2)
    point = torch.tensor([[0.03, -0.04, 1.0]])
    blob = GaussianField(
        point, torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), -3.0), torch.zeros(1), torch.ones(1, 1, 3), True
    )
    render = OracleRasterizer()
    fine, coarse = (
        render(blob, camera, background=torch.zeros(3)).image.double() for camera in (fine_camera, coarse_camera)
    )
    down, seen = blob_centre(Pyramid(grid).down(fine)), blob_centre(coarse)
    scale = (coarse_camera.width / width, coarse_camera.height / height)
    in_fine_pixels = [(a - b) / s for a, b, s in zip(down, seen, scale, strict=True)]
    expected = [0.0, 0.0]
    if grid == "even":
        sides_of = zip(blob_centre(fine), (width, height), strict=True)
        expected = [0.5 if side % 2 == 0 else 0.5 - x / side for x, side in sides_of]
    # Worst seen 0.004 px: the blob is cut at three sigma and widened by 0.3 px at either size.
    assert in_fine_pixels == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("size", [(64, 80), (63, 81), (33, 50)])
@pytest.mark.parametrize("grid", GRIDS)
def test_up_undoes_the_shift_of_down(grid: str, size: tuple[int, int]) -> None:
    y, x = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) for side in size), indexing="ij")
    blob = torch.exp(-((x - 0.45 * size[1]) ** 2 + (y - 0.52 * size[0]) ** 2) / 18)[None]
    pyramid = Pyramid(grid)
    there_and_back = pyramid.up(pyramid.down(blob), size)
    assert blob_centre(there_and_back) == pytest.approx(blob_centre(blob), abs=0.02)  # worst seen 0.0098, odd sides


@settings(deadline=None, max_examples=20)
@given(grid=grids, height=st.integers(1, 9), width=st.integers(1, 9))
def test_gradients_are_those_of_finite_differences(grid: str, height: int, width: int) -> None:
    pyramid, image = Pyramid(grid), picture(1, height, width, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(pyramid.down, image)
    coarse = picture(1, (height + 1) // 2, (width + 1) // 2, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda small: pyramid.up(small, (height, width)), coarse)


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_any_precision_and_any_leading_dimensions(grid: str, dtype: torch.dtype) -> None:
    pyramid, batch = Pyramid(grid), picture(2, 3, 21, 30, dtype=dtype)
    down = pyramid.down(batch)
    up = pyramid.up(down, (21, 30))
    assert (down.dtype, up.dtype, down.shape, up.shape) == (dtype, dtype, (2, 3, 11, 15), batch.shape)
    torch.testing.assert_close(down[1, 2], pyramid.down(batch[1, 2]), rtol=0, atol=0)
    torch.testing.assert_close(up[0], pyramid.up(down[0], (21, 30)), rtol=0, atol=0)
    exact = pyramid.down(batch.double())
    # One rounding of the result to the image's precision.
    rtol = torch.finfo(dtype).eps if dtype != torch.float64 else 1e-14
    torch.testing.assert_close(down.double(), exact, rtol=rtol, atol=1e-6)


@pytest.mark.gpu
def test_a_gpu_gives_what_the_cpu_gives() -> None:
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    for grid in GRIDS:
        pyramid, image = Pyramid(grid), picture(3, 101, 150)
        for cpu, gpu in zip(pyramid.laplacian(image, 4), pyramid.laplacian(image.cuda(), 4), strict=True):
            torch.testing.assert_close(gpu.cpu(), cpu, rtol=0, atol=1e-6)


def test_values_are_not_clamped_and_the_argument_is_not_touched() -> None:
    image = torch.zeros(3, 8, 8)
    image[:, 3:7, 3:7], image[:, 0, 0] = 2.0, -1.0
    before = image.clone()
    for grid in GRIDS:
        down = Pyramid(grid).down(image)
        assert down.max() > 1.0
        assert down.min() < -0.05
        assert Pyramid(grid).up(down, (8, 8)).max() > 1.0
        assert torch.equal(image, before)


def test_sizes_and_what_is_refused() -> None:
    images = Pyramid().gaussian(torch.zeros(3, 267, 1063), 4)
    assert [tuple(image.shape[-2:]) for image in images] == [(267, 1063), (134, 532), (67, 266), (34, 133)]
    with pytest.raises(UserInputError, match="--grid odd: expected camera or even"):
        Pyramid("odd")
    with pytest.raises(UserInputError, match="a pyramid of 0 levels: expected at least 1"):
        Pyramid().laplacian(torch.zeros(3, 4, 4), 0)
    with pytest.raises(UserInputError, match=r"Up to 8x9 \(height x width\) needs an image of 4x5, got 5x4"):
        Pyramid().up(torch.zeros(3, 5, 4), (8, 9))


def test_real_photos_leave_a_small_residual(shared_data: Path) -> None:
    """On both grids the first residual of a real photo holds a small share of its variance and no constant."""
    photo = cv2.imread(str(shared_data / "fox" / "images" / "0001.jpg")).astype(np.float32) / 255
    image = torch.from_numpy(photo).permute(2, 0, 1)
    for grid in GRIDS:
        residual = Pyramid(grid).laplacian(image, 2)[0]
        assert residual.var() < 0.03 * image.var()
        assert abs(residual.mean()) < 1e-3


def test_what_is_kept_from_inference_mode_serves_training() -> None:
    """Use sizes of no other test, so that caches by size are filled here first."""
    fine, coarse = torch.randn(3, 137, 241), torch.randn(3, 69, 121)
    with torch.inference_mode():
        Pyramid().down(fine.clone())
        Pyramid().up(coarse.clone(), (137, 241))
    for leaf in (fine.requires_grad_(), coarse.requires_grad_()):
        image = Pyramid().down(leaf) if leaf is fine else Pyramid().up(leaf, (137, 241))
        image.square().sum().backward()  # type: ignore[no-untyped-call]  # torch's
        assert leaf.grad is not None
        assert bool(leaf.grad.isfinite().all())
