"""Stand-ins for CUDA modules against the oracle, autograd in float64 and brute force."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.family import BACKBONES, VARIANTS, install, stand_ins
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.rasterizers.signed_color import signed_degree
from lapgs_plugin.reference_raster.oracle import OracleRasterizer, project
from tests.raster.scenes import COLORED, Case, make_camera, random_case, to_world
from tests.raster.standin_cases import covariances

SPLIT = {"graphdeco-accel", "taming", "taming-rasterizer", "fastgs"}


def settings_of(module: ModuleType, camera: Camera, background: tuple[float, ...], degree: int, **more: Any) -> Any:
    """Make settings like the checkouts: transposed matrices, half fields of view."""
    tanx, tany = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, 0], projection[1, 1], projection[3, 2] = 1 / tanx, 1 / tany, 1
    projection[0, 2], projection[1, 2] = 2 * camera.cx / camera.width - 1, 2 * camera.cy / camera.height - 1
    projection[2, 2], projection[2, 3] = 100 / (100 - 0.01), -1 / (100 - 0.01)
    pose = camera.world_to_camera.double()
    values: dict[str, Any] = {
        "image_height": camera.height, "image_width": camera.width, "tanfovx": tanx, "tanfovy": tany,
        "bg": torch.tensor(background), "scale_modifier": 1.0, "viewmatrix": pose.T.float(),
        "projmatrix": (projection @ pose).T.float(), "sh_degree": degree, "prefiltered": False, "debug": False,
        "campos": (-pose[:3, :3].T @ pose[:3, 3]).float(), "antialiasing": False, "mult": 1.0, "get_flag": False,
        "metric_map": torch.zeros(camera.height * camera.width, dtype=torch.int32), "pixel_weights": None,
    }  # fmt: skip
    fields = module.GaussianRasterizationSettings._fields
    return module.GaussianRasterizationSettings(
        **{key: value for key, value in (values | more).items() if key in fields}
    )


def activated(case: Case) -> dict[str, Tensor]:
    """Return the arguments that checkouts pass to the rasterizer, differentiable by the field's parameters."""
    field = case.field
    return {
        "means3D": field.means, "opacities": field.opacity_logits.sigmoid()[:, None],
        "scales": field.log_scales.exp(), "rotations": normalize(field.quaternions), "shs": field.sh,
    }  # fmt: skip


def call(module: ModuleType, variant: str, case: Case, inputs: dict[str, Tensor], **more: Any) -> tuple[Tensor, ...]:
    degree = case.field.sh_degree if case.sh_degree is None else case.sh_degree
    degree = signed_degree(degree) if case.field.signed else degree
    settings = settings_of(module, case.camera, case.background, degree, **more)
    inputs = dict(inputs)
    points = torch.zeros(len(case.field), 4 if variant == "fastgs" else 3, requires_grad=True)
    if variant in SPLIT and "shs" in inputs:
        shs = inputs.pop("shs")
        inputs.update(dc=shs[:, :1], shs=shs[:, 1:])
    results: tuple[Tensor, ...] = module.GaussianRasterizer(settings)(means2D=points, **inputs)
    return (*results, points)


def module_of(variant: str) -> ModuleType:
    return stand_ins(variant)[VARIANTS[variant].module]


def case_of(*, signed: bool = False, sh_degree: int = 3, n: int = 60, **more: Any) -> Case:
    camera = make_camera(53, 41, pose_seed=7, principal_offset=(3.0, -2.0))
    case = random_case(
        n, 53, 41, seed=5, sh_degree=sh_degree, signed=signed, background=COLORED, camera=camera, **more
    )  # fmt: skip
    return case.to(torch.float32)


def relative(a: Tensor, b: Tensor) -> float:
    return ((a.double() - b.double()).norm() / b.double().norm().clamp_min(1e-30)).item()


@pytest.mark.parametrize("variant", BACKBONES)
@pytest.mark.parametrize("signed", [False, True])
def test_image_radii_and_gradients_are_the_oracles(variant: str, signed: bool) -> None:
    case = case_of(signed=signed)
    weights = torch.randn(3, 41, 53, generator=torch.Generator().manual_seed(1))
    exact = case.to(torch.float64).with_leaves()
    # FastGS does not cut at three sigma: see the tests of its tiles. With mult 1 the cut at 1/255 remains.
    expected = exact.render(OracleRasterizer(three_sigma_cut=variant != "fastgs"))
    (expected.image * weights).sum().backward()

    mine = case.with_leaves()
    image, radii, *_, points = call(module_of(variant), variant, mine, activated(mine))
    (image * weights).sum().backward()
    assert (image - expected.image).abs().max() < 2e-5  # worst seen: 1.7e-6
    if variant != "fastgs":
        assert torch.equal(radii, expected.radii)
    for name, value in mine.field.parameters.items():
        assert relative(value.grad, exact.field.parameters[name].grad) < 2e-5, name  # worst seen: 2.5e-6
    half = torch.tensor([53 / 2, 41 / 2])
    assert relative(points.grad[:, :2], expected.means2d.grad * half) < 2e-5  # worst seen: 1.9e-6
    assert torch.equal(points.grad[:, 2:3] == 0, torch.ones(len(radii), 1, dtype=torch.bool)) or variant == "fastgs"
    if variant == "fastgs":
        assert relative(points.grad[:, 2:], expected.absgrad2d * half) < 2e-5  # worst seen: 4.5e-7


# ------------------------------------------------------------------------------------------- FastGS's tiles and counts


def least_distance(conic: Tensor, centre: Tensor, tile: Tensor) -> float:
    """Least squared Mahalanobis distance of a point of the square [16 tile, 16 tile + 16] from a centre, float64."""
    low, high = 16 * tile - centre, 16 * tile + 16 - centre  # (2,) each
    if bool(((low <= 0) & (high >= 0)).all()):
        return 0.0
    xx, xy, yy = conic.tolist()
    distances = []
    for x in (float(low[0]), float(high[0])):
        y = min(max(-xy * x / yy, float(low[1])), float(high[1]))
        distances.append(xx * x * x + 2 * xy * x * y + yy * y * y)
    for y in (float(low[1]), float(high[1])):
        x = min(max(-xy * y / xx, float(low[0])), float(high[0]))
        distances.append(xx * x * x + 2 * xy * x * y + yy * y * y)
    return min(distances)


def brute_force(case: Case, mult: float, marked: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Image, which Gaussians reach a tile, and each one's sums over pixels, by FastGS's tiles."""
    case = case.to(torch.float64)
    seen = project(case.field, case.camera, three_sigma_cut=False)
    opacities = case.field.opacity_logits.sigmoid()
    direction = normalize(case.field.means - case.camera.position, dim=1)
    colors = sh_to_color(case.field.sh, direction, case.field.sh_degree, signed=case.field.signed)
    height, width = case.camera.height, case.camera.width
    image, n = case.background_tensor[:, None, None].expand(3, height, width).clone(), len(case.field)
    reached = torch.zeros(n, dtype=torch.bool)
    sums = {name: torch.zeros(n, dtype=torch.float64) for name in ("weights", "counts", "blending", "distances")}
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    t, color = torch.ones(height, width).double(), torch.zeros(3, height, width).double()
    done = torch.zeros(height, width, dtype=torch.bool)
    for k in torch.argsort(seen.depths, stable=True).tolist():
        i, centre, conic = int(seen.ids[k]), seen.means2d[k], seen.conics[k]
        limit = 2 * mult * math.log(255 * float(opacities[i])) if opacities[i] > 1 / 255 else -1.0
        inside = torch.zeros(height, width, dtype=torch.bool)
        for v in range(-(-height // 16)):
            for u in range(-(-width // 16)):
                if least_distance(conic, centre, torch.tensor([u, v]).double()) <= limit:
                    inside[16 * v : 16 * v + 16, 16 * u : 16 * u + 16] = True
        reached[i] = inside.any()
        dx, dy = x - centre[0], y - centre[1]
        q = conic[0] * dx * dx + 2 * conic[1] * dx * dy + conic[2] * dy * dy
        alpha = (opacities[i] * torch.exp(-q / 2)).clamp(max=0.99)
        here = inside & ~done & (alpha >= 1 / 255)
        done |= here & (t * (1 - alpha) < 1e-4)
        here &= ~done
        share = torch.where(here, alpha * t, 0.0)
        color += share * colors[i][:, None, None]
        t = t - share
        sums["weights"][i] = marked[here].sum()
        sums["counts"][i] = here.sum()
        sums["blending"][i] = share.sum()
        sums["distances"][i] = torch.hypot(dx, dy)[here].sum()
    return color + t * image, reached, sums


@pytest.mark.parametrize("mult", [0.3, 0.5, 1.0])
def test_fastgs_blends_in_the_tiles_that_its_ellipses_meet_and_counts_marked_pixels(mult: float) -> None:
    case = case_of(n=50, pixels=(1.0, 9.0))
    marked = torch.rand(41, 53, generator=torch.Generator().manual_seed(3)) < 0.4
    expected, reached, sums = brute_force(case, mult, marked)
    image, radii, counts, _ = call(
        module_of("fastgs"), "fastgs", case, activated(case), mult=mult, get_flag=True, metric_map=marked.int()
    )
    assert (image - expected).abs().max() < 2e-5  # worst seen: 5.9e-7
    assert torch.equal(radii > 0, reached)
    assert counts.dtype == torch.int32
    assert torch.equal(counts.double(), sums["weights"])
    if mult == 0.3:
        square = call(module_of("graphdeco"), "graphdeco", case, activated(case))[0]
        assert (image - square).abs().max() > 1e-3, "the compact box changes nothing here: the test shows nothing"


def test_fastgs_without_the_flag_counts_nothing() -> None:
    case = case_of(n=5)
    counts = call(module_of("fastgs"), "fastgs", case, activated(case), get_flag=None)[2]
    assert counts.shape == (0,)
    assert counts.dtype == torch.int32


# ------------------------------------------------------------------------------------------------ Taming's scores


def test_taming_sums_over_pixels() -> None:
    case = case_of(n=50)
    weights = torch.rand(41, 53, generator=torch.Generator().manual_seed(3))
    results = call(module_of("taming"), "taming", case, activated(case), pixel_weights=weights)
    image, radii, counts, *lists, centres, depths, again, weighted, pixels, blending, distances, _ = results
    _, _, sums = brute_force(case, 100.0, weights.double())  # all tiles
    shown = call(module_of("graphdeco"), "graphdeco", case, activated(case))
    seen = project(case.to(torch.float64).field, case.to(torch.float64).camera)
    assert torch.equal(image, shown[0])
    assert torch.equal(radii, shown[1])
    assert torch.equal(again, radii)
    assert counts.shape == (41, 53)
    assert [t.numel() for t in lists] == [0, 0, 0]
    assert (centres[seen.ids] - seen.means2d).abs().max() < 1e-4  # worst seen: 6.8e-6
    assert (depths[seen.ids] - seen.depths).abs().max() < 1e-5  # worst seen: 6.2e-7
    assert not centres[radii == 0].any()
    assert not depths[radii == 0].any()
    # Tiles outside of three sigma are in the brute force only: in this scene they hold nothing of these.
    small = case.field.opacity_logits.sigmoid() < math.exp(4.5) / 255
    assert int(small.sum()) >= 20
    assert torch.equal(pixels[small].double(), sums["counts"][small])
    for mine, name in ((weighted, "weights"), (blending, "blending"), (distances, "distances")):
        assert relative(mine[small], sums[name][small]) < 1e-5, name  # worst seen: 5.9e-7


@pytest.mark.parametrize("rows", [None, 0, 1])
def test_taming_without_two_rows_of_weights_gives_empty_sums(rows: int | None) -> None:
    case = case_of(n=5)
    weights = None if rows is None else torch.ones(rows, 41, 53)
    results = call(module_of("taming"), "taming", case, activated(case), pixel_weights=weights)
    assert len(results) == 13 + 1
    assert [t.numel() for t in results[9:13]] == [0, 0, 0, 0]
    assert results[2].shape == ((41, 53) if rows == 1 else (0,))


# ------------------------------------------------------------------------ given covariances and colours, antialiasing


def covariance_of(case: Case) -> Tensor:
    """(n, 6) covariances of a field, differentiable."""
    return covariances({"quats": normalize(case.field.quaternions), "scales": case.field.log_scales.exp()})


@pytest.mark.parametrize("variant", ["graphdeco", "fastgs"])
def test_given_covariances_and_colours_have_the_gradients_of_what_they_come_from(variant: str) -> None:
    case = case_of(sh_degree=2)
    weights = torch.randn(3, 41, 53, generator=torch.Generator().manual_seed(1))
    whole, apart = case.with_leaves(), case.with_leaves()
    image = call(module_of(variant), variant, whole, activated(whole))[0]
    (image * weights).sum().backward()
    inputs = activated(apart)
    direction = normalize(apart.field.means - case.camera.position, dim=1)
    inputs["colors_precomp"] = sh_to_color(inputs.pop("shs"), direction, 2, signed=False)
    inputs["cov3D_precomp"] = covariance_of(apart)
    del inputs["scales"], inputs["rotations"]
    again = call(module_of(variant), variant, apart, inputs)[0]
    (again * weights).sum().backward()
    assert (image - again).abs().max() < 2e-5  # worst seen: 2.4e-7
    for name, value in whole.field.parameters.items():
        assert relative(apart.field.parameters[name].grad, value.grad) < 1e-4, name  # worst seen: 2.9e-7


def test_round_gaussians_may_come_as_covariances() -> None:
    """Their axes are arbitrary, and nothing may divide by the differences of their eigenvalues."""
    case = case_of(n=1)
    covariance = torch.tensor([[0.04, 0, 0, 0.04, 0, 0.04]], requires_grad=True)
    inputs = activated(case) | {"means3D": to_world(torch.tensor([[0.0, 0.0, 2.0]]), case.camera)}
    del inputs["scales"], inputs["rotations"]
    image = call(module_of("graphdeco"), "graphdeco", case, inputs | {"cov3D_precomp": covariance})[0]
    image.square().sum().backward()
    assert covariance.grad is not None
    assert torch.isfinite(covariance.grad).all()
    assert covariance.grad.abs().max() > 0


def dimmed(case: Case) -> Case:
    """Return the case with opacities dimmed by antialiasing, with the gradient of the CUDA code."""
    seen = project(case.field, case.camera)
    xx, xy, yy = (seen.conics[:, i] * seen.determinants * sign for i, sign in ((2, 1), (1, -1), (0, 1)))

    def share(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        return (x * y - z * z) / ((x + 0.3) * (y + 0.3) - z * z)

    true, shifted = share(xx - 0.3, yy - 0.3, xy), share(xx, yy, xy)
    factor = (true.detach() + shifted - shifted.detach()).clamp(min=2.5e-5).sqrt()
    opacities = case.field.opacity_logits.sigmoid()
    opacities = opacities.index_put((seen.ids,), opacities[seen.ids] * factor)
    return replace(case, field=case.field.with_parameters({"opacity_logits": torch.logit(opacities)}))


def by_inverse_depth(case: Case) -> Case:
    """Return the case in shades of 1 / depth over black."""
    pose = case.camera.world_to_camera
    depth = case.field.means @ pose[2, :3] + pose[2, 3]
    sh = (1 / depth)[:, None, None].expand(-1, 1, 3) * math.sqrt(4 * math.pi)
    field = replace(case.field.with_parameters({"sh": sh}), signed=True)
    return replace(case, field=field, background=(0.0, 0.0, 0.0), sh_degree=None)


@pytest.mark.parametrize("variant", ["graphdeco-aa", "graphdeco-accel"])
@pytest.mark.parametrize("antialiasing", [False, True])
def test_antialiasing_and_inverse_depths(variant: str, antialiasing: bool) -> None:
    case = case_of(pixels=(0.3, 4.0))
    generator = torch.Generator().manual_seed(1)
    weights, depth_weights = torch.randn(3, 41, 53, generator=generator), torch.randn(1, 41, 53, generator=generator)
    exact = case.to(torch.float64).with_leaves()
    smooth = dimmed(exact) if antialiasing else exact
    expected = smooth.render(OracleRasterizer()).image
    expected_depth = by_inverse_depth(smooth).render(OracleRasterizer()).image[:1]
    ((expected * weights).sum() + (expected_depth * depth_weights).sum()).backward()

    mine = case.with_leaves()
    image, _, inverse_depths, _ = call(module_of(variant), variant, mine, activated(mine), antialiasing=antialiasing)
    ((image * weights).sum() + (inverse_depths * depth_weights).sum()).backward()
    assert (image - expected).abs().max() < 2e-5  # worst seen: 1.1e-6
    assert (inverse_depths - expected_depth).abs().max() < 2e-5  # worst seen: 8.7e-7
    for name, value in mine.field.parameters.items():
        assert relative(value.grad, exact.field.parameters[name].grad) < 1e-4, name  # worst seen: 2.3e-6
    if antialiasing:
        plain = call(module_of(variant), variant, case, activated(case))[0]
        assert (plain - image).abs().max() > 0.01, "antialiasing changes nothing here: the test shows nothing"


def test_scale_modifier_multiplies_scales_but_not_their_gradient() -> None:
    case = case_of()
    gradients, images = [], []
    for modifier in (1.0, 1.5):
        inputs = activated(case)
        scales = (inputs["scales"].detach() * 1.5 / modifier).requires_grad_()
        image = call(module_of("graphdeco"), "graphdeco", case, inputs | {"scales": scales}, scale_modifier=modifier)[0]
        image.square().sum().backward()
        assert scales.grad is not None
        gradients.append(scales.grad)
        images.append(image)
    assert relative(images[1], images[0]) < 1e-6  # worst seen: 0
    assert relative(gradients[1], gradients[0]) < 1e-5  # worst seen: 0


# ----------------------------------------------------------------------------------------------------- training


@pytest.mark.parametrize("variant", BACKBONES)
def test_a_training_loop_written_for_the_cuda_module_learns(variant: str) -> None:
    """Call like a checkout's train.py: render, SSIM, densification statistics, optimizer."""
    case = case_of(sh_degree=1, n=80)
    with install(variant) as modules, torch.no_grad():
        module = modules[VARIANTS[variant].module]
        fused_ssim = modules["fused_ssim"].fused_ssim
        target = call(module, variant, case, activated(case))[0]
        start = case.field.with_parameters({"sh": torch.zeros_like(case.field.sh)})
        student = replace(case, field=start).with_leaves()
        groups = [{"params": [p], "lr": 0.03 if name == "sh" else 1e-3} for name, p in student.field.parameters.items()]
        sparse = hasattr(module, "SparseGaussianAdam")
        make = module.SparseGaussianAdam if sparse else torch.optim.Adam
        optimizer = make(groups, lr=0.0, eps=1e-15)
        losses, accumulated = [], torch.zeros(80, 1)
        for _ in range(12):
            with torch.enable_grad():
                image, radii, *_, points = call(module, variant, student, activated(student))
                loss = 0.8 * (image - target).abs().mean() + 0.2 * (1 - fused_ssim(image[None], target[None]))
                loss.backward()
            visible = radii > 0
            accumulated[visible] += points.grad[visible, :2].norm(dim=-1, keepdim=True)
            if sparse:
                optimizer.step(visible, len(radii))
            else:
                optimizer.step()
            optimizer.zero_grad(set_to_none=True)
            losses.append(loss.item())
    assert losses[-1] < 0.7 * losses[0]
    assert int((accumulated > 0).sum()) > 60


# ------------------------------------------------------------------------------------------------- edges and errors


@pytest.mark.parametrize("variant", BACKBONES)
def test_no_gaussians_give_black(variant: str) -> None:
    image, radii, *_ = call(module_of(variant), variant, case_of(n=0), activated(case_of(n=0)))
    assert not image.any()
    assert radii.shape == (0,)


def test_mark_visible_asks_for_depth_only() -> None:
    module, camera = module_of("taming"), make_camera(20, 10)
    rasterizer = module.GaussianRasterizer(settings_of(module, camera, (0.0, 0.0, 0.0), 0))
    points = torch.tensor([[0.0, 0, 0.19], [0, 0, 0.21], [99, 0, 1], [0, 0, -1]])
    assert rasterizer.markVisible(points).tolist() == [False, True, True, False]


def test_arguments_that_do_not_fit_are_refused() -> None:
    module, case = module_of("graphdeco"), case_of(n=3)
    with pytest.raises(UserInputError, match="shs and colors_precomp"):
        call(module, "graphdeco", case, activated(case) | {"colors_precomp": torch.zeros(3, 3)})
    with pytest.raises(UserInputError, match="cov3D_precomp"):
        call(module, "graphdeco", case, activated(case) | {"cov3D_precomp": torch.zeros(3, 6)})
    with pytest.raises(UserInputError, match="opacities is"):
        call(module, "graphdeco", case, activated(case) | {"opacities": torch.zeros(3)})
    with pytest.raises(UserInputError, match="sh_degree 3"):
        call(module, "graphdeco", case, activated(case) | {"shs": torch.zeros(3, 4, 3)})
    with pytest.raises(UserInputError, match="focal lengths"):
        call(module, "graphdeco", case, activated(case), tanfovx=0.1)
    settings = settings_of(module, case.camera, case.background, 3)
    for shape in ((3, 2), (2, 3), (9,)):
        with pytest.raises(UserInputError, match=r"means2D is .* expected \(3, 3\) or \(3, 4\)"):
            module.GaussianRasterizer(settings)(means2D=torch.zeros(shape), **activated(case))
    with pytest.raises(UserInputError, match=r"bg is \(1,\).* expected \(3,\)"):
        call(module, "graphdeco", case, activated(case), bg=torch.zeros(1))
    marked = {"get_flag": True, "metric_map": torch.ones(7, dtype=torch.int32)}
    with pytest.raises(UserInputError, match=r"7 weights of pixels.*53x41"):
        call(module_of("fastgs"), "fastgs", case, activated(case), **marked)


def test_a_background_may_be_a_row() -> None:
    module, case = module_of("graphdeco"), case_of()
    (image, *_), (expected, *_) = (
        call(module, "graphdeco", case, activated(case), bg=torch.tensor(case.background).view(shape))
        for shape in ((1, 3), (3,))
    )
    assert torch.equal(image, expected)


def test_install_is_undone_and_refuses_to_replace() -> None:
    before = dict(sys.modules)
    with install("taming-rasterizer") as modules:
        import diff_gaussian_rasterization
        from diff_gaussian_rasterization._C import fusedssim
        from fused_ssim import fused_ssim
        from simple_knn._C import distCUDA2

        assert diff_gaussian_rasterization is modules["diff_gaussian_rasterization"]
        assert diff_gaussian_rasterization.SparseGaussianAdam
        assert callable(fusedssim)
        assert callable(fused_ssim)
        assert callable(distCUDA2)
        with pytest.raises(UserInputError, match="already imported"), install("graphdeco"):
            pass
    assert {name for name in sys.modules if name not in before and not name.startswith("lapgs_plugin")} == set()
    with pytest.raises(UserInputError, match="fastgs"), install("gsplat"):
        pass


# ---------------------------------------------------------------------------------- SSIM, neighbours, sparse Adam


def ssim_by_hand(a: Tensor, b: Tensor, y: int, x: int) -> float:
    """SSIM of one pixel of two images (h, w), float64, zeros outside."""
    window = torch.tensor([math.exp(-(i * i) / (2 * 1.5**2)) for i in range(-5, 6)], dtype=torch.float64)
    window = torch.outer(window, window) / window.sum() ** 2
    a, b = (torch.nn.functional.pad(t.double(), (5, 5, 5, 5))[y : y + 11, x : x + 11] for t in (a, b))
    mu_a, mu_b = (window * a).sum(), (window * b).sum()
    var_a, var_b = (window * a * a).sum() - mu_a**2, (window * b * b).sum() - mu_b**2
    both = (window * a * b).sum() - mu_a * mu_b
    value = (2 * mu_a * mu_b + 1e-4) * (2 * both + 9e-4) / ((mu_a**2 + mu_b**2 + 1e-4) * (var_a + var_b + 9e-4))
    return float(value)


def test_fused_ssim() -> None:
    module = stand_ins("taming")["fused_ssim"]
    generator = torch.Generator().manual_seed(0)
    first, second = (torch.rand(1, 3, 19, 23, generator=generator) for _ in range(2))
    values = torch.tensor([[[ssim_by_hand(first[0, c], second[0, c], y, x) for x in range(23)] for y in range(19)]
                           for c in range(3)])  # fmt: skip
    assert abs(module.fused_ssim(first, second) - values.mean()) < 1e-6  # worst seen: 3.0e-8
    assert (
        abs(module.fused_ssim(first, second, padding="valid") - values[:, 5:-5, 5:-5].mean()) < 1e-6
    )  # worst seen: 1.6e-7
    assert (module.fused_ssim_(first, second) - values.mean(0)).abs().max() < 1e-5  # worst seen: 8.0e-7
    with pytest.raises(UserInputError, match="padding"):
        module.fused_ssim(first, second, padding="full")
    for function in (module.fused_ssim, module.fused_ssim_):
        for padding in ("same", "valid"):
            with pytest.raises(UserInputError, match="images of one shape"):
                function(first, second[:, :, :7], padding=padding)
    binding = stand_ins("graphdeco-accel")["diff_gaussian_rasterization._C"]
    with pytest.raises(UserInputError, match="images of one shape"):
        binding.fusedssim(1e-4, 9e-4, first, second[:, :, :7])


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_ssim_gradient_goes_to_the_first_image(padding: str) -> None:
    module = stand_ins("graphdeco-accel")["fused_ssim"]
    binding = stand_ins("graphdeco-accel")["diff_gaussian_rasterization._C"]
    generator = torch.Generator().manual_seed(0)
    first, second = (torch.rand(1, 3, 19, 23, generator=generator).requires_grad_() for _ in range(2))
    module.fused_ssim(first, second, padding=padding).backward()
    assert second.grad is None
    step, direction = 1e-3, torch.randn(1, 3, 19, 23, generator=generator)
    with torch.no_grad():
        ahead, back = (module.fused_ssim(first + s * direction, second, padding=padding) for s in (step, -step))
    assert abs((ahead - back) / (2 * step) - (first.grad * direction).sum()) < 1e-3  # worst seen: 1.9e-5
    if padding == "same":
        values = binding.fusedssim(1e-4, 9e-4, first, second)
        grad = binding.fusedssim_backward(1e-4, 9e-4, first, second, torch.full_like(values, 1 / values.numel()))
        assert relative(grad, first.grad) < 1e-4  # worst seen: 3.4e-7


def test_distances_to_three_neighbours() -> None:
    points = torch.randn(40, 3, generator=torch.Generator().manual_seed(0))
    points[7] = points[3]  # a double is a neighbour at distance 0
    squared = torch.cdist(points.double(), points.double()).square().fill_diagonal_(torch.inf)
    distances = stand_ins("taming")["simple_knn._C"].distCUDA2(points)
    assert relative(distances, squared.topk(3, largest=False).values.mean(1)) < 1e-6  # worst seen: 2.8e-8


@pytest.mark.parametrize("count", [1, 3, 40])
def test_neighbours_beside_their_distances(count: int) -> None:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    points[5:12] = points[4:5]  # more at one position than are returned
    distances, neighbours = stand_ins("taming", neighbours=True)["simple_knn._C"].distCUDA2(points)
    assert torch.equal(distances, stand_ins("taming")["simple_knn._C"].distCUDA2(points))
    assert (neighbours.shape, neighbours.dtype) == ((count, 3), torch.int32)
    there = min(3, count - 1)
    found, own = neighbours[:, :there].long(), torch.arange(count)[:, None]
    assert not bool((found == own).any())
    assert all(len(set(row)) == there for row in found.tolist())
    squared = torch.cdist(points.double(), points.double()).square().fill_diagonal_(torch.inf)
    nearest = squared.topk(there, largest=False).values
    torch.testing.assert_close(squared.gather(1, found), nearest)  # worst seen: equal
    assert not bool(neighbours[:, there:].any())


def test_sparse_adam_moves_visible_rows_only() -> None:
    adam = module_of("fastgs").SparseGaussianAdam
    generator = torch.Generator().manual_seed(0)
    parameter = torch.randn(6, 2, 3, generator=generator).requires_grad_()
    optimizer = adam([{"params": [parameter], "lr": 0.1}], lr=0.0, eps=1e-15)
    expected, m, v = parameter.detach().double().clone(), torch.zeros(6, 2, 3).double(), torch.zeros(6, 2, 3).double()
    for seed in range(4):
        parameter.grad = torch.randn(6, 2, 3, generator=generator)
        visible = torch.rand(6, generator=generator) < 0.5
        for i in range(6):
            if visible[i]:
                g = parameter.grad[i].double()
                m[i], v[i] = 0.9 * m[i] + 0.1 * g, 0.999 * v[i] + 0.001 * g * g
                expected[i] -= 0.1 * m[i] / (v[i].sqrt() + 1e-15)
        optimizer.step(visible, 6)
        assert relative(parameter.detach(), expected) < 1e-5, seed  # worst seen: 6.0e-8
    assert relative(optimizer.state[parameter]["exp_avg"], m) < 1e-5  # worst seen: 5.5e-8
    assert relative(optimizer.state[parameter]["exp_avg_sq"], v) < 1e-5  # worst seen: 8.4e-8
