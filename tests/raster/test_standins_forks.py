"""Stand-ins of forks' rasterizers against autograd in float64, closed forms and graphdeco's stand-in."""

from __future__ import annotations

import gc
import math
import weakref
from contextlib import nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.family import stand_ins
from lapgs_plugin.family.forks import compute_relocation
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.reference_raster.oracle import project
from tests.raster.scenes import Case
from tests.raster.test_standins import activated, call, case_of, module_of, relative, settings_of

BOUND = 2e-5
"""Relative; sums in float32 and in float64. Worst seen: 3e-7."""


def blended(case: Case) -> tuple[Tensor, Tensor]:
    """Return shares (n, h, w) of the Gaussians in the pixels, and a leaf (n, h, w) that their values are scaled by.

    Written from the equations in float64, with three-sigma squares in whole tiles.
    """
    case = case.to(torch.float64)
    seen = project(case.field, case.camera)
    height, width = case.camera.height, case.camera.width
    n = len(case.field)
    values = torch.zeros(n, height, width, dtype=torch.float64)
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    order = torch.argsort(seen.depths, stable=True).tolist()
    for k in order:
        dx, dy = x - seen.means2d[k][0], y - seen.means2d[k][1]
        a, b, c = seen.conics[k]
        first, last = (seen.means2d[k] - seen.radii[k]) // 16, (seen.means2d[k] + seen.radii[k] + 15) // 16
        inside = (x // 16 >= first[0]) & (x // 16 < last[0]) & (y // 16 >= first[1]) & (y // 16 < last[1])
        values[int(seen.ids[k])] = torch.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2) * inside
    values.requires_grad_()
    shares: list[Tensor] = [torch.zeros(height, width, dtype=torch.float64)] * n
    through = torch.ones(height, width, dtype=torch.float64)
    done = torch.zeros(height, width, dtype=torch.bool)
    opacities = case.field.opacity_logits.sigmoid()
    for k in order:
        i = int(seen.ids[k])
        alpha = (opacities[i] * values[i]).clamp(max=0.99)
        here = ~done & (alpha >= 1 / 255)
        done = done | (here & (through * (1 - alpha) < 1e-4))
        alpha = torch.where(here & ~done, alpha, 0.0)
        shares[i] = alpha * through
        through = through * (1 - alpha)
    return torch.stack(shares), values


def small_case() -> Case:
    return case_of(n=40, pixels=(1.0, 6.0))


def test_speedy_splat_scores_are_sums_of_squared_derivatives() -> None:
    case = small_case()
    scores = torch.zeros(40, 1, requires_grad=True)
    image, radii, seconds, _ = call(
        module_of("speedy-splat"), "speedy-splat", case, activated(case) | {"scores": scores}
    )
    image.sum().backward()
    shares, values = blended(case)
    wide = case.to(torch.float64)
    colors = sh_to_color(
        wide.field.sh, normalize(wide.field.means - wide.camera.position, dim=1), wide.field.sh_degree, signed=False
    )
    background = wide.background_tensor
    total = torch.einsum("nhw,nc->chw", shares, colors) + (1 - shares.sum(0)) * background[:, None, None]
    assert relative(image, total.float()) < BOUND
    (derivatives,) = torch.autograd.grad(total.sum(), values)
    assert scores.grad is not None
    assert (
        relative(scores.grad[:, 0], (derivatives**2).sum((1, 2)).float()) < 1e-3
    )  # worst seen: 2e-7; a pixel at 1/255 may turn on another processor
    assert radii.shape == (40,)
    assert seconds.shape == (1,)


def test_scores_without_gradients_cost_nothing_and_change_nothing() -> None:
    case = small_case()
    plain = call(module_of("graphdeco"), "graphdeco", case, activated(case))[0]
    scored = call(module_of("speedy-splat"), "speedy-splat", case, activated(case) | {"scores": torch.zeros(40, 1)})[0]
    assert torch.equal(plain, scored)


def test_mini_splatting_sums_shares_and_counts_pixels() -> None:
    case = small_case()
    with torch.no_grad():
        _, _, sums, counts, leads, _ = call(module_of("mini-splatting"), "mini-splatting", case, activated(case))
    shares, _ = blended(case)
    shares = shares.detach()
    assert relative(sums, shares.sum((1, 2)).float()) < BOUND
    assert (counts - (shares > 0).sum((1, 2))).abs().max() <= 1  # alpha of a pixel may be at 1/255
    leaders = shares.flatten(1).argmax(0)[shares.flatten(1).max(0).values > 0]
    assert (leads - torch.bincount(leaders, minlength=40)).abs().max() <= 1


def test_mini_splatting_finds_points_where_rays_come_nearest() -> None:
    """One round Gaussian on each ray: the nearest point is the foot of the perpendicular from its centre."""
    case = small_case()
    arguments = activated(case)
    scale = arguments["scales"].mean(1, keepdim=True).expand(-1, 3)
    module = module_of("mini-splatting")
    settings = settings_of(module, case.camera, (0.0, 0.0, 0.0), 3)
    with torch.no_grad():
        results = module.GaussianRasterizer(settings).render_depth(
            means2D=torch.zeros(40, 3), **(arguments | {"scales": scale})
        )
    points, at = results["out_pts"].flatten(1).T, results["gidx"].flatten().long()
    seen = points.abs().sum(1) > 0
    ray = normalize(points - settings.campos, dim=1)
    to_centre = arguments["means3D"][at] - points
    assert int(seen.sum()) > 200
    assert ((ray * to_centre).sum(1).abs() / to_centre.norm(dim=1))[seen].max() < 1e-3  # 1e-5 seen
    assert results["accum_alpha"].min() >= 0
    assert results["accum_alpha"].max() <= 1


@pytest.mark.parametrize("variant", ["mini-splatting", "mini-splatting2"])
def test_mini_splatting_finds_no_points_of_no_gaussians(variant: str) -> None:
    case, module = case_of(n=0), module_of(variant)
    rasterizer = module.GaussianRasterizer(settings_of(module, case.camera, (0.0, 0.0, 0.0), 3))
    culling = {"culling": torch.zeros(0, dtype=torch.bool)} if variant == "mini-splatting2" else {}
    results = rasterizer.render_depth(means2D=torch.zeros(0, 3), **activated(case), **culling)
    whole = rasterizer.render_depth(
        means2D=torch.zeros(40, 3),
        **activated(small_case()),
        **({"culling": torch.zeros(40, dtype=torch.bool)} if culling else {}),
    )
    assert {name: (value.shape, value.dtype) for name, value in results.items()} == {
        name: (value.shape, value.dtype) for name, value in whole.items()
    }
    assert results.pop("accum_alpha").eq(1).all()
    assert not any(value.any() for value in results.values())


def test_absgs_returns_shares_and_absolute_gradients() -> None:
    case = small_case()
    module = module_of("absgs")
    settings = settings_of(module, case.camera, case.background, 3)
    points = torch.zeros(40, 4, requires_grad=True)
    image, _, sums = module.GaussianRasterizer(settings)(means2D=points, **activated(case))
    image.sum().backward()
    shares, _ = blended(case)
    assert relative(sums, shares.detach().sum((1, 2)).float()) < BOUND
    assert points.grad is not None
    assert bool((points.grad[:, 2:] >= points.grad[:, :2].abs() * (1 - 1e-4)).all())


def test_pixel_gs_counts_pixels_and_scales_screen_gradients_by_depth() -> None:
    case = small_case()
    expected = call(module_of("graphdeco"), "graphdeco", case, activated(case))
    results = call(module_of("pixel-gs"), "pixel-gs", case, activated(case), depth_threshold=4.0)
    assert torch.equal(results[0], expected[0])
    for image, points in ((expected[0], expected[-1]), (results[0], results[-1])):
        image.sum().backward(inputs=[points])
    pose = case.camera.world_to_camera
    depths = case.field.means.detach() @ pose[2, :3] + pose[2, 3]
    assert 0 < int((depths < 4).sum()) < 40
    scaled = expected[-1].grad * (depths / 4).square().clamp(max=1)[:, None]
    torch.testing.assert_close(results[-1].grad, scaled, rtol=1e-5, atol=1e-6)  # 0 seen
    shares, _ = blended(case)
    assert (results[2][:, 0] - (shares > 0).sum((1, 2))).abs().max() <= 1  # alpha of a pixel may be at 1/255


def test_mip_splatting_dims_as_graphdeco_does_and_sums_absolute_gradients() -> None:
    case = small_case()
    more: dict[str, Any] = {"kernel_size": 0.3, "subpixel_offset": torch.zeros(41, 53, 2)}
    expected = call(module_of("graphdeco-aa"), "graphdeco-aa", case, activated(case), antialiasing=True)[0]
    image, _, points = call(module_of("mip-splatting"), "mip-splatting", case, activated(case), **more)
    assert (image - expected).abs().max() < 1e-5  # it adds 1e-6 px^4 to a determinant; worst seen: 1e-6
    assert torch.equal(call(module_of("mip-splatting"), "mip-splatting", case, activated(case), **more)[0], image)
    image.sum().backward(inputs=[points])
    assert points.grad is not None
    assert bool((points.grad[:, 2] >= points.grad[:, :2].norm(dim=1) * (1 - 1e-4)).all())
    with pytest.raises(UserInputError, match="ray_jitter"):
        call(
            module_of("mip-splatting"),
            "mip-splatting",
            case,
            activated(case),
            **(more | {"subpixel_offset": torch.ones(1)}),
        )


def test_mip_splatting_refuses_offsets_whenever_they_are_not_zero() -> None:
    """It remembers offsets that were zero, and no others."""
    case, offset = small_case(), torch.zeros(41, 53, 2)
    more: dict[str, Any] = {"kernel_size": 0.3, "subpixel_offset": offset}
    for moved in (0.0, 0.0, 0.5, 0.5, 0.0, 0.5):
        offset.fill_(moved)
        with pytest.raises(UserInputError, match="ray_jitter") if moved else nullcontext():
            call(module_of("mip-splatting"), "mip-splatting", case, activated(case), **more)


def test_efficientgs_leaves_out_sh_and_marks_the_largest_shares() -> None:
    case = small_case()
    module = module_of("efficientgs")
    more: dict[str, Any] = {"use_train_speedup": False, "ignored_rate": 0.0, "lambda_dssim": 0.2, "use_hwc": True}
    degrees = torch.arange(40, dtype=torch.int32) % 4
    loss = torch.rand(3, 41, 53, generator=torch.Generator().manual_seed(0))
    options = {"gt_image": None, "sparse_shs_degree": degrees, "pix_loss": loss, "top_k": 1}
    with torch.no_grad():
        image, _, largest, _, _, losses, *_ = call(module, "efficientgs", case, activated(case) | options, **more)
        kept = activated(case)
        for i, degree in enumerate(degrees.tolist()):
            kept["shs"][i, (degree + 1) ** 2 :] = 0
        expected = call(module_of("graphdeco"), "graphdeco", case, kept)[0]
    assert torch.equal(image.permute(2, 0, 1), expected)
    shares = blended(case)[0].detach()
    leaders = shares.flatten(1).argmax(0)[shares.flatten(1).max(0).values > 0]
    assert (largest - (torch.bincount(leaders, minlength=40) > 0).int()).abs().sum() <= 1
    assert 0 < float(losses.sum()) < float((shares * loss.sum(0)).sum())
    options["pix_loss"] = loss[:, :-1]
    with pytest.raises(UserInputError, match=r"pix_loss is \(3, 40, 53\): expected \(3, 41, 53\)"):
        call(module, "efficientgs", case, activated(case) | options, **more)


def test_pixel_weights_of_another_level_are_resized() -> None:
    """A script that finds the edges of all photos at its start has those of the coarsest level ever after."""
    case, module = small_case(), module_of("taming")
    sums = []
    for size in ((41, 53), (21, 27), (41 * 53,), (7, 5, 3)):
        weights = torch.full(size, 0.5)
        if len(size) == 3:
            with pytest.raises(UserInputError, match=r"pixel_weights is \(7, 5, 3\), expected \(41, 53\)"):
                call(module, "taming", case, activated(case), pixel_weights=weights)
        else:
            sums.append(call(module, "taming", case, activated(case), pixel_weights=weights)[9])
    assert float(sums[0].max()) > 0
    for other in sums[1:]:
        assert torch.allclose(other, sums[0], rtol=1e-5)


def with_depths(name: str, case: Case, **settings: Any) -> tuple[list[Tensor], list[Tensor]]:
    """Return outputs of a variant, and gradients of the centres, opacities, SH and of `means2D` by all of them."""
    module = module_of(name)
    inputs = {key: value.detach().requires_grad_() for key, value in activated(case).items()}
    points = torch.zeros(40, 3, requires_grad=True)
    outputs = module.GaussianRasterizer(settings_of(module, case.camera, case.background, 3, **settings))(
        means2D=points, **inputs
    )
    torch.stack([one.square().sum() for one in outputs if one.requires_grad]).sum().backward()
    leaves = inputs["means3D"], inputs["opacities"], inputs["shs"], points
    return list(outputs), [leaf.grad for leaf in leaves if leaf.grad is not None]


def test_depth_and_alpha_are_blended_as_colours_with_gradients() -> None:
    case = small_case()
    (image, radii, depth, alpha), gradients = with_depths("depth-and-alpha", case)
    shares, _ = blended(case)
    wide = case.to(torch.float64)
    seen = project(wide.field, wide.camera)
    depths = torch.zeros(40, dtype=torch.float64).index_put((seen.ids,), seen.depths)
    assert relative(depth[0], (shares * depths[:, None, None]).sum(0)) < BOUND
    assert relative(alpha[0], shares.sum(0)) < BOUND
    plain, plain_radii, _ = call(module_of("graphdeco"), "graphdeco", case, activated(case))
    assert torch.equal(image, plain)
    assert torch.equal(radii, plain_radii)
    # By finite differences along the opacities, of which nothing is discrete but the threshold of 1/255.
    field = case.field
    step = 1e-3
    losses = []
    for sign in (1, -1):
        moved = activated(case) | {"opacities": activated(case)["opacities"] + sign * step * gradients[1].sign()}
        module = module_of("depth-and-alpha")
        settings = settings_of(module, case.camera, case.background, 3)
        outputs = module.GaussianRasterizer(settings)(means2D=torch.zeros(40, 3), **moved)
        losses.append(sum(float(one.double().square().sum()) for one in (outputs[0], *outputs[2:])))
    assert len(field) == 40
    slope = (losses[0] - losses[1]) / (2 * step)
    assert abs(slope / float(gradients[1].abs().sum()) - 1) < 0.02


def test_the_same_outputs_in_another_order_have_the_same_gradients() -> None:
    case = small_case()
    (image, radii, depth, alpha), gradients = with_depths("depth-and-alpha", case)
    others, other_gradients = with_depths("depth-acc", case)
    for one, other in zip((image, depth, alpha, radii, *gradients), (*others, *other_gradients), strict=True):
        assert torch.equal(one, other)


def test_confidence_scales_the_gradients_of_each_gaussian_but_for_those_of_the_centres_on_screen() -> None:
    case = small_case()
    confidence = torch.rand(40, 1, generator=torch.Generator().manual_seed(2))
    outputs, gradients = with_depths("depth-and-alpha", case)
    others, scaled = with_depths("confidence", case, confidence=confidence)
    for one, other in zip(outputs, others, strict=True):
        assert torch.equal(one, other)
    for one, other in zip(gradients[:3], scaled[:3], strict=True):
        assert torch.allclose(one * confidence.reshape(-1, *(1,) * (one.ndim - 1)), other, rtol=1e-6)
    assert torch.equal(gradients[3][:, :2], scaled[3][:, :2])
    assert bool((scaled[3][:, 2] >= scaled[3][:, :2].abs().sum(1) * (1 - 1e-5)).all()), "sums of absolute values"


def test_surfels_are_flat_gaussians_with_depths_and_normals() -> None:
    case = small_case()
    inputs = activated(case)
    module = module_of("2dgs")
    settings = settings_of(module, case.camera, case.background, 3)
    image, radii, maps = module.GaussianRasterizer(settings)(
        means2D=torch.zeros(40, 3), **(inputs | {"scales": inputs["scales"][:, :2].contiguous()})
    )
    flat = torch.cat([inputs["scales"][:, :2], inputs["scales"][:, :2].max(1, keepdim=True).values * 1e-4], 1)
    expected = call(module_of("graphdeco"), "graphdeco", case, inputs | {"scales": flat})[0]
    assert torch.equal(image, expected)
    assert maps.shape == (7, 41, 53)
    seen = maps[1] > 0.5
    assert bool((maps[5][seen] > 0).all())
    assert float(maps[2:5].norm(dim=0).max()) <= 1 + 1e-4
    assert radii.shape == (40,)


def test_gradients_of_surfels_are_finite_where_nothing_is_blended() -> None:
    """The checkout divides the depth by alpha and replaces NaN, whose gradient stays NaN in empty pixels."""
    case = small_case()
    inputs = activated(case)
    means = inputs["means3D"].detach().clone().requires_grad_()
    module = module_of("2dgs")
    settings = settings_of(module, case.camera, case.background, 3)
    scales = (inputs["scales"][:, :2] / 4).contiguous()  # small ones leave gaps
    _, _, maps = module.GaussianRasterizer(settings)(
        means2D=torch.zeros(40, 3), **(inputs | {"means3D": means, "scales": scales})
    )
    assert bool((maps[1] == 0).any())
    above: list[Tensor] = []
    depth = maps[0] / maps[1]
    depth.register_hook(above.append)
    torch.nan_to_num(depth, 0, 0).sum().backward()
    assert not bool((above[0] / maps[1].detach()).isfinite().all())
    assert means.grad is not None
    assert bool(means.grad.isfinite().all())
    assert float(means.grad.norm()) > 0


@pytest.mark.parametrize("copies", [1, 2, 5])
def test_relocated_copies_have_the_opacity_and_the_light_of_one(copies: int) -> None:
    """Equation 9: n copies of opacity 1 - (1 - o)^(1/n) cover what one covered; one copy stays as it is."""
    opacity, scale = torch.tensor([[0.3], [0.9]]), torch.tensor([[1.0, 2, 3], [0.1, 0.1, 0.2]])
    binoms = torch.tensor([[float(math.comb(n, k)) for k in range(51)] for n in range(51)])
    opacities, scales = compute_relocation(opacity, scale, torch.full((2, 1), copies), binoms, 51)
    torch.testing.assert_close(1 - (1 - opacities) ** copies, opacity)
    # Along a ray the light of n copies, integrated over a line, is that of the one.
    x = torch.linspace(-20, 20, 40001, dtype=torch.float64)
    for i in range(2):
        ratio = float(scales[i, 0] / scale[i, 0])
        light = (1 - (1 - opacities[i].double() * torch.exp(-((x / ratio) ** 2) / 2)) ** copies).sum()
        torch.testing.assert_close(light, (opacity[i].double() * torch.exp(-(x**2) / 2)).sum(), rtol=1e-5, atol=0)


def faster_gs_image(case: Case, info: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Return the image, and the leaves that it was made of."""
    module, field, camera = stand_ins("faster-gs")["FasterGSCudaBackend.torch_bindings"], case.field, case.camera
    settings = module.RasterizerSettings(
        w2c=camera.world_to_camera, cam_position=camera.position, bg_color=torch.tensor(case.background),
        active_sh_bases=16, width=53, height=41, focal_x=camera.fx, focal_y=camera.fy, center_x=camera.cx,
        center_y=camera.cy, near_plane=0.2, far_plane=1e4, proper_antialiasing=False,
    )  # fmt: skip
    leaves = [
        field.means,
        field.log_scales,
        field.quaternions,
        field.opacity_logits[:, None],
        field.sh[:, :1],
        field.sh[:, 1:],
    ]
    leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]
    return module.diff_rasterize(*leaves, info, settings), leaves


def test_faster_gs_takes_raw_parameters_and_notes_screen_gradients() -> None:
    case, info = small_case(), torch.zeros(2, 40)
    image, leaves = faster_gs_image(case, info)
    image.sum().backward()  # type: ignore[no-untyped-call]  # torch's
    expected, radii, points = call(module_of("graphdeco"), "graphdeco", case, activated(case))
    expected.sum().backward(inputs=[points])
    assert relative(image, expected) < BOUND
    assert torch.equal(info[0], (radii > 0).float())
    assert points.grad is not None
    assert relative(info[1], points.grad[:, :2].norm(dim=1)) < 1e-3  # worst seen: 5e-7
    assert all(leaf.grad is not None for leaf in leaves)


def test_images_of_faster_gs_are_gone_when_nothing_has_them() -> None:
    """A hook of the graph that has the image would keep both, where Python does not look for cycles."""
    image, leaves = faster_gs_image(small_case(), torch.zeros(2, 40))
    image.sum().backward()  # type: ignore[no-untyped-call]  # torch's
    kept = [weakref.ref(image), weakref.ref(leaves[0])]
    del image, leaves
    gc.collect()
    assert [one() for one in kept] == [None, None]
