"""Test the probe for signed colour, its fallback, and wrapped extensions against the oracle."""

from __future__ import annotations

import logging
import re
import shlex
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.evaluation.cases import Case, make_camera, make_field, pixel_weights, random_case
from lapgs_plugin.evaluation.conformance import Subject, check, check_case, conformance_cases
from lapgs_plugin.family import BACKBONES, VARIANTS, install
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import RenderResult
from lapgs_plugin.patching.engine import Target, plan_apply
from lapgs_plugin.patching.files import write_all
from lapgs_plugin.patching.recipe import Edit, Recipe
from lapgs_plugin.rasterizers import extensions, signed_color
from lapgs_plugin.rasterizers.extensions import CudaExtension, _ScreenPoints, installed_extensions
from lapgs_plugin.rasterizers.signed_color import (
    ColorPath,
    SignedColorRasterizer,
    explain_fallback,
    has_signed_color,
    precomputed_colors,
    signed_degree,
)
from lapgs_plugin.reference_raster import OracleRasterizer
from lapgs_plugin.reference_raster.layout import SIGNED_COLOR_BIT
from tests.raster.scenes import gradients

ORACLE = OracleRasterizer()
CONSTANT = 0.28209479177387814  # the first basis function


class Unpatched:
    """An unpatched extension: it takes a negative degree for one below 1, and clamps colours."""

    name = "some_extension"
    device = torch.device("cpu")

    def __init__(self) -> None:
        self.calls: list[tuple[int, bool]] = []

    def render(
        self, field: GaussianField, camera: Camera, *, background: Tensor, sh_degree: int, colors: Tensor | None = None
    ) -> RenderResult:
        self.calls.append((sh_degree, colors is not None))
        if colors is not None:
            field = replace(field.with_parameters({"sh": colors[:, None] / CONSTANT}), signed=True)
            return ORACLE(field, camera, background=background, sh_degree=0)
        return self.with_sh(field, camera, background, sh_degree)

    def with_sh(self, field: GaussianField, camera: Camera, background: Tensor, sh_degree: int) -> RenderResult:
        return ORACLE(replace(field, signed=False), camera, background=background, sh_degree=max(sh_degree, 0))


class Patched(Unpatched):
    def with_sh(self, field: GaussianField, camera: Camera, background: Tensor, sh_degree: int) -> RenderResult:
        signed = bool(sh_degree & SIGNED_COLOR_BIT)
        degree = sh_degree & ~SIGNED_COLOR_BIT
        return ORACLE(replace(field, signed=signed), camera, background=background, sh_degree=degree)


class PatchedForward(Patched):
    """An extension that renders signed colour, but leaves clamped channels out of the gradient."""

    def with_sh(self, field: GaussianField, camera: Camera, background: Tensor, sh_degree: int) -> RenderResult:
        right = super().with_sh(field, camera, background, sh_degree)
        clamped = super().with_sh(field, camera, background, sh_degree & ~SIGNED_COLOR_BIT)
        return replace(right, image=right.image.detach() + clamped.image - clamped.image.detach())


class PatchedForwardAlone(Patched):
    """An extension whose backward pass was not patched: it takes the degree for 0."""

    def with_sh(self, field: GaussianField, camera: Camera, background: Tensor, sh_degree: int) -> RenderResult:
        right = super().with_sh(field, camera, background, sh_degree)
        constant = super().with_sh(field, camera, background, sh_degree & SIGNED_COLOR_BIT)
        return replace(right, image=right.image.detach() + constant.image - constant.image.detach())


class AlwaysSigned(Unpatched):
    """An extension that takes the degree for 0."""

    def with_sh(self, field: GaussianField, camera: Camera, background: Tensor, sh_degree: int) -> RenderResult:
        return ORACLE(replace(field, signed=True), camera, background=background, sh_degree=0)


@pytest.mark.parametrize(
    ("extension", "native"),
    [(Unpatched, False), (Patched, True), (PatchedForward, False), (PatchedForwardAlone, False), (AlwaysSigned, False)],
)
def test_the_probe_finds_out_what_an_extension_does(extension: type[Unpatched], native: bool) -> None:
    assert has_signed_color(extension()) is native
    with torch.inference_mode():
        assert has_signed_color(extension()) is native


def test_the_probe_works_where_gradients_are_off() -> None:
    with torch.no_grad():
        assert has_signed_color(Patched())


def scene(signed: bool) -> Case:
    return random_case(30, 20, 18, seed=3, sh_degree=2, signed=signed)


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("extension", [Unpatched, Patched])
@pytest.mark.parametrize("degree", [None, 1])
def test_both_paths_give_the_oracles_image_and_gradients(
    extension: type[Unpatched], signed: bool, degree: int | None
) -> None:
    case = replace(scene(signed), sh_degree=degree)
    weights = pixel_weights(case)
    actual = gradients(SignedColorRasterizer(extension()), case, weights)
    for name, value in gradients(ORACLE, case, weights).items():
        torch.testing.assert_close(actual[name], value, rtol=1e-10, atol=1e-12)  # worst seen 3e-14


def test_an_ordinary_call_is_handed_on_untouched_and_asks_nothing() -> None:
    extension = Unpatched()
    scene(signed=False).render(SignedColorRasterizer(extension))
    assert extension.calls == [(2, False)]


def test_the_paths_of_signed_calls() -> None:
    native, fallback = Patched(), Unpatched()
    scene(signed=True).render(SignedColorRasterizer(native))
    scene(signed=True).render(SignedColorRasterizer(fallback))
    assert native.calls[-1] == (signed_degree(2), False)
    assert fallback.calls[-1] == (2, True)
    forced = Patched()
    scene(signed=True).render(SignedColorRasterizer(forced, path=ColorPath.PRECOMPUTED))
    assert forced.calls == [(2, True)]


def test_one_warning_and_one_probe(caplog: pytest.LogCaptureFixture) -> None:
    extension = Unpatched()
    rasterizer = SignedColorRasterizer(extension)
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            scene(signed=True).render(rasterizer)
    assert len(extension.calls) == 5  # three scenes, and two by the probe
    (record,) = caplog.records
    assert "some_extension has no signed colour" in record.getMessage()
    assert "lapgs patch apply" in record.getMessage()


# --------------------------------------------------------------------------------------- what a warning says


@pytest.fixture
def target(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Target:
    """Make a checkout with a rasterizer's sources, and a patch of one edit."""
    folder = tmp_path / "submodules" / "raster"
    (folder / "some_extension").mkdir(parents=True)
    (folder / "shade.cu").write_text("float shade() { return 0.5f; }\n")
    edit = Edit("signed-color", "raw", "shade.cu", "return 0.5f", before="/* raw */")
    recipe = Recipe("some", "Some", (), reinstall="pip install {folder}", edit=(edit,))
    patch_target = Target(recipe, folder)
    monkeypatch.setattr(signed_color, "find_targets", lambda _: (patch_target,))
    return patch_target


def test_unpatched_sources_are_to_be_patched(target: Target, tmp_path: Path) -> None:
    said = explain_fallback("some_extension", tmp_path)
    assert f"run `lapgs patch apply {tmp_path}` and then `pip install {target.folder}`" in said


def test_the_command_can_be_pasted_where_names_have_spaces(target: Target, tmp_path: Path) -> None:
    folder = tmp_path / "my code"
    (command,) = re.findall("`(lapgs patch apply .*?)`", explain_fallback("some_extension", folder))
    assert shlex.split(command) == ["lapgs", "patch", "apply", str(folder)]


def test_patched_sources_beside_an_old_build_are_said_to_be_stale(target: Target, tmp_path: Path) -> None:
    write_all(plan_apply(target, ["signed-color"]))
    said = explain_fallback("some_extension", tmp_path)
    assert f"sources in {target.folder} are patched, but the installed build is older" in said
    assert f"run `pip install {target.folder}`" in said
    assert "lapgs patch" not in said


def test_sources_that_the_patch_does_not_fit_are_not_to_be_patched(target: Target, tmp_path: Path) -> None:
    (target.folder / "shade.cu").write_text("float shade() { return 0.25f; }\n")
    said = explain_fallback("some_extension", tmp_path)
    assert f"does not fit its sources in {target.folder}: `lapgs patch status {tmp_path}` says where" in said
    assert "lapgs patch apply" not in said


def test_of_several_checkouts_none_is_said_to_be_the_installed_one(
    target: Target, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = replace(target, folder=Path(shutil.copytree(target.folder, tmp_path / "other")))
    monkeypatch.setattr(signed_color, "find_targets", lambda _: (other, target))
    said = explain_fallback("some_extension", tmp_path)
    assert "`lapgs patch apply CHECKOUT`" in said
    assert str(tmp_path) not in said


def test_sources_of_another_module_say_nothing_about_this_one(target: Target, tmp_path: Path) -> None:
    assert str(target.folder) not in explain_fallback("another_extension", tmp_path)


def test_a_folder_that_is_no_checkout_still_gets_the_command(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "missing"):
        said = explain_fallback("some_extension", folder)
        assert "lapgs patch apply CHECKOUT" in said
        assert "\n" not in said


def test_precomputed_colours_of_an_ordinary_field_are_clamped() -> None:
    case = scene(signed=False)
    case = replace(case, field=case.field.with_parameters({"sh": case.field.sh - 1}))
    colors = precomputed_colors(case.field, case.camera, 2)
    raw = precomputed_colors(replace(case.field, signed=True), case.camera, 2)
    assert (raw < -0.5).any()
    torch.testing.assert_close(colors, (raw + 0.5).clamp(min=0))


# -------------------------------------------------------------------------------------- wrapped CUDA modules


@pytest.mark.parametrize("variant", BACKBONES)
def test_every_variant_is_wrapped_to_the_oracles_conventions(variant: str) -> None:
    """Compare matrices, units of the screen gradient, separate DC, degree 0, no Gaussians and none in view.

    The stand-ins have the arguments of the CUDA modules.
    """
    names = ("off_centre", "non_square_pixels", "invisible", "no_gaussians", "lower_degree", "degree_0_white")
    chosen = [case for case in conformance_cases() if case.name in names]
    with install(variant):
        module = VARIANTS[variant].module
        assert module in installed_extensions()
        extension = CudaExtension(module, device="cpu")
        assert SignedColorRasterizer(extension).path is ColorPath.NATIVE
        subject = Subject(variant, SignedColorRasterizer(extension), semantics=extension.semantics)
        outcomes = list(check(subject, chosen))
    assert len(outcomes) == 2 * len(names)
    assert [(outcome.case, outcome.problems) for outcome in outcomes if outcome.problems] == []


def test_an_extension_inside_of_a_package_that_is_absent_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    owners = {"absent_package.raster": None, "absent_module": None, "json.decoder": None}
    monkeypatch.setattr(extensions, "rasterizer_owners", lambda: owners)
    assert installed_extensions() == ["json.decoder"]


def test_screen_gradients_come_back_in_pixels() -> None:
    means2d, absolute = torch.zeros(3, 2, requires_grad=True), torch.zeros(3, 2)
    points = _ScreenPoints.apply(means2d, 40, 20, 4, absolute)
    assert points.shape == (3, 4)
    points.backward(torch.tensor([[20.0, 10.0, 40.0, 30.0]]).expand(3, 4))
    assert means2d.grad is not None
    assert means2d.grad.tolist() == [[1.0, 1.0]] * 3
    assert absolute.tolist() == [[2.0, 3.0]] * 3


# ------------------------------------------------------------------- what a rasterizer must never be called with


def _in_some_tile(view: Any, inputs: dict[str, Tensor]) -> bool:
    """Return whether a Gaussian has alpha >= 1/255 between the first and last pixels of a tile, by dense sampling."""
    hom = torch.cat([inputs["means3D"], torch.ones(len(inputs["means3D"]), 1)], 1) @ view.projmatrix
    size = torch.tensor([view.image_width, view.image_height])
    centres = ((hom[:, :2] / hom[:, 3:] + 1) * size - 1) / 2  # (n, 2)
    focal = size / (2 * torch.tensor([view.tanfovx, view.tanfovy]))
    sigmas = inputs["scales"].amax(1) * focal.max() / hom[:, 3]  # (n,) the Gaussians of these tests are spheres
    steps = [torch.arange(0, 16 * -(-int(side) // 16), 0.25) for side in size]
    x, y = (part[part % 16 <= 15] for part in steps)
    points = torch.cartesian_prod(x, y)  # (p, 2)
    q = (points - centres[:, None]).square().sum(2) / (2 * (sigmas**2 + 0.3))[:, None]  # (n, p)
    alphas = inputs["opacities"] * torch.exp(-q)  # (n, p)
    return bool((alphas[hom[:, 3] > 0.2] >= 1 / 255).any())


@contextmanager
def brittle(variant: str) -> Iterator[CudaExtension]:
    """A stand-in that refuses calls in which no tile has a Gaussian, like CUDA rasterizers that blend in buckets."""
    with install(variant) as modules:
        module = modules[VARIANTS[variant].module]

        class Brittle(module.GaussianRasterizer):  # type: ignore[misc, name-defined]  # a class made at run time
            @wraps(module.GaussianRasterizer.forward)  # the wrapper reads the arguments' names
            def forward(self, **inputs: Tensor) -> Any:
                assert _in_some_tile(self.raster_settings, inputs), "illegal memory access"
                return super().forward(**inputs)

        module.GaussianRasterizer = Brittle
        yield CudaExtension(VARIANTS[variant].module, device="cpu")


def sparse_case(places: list[tuple[float, float, float]], opacities: list[float], camera: Camera) -> Case:
    """Make small spheres at (x, y) pixels and depths."""
    x, y, depth = torch.tensor(places, dtype=torch.float64).reshape(-1, 3).unbind(1)
    points = torch.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, torch.ones_like(x)], 1)
    means = (points * depth[:, None] - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
    field = make_field(means, scales=1e-3, opacities=torch.tensor(opacities, dtype=torch.float64))
    return Case("sparse", field, camera, (0.2, 0.7, 0.4))


def sparse_problems(variant: str, gaussians: list[tuple[float, float, float, float]], camera: Camera) -> list[str]:
    """Compare a render of small spheres, (x, y, depth, opacity) each, with the oracle's, on a brittle extension."""
    case = sparse_case([g[:3] for g in gaussians], [g[3] for g in gaussians], camera).to(torch.float32)
    with brittle(variant) as extension:
        subject = Subject(variant, SignedColorRasterizer(extension), semantics=extension.semantics)
        problems = check_case(subject, case).problems
    # Most gradients of a sphere in the middle of a pixel are zero but for rounding, and of any sphere the
    # gradient of its rotation.
    rounding = ("is off by", "gradient of quaternions")
    return [line for line in problems if "gradient" not in line or not any(words in line for words in rounding)]


IN_BUCKETS = pytest.mark.parametrize("variant", ["fastgs", "graphdeco-accel", "taming", "taming-rasterizer"])
SPHERES = st.lists(
    st.tuples(
        st.sampled_from([-40.0, -0.6, 0.0, 5.0, 15.5, 18.0, 30.5, 60.0]),
        st.sampled_from([-40.0, -0.6, 0.0, 15.5, 16.0, 40.0]),
        st.sampled_from([-2.0, 0.1, 2.0, 9.0]),
        st.sampled_from([0.001, 0.00385, 0.004, 0.0095, 0.02, 0.5]),
    ),
    max_size=3,
)


@IN_BUCKETS
@settings(deadline=None, max_examples=40)
@given(gaussians=SPHERES, size=st.sampled_from([(31, 17), (16, 16), (48, 2)]), pose_seed=st.integers(0, 3))
def test_some_tile_always_has_a_gaussian_and_the_image_is_the_oracles(
    variant: str, gaussians: list[tuple[float, float, float, float]], size: tuple[int, int], pose_seed: int
) -> None:
    assert sparse_problems(variant, gaussians, make_camera(*size, pose_seed=pose_seed)) == []


@IN_BUCKETS
@settings(deadline=None, max_examples=20)
@given(gaussians=SPHERES, pose_seed=st.integers(0, 3))
@example(gaussians=[(-0.6, -0.6, 2.0, 0.02), (-0.6, 0.0, 2.0, 0.0095)], pose_seed=0)
def test_a_single_pixel_is_the_oracles_unless_a_threshold_runs_through_it(
    variant: str, gaussians: list[tuple[float, float, float, float]], pose_seed: int
) -> None:
    # Then nothing of the image can be compared, which is said; that some tile has a Gaussian is checked all the same.
    nothing_compared = "the band has 100% of the pixels, expected at most 40%"
    problems = sparse_problems(variant, gaussians, make_camera(1, 1, pose_seed=pose_seed))
    assert problems in ([], [nothing_compared])


@IN_BUCKETS
@pytest.mark.parametrize("gaussians", [[], [(0.0, 0.0, 2.0, 0.5)], [(0.0, 0.0, -2.0, 0.5)], [(40.0, 0.0, 2.0, 0.5)]])
def test_a_single_pixel_far_from_thresholds_is_the_oracles(
    variant: str, gaussians: list[tuple[float, float, float, float]]
) -> None:
    assert sparse_problems(variant, gaussians, make_camera(1, 1)) == []


def test_settings_that_are_not_known_are_refused_by_name() -> None:
    with install("graphdeco") as modules:
        module = modules["diff_gaussian_rasterization"]
        fields = [*module.GaussianRasterizationSettings._fields, "glow"]
        module.GaussianRasterizationSettings = type("Settings", (), {"_fields": tuple(fields)})
        with pytest.raises(UserInputError, match="its settings have glow"):
            CudaExtension("diff_gaussian_rasterization", device="cpu")


def test_a_field_elsewhere_or_in_other_precision_is_refused() -> None:
    case = scene(signed=False)
    with install("graphdeco"):
        extension = CudaExtension("diff_gaussian_rasterization", device="cpu")
        with pytest.raises(UserInputError, match=r"means is torch\.float64 on cpu, expected float32 on cpu"):
            case.render(SignedColorRasterizer(extension))


@pytest.mark.skipif("diff_gaussian_rasterization" in installed_extensions(), reason="it is installed")
def test_a_module_that_is_not_installed_is_said_to_be_so() -> None:
    with pytest.raises(MissingExtraError, match="diff_gaussian_rasterization cannot be imported"):
        CudaExtension("diff_gaussian_rasterization")
