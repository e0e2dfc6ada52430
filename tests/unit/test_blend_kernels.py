"""Our kernels that blend against autograd in float64, interpreted or compiled, and against gsplat's on a GPU."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import pytest

CHECKS = """
import torch
from lapgs_plugin.gpu_raster.blend_kernels import Shape, blend_backward, blend_forward
from tests.gaussian_records import records_of

def blended(means, conics, colors, opacities, background, offsets, flat, height, width):
    # Every pixel blends the pairs of its tile, in order.
    cameras, down, across = offsets.shape
    ends = [*offsets.flatten().tolist(), len(flat)]
    images, last = background[:, :, None, None].repeat(1, 1, height, width), torch.zeros(cameras, height, width).int()
    for tile in range(offsets.numel()):
        camera, row, column = tile // (down * across), tile // across % down * 16, tile % across * 16
        ys, xs = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        ys, xs = (each[row : row + 16, column : column + 16] for each in (ys, xs))
        left, color = torch.ones(ys.shape, dtype=means.dtype), torch.zeros(3, *ys.shape, dtype=means.dtype)
        ended = torch.zeros(ys.shape, dtype=torch.bool)
        for pair in range(ends[tile], ends[tile + 1]):
            one = int(flat[pair])
            x, y = means[one, 0] - xs, means[one, 1] - ys
            sigma = 0.5 * (conics[one, 0] * x * x + conics[one, 2] * y * y) + conics[one, 1] * x * y
            alpha = (opacities[one] * torch.exp(-sigma)).clamp_max(0.999)
            alpha = torch.where((sigma < 0) | (alpha < 1 / 255), 0.0, alpha)
            ended = ended | (left * (1 - alpha) <= 1e-4)
            alpha = torch.where(ended, 0.0, alpha)
            color = color + alpha * left * colors[one][:, None, None]
            left = left * (1 - alpha)
            there = last[camera, row : row + 16, column : column + 16]
            there[alpha > 0] = pair
        images[camera, :, row : row + 16, column : column + 16] = color + left * background[camera][:, None, None]
    return images, last

def check(shapes, cameras, count, height, width, absolute, limit):
    torch.manual_seed(count)
    down, across = -(-height // 16), -(-width // 16)
    means = torch.rand(cameras * count, 2) * torch.tensor([width, height])
    factors = 8 * (torch.rand(cameras * count, 2, 2) - 0.5)
    inverse = torch.linalg.inv(factors @ factors.mT + 0.3 * torch.eye(2))
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
    colors, opacities = torch.randn(cameras * count, 3), (1.3 * torch.rand(cameras * count)).clamp(0.05, 1.0)
    means[0], conics[0], colors[0] = torch.nan, torch.nan, torch.nan  # culled: memory that nobody wrote
    # Every Gaussian is in the list of every tile of its image, but the first one; the first tile is empty.
    lists = [torch.arange(1, count) + camera * count for camera in range(cameras) for _ in range(down * across)]
    lists[0] = lists[0][:0]
    flat = torch.cat(lists).int()
    offsets = torch.tensor([0, *[len(each) for each in lists[:-1]]]).cumsum(0).int().view(cameras, down, across)
    background, by_images = torch.rand(cameras, 3), torch.randn(cameras, 3, height, width)
    leaves = [each.double().requires_grad_() for each in (means, conics, colors, opacities)]
    images, last = blended(*leaves, background.double(), offsets, flat, height, width)
    expected = torch.autograd.grad((images * by_images).sum(), leaves)
    assert int(last.max()) < len(flat) - 1 or count < 60  # pixels end before the last Gaussian of a long list
    by_images, images = (each.permute(0, 2, 3, 1).detach().float().contiguous() for each in (by_images, images))
    for shape in shapes:
        records = records_of(*(each.to(DEVICE) for each in (means, conics, colors, opacities)))
        tiles = offsets.flatten().to(DEVICE), flat.to(DEVICE)
        if absolute:  # the number of pairs is on the device, too, and there is room for more
            number = torch.tensor([len(flat)], dtype=torch.int32, device=DEVICE)
            tiles = torch.cat([tiles[0], number]), torch.nn.functional.pad(tiles[1], (0, 40), value=2**30)
        image, *rest = blend_forward(records, background.to(DEVICE), *tiles, (width, height), cameras, shape)
        off = float((image.cpu() - images).abs().max())
        print(shape, cameras, count, f"images {off:.1e}")
        assert off < limit
        first, rest = blend_backward(records, *tiles, image, *rest, by_images.to(DEVICE), absolute, shape)
        found = [first[..., 4:6], torch.cat([first[..., 6:], rest[..., :1]], -1), first[..., :3], first[..., 3]]
        for one, other in zip(found, expected, strict=True):
            one, other = one.cpu().view_as(other), other.nan_to_num()
            worst = float((one - other).abs().max() / other.abs().max())
            print(shape, cameras, count, f"{worst:.1e}")
            assert worst < limit
        assert rest.shape[-1] == (3 if absolute else 1)
        if absolute:  # as much as the sum at least
            whole = rest[..., 1:]
            assert (whole >= found[0].abs() - 1e-5 * whole.max()).all()
            assert (whole > 1.5 * found[0].abs()).any()

check([Shape(8, 1)], 2, 7, 5, 21, True, 1e-5)  # worst seen 8.6e-7
check([Shape()], 1, 60, 5, 21, False, 2e-5)  # worst seen 1.1e-6
check([Shape(8)], 2, 150, 7, 12, True, 2e-5)  # more pairs than are read at once; worst seen 8.2e-6
check([Shape(2)], 1, 9, 18, 21, False, 2e-5)  # 32 regions in a tile; worst seen 3.4e-6
if DEVICE == "cuda":
    shapes = [Shape(*each) for each in ((), (4, 1), (2,), (8,), (8, 1), (16,))]
    # An alpha that is FAINTEST up to rounding may count in one of both; an H200 has 4.2e-6.
    check(shapes, 2, 100, 37, 50, True, 1e-3)
    check(shapes, 1, 500, 21, 35, False, 1e-3)
"""

WITH_GSPLAT = """
from dataclasses import replace

import torch
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.rasterizers.gsplat.direct_stack import DirectStack
from lapgs_plugin.gpu_raster import tiles
from lapgs_plugin.rasterizers.gsplat.stack import GsplatStack
from tests.gsplat_on_cpu import GsplatOnCpu, gsplat_on_cpu

tiles.LEAST_ROOM = 256  # places for pairs are slow to interpret

def field(count, signed):
    generator = torch.Generator().manual_seed(count)
    def normal(*shape):
        return torch.randn(count, *shape, generator=generator)
    means, log_scales = normal(3) + torch.tensor([0.0, 0.0, 4.0]), 0.3 * normal(3) - 2.0
    return GaussianField(means, normal(4), log_scales, normal() + 1.0, 0.3 * normal(4, 3), signed)

def close(found, expected):
    pairs = zip(found, expected, strict=True)
    worst = max(float((one - other).abs().max() / other.abs().max()) for one, other in pairs)
    print(f"{worst:.1e}")
    assert worst < 1e-5  # worst seen 2.3e-6

camera, moved, some = Camera(24, 20, 30.0, 30.0, 12.0, 10.0, torch.eye(4)), torch.eye(4), torch.tensor([0.1, 0.2, 0.3])
moved[0, 3] = 0.2
with gsplat_on_cpu():
    for cameras in ([camera], [camera, replace(camera, world_to_camera=moved)]):
        for signed in (False, True):
            found = []
            for ours in (True, False):
                given = field(50, signed)
                for value in given.parameters.values():
                    value.requires_grad_()
                rasterizer = GsplatOnCpu(ours, own_radii=True, absgrad=False)
                if len(cameras) == 1:
                    result = rasterizer(given, camera, background=some)
                else:
                    result = rasterizer.render_batch(given, cameras, background=some)
                weights = torch.randn(result.image.shape, generator=torch.Generator().manual_seed(1))
                (result.image * weights).sum().backward()
                alone = rasterizer.render_images(given.detach(), cameras, background=some)
                gradients = [result.means2d.grad, *(value.grad for value in given.parameters.values())]
                found.append([result.image.detach(), alone, *gradients])
            close(*found)
    # Cameras of several sizes have the images, radii, centres and gradients that each has alone.
    cameras = [camera, replace(camera, width=25, height=18)]
    together, alone = field(30, False), field(30, False)
    for given in (together, alone):
        given.means[0], given.log_scales[0], given.opacity_logits[0] = torch.tensor([1.45, 0.0, 3.0]), -4.0, 1.0
        for value in given.parameters.values():
            value.requires_grad_()
    rasterizer = GsplatOnCpu(True, own_radii=True, absgrad=True)
    batch = rasterizer.render_batch(together, cameras, background=some)
    assert batch.image.shape == (2, 3, 20, 25)
    weights = [torch.randn(3, one.height, one.width) for one in cameras]
    parts = [batch.image[row, :, : one.height, : one.width] for row, one in enumerate(cameras)]
    sum((part * weight).sum() for part, weight in zip(parts, weights, strict=True)).backward()
    assert batch.radii[:, 0].tolist() == [0, 2]  # the first camera has it in its padding
    for row, one in enumerate(cameras):
        result = rasterizer(alone, one, background=some)
        (result.image * weights[row]).sum().backward()
        assert torch.equal(batch.radii[row], result.radii)
        assert torch.equal(batch.means2d[row], result.means2d)
        assert torch.equal(parts[row], result.image)
        close([batch.means2d.grad[row], batch.absgrad2d[row]], [result.means2d.grad, result.absgrad2d])
    close([v.grad for v in together.parameters.values()], [v.grad for v in alone.parameters.values()])
    fields = [field(60, True), field(40, False)]
    for cameras, background in (([camera, camera.resized(12, 10)], some), ([camera], None)):
        stacks = DirectStack(fields, torch.device("cpu")), GsplatStack(fields, torch.device("cpu"))
        close(*(stack.render(cameras, background) for stack in stacks))
"""


def run_checks(device: str, checks: str = CHECKS, **environment: str) -> None:
    command = [sys.executable, "-c", f"DEVICE = {device!r}\n{checks}"]
    done = subprocess.run(command, check=False, env={**os.environ, **environment}, capture_output=True, text=True)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only")
def test_interpreted() -> None:
    run_checks("cpu", TRITON_INTERPRET="1")


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only")
def test_interpreted_against_gsplats_functions() -> None:
    run_checks("cpu", WITH_GSPLAT, TRITON_INTERPRET="1")


@pytest.mark.gpu
def test_compiled() -> None:
    run_checks("cuda")
