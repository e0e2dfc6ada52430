"""Our kernels behind the arguments of `gsplat.rasterization`: against the oracle, and on a GPU against gsplat's own."""

from __future__ import annotations

import importlib.util

import pytest
import torch

from tests.unit.test_blend_kernels import run_checks

COMMON = """
import torch
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.gpu_raster import tiles
from lapgs_plugin.rasterizers.gsplat.rasterization import rasterization, refusal
from lapgs_plugin.reference_raster.oracle import OracleRasterizer

SIZE, UNIT = (21, 18), 1 / 16  # nearer than the family's near plane, but for gsplat's
NAMES = ("means", "quats", "scales", "opacities", "colors")
if DEVICE == "cpu":
    tiles.LEAST_ROOM = 256  # places for pairs are slow to interpret


def splats(count, coefficients):
    generator = torch.Generator().manual_seed(count)
    depths = 2.5 + 2 * torch.rand(count, 1, generator=generator)
    aside = torch.tensor([0.4, 0.35]) * (2 * torch.rand(count, 2, generator=generator) - 1)
    colors = (coefficients, 3) if coefficients else (3,)
    return [
        torch.cat([aside * depths, depths], 1) * UNIT,
        torch.randn(count, 4, generator=generator) * 2,
        (torch.randn(count, 3, generator=generator) * 0.3 - 1.7).exp() * UNIT,
        torch.rand(count, generator=generator).clamp(0.05, 0.95),
        torch.randn(count, *colors, generator=generator) * 0.3,
    ]


def views(count):
    poses = torch.eye(4).repeat(count, 1, 1)
    turn = torch.tensor(0.1)
    for i in range(1, count):
        poses[i, 0, 0] = poses[i, 2, 2] = turn.cos()
        poses[i, 0, 2], poses[i, 2, 0] = turn.sin(), -turn.sin()
        poses[i, :3, 3] = torch.tensor([-0.3, 0.1, 0.4]) * UNIT
    intrinsics = torch.tensor([[22.0, 0.0, 10.0], [0.0, 23.0, 9.5], [0.0, 0.0, 1.0]])
    return poses, intrinsics.repeat(count, 1, 1)


def inputs_of(values, cameras, **options):
    poses, intrinsics = views(cameras)
    leaves = [value.to(DEVICE, copy=True).requires_grad_() for value in values]
    backgrounds = torch.rand(cameras, 3, generator=torch.Generator().manual_seed(2))
    inputs = {
        **dict(zip(NAMES, leaves, strict=True)), "viewmats": poses.to(DEVICE), "Ks": intrinsics.to(DEVICE),
        "width": SIZE[0], "height": SIZE[1], "near_plane": 0.01, "far_plane": 1e10, "packed": False,
        "sparse_grad": False, "rasterize_mode": "classic", "camera_model": "pinhole", "distributed": False,
        "with_ut": False, "with_eval3d": False, "backgrounds": backgrounds.to(DEVICE), **options,
    }
    assert refusal(inputs) == ""
    return inputs, leaves


def weights(cameras):
    generator = torch.Generator().manual_seed(7)
    size = SIZE[::-1]
    return torch.randn(cameras, *size, 3, generator=generator), torch.randn(cameras, *size, 1, generator=generator)


def differentiated(function, inputs, leaves, with_alphas):
    images, alphas, info = function(**inputs)
    by_images, by_alphas = (each.to(DEVICE) for each in weights(len(images)))
    info["means2d"].retain_grad()
    loss = (images * by_images).sum() + ((alphas * by_alphas).sum() if with_alphas else 0)
    loss.backward()
    absolute = [info["means2d"].absgrad] if inputs.get("absgrad") else []
    found = [images, alphas, *(leaf.grad for leaf in leaves), info["means2d"].grad, *absolute]
    return [each.detach().cpu() for each in found], info


def close(found, expected):
    limit = 1e-5 if DEVICE == "cpu" else 1e-3  # worst seen 1.9e-6 on a CPU
    assert len(found) == len(expected)
    for i, (one, other) in enumerate(zip(found, expected, strict=True)):
        worst = float((one - other).abs().max() / other.abs().max())
        print(i, f"{worst:.1e}")
        assert one.shape == other.shape
        assert worst < limit, (i, worst)
"""

AGAINST_THE_ORACLE = """
def expected(values, cameras, degree, signed, backgrounds, with_alphas):
    # The oracle has parameters before activation, and the family's near plane: in lengths of UNIT.
    exact = [value.double().requires_grad_() for value in values]
    means, quats, scales, opacities, colors = exact
    sh = colors if degree is not None else colors[:, None] / 0.28209479177387814
    field = GaussianField(means / UNIT, quats, (scales / UNIT).log(), opacities.logit(), sh, signed or degree is None)
    poses, intrinsics = views(cameras)
    poses[:, :3, 3] /= UNIT
    by_images, by_alphas = weights(cameras)
    oracle, results, loss = OracleRasterizer(three_sigma_cut=False), [], 0
    for i in range(cameras):
        (fx, _, cx), (_, fy, cy), _ = intrinsics[i].tolist()
        camera = Camera(*SIZE, fx, fy, cx, cy, poses[i])
        result = oracle(field, camera, background=backgrounds[i].cpu().double(), sh_degree=degree or 0)
        results.append(result)
        loss = loss + (result.image.permute(1, 2, 0) * by_images[i]).sum()
        if with_alphas:
            loss = loss + ((1 - result.transmittance[..., None]) * by_alphas[i]).sum()
    loss.backward()
    return [
        torch.stack([each.image.permute(1, 2, 0) for each in results]).detach(),
        torch.stack([1 - each.transmittance[..., None] for each in results]).detach(),
        *(leaf.grad for leaf in exact),
        torch.stack([each.means2d.grad for each in results]),
        torch.stack([each.absgrad2d for each in results]),
    ]


for count, cameras, coefficients, degree, signed, with_alphas in (
    (40, 1, 16, 3, False, True), (30, 2, 16, 2, True, True), (25, 2, 4, 1, False, False), (25, 1, 0, None, False, True),
):
    values = splats(count, coefficients)
    inputs, leaves = inputs_of(values, cameras, absgrad=True, sh_degree=degree)
    found, info = differentiated(
        lambda **each: rasterization(signed=signed, **each), inputs, leaves, with_alphas
    )
    close(found, expected(values, cameras, degree, signed, inputs["backgrounds"], with_alphas))
    assert info["radii"].shape == info["means2d"].shape == (cameras, count, 2)
    assert (info["n_cameras"], info["width"], info["height"]) == (cameras, *SIZE)
    assert bool((info["radii"] > 0).all(-1).any())
"""

DEPTHS = """
values = splats(30, 4)
inputs, _ = inputs_of(values, 2, sh_degree=1)
with torch.no_grad():
    image, alphas, _ = rasterization(**inputs)
    both, _, _ = rasterization(**inputs, render_mode="RGB+D")
    expected, _, _ = rasterization(**inputs, render_mode="ED")
    assert torch.equal(both[..., :3], image)
    assert torch.allclose(both[..., 3:], expected * alphas.clamp_min(1e-10), atol=1e-6)
    covered = alphas[..., 0] > 0.5
    assert 2 * UNIT < float(expected[..., 0][covered].min()) < float(expected[..., 0][covered].max()) < 5.5 * UNIT
    far = float(values[0][:, 2].max()) + 1e-4
    assert torch.equal(rasterization(**{**inputs, "far_plane": far})[0][0], image[0])
    assert float(rasterization(**{**inputs, "far_plane": 0.02})[1].max()) == 0
    assert float(rasterization(**{**inputs, "near_plane": 1.0})[1].max()) == 0
"""

AGAINST_GSPLAT = """
import gsplat

for count, cameras, coefficients, degree, absgrad, with_alphas in (
    (300, 1, 16, 3, False, False), (300, 3, 16, 2, True, True), (200, 1, 0, None, True, True),
):
    values, results = splats(count, coefficients), []
    for function in (rasterization, gsplat.rasterization):
        inputs, leaves = inputs_of(values, cameras, absgrad=absgrad, sh_degree=degree)
        results.append(differentiated(function, inputs, leaves, with_alphas))
    (ours, info), (own, other) = results
    close(ours, own)
    seen = (other["radii"] > 0).all(-1)
    assert torch.equal(info["radii"][seen], other["radii"][seen])
    assert torch.equal((info["radii"] > 0).all(-1), seen)
    assert torch.allclose(info["means2d"][seen], other["means2d"][seen], atol=1e-3)
    assert (info["width"], info["height"], info["n_cameras"]) == (other["width"], other["height"], other["n_cameras"])
for mode in ("RGB+ED", "D"):
    with torch.no_grad():
        inputs, _ = inputs_of(splats(200, 4), 2, sh_degree=1, render_mode=mode)
        ours, own = rasterization(**inputs)[0], gsplat.rasterization(**inputs)[0]
    assert torch.allclose(ours[..., :3], own[..., :3], atol=1e-3)
    assert float((ours - own).abs().max()) < 1e-3 * max(1.0, float(own.abs().max()))
"""

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only"
)


@needs_triton
def test_interpreted_against_the_oracle() -> None:
    run_checks("cpu", COMMON + AGAINST_THE_ORACLE, TRITON_INTERPRET="1")


@needs_triton
def test_depths_and_planes_interpreted() -> None:
    run_checks("cpu", COMMON + DEPTHS, TRITON_INTERPRET="1")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_compiled() -> None:
    run_checks("cuda", COMMON + AGAINST_THE_ORACLE + DEPTHS)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_compiled_against_gsplats_own() -> None:
    pytest.importorskip("gsplat")
    run_checks("cuda", COMMON + AGAINST_GSPLAT)
