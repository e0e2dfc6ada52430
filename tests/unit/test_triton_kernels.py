"""Our Triton kernels against PyTorch's autograd: interpreted on a CPU, compiled on a GPU."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import pytest
import torch

CHECKS = """
import torch
from lapgs_plugin.rasterizers.gsplat.blend_gradients import records_of
from lapgs_plugin.rasterizers.gsplat.kernels import activate, finish_gradients, visible_colors, write_to_stack
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch
from lapgs_plugin.ops.photometric_loss.in_triton import photometric_loss_triton
from lapgs_plugin.ops.upsample import upsample_add
from lapgs_plugin.ops.densification_statistics.in_triton import add_statistics_triton

def close(found, expected, absolute=1e-5, relative=1e-4):
    torch.testing.assert_close(found, expected, atol=absolute, rtol=relative)

torch.set_default_device(DEVICE)
torch.manual_seed(0)
n = 300
centres_of_three = torch.tensor([[0.3, -0.2, 0.5], [-1.0, 0.4, 0.2], [0.1, 2.0, -0.7]])
cases = ((3, 3, False), (3, 3, True), (3, 1, False), (2, 2, True), (3, 0, False), (0, 0, True))
for cameras, (degree, active, signed) in [(1, case) for case in cases] + [(3, case) for case in cases[:4]]:
    means, log_scales = (torch.randn(n, 3, requires_grad=True) for _ in range(2))
    logits = torch.randn(n, requires_grad=True)
    sh = (torch.randn(n, (degree + 1) ** 2, 3) / 2).requires_grad_()
    centre = centres_of_three[:cameras]
    radii, pixels = torch.randint(0, 3, (cameras, n, 2), dtype=torch.int32), torch.randn(cameras, n, 2)
    shown = (radii > 0).all(-1)
    scales, opacities = activate(log_scales.detach(), logits.detach())
    close(scales, log_scales.exp())
    close(opacities, logits.sigmoid())
    given, conics = (means.detach(), centre, sh.detach(), active, signed, radii), torch.randn(cameras, n, 3)
    splats = pixels, conics, opacities
    colors, largest, centres, records = visible_colors(*given, True, splats, False)
    directions = [torch.nn.functional.normalize(means - each, dim=-1) for each in centre]
    seen = torch.stack([sh_to_color(sh, each, active, signed=signed) for each in directions])
    close(colors[shown], seen[shown])
    assert (largest == torch.where(shown, radii.amax(-1), 0)).all()
    close(centres, torch.where(shown[..., None], pixels - 0.5, 0.0))
    assert len(records) == 0
    packed, largest, _, records = visible_colors(*given, False, splats, True)
    assert largest.numel() == 0
    close(packed[shown], colors[shown])
    expected = records_of(pixels, conics, colors, opacities.expand(cameras, -1))
    meant = [0, 1, 2, 3, 4, 5, 8, 9, 10]
    close(records[shown][:, meant], expected[shown][:, meant])
    if active == degree and cameras == 1:
        found = radii[0], pixels[0], torch.randn(n)
        parts = *found, records[0]
        placed = [torch.full((n + 40, *part.shape[1:]), -7, dtype=part.dtype) for part in parts]
        write_to_stack(means.detach(), centre, sh.detach(), opacities, signed, (*found, conics[0]), placed, 30)
        assert all((whole[:30] == -7).all() and (whole[30 + n :] == -7).all() for whole in placed)
        for part, whole in zip(found, placed[:3], strict=True):
            close(whole[30 : 30 + n], part)
        written = placed[3][30 : 30 + n]
        close(written[shown[0]][:, meant], records[0][shown[0]][:, meant])  # two kernels, which may round differently
        assert (written[~shown[0]] == -7).all()

    by_color = torch.randn(cameras, n, 3) * shown[..., None]
    by_mean, by_scale = (torch.randn(n, 3) * shown.any(0)[:, None] for _ in range(2))
    by_opacity = torch.randn(cameras, n)
    loss = (seen * by_color).sum() + (means * by_mean).sum()
    loss = loss + (log_scales.exp() * by_scale).sum() + (logits.sigmoid() * by_opacity).sum()
    expected = torch.autograd.grad(loss, (means, log_scales, logits, sh))
    for views in (False, True):  # of memory that holds other numbers too
        if views:
            held = torch.randn(cameras, n, 8)
            held[..., :3], held[..., 3] = by_color, by_opacity
            by_color, by_opacity, colors = held[..., :3], held[..., 3], packed
        by_mean_here, by_scale_here = by_mean.clone(), by_scale.clone()
        by_sh, by_logit = finish_gradients(
            *given, colors, scales, opacities, by_color, by_mean_here, by_scale_here, by_opacity
        )
        for found, wanted in zip((by_mean_here, by_scale_here, by_logit, by_sh), expected, strict=True):
            close(found, wanted)

    if cameras == 3:
        norms, counts = torch.rand(n), torch.rand(n)
        each = (pixels * torch.tensor([20.0, 15.0])).norm(dim=-1)
        expected = norms + torch.where(shown, each, 0.0).sum(0), counts + shown.sum(0)
        add_statistics_triton(pixels, torch.where(shown, 5, 0).int(), (40, 30), norms, counts)
        close(norms, expected[0])
        close(counts, expected[1])
pixels, shown = pixels[0].contiguous(), shown[0]

for shape, kind, interleaved in (
    ((3, 18, 5), torch.float32, False),
    ((2, 3, 5, 47), torch.uint8, True),
    ((3, 1, 1), torch.float16, True),
):
    prediction, target = torch.rand(shape), torch.rand(shape)
    prediction[..., 0] = target[..., 0] = 1.0  # L1 has no slope where both are equal
    if interleaved:
        prediction = prediction.movedim(-3, -1).contiguous().movedim(-1, -3)
    prediction.requires_grad_()
    stored = target.to(kind) if kind != torch.uint8 else (255 * target).round().to(kind)
    exact = stored.double() / (255 if kind == torch.uint8 else 1)
    losses = photometric_loss_triton(prediction, stored, 0.2), photometric_loss_torch(prediction.double(), exact, 0.2)
    close(losses[0].double(), losses[1])
    found, expected = (torch.autograd.grad(3 * loss, prediction)[0] for loss in losses)
    assert found.stride() == prediction.stride()
    close(found * found.numel(), expected * found.numel(), 1e-4)  # values to 7; worst seen 3e-6
broken = prediction.detach().clone()
broken[1, 0, 0] = torch.nan
assert photometric_loss_triton(broken, stored, 0.2).isnan()
cut = torch.rand(3, 4, 6)[:, 1:, 1:]  # with gaps in memory
close(photometric_loss_triton(cut, cut.clone(), 0.2), torch.zeros(()))

norms, counts = torch.rand(n), torch.rand(n)
expected = norms + torch.where(shown, (pixels * torch.tensor([20.0, 15.0])).norm(dim=-1), 0.0), counts + shown
add_statistics_triton(pixels, torch.where(shown, 5, 0).int(), (40, 30), norms, counts)
close(norms, expected[0])
close(counts, expected[1])

from lapgs_plugin.rasterizers.gsplat.self_check import stacking_works
from lapgs_plugin.ops import adam, color_transform, densification_statistics, photometric_loss
from lapgs_plugin.ops import position_noise, regularization
torch.set_default_device(None)
assert stacking_works.difference(torch.device(DEVICE)) < 1e-5  # worst seen 2e-7
assert color_transform.triton_works.difference(torch.device(DEVICE)) < 5e-5  # worst seen 2e-5
assert adam.triton_works.difference(torch.device(DEVICE)) < 1e-5  # worst seen 1e-6
assert densification_statistics.triton_works.difference(torch.device(DEVICE)) < 1e-5
assert photometric_loss.triton_works.difference(torch.device(DEVICE)) < 1e-3  # worst seen 1e-5
assert position_noise.triton_works.difference(torch.device(DEVICE)) < 1e-5
assert regularization.triton_works.difference(torch.device(DEVICE)) < 1e-5
"""


def run_checks(device: str, **environment: str) -> None:
    command = [sys.executable, "-c", f"DEVICE = {device!r}\n{CHECKS}"]
    done = subprocess.run(command, check=False, env={**os.environ, **environment}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only")
def test_interpreted() -> None:
    run_checks("cpu", TRITON_INTERPRET="1")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_compiled() -> None:
    run_checks("cuda")
