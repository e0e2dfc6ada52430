"""The fast CPU rasterizer against the oracle: images, gradients, statistics, in both precisions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.reference_raster import pipeline
from lapgs_plugin.reference_raster.fast import CpuRasterizer
from lapgs_plugin.reference_raster.oracle import OracleRasterizer
from lapgs_plugin.reference_raster.thresholds import ThresholdMask, threshold_mask
from tests.raster import scenes
from tests.raster.assertions import (
    GradientBounds,
    assert_close_outside,
    assert_elements_close,
    assert_gradients_match,
    assert_radii_close,
)
from tests.raster.scenes import Case

ORACLE, CPU = OracleRasterizer(), CpuRasterizer()
DTYPES = [torch.float64, torch.float32]

# Worst values seen over the adversarial and 700 random scenes, in float64 and float32:
# image and transmittance 2.3e-14 and 5.6e-6, absolute.
IMAGE_BOUND = {torch.float64: 1e-12, torch.float32: 3e-5}
# Centres on the image 1.7e-15 and 6e-7 of the largest.
CENTRE_BOUND = {torch.float64: 1e-13, torch.float32: 3e-6}
# Gradients: element 2.8e-13 and 6.2e-5, row 4e-12 and 1.2e-3, relative L2 2.8e-13 and 5.6e-5.
GRADIENT_BOUNDS = {
    torch.float64: GradientBounds(element=1e-12, row=3e-11, row_floor=1e-3, relative_l2=1e-12),
    torch.float32: GradientBounds(element=3e-4, row=5e-3, row_floor=1e-3, relative_l2=3e-4),
}

# The same scenes in each run: how closely gradients agree depends on their conditioning, which has no bound over all
# scenes. No shrinking, which takes minutes; no clock, which does not know compilation.
PROPERTY = settings(
    deadline=None,
    derandomize=True,
    max_examples=25,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


def mask_of(case: Case) -> ThresholdMask:
    return threshold_mask(case.field, case.camera, sh_degree=case.sh_degree)


def assert_same_rendering(case: Case) -> None:
    """Image, transmittance, radii and centres are the oracle's, in float64 of the same numbers, outside the mask."""
    dtype, mask = case.field.means.dtype, mask_of(case)
    with torch.no_grad():
        expected, actual = case.to(torch.float64).render(ORACLE), case.render(CPU)
    assert actual.image.dtype == dtype
    assert_close_outside(actual.image, expected.image, mask.pixels, IMAGE_BOUND[dtype], name="image")
    assert_close_outside(actual.transmittance, expected.transmittance, mask.pixels, IMAGE_BOUND[dtype], name="T")
    assert_radii_close(actual.radii, expected.radii, mask.radii)
    kept = ~mask.radii
    assert_elements_close(actual.means2d[kept], expected.means2d[kept], CENTRE_BOUND[dtype], name="means2d")


def assert_same_gradients(case: Case) -> None:
    """Gradients of a loss outside the mask are the oracle's, for Gaussians away from kinks."""
    mask = mask_of(case)
    weights = scenes.pixel_weights(case) * ~mask.pixels
    expected = scenes.gradients(ORACLE, case.to(torch.float64), weights.double())
    actual = scenes.gradients(CPU, case, weights)
    bounds = GRADIENT_BOUNDS[case.field.means.dtype]
    assert_gradients_match(actual, expected, bounds, excused=mask.kinks | mask.radii)


def assert_same(case: Case) -> None:
    assert_same_rendering(case)
    assert_same_gradients(case)


# ------------------------------------------------------------------------------------------------ the oracle


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", scenes.ADVERSARIAL)
def test_adversarial_scenes_are_those_of_the_oracle(name: str, dtype: torch.dtype) -> None:
    assert_same(scenes.ADVERSARIAL[name]().to(dtype))


@pytest.mark.parametrize("dtype", DTYPES)
@PROPERTY
@given(case=scenes.random_cases())
def test_any_scene_is_that_of_the_oracle(dtype: torch.dtype, case: Case) -> None:
    assert_same(case.to(dtype))


@pytest.mark.parametrize("active", [0, 1, 2, 3])
@pytest.mark.parametrize("stored", [0, 1, 2, 3])
def test_every_degree_at_sizes_around_a_vector(stored: int, active: int) -> None:
    if active > stored:
        pytest.skip("a degree that the field does not have")
    for n in (1, 15, 16, 17, 33):
        case = replace(scenes.random_case(n, 24, 20, seed=n, sh_degree=stored), sh_degree=active)
        assert_same(case)
        sh = scenes.gradients(CPU, case, scenes.pixel_weights(case))["sh"]
        assert not sh[:, (active + 1) ** 2 :].any()  # bands above the active degree


@pytest.mark.parametrize("signed", [False, True])
def test_signed_and_clamped_colours(signed: bool) -> None:
    case = scenes.clamped_colors()
    case = replace(case, field=replace(case.field, signed=signed))
    assert_same(case)
    lowest = case.render(CPU).image.min()
    assert lowest < 0 if signed else lowest >= 0


def test_gradients_by_transmittance_and_background_are_those_of_the_oracle() -> None:
    case = scenes.random_case(60, 37, 29, seed=4, sh_degree=1)
    weights, opacity_weights = scenes.pixel_weights(case), scenes.pixel_weights(case)[0].flip(0)
    gradients = []
    for rasterizer in (ORACLE, CPU):
        leaves = case.with_leaves()
        background = case.background_tensor.requires_grad_()
        result = rasterizer(leaves.field, case.camera, background=background)
        ((result.image * weights).sum() + (result.transmittance * opacity_weights).sum()).backward()
        assert background.grad is not None
        parameters = {name: value.grad for name, value in leaves.field.parameters.items() if value.grad is not None}
        gradients.append((parameters, background.grad))
    (expected, expected_background), (actual, actual_background) = gradients
    assert_gradients_match(actual, expected, GRADIENT_BOUNDS[torch.float64])
    assert_elements_close(actual_background, expected_background, 1e-13, name="background")


def test_loss_of_the_transmittance_alone() -> None:
    case = scenes.random_case(30, 20, 20, seed=5).with_leaves()
    case.render(CPU).transmittance.sum().backward()
    assert case.field.sh.grad is not None
    assert case.field.opacity_logits.grad is not None
    assert not case.field.sh.grad.any()
    assert (case.field.opacity_logits.grad <= 0).all()
    assert case.field.opacity_logits.grad.any()


# ------------------------------------------------------------------------------------- activated input, given colours


def view_of(camera: Camera) -> pipeline.View:
    pose, focal, principal = camera.world_to_camera.numpy(), (camera.fx, camera.fy), (camera.cx, camera.cy)
    return pipeline.make_view(camera.width, camera.height, pose, focal, principal)


@pytest.mark.parametrize("given_colors", [False, True])
def test_activated_input_and_given_colours_by_the_chain_rule(given_colors: bool) -> None:
    case = scenes.random_case(50, 35, 28, seed=6, sh_degree=2).with_leaves()
    field, weights = case.field, scenes.pixel_weights(case)
    activated = [
        torch.nn.functional.normalize(field.quaternions, dim=-1), field.log_scales.exp(), field.opacity_logits.sigmoid()
    ]  # fmt: skip
    directions = torch.nn.functional.normalize(field.means - case.camera.position, dim=-1)
    colors = sh_to_color(field.sh, directions, 2, signed=False)

    quats, scales, opacities = (t.detach().numpy() for t in activated)
    gaussians = pipeline.Gaussians(
        means=field.means.detach().numpy(),
        quats=quats,
        scales=scales,
        opacities=opacities,
        sh=None if given_colors else field.sh.detach().numpy(),
        colors=colors.detach().numpy() if given_colors else None,
        raw=False,
        signed=False,
        sh_degree=2,
    )
    view = view_of(case.camera)
    rendering = pipeline.render(gaussians, view, case.background_tensor.numpy(), keep=True)
    slopes = pipeline.gradients(gaussians, view, rendering, weights.numpy(), None)
    outputs = [field.means, *activated, colors if given_colors else field.sh]
    by_color = slopes.colors if given_colors else slopes.sh
    assert by_color is not None
    gradients = slopes.means, slopes.quats, slopes.scales, slopes.opacities, by_color
    torch.autograd.backward(outputs, [torch.from_numpy(g) for g in gradients])

    expected = scenes.gradients(ORACLE, case, weights)
    actual = {name: value.grad for name, value in field.parameters.items() if value.grad is not None}
    actual |= {"means2d": torch.from_numpy(slopes.centres), "absgrad2d": torch.from_numpy(slopes.absolute_centres)}
    assert_gradients_match(actual, expected, GRADIENT_BOUNDS[torch.float64])
    with torch.no_grad():
        image = case.render(ORACLE).image
    assert_elements_close(torch.from_numpy(rendering.image), image, 1e-13, name="image")


def test_a_scale_of_zero_has_a_gradient() -> None:
    case = scenes.one_gaussian()
    gaussians = pipeline.Gaussians(
        *(a.numpy() for a in (case.field.means, case.field.quaternions)),
        scales=np.zeros((1, 3)), opacities=np.array([0.5]), sh=None, colors=np.ones((1, 3)),
        raw=False, signed=False, sh_degree=0,
    )  # fmt: skip
    view = view_of(case.camera)
    rendering = pipeline.render(gaussians, view, np.zeros(3), keep=True)
    slopes = pipeline.gradients(gaussians, view, rendering, np.ones_like(rendering.image), None)
    assert rendering.image.max() > 0.3
    assert np.isfinite(slopes.scales).all()


# ------------------------------------------------------------------------------------------------ broken parameters

BROKEN = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("value", BROKEN)
@pytest.mark.parametrize("name", ["means", "quaternions", "log_scales", "opacity_logits"])
def test_broken_geometry_harms_nobody_else(name: str, value: float, dtype: torch.dtype) -> None:
    case = scenes.random_case(40, 30, 30, seed=7, sh_degree=1).to(dtype)
    parameters = {key: tensor.clone() for key, tensor in case.field.parameters.items()}
    flat = parameters[name].view(40, -1)
    flat[3, 0] = flat[20] = value
    broken = replace(case, field=case.field.with_parameters(parameters)).with_leaves()
    result = broken.render(CPU)
    (result.image * scenes.pixel_weights(case)).sum().backward()

    assert torch.isfinite(result.image).all()
    # A scale of zero and an opacity of exactly one or zero are legitimate; all else takes the Gaussian out.
    if (name, value) not in {("log_scales", -math.inf), ("opacity_logits", math.inf)}:
        kept = torch.ones(40, dtype=torch.bool)
        kept[[3, 20]] = False
        if name != "opacity_logits":
            assert not result.radii[~kept].any()
        whole = replace(case, field=case.field.with_parameters({k: v[kept] for k, v in case.field.parameters.items()}))
        assert torch.equal(result.image, whole.render(CPU).image)
        for key, tensor in broken.field.parameters.items():
            assert tensor.grad is not None
            assert torch.isfinite(tensor.grad).all(), key
            assert not tensor.grad[~kept].any(), key


def test_a_broken_colour_shows_in_the_image_where_the_gaussian_is() -> None:
    case = scenes.one_gaussian()
    sh = case.field.sh.clone()
    sh[0, 0, 1] = math.nan
    image = replace(case, field=case.field.with_parameters({"sh": sh})).render(CPU).image
    assert image[1].isnan().any()
    assert not image[[0, 2]].isnan().any()
    assert not image[:, 0, -1].isnan().any()


def test_huge_numbers_in_float32_do_not_crash() -> None:
    generator = torch.Generator().manual_seed(8)
    case = scenes.random_case(64, 40, 40, seed=8, sh_degree=3).to(torch.float32)
    for scale in (1e3, 1e10, 1e30):
        noise = {
            k: v * (scale * torch.randn(v.shape, generator=generator)).exp().clamp(max=3e38)
            for k, v in case.field.parameters.items()
        }
        wild = replace(case, field=case.field.with_parameters(noise)).with_leaves()
        wild.render(CPU).image.sum().backward()


# ------------------------------------------------------------------------------------------------ bad input


def test_bad_input_is_named() -> None:
    case = scenes.random_case(5, 20, 20, sh_degree=1).to(torch.float32)
    for field, message in (
        (case.field.with_parameters({"sh": case.field.sh.double()}), "sh is torch.float64 and means are torch.float32"),
        (case.field.to(dtype=torch.float16), "float16, expected float32 or float64"),
        (case.field.to(device="meta"), "means is on meta, expected the CPU"),
    ):
        with pytest.raises(UserInputError, match=message):
            CPU(field, case.camera, background=torch.zeros(3))


def test_camera_and_background_of_another_precision_and_strided_parameters() -> None:
    case = scenes.random_case(40, 30, 20, seed=9, sh_degree=1)
    single = case.to(torch.float32)
    parameters = {
        name: value.repeat_interleave(2, dim=0)[::2].requires_grad_() for name, value in single.field.parameters.items()
    }
    assert not any(value.is_contiguous() for value in parameters.values())
    field = single.field.with_parameters(parameters)
    result = CPU(field, case.camera, background=case.background_tensor)
    expected = single.render(CPU)
    # The camera's pose is rounded to float32 by the rasterizer instead of by the case.
    assert torch.equal(result.image, expected.image)
    result.image.sum().backward()
    assert all(value.grad is not None for value in parameters.values())


def test_what_a_call_returns() -> None:
    case = scenes.random_case(20, 30, 20, seed=10).to(torch.float32).with_leaves()
    result = case.render(CPU)
    assert CPU.name == "cpu"
    assert result.image.shape == (3, 20, 30)
    assert result.transmittance.shape == (20, 30)
    assert result.radii.dtype == torch.int32
    assert result.means2d.is_leaf
    assert result.absgrad2d is not None
    assert not result.absgrad2d.requires_grad
    assert not result.absgrad2d.any()
    with torch.no_grad():
        quiet = case.render(CPU)
    assert not quiet.image.requires_grad
    assert not quiet.means2d.requires_grad


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["saturated", "opaque_crowd", "crowd", "ragged_size"])
def test_without_gradients_the_image_has_the_same_bits(name: str, dtype: torch.dtype) -> None:
    case = scenes.ADVERSARIAL[name]().to(dtype).with_leaves()
    with torch.no_grad():
        quiet = case.render(CPU)
    loud = case.render(CPU)
    assert torch.equal(quiet.image, loud.image)
    assert torch.equal(quiet.transmittance, loud.transmittance)
    assert torch.equal(quiet.radii, loud.radii)


def test_images_alone_have_the_same_bits() -> None:
    case = scenes.random_case(60, 45, 37, seed=5, sh_degree=2).to(torch.float32)
    background = torch.tensor([0.2, 0.4, 0.6])
    cameras = [case.camera, replace(case.camera, fx=1.2 * case.camera.fx)]
    images = CPU.render_images(case.field, cameras, background=background)
    assert images.shape == (2, 3, 37, 45)
    for image, camera in zip(images, cameras, strict=True):
        assert torch.equal(image, CPU(case.field, camera, background=background).image)
    (alone,) = CPU.render_images(case.field, cameras[:1], background=background)
    assert torch.equal(alone, images[0])
    with pytest.raises(UserInputError, match="background"):
        CPU.render_images(case.field, cameras, background=torch.zeros(4))
