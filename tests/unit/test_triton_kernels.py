"""Our Triton kernels, but for those that blend, against PyTorch's autograd: interpreted on a CPU, compiled on a GPU."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import pytest
import torch

CHECKS = """
import torch
from gsplat.cuda import _torch_impl
from lapgs_plugin.gpu_raster.cameras import DeviceCameras
from lapgs_plugin.gpu_raster.kernels import project, project_backward, project_into
from lapgs_plugin.gpu_raster.records import Parameters, records_of
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
width, height = 64, 48
matrix = torch.tensor([[60.0, 0, 30], [0, 55, 25], [0, 0, 1]])
cases = ((3, 3, False), (3, 3, True), (3, 1, False), (2, 2, True), (3, 0, False), (0, 0, True), (1, 1, False))
for cameras, (degree, active, signed) in [(1, case) for case in cases] + [(3, case) for case in cases[:4]]:
    # Some are behind a camera, some beyond its borders, where the Jacobian is limited, and some too faint.
    means = 2 * torch.randn(n, 3) + torch.tensor([0.0, 0.0, 3.0])
    sh = torch.randn(n, (degree + 1) ** 2, 3) / 2
    given = Parameters(means, torch.randn(n, 4), 0.5 * torch.randn(n, 3) - 2, 2.5 * torch.randn(n) - 1, sh)
    poses, intrinsics = torch.eye(4).repeat(cameras, 1, 1), matrix.repeat(cameras, 1, 1)
    for index, pose in enumerate(poses):
        pose[:3, :3] = _torch_impl._quat_to_rotmat(torch.tensor([1.0, 0.1 * index, -0.05 * index, 0.02]))
        pose[:3, 3] = torch.tensor([0.3 * index, -0.1, 0.2])
    centres = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0].contiguous()
    seen_from = DeviceCameras(poses, intrinsics, centres, width, height)
    leaves = Parameters(*(value.double().requires_grad_() for value in given))
    covariances, _ = _torch_impl._quat_scale_to_covar_preci(
        leaves.quaternions, leaves.log_scales.exp(), compute_preci=False
    )
    whole_radii, pixels, depths, conics, _ = _torch_impl._fully_fused_projection(
        leaves.means, covariances, poses.double(), intrinsics.double(), width, height, eps2d=0.3, near_plane=0.2
    )
    opacities = leaves.logits.sigmoid().expand(cameras, -1)
    directions = [torch.nn.functional.normalize(leaves.means - each, dim=-1) for each in centres.double()]
    colors = torch.stack([sh_to_color(leaves.sh, each, active, signed=signed) for each in directions])

    found = project(given, seen_from, active, signed, with_geometry=True)
    shown = (found.radii > 0).all(-1)
    assert 0.3 < shown.float().mean() < 0.7
    # Footprints end where alpha is 1/255, unless they end at 3.33 standard deviations before.
    areas = 1 / (conics[..., :1] * conics[..., 2:] - conics[..., 1:2] ** 2)
    variances = areas * conics[..., [2, 0]]
    reach = (2 * torch.log(255 * opacities)).clamp_min(0).sqrt().clamp_max(3.33)
    radii = (reach[..., None] * variances.sqrt()).ceil().nan_to_num()
    inside = ((pixels + radii > 0) & (pixels - radii < torch.tensor([width, height]))).all(-1) & (depths >= 0.2)
    radii = torch.where(inside[..., None] & (opacities[..., None] >= 1 / 255), radii, 0.0)
    assert (found.radii == radii).float().mean() > 0.999  # a radius may be rounded up from another side of a number
    for one, other in ((found.means2d, pixels), (found.depths, depths)):
        close(one[shown].double(), other[shown])
    meant = [0, 1, 2, 3, 4, 5, 8, 9, 10]
    records = records_of(pixels, conics, colors, opacities)
    close(found.records[shown][:, meant].double(), records[shown][:, meant])
    assert (found.visible_radii == torch.where(shown, found.radii.amax(-1), 0)).all()
    close(found.centres.double(), torch.where(shown[..., None], pixels - 0.5, 0.0))
    alone = project(given, seen_from, active, signed)
    assert alone.visible_radii.numel() == alone.centres.numel() == 0
    close(alone.records[shown][:, meant], found.records[shown][:, meant], 0.0, 1e-6)
    if active == degree:
        parts = found.radii[-1], found.means2d[-1], found.depths[-1], found.records[-1]
        placed = [torch.full((n + 40, *part.shape[1:]), -7, dtype=part.dtype) for part in parts]
        project_into(placed, 30, given, seen_from, cameras - 1, signed)
        assert all((whole[:30] == -7).all() and (whole[30 + n :] == -7).all() for whole in placed)
        assert (placed[0][30 : 30 + n] == parts[0]).all()
        for part, whole in zip(parts[1:3], placed[1:3], strict=True):
            close(whole[30 : 30 + n][shown[-1]], part[shown[-1]], 0.0, 1e-6)
        written = placed[3][30 : 30 + n]
        close(written[shown[-1]][:, meant], parts[3][shown[-1]][:, meant], 0.0, 1e-6)
        assert (written[~shown[-1]] == -7).all()

    first = torch.randn(cameras, n, 8) * shown[..., None]
    for columns in (1, 3):
        others = torch.randn(cameras, n, columns) * shown[..., None]
        conic = torch.cat([first[..., 6:], others[..., :1]], -1)
        loss = (colors * first[..., :3])[shown].sum() + (opacities * first[..., 3])[shown].sum()
        loss = loss + (pixels * first[..., 4:6])[shown].sum() + (conics * conic)[shown].sum()
        expected = torch.autograd.grad(loss, leaves, retain_graph=True)
        gradients = project_backward(given, seen_from, active, signed, found.radii, found.records, first, others)
        for one, other in zip(gradients, expected, strict=True):
            worst = float((one - other).abs().max() / other.abs().max())
            assert worst < 1e-5, (cameras, degree, active, signed, worst)  # worst seen 2e-6
    pixels, radii = found.centres, found.visible_radii

    norms, counts = torch.rand(n), torch.rand(n)
    each = (pixels * torch.tensor([20.0, 15.0])).norm(dim=-1)
    expected = norms + torch.where(shown, each, 0.0).sum(0), counts + shown.sum(0)
    if cameras == 1:
        pixels, radii = pixels[0], radii[0]
    add_statistics_triton(pixels.contiguous(), radii.contiguous(), (40, 30), norms, counts)
    close(norms, expected[0])
    close(counts, expected[1])

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

from lapgs_plugin.ops import adam, color_transform, densification_statistics, photometric_loss
from lapgs_plugin.ops import position_noise, regularization
from lapgs_plugin.ops.adam import rows, tensorwise
torch.set_default_device(None)
assert color_transform.triton_works.difference(torch.device(DEVICE)) < 5e-5  # worst seen 2e-5
assert adam.triton_works.difference(torch.device(DEVICE)) < 1e-5  # worst seen 1e-6
assert tensorwise.triton_works.difference(torch.device(DEVICE)) < 1e-5  # worst seen 8e-7
assert rows.triton_works.difference(torch.device(DEVICE)) < 1e-5  # worst seen 2e-7
assert densification_statistics.triton_works.difference(torch.device(DEVICE)) < 1e-5
assert photometric_loss.triton_works.difference(torch.device(DEVICE)) < 1e-3  # worst seen 3e-5
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
