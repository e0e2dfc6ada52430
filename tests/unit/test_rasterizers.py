"""Test the choice of rasterizer, the settings it gets from the training, and gsplat behind our interface."""

from __future__ import annotations

import gc
import logging
import weakref
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gsplat
import pytest
import torch
from gsplat.cuda import _torch_impl
from torch import Tensor

from lapgs_bench.kernels.gsplat_on_cpu import _cuda_parts_replaced
from lapgs_plugin.adapters.fastgs import Adapter as FastgsAdapter
from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.evaluation.cases import Case, pixel_weights, random_case
from lapgs_plugin.family import install, stand_ins
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.rasterizer import Rasterizer, RenderResult, render_transmittance
from lapgs_plugin.rasterizers import choice
from lapgs_plugin.rasterizers.choice import PlacedRasterizer, rasterizer_for
from lapgs_plugin.rasterizers.extensions import CudaExtension
from lapgs_plugin.rasterizers.gsplat import rasterizer as gsplat_adapter
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from lapgs_plugin.rasterizers.signed_color import SignedColorRasterizer
from lapgs_plugin.reference_raster import CpuRasterizer, OracleRasterizer
from lapgs_plugin.runs.manifest import Manifest, SceneReference

FASTGS, GRAPHDECO = "diff_gaussian_rasterization_fastgs", "diff_gaussian_rasterization"
LOGGER = "lapgs_plugin.rasterizers.choice"


def manifest(rasterizer: str, **raster: Any) -> Manifest:
    scene = SceneReference("scene", "3dgs:-1", True, (0.0, 0.0, 0.0), "colmap")
    return Manifest(scene, 2, "camera", "reconstructed", "xyz", 3, rasterizer, 0, {"raster": raster})


def scene(signed: bool = False) -> Case:
    case = random_case(60, 45, 37, seed=5, sh_degree=2).to(torch.float32)
    return replace(case, field=replace(case.field, signed=signed))


@pytest.fixture
def line(caplog: pytest.LogCaptureFixture) -> Iterator[Any]:
    """Return the only logged line."""
    caplog.set_level(logging.INFO, LOGGER)

    def only() -> str:
        (record,) = (record for record in caplog.records if record.name == LOGGER)
        return record.getMessage()

    return only


@pytest.fixture
def no_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pretend to have a GPU; nothing is rendered on it."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "A GPU")


def chosen(placed: PlacedRasterizer) -> tuple[str, str]:
    return placed.rasterizer.name, placed.device.type


# ------------------------------------------------------------------------------------------ without a CUDA device


@pytest.mark.usefixtures("no_cuda")
def test_without_cuda_the_fast_one_renders_and_says_what_it_cannot_honour(line: Any) -> None:
    placed = rasterizer_for(manifest(FASTGS, mult=0.5))
    assert chosen(placed) == ("cpu", "cpu")
    assert placed.unsupported == {"mult": 0.5}
    assert line() == (
        f"rendering with the CPU rasterizer: the fastest without a CUDA device; the run was trained with {FASTGS}, "
        "images may differ slightly; cpu cannot honour mult = 0.5 of the training "
        f"(--rasterizer {FASTGS} can, slowly on a CPU)"
    )


@pytest.mark.usefixtures("no_cuda")
@pytest.mark.parametrize(("trained", "shown"), [("cpu", "the CPU rasterizer"), ("oracle", "oracle on the CPU")])
def test_a_run_of_ours_is_rendered_as_it_was_trained(trained: str, shown: str, line: Any) -> None:
    assert chosen(rasterizer_for(manifest(trained))) == (trained, "cpu")
    assert line() == f"rendering with {shown}: as in training"


@pytest.mark.usefixtures("no_cuda")
def test_settings_that_change_nothing_are_not_worth_a_word() -> None:
    assert rasterizer_for(manifest(GRAPHDECO, antialiasing=False)).unsupported == {}
    assert rasterizer_for(manifest(FASTGS, mult=1.0)).unsupported == {}


@pytest.mark.usefixtures("no_cuda")
@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize(("name", "setting"), [(FASTGS, {"mult": 0.3}), (GRAPHDECO, {"antialiasing": True})])
def test_a_stand_in_asked_for_by_name_honours_the_settings(name: str, setting: dict[str, Any], signed: bool) -> None:
    placed = rasterizer_for(manifest(name, **setting), device="cpu", rasterizer=name)
    assert chosen(placed) == (name, "cpu")
    assert placed.unsupported == {}
    case = scene(signed)
    with torch.no_grad():
        honoured, plain = case.render(placed.rasterizer).image, case.render(OracleRasterizer()).image
    assert (honoured - plain).abs().max() > 1e-2  # it does change this image
    variant = "fastgs" if name == FASTGS else "graphdeco-aa"
    direct = SignedColorRasterizer(CudaExtension(name, "cpu", settings=setting, module=stand_ins(variant)[name]))
    assert torch.equal(case.render(direct).image, honoured)


@pytest.mark.usefixtures("no_cuda")
@pytest.mark.parametrize(
    ("device", "rasterizer", "message"),
    [
        ("gpu", "auto", "--device gpu: expected auto, cuda, cpu"),
        ("cuda", "auto", "--device cuda: PyTorch finds no CUDA device"),
        ("auto", "my_own", "--rasterizer my_own: expected auto, gsplat, cpu, oracle, faster-gs, diff_gaussian"),
        ("cpu", "gsplat", "--rasterizer gsplat: PyTorch finds no CUDA device"),
        ("auto", "gsplat", "--rasterizer gsplat: PyTorch finds no CUDA device"),
    ],
)
def test_what_cannot_be_had_is_refused_in_one_line(device: str, rasterizer: str, message: str) -> None:
    with pytest.raises((UserInputError, MissingExtraError), match=message) as caught:
        rasterizer_for(manifest("cpu"), device, rasterizer)
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("no_cuda")
def test_a_backbone_without_a_stand_in_is_not_offered_on_a_cpu(monkeypatch: pytest.MonkeyPatch, line: Any) -> None:
    class Theirs(FastgsAdapter):
        info = replace(FastgsAdapter.info, rasterizer="their_raster", stand_in="")

    monkeypatch.setattr(choice, "rasterizer_owners", lambda: {"their_raster": Theirs})
    with pytest.raises(UserInputError, match="--rasterizer their_raster: it has no stand-in for a CPU; leave"):
        rasterizer_for(manifest("their_raster"), rasterizer="their_raster")
    rasterizer_for(manifest("their_raster", mult=0.5))
    assert line().endswith("cpu cannot honour mult = 0.5 of the training")


# --------------------------------------------------------------------------------------------- with a CUDA device


@pytest.mark.usefixtures("cuda")
def test_with_cuda_the_rasterizer_of_the_training_renders_with_its_settings(line: Any) -> None:
    with install("fastgs"):
        placed = rasterizer_for(manifest(FASTGS, mult=0.5))
    assert chosen(placed) == (FASTGS, "cuda")
    assert placed.unsupported == {}
    assert line() == f"rendering with {FASTGS} on A GPU: as in training"


@pytest.mark.usefixtures("cuda")
def test_a_build_that_lacks_a_setting_says_so(line: Any) -> None:
    with install("taming"):
        placed = rasterizer_for(manifest(GRAPHDECO, antialiasing=True))
    assert chosen(placed) == (GRAPHDECO, "cuda")
    assert placed.unsupported == {"antialiasing": True}
    assert "cannot honour antialiasing = True" in line()


@pytest.mark.usefixtures("cuda")
def test_gsplat_is_next_and_the_cpu_last(monkeypatch: pytest.MonkeyPatch, line: Any) -> None:
    monkeypatch.setattr(gsplat_adapter, "missing", lambda **options: "")
    placed = rasterizer_for(manifest(FASTGS, mult=0.5))
    assert chosen(placed) == ("gsplat", "cuda")
    assert placed.unsupported == {"mult": 0.5}
    assert f"rendering with gsplat on A GPU: {FASTGS} cannot be imported" in line()
    assert rasterizer_for(manifest(GRAPHDECO, antialiasing=True)).unsupported == {}

    monkeypatch.setattr(gsplat_adapter, "missing", lambda **options: "gsplat is not installed")
    assert chosen(rasterizer_for(manifest(FASTGS))) == ("cpu", "cpu")
    with pytest.raises(MissingExtraError, match=r"--device cuda: .*cannot be imported.* and gsplat is not installed"):
        rasterizer_for(manifest(FASTGS), device="cuda")


@pytest.mark.usefixtures("cuda")
def test_the_device_decides_for_runs_of_either_kind(monkeypatch: pytest.MonkeyPatch, line: Any) -> None:
    monkeypatch.setattr(gsplat_adapter, "missing", lambda **options: "")
    assert chosen(rasterizer_for(manifest("cpu"), device="cuda")) == ("gsplat", "cuda")
    assert "with gsplat on A GPU: --rasterizer cpu renders on cpu, not on --device cuda; the run was" in line()
    assert chosen(rasterizer_for(manifest("cpu"))) == ("cpu", "cpu")
    assert rasterizer_for(manifest("gsplat", antialiasing=True), rasterizer="cpu").unsupported == {"antialiasing": True}
    with install("fastgs"):
        assert chosen(rasterizer_for(manifest(FASTGS), device="cpu")) == ("cpu", "cpu")
        assert chosen(rasterizer_for(manifest("cpu"), rasterizer=FASTGS)) == (FASTGS, "cuda")
        assert chosen(rasterizer_for(manifest(FASTGS), device="cpu", rasterizer=FASTGS)) == (FASTGS, "cpu")
    with pytest.raises(UserInputError, match="--rasterizer cpu renders on cpu, not on --device cuda; choose"):
        rasterizer_for(manifest(FASTGS), device="cuda", rasterizer="cpu")


# ------------------------------------------------------------------------------------------------ what a call costs


def test_rendering_is_one_pass_that_keeps_nothing() -> None:
    calls = []
    with install("fastgs") as modules:
        module = modules[FASTGS]

        class Counting(module.GaussianRasterizer):  # type: ignore[name-defined, misc]  # the class of a loaded module
            def forward(self, *args: Any, **kwargs: Any) -> Any:
                calls.append(self.raster_settings.bg.tolist())
                return super().forward(*args, **kwargs)

        extension = CudaExtension(FASTGS, "cpu")
        module.GaussianRasterizer = Counting
        case = scene().with_leaves()
        with torch.no_grad():
            result = case.render(SignedColorRasterizer(extension))
    assert len(calls) == 1
    assert result.transmittance is None
    assert result.absgrad2d is None
    assert not any(value.requires_grad for value in (result.image, result.means2d))


@pytest.mark.parametrize("signed", [False, True])
def test_the_transmittance_is_there_for_who_asks(signed: bool) -> None:
    case = scene(signed)
    expected = case.render(OracleRasterizer(three_sigma_cut=False)).transmittance
    with install("fastgs"):
        rasterizer = SignedColorRasterizer(CudaExtension(FASTGS, "cpu"))
        actual = render_transmittance(rasterizer, case.field, case.camera)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-5)  # worst seen 1.1e-6


def test_settings_that_an_extension_does_not_have_are_refused() -> None:
    with install("taming"), pytest.raises(UserInputError, match="has no setting mult; expected some of"):
        CudaExtension(GRAPHDECO, "cpu", settings={"mult": 0.5})


@pytest.mark.parametrize("signed", [False, True])
def test_a_rasterizer_needs_no_more_than_a_call(signed: bool) -> None:
    class Minimal(Rasterizer):
        name = "minimal"

        def __call__(self, *inputs: Any, **options: Any) -> RenderResult:
            return OracleRasterizer()(*inputs, **options)

    case, minimal = scene(signed), Minimal()
    background, leaves = torch.tensor(case.background), case.with_leaves().field
    cameras = [case.camera, replace(case.camera, cx=case.camera.cx + 3.0)]
    expected = CpuRasterizer().render_images(case.field, cameras, background=background)
    images = minimal.render_images(leaves, cameras, background=background)
    torch.testing.assert_close(images, expected, rtol=0, atol=1e-5)  # worst seen 1.2e-6
    assert not images.requires_grad
    alone = minimal.render_image(leaves, cameras[1], background=background)
    torch.testing.assert_close(alone.detach(), expected[1], rtol=0, atol=1e-5)
    assert alone.requires_grad
    assert [minimal.can_batch, minimal.can_stack, minimal.in_current_stream] == [False] * 3


# ----------------------------------------------------------------------------------------------------------- gsplat


class WithoutCuda:
    """Compute `gsplat.rasterization` and `spherical_harmonics` by gsplat's PyTorch code, and record the arguments."""

    def __init__(self) -> None:
        self.asked: dict[str, Any] = {}
        self.hooks: list[Any] = []

    def spherical_harmonics(self, degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
        return _torch_impl._spherical_harmonics(degree, directions, coefficients)

    def rasterization(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        width: int,
        height: int,
        *,
        near_plane: float,
        eps2d: float,
        backgrounds: Tensor,
        sh_degree: int | None = None,
        **asked: Any,
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        self.asked = {"near_plane": near_plane, "eps2d": eps2d, **asked}
        if sh_degree is not None:
            position = torch.linalg.inv(viewmats[0])[:3, 3]
            colors = (self.spherical_harmonics(sh_degree, means - position, colors) + 0.5).clamp_min(0.0)
        covariances, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        radii, means2d, depths, conics, _ = _torch_impl._fully_fused_projection(
            means, covariances, viewmats, Ks, width, height, eps2d=eps2d, near_plane=near_plane
        )
        shown = (radii > 0).all(-1, keepdim=True)  # (1, n, 1)
        means2d, conics = (
            torch.where(shown, means2d, torch.nan),
            torch.where(shown, conics, torch.nan),
        )  # as never written
        columns, rows = -(-width // 16), -(-height // 16)
        _, tile_ids, ids = _torch_impl._isect_tiles(means2d.nan_to_num(), radii, depths, 16, columns, rows)
        offsets = _torch_impl._isect_offset_encode(tile_ids, 1, columns, rows)
        with _cuda_parts_replaced():
            image, alpha = _torch_impl._rasterize_to_pixels(
                means2d, conics, colors[None], opacities[None], width, height, 16, offsets, ids, backgrounds=backgrounds
            )
        if asked["absgrad"]:
            means2d.register_hook(lambda gradient: setattr(means2d, "absgrad", gradient.abs()))
        info = {"radii": radii, "means2d": means2d, "conics": conics}
        if asked.get("packed"):
            return image, alpha, self._packed(info, asked["absgrad"])
        return image, alpha, {**info, "gaussian_ids": None}

    def _packed(self, found: dict[str, Any], absgrad: bool) -> dict[str, Any]:
        """Return the results of visible Gaussians alone; gradients go to their centres, as in gsplat."""
        ids = (found["radii"][0] > 0).all(-1).nonzero()[:, 0]
        packed: Any = found["means2d"][0, ids]
        whole = found["means2d"]

        def hand_over(gradient: Tensor) -> None:
            if absgrad:
                packed.absgrad = gradient[0, ids].abs()
            for hook in self.hooks:
                hook(gradient[0, ids])

        if whole.requires_grad:
            whole.register_hook(hand_over)
        packed.register_hook = self.hooks.append
        radii, conics = found["radii"][0, ids], found["conics"][0, ids]
        return {"radii": radii, "means2d": packed, "conics": conics, "gaussian_ids": ids}


class AsOf160(WithoutCuda):
    """The same with the signatures of gsplat 1.6.0, which has a tensor for absolute gradients from the start."""

    def spherical_harmonics(  # type: ignore[override]  # that is the point
        self, degrees_to_use: int, means: Tensor, viewmats: Tensor, coeffs: Tensor, masks: Tensor | None = None
    ) -> Tensor:
        positions = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]  # (c, 3)
        return torch.stack(
            [super(AsOf160, self).spherical_harmonics(degrees_to_use, means - p, coeffs) for p in positions]
        )

    def rasterization(self, *args: Any, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        image, alpha, info = super().rasterization(*args, **{**options, "absgrad": False})
        self.asked["absgrad"], centres = options["absgrad"], info["means2d"]
        if options["absgrad"]:
            centres.absgrad = torch.zeros_like(centres)

            def fill(gradient: Tensor) -> None:
                centres.absgrad.copy_(gradient.abs())

            centres.register_hook(fill)  # before that of the adapter
        return image, alpha, info


@pytest.fixture(params=[WithoutCuda, AsOf160], ids=["1.5.3", "1.6.0"])
def without_cuda(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> WithoutCuda:
    code: WithoutCuda = request.param()
    monkeypatch.setattr(gsplat, "rasterization", code.rasterization)
    monkeypatch.setattr(gsplat, "spherical_harmonics", code.spherical_harmonics)
    return code


def faint(signed: bool) -> Case:
    """Make Gaussians whose alpha is below 1/255 well inside three sigma: no footprint is cut and no alpha capped."""
    case = random_case(300, 70, 50, seed=3, background=(0.0, 0.0, 0.0)).to(torch.float32)
    opacities = 0.01 + 0.19 * torch.rand(300, generator=torch.Generator().manual_seed(4))
    field = case.field.with_parameters({"opacity_logits": torch.logit(opacities)})
    return replace(case, field=replace(field, signed=signed))


@pytest.mark.parametrize("signed", [False, True])
def test_gsplat_is_the_oracle_where_their_semantics_agree(signed: bool, without_cuda: WithoutCuda) -> None:
    case = faint(signed)
    weights = pixel_weights(case)
    results = {}
    for name, rasterizer in (("theirs", GsplatRasterizer("cpu")), ("ours", OracleRasterizer())):
        fresh = case.with_leaves()
        result = fresh.render(rasterizer)
        (result.image * weights).sum().backward()
        gradients = {key: value.grad for key, value in fresh.field.parameters.items()}
        results[name] = result, {**gradients, "means2d": result.means2d.grad}
    (theirs, their_gradients), (ours, our_gradients) = results["theirs"], results["ours"]
    assert ours.image.min() < -0.1 or not signed
    # Rounding alone; worst seen: image 5e-7, transmittance 5e-7, centres 8e-6, gradients 3.5e-6 of their norm.
    torch.testing.assert_close(theirs.image, ours.image, rtol=0, atol=1e-5)
    torch.testing.assert_close(theirs.transmittance, ours.transmittance, rtol=0, atol=1e-5)
    both = (theirs.radii > 0) & (ours.radii > 0)
    assert both.float().mean() > 0.5
    assert torch.equal(theirs.radii[both], ours.radii[both])
    torch.testing.assert_close(theirs.means2d[both], ours.means2d[both], rtol=0, atol=1e-4)
    assert (theirs.means2d[theirs.radii == 0] == 0).all()
    for name, gradient in our_gradients.items():
        assert gradient is not None
        assert (their_gradients[name] - gradient).norm() < 1e-4 * gradient.norm(), name
    assert theirs.absgrad2d is not None
    torch.testing.assert_close(theirs.absgrad2d, theirs.means2d.grad.abs())


@pytest.mark.parametrize("degree", [-1, 2])
def test_a_degree_that_the_field_lacks_and_half_a_colour_are_refused_before_anything_is_rendered(
    degree: int, without_cuda: WithoutCuda
) -> None:
    case = random_case(20, 20, 20, seed=3, sh_degree=1).to(torch.float32)
    with install("graphdeco"):
        extension = SignedColorRasterizer(CudaExtension(GRAPHDECO, "cpu"))
        rasterizers = CpuRasterizer(), OracleRasterizer(), extension, GsplatRasterizer("cpu")
        for rasterizer in rasterizers:
            with pytest.raises(UserInputError, match=f"sh_degree {degree}: expected 0 to 1"):
                rasterizer(case.field, case.camera, background=torch.zeros(3), sh_degree=degree)
            with pytest.raises(UserInputError, match=r"background has shape \(1,\), expected \(3,\)"):
                rasterizer(case.field, case.camera, background=torch.zeros(1))
    assert without_cuda.asked == {}


@pytest.mark.parametrize(
    ("count", "degree", "direct"), [(44_739_242, 3, True), (44_739_243, 3, False), (10**8, 0, True)]
)
def test_fields_whose_coefficients_32_bits_cannot_number_are_left_to_gsplat(
    count: int, degree: int, direct: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = (3,), (4,), (3,), (), ((degree + 1) ** 2, 3)
    field = GaussianField(*(torch.empty(count, *size, device="meta") for size in sizes))
    monkeypatch.setattr(gsplat_adapter, "direct_works", lambda: True)
    rasterizer = GsplatRasterizer("cpu")
    rasterizer._may_be_direct = True
    assert rasterizer._calls_kernels(field) is direct


@pytest.mark.parametrize(
    ("triton", "gsplats", "options", "lacks"),
    [
        ("", "no nvcc", {}, ""),
        ("no Triton", "", {}, ""),
        ("no Triton", "no nvcc", {}, "no Triton and no nvcc"),
        ("", "no nvcc", {"packed": True}, "--packed and --antialiased need gsplat's CUDA part: no nvcc"),
        ("", "no nvcc", {"antialiasing": True}, "--packed and --antialiased need gsplat's CUDA part: no nvcc"),
        ("", "no nvcc", {"direct": False}, "no nvcc"),
    ],
)
def test_a_gpu_needs_triton_or_gsplats_cuda_part(
    triton: str, gsplats: str, options: dict[str, bool], lacks: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gsplat_adapter, "triton_missing", lambda: triton)
    monkeypatch.setattr(gsplat_adapter, "gsplat_missing", lambda: gsplats)
    if lacks:
        with pytest.raises(MissingExtraError, match=f"^--rasterizer gsplat: {lacks}; `lapgs doctor` says what to"):
            GsplatRasterizer(**options)
    else:
        rasterizer = GsplatRasterizer(**options)
        assert rasterizer.can_stack


def test_kernels_that_fail_their_validation_leave_a_line_where_gsplat_cannot_take_their_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gsplat_adapter, "triton_missing", lambda: "")
    monkeypatch.setattr(gsplat_adapter, "gsplat_missing", lambda: "there is no nvcc")
    monkeypatch.setattr(gsplat_adapter, "direct_works", lambda: False)
    with pytest.raises(
        MissingExtraError, match=r"our kernels do not work here \(the log says why\), and there is no nv"
    ):
        GsplatRasterizer()._calls_kernels(faint(False).field)
    monkeypatch.setattr(gsplat_adapter, "gsplat_missing", lambda: "")
    assert not GsplatRasterizer()._calls_kernels(faint(False).field)


def test_gsplat_is_asked_for_the_conventions_of_the_family(without_cuda: WithoutCuda) -> None:
    with torch.no_grad():
        result = faint(False).render(GsplatRasterizer("cpu", antialiasing=True))
    assert without_cuda.asked == {
        **{"near_plane": 0.2, "eps2d": 0.3, "radius_clip": 0.0, "packed": False},
        **{"rasterize_mode": "antialiased", "absgrad": False},
    }
    assert result.absgrad2d is None


@pytest.mark.usefixtures("without_cuda")
def test_packed_results_and_gsplats_own_radii_say_the_same() -> None:
    case = faint(True)
    weights, results = pixel_weights(case), []
    for options in ({}, {"packed": True, "own_radii": True}):
        fresh = case.with_leaves()
        result = fresh.render(GsplatRasterizer("cpu", **options))
        (result.image * weights).sum().backward()
        results.append(result)
    whole, packed = results
    assert 0 < (whole.radii > 0).sum() < len(whole.radii)
    assert torch.equal(whole.means2d, packed.means2d)
    assert torch.equal(whole.means2d.grad.nan_to_num(), packed.means2d.grad)
    assert torch.equal(whole.absgrad2d.nan_to_num(), packed.absgrad2d)
    assert torch.equal(whole.radii > 0, packed.radii > 0)


@pytest.mark.usefixtures("without_cuda")
def test_absolute_gradients_are_left_out_where_nobody_asks() -> None:
    case = faint(False).with_leaves()
    result = case.render(GsplatRasterizer("cpu", absgrad=False))
    result.image.sum().backward()
    assert result.absgrad2d is None
    assert result.means2d.grad is not None


def test_gsplat_without_gaussians_shows_the_background(without_cuda: WithoutCuda) -> None:
    case = random_case(0, 20, 10, seed=0, background=(0.1, 0.2, 0.3)).to(torch.float32)
    result = case.render(GsplatRasterizer("cpu"))
    torch.testing.assert_close(result.image, torch.tensor([0.1, 0.2, 0.3])[:, None, None].expand(3, 10, 20))
    assert without_cuda.asked == {}
    with pytest.raises(UserInputError, match=r"means is torch\.float64 on cpu, expected float32 on cpu"):
        case.to(torch.float64).render(GsplatRasterizer("cpu"))


def test_what_a_backward_pass_needed_is_let_go_at_once(without_cuda: WithoutCuda) -> None:
    """Memory is freed without the cycle collector, which sees small objects and not the gigabytes behind them."""
    case = faint(False).with_leaves()
    gc.collect()
    gc.disable()
    try:
        result = GsplatRasterizer("cpu", absgrad=False)(case.field, case.camera, background=torch.zeros(3))
        centres = weakref.ref(result.means2d.of_gsplat)  # type: ignore[attr-defined]  # where gsplat leaves its gradients
        result.image.sum().backward()
        assert result.means2d.grad is not None
        del result
        assert centres() is None
    finally:
        gc.enable()
