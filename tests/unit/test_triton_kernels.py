"""Our Triton kernels, but for those that blend, against PyTorch's autograd: interpreted on a CPU, compiled on a GPU."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

CHECKS = """
import torch
from gsplat.cuda import _torch_impl
from lapgs_plugin.gpu_raster.cameras import DeviceCameras
from lapgs_plugin.gpu_raster.kernels import project, project_backward, project_into
from lapgs_plugin.gpu_raster.records import Parameters
from tests.gaussian_records import records_of
from lapgs_plugin.fields.spherical_harmonics import sh_to_color
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch
from lapgs_plugin.ops.photometric_loss.in_triton import loss_and_l1_triton, photometric_loss_triton
from lapgs_plugin.ops.upsample import upsample_add
from lapgs_plugin.ops.densification_statistics.in_triton import add_statistics_triton

def close(actual, expected, absolute=1e-5, relative=1e-4):
    torch.testing.assert_close(actual, expected, atol=absolute, rtol=relative)

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
    field = Parameters(means, torch.randn(n, 4), 0.5 * torch.randn(n, 3) - 2, 2.5 * torch.randn(n) - 1, sh)
    poses, intrinsics = torch.eye(4).repeat(cameras, 1, 1), matrix.repeat(cameras, 1, 1)
    for index, pose in enumerate(poses):
        pose[:3, :3] = _torch_impl._quat_to_rotmat(torch.tensor([1.0, 0.1 * index, -0.05 * index, 0.02]))
        pose[:3, 3] = torch.tensor([0.3 * index, -0.1, 0.2])
    centres = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0].contiguous()
    seen_from = DeviceCameras(poses, intrinsics, centres, width, height)
    leaves = Parameters(*(value.double().requires_grad_() for value in field))
    covariances, _ = _torch_impl._quat_scale_to_covar_preci(
        leaves.quaternions, leaves.log_scales.exp(), compute_preci=False
    )
    whole_radii, pixels, depths, conics, _ = _torch_impl._fully_fused_projection(
        leaves.means, covariances, poses.double(), intrinsics.double(), width, height, eps2d=0.3, near_plane=0.2
    )
    opacities = leaves.logits.sigmoid().expand(cameras, -1)
    directions = [torch.nn.functional.normalize(leaves.means - centre, dim=-1) for centre in centres.double()]
    colors = torch.stack([sh_to_color(leaves.sh, direction, active, signed=signed) for direction in directions])

    seen = project(field, seen_from, active, signed, with_geometry=True)
    shown = (seen.radii > 0).all(-1)
    assert 0.3 < shown.float().mean() < 0.7
    # Footprints end where alpha is 1/255, unless they end at 3.33 standard deviations before.
    areas = 1 / (conics[..., :1] * conics[..., 2:] - conics[..., 1:2] ** 2)
    variances = areas * conics[..., [2, 0]]
    reach = (2 * torch.log(255 * opacities)).clamp_min(0).sqrt().clamp_max(3.33)
    radii = (reach[..., None] * variances.sqrt()).ceil().nan_to_num()
    inside = ((pixels + radii > 0) & (pixels - radii < torch.tensor([width, height]))).all(-1) & (depths >= 0.2)
    radii = torch.where(inside[..., None] & (opacities[..., None] >= 1 / 255), radii, 0.0)
    assert (seen.radii == radii).float().mean() > 0.999  # a radius may be rounded up from another side of a number
    for one, other in ((seen.means2d, pixels), (seen.depths, depths)):
        close(one[shown].double(), other[shown])
    meant = [0, 1, 2, 3, 4, 5, 8, 9, 10]
    records = records_of(pixels, conics, colors, opacities)
    close(seen.records[shown][:, meant].double(), records[shown][:, meant])
    assert (seen.visible_radii == torch.where(shown, seen.radii.amax(-1), 0)).all()
    close(seen.centres.double(), torch.where(shown[..., None], pixels - 0.5, 0.0))
    alone = project(field, seen_from, active, signed)
    assert alone.visible_radii.numel() == alone.centres.numel() == 0
    close(alone.records[shown][:, meant], seen.records[shown][:, meant], 0.0, 1e-6)
    if active == degree:
        parts = seen.radii[-1], seen.means2d[-1], seen.depths[-1], seen.records[-1]
        placed = [torch.full((n + 40, *part.shape[1:]), -7, dtype=part.dtype) for part in parts]
        project_into(placed, 30, field, seen_from, cameras - 1, signed)
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
        gradients = project_backward(field, seen_from, active, signed, seen.radii, seen.records, first, others)
        for one, other in zip(gradients, expected, strict=True):
            worst = float((one - other).abs().max() / other.abs().max())
            assert worst < 1e-5, (cameras, degree, active, signed, worst)  # worst seen 2e-6
    pixels, radii = seen.centres, seen.visible_radii

    norms, counts = torch.rand(n), torch.rand(n)
    lengths = (pixels * torch.tensor([20.0, 15.0])).norm(dim=-1)
    expected = norms + torch.where(shown, lengths, 0.0).sum(0), counts + shown.sum(0)
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
    gradient, expected = (torch.autograd.grad(3 * loss, prediction)[0] for loss in losses)
    assert gradient.stride() == prediction.stride()
    close(gradient * gradient.numel(), expected * gradient.numel(), 1e-4)  # values to 7; worst seen 3e-6
# Views of several sizes, of which the last has no row of the third program of the largest.
sizes = [(37, 70), (41, 64), (40, 31)]
views = torch.rand(2, 3, 70, 41, 3).movedim(-1, 2)
views[:, 0, :, :, 37:] = views[:, 1, :, 64:] = views[:, 2, :, 31:] = torch.nan  # is not read
prediction, target = views[0].requires_grad_(), (255 * views[1]).nan_to_num().to(torch.uint8)
loss = photometric_loss_triton(prediction, target, 0.2, sizes)
(gradient,) = torch.autograd.grad(3 * loss, prediction)
exact = prediction.detach().double().requires_grad_()
parts = [(exact[i, :, :h, :w], target[i, :, :h, :w].double() / 255) for i, (w, h) in enumerate(sizes)]
expected = torch.stack([photometric_loss_torch(*part, 0.2) for part in parts]).mean()
close(loss.double(), expected)
(by_views,) = torch.autograd.grad(3 * expected, exact)
close((gradient * gradient.numel()).double(), by_views * gradient.numel(), 1e-4)  # values to 16; worst seen 4.5e-6
for shape in ((3, 18, 5), (2, 3, 70, 41)):
    prediction, target = torch.rand(shape).requires_grad_(), torch.rand(shape)
    values = loss_and_l1_triton(prediction, target, 0.2)
    exact = prediction.double()
    expected = photometric_loss_torch(exact, target.double(), 0.2), (exact - target).abs().mean()
    for one, other in zip(values, expected, strict=True):
        close(one.double(), other)
    for factors in ((3.0, 0.0), (0.0, 2.0), (1.0, 2.0)):
        sums = [sum(f * value for f, value in zip(factors, each, strict=True) if f) for each in (values, expected)]
        one, other = (torch.autograd.grad(value, prediction, retain_graph=True)[0] for value in sums)
        close(one * one.numel(), other * one.numel(), 1e-4)
broken = prediction.detach().clone()[0, :, :18, :5]
broken[1, 0, 0] = torch.nan
assert photometric_loss_triton(broken, stored, 0.2).isnan()
cut = torch.rand(3, 4, 6)[:, 1:, 1:]  # with gaps in memory
close(photometric_loss_triton(cut, cut.clone(), 0.2), torch.zeros(()))

from lapgs_plugin.ops import adam, color_transform, densification_statistics, photometric_loss
from lapgs_plugin.ops import position_noise, regularization
from lapgs_plugin.ops.adam import multi_tensor, rows
torch.set_default_device(None)
assert color_transform.triton_works.difference(torch.device(DEVICE)) < 5e-5  # worst seen 2e-5
assert adam.triton_works.difference(torch.device(DEVICE)) < 1e-5  # worst seen 1e-6
assert multi_tensor.triton_works.difference(torch.device(DEVICE)) < 1e-5  # worst seen 8e-7
# As many tensors as a fork has, of which one launch takes six; one group has other betas.
parameters = [torch.nn.Parameter(torch.randn(size, 3).to(DEVICE)) for size in (600, 1, 300, 0, 171, 513, 90, 700)]
groups = [{"params": [one], "lr": 0.1 * i} for i, one in enumerate(parameters, start=1)]
groups[2]["betas"] = 0.5, 0.9
others = [torch.nn.Parameter(one.detach().clone()) for one in parameters]
optimizer = torch.optim.Adam(groups, eps=1e-15)
reference = torch.optim.Adam([{**group, "params": [other]} for group, other in zip(groups, others, strict=True)])
works, multi_tensor.triton_works = multi_tensor.triton_works, lambda *tensors: True
multi_tensor.fuse_steps(optimizer)
for _ in range(3):
    for one, other in zip(parameters, others, strict=True):
        one.grad = other.grad = torch.randn(one.shape).to(DEVICE)
    optimizer.step()
    reference.step()
for one, other in zip(parameters, others, strict=True):
    close(one, other, 1e-5)  # numbers to 4, moved by 2
multi_tensor.triton_works = works
assert rows.triton_works.difference(torch.device(DEVICE)) < 1e-5  # worst seen 2e-7
assert densification_statistics.triton_works.difference(torch.device(DEVICE)) < 1e-5
assert photometric_loss.triton_works.difference(torch.device(DEVICE)) < 1e-3  # worst seen 3e-5
assert position_noise.triton_works.difference(torch.device(DEVICE)) < 1e-5
assert regularization.triton_works.difference(torch.device(DEVICE)) < 1e-5
"""


NOISE = """
import torch
from lapgs_plugin.ops import position_noise
position_noise.triton_works = lambda means: True
n = 20_000

def drawn():
    means = torch.zeros(n, 3)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1)
    position_noise.add_noise(means, upright, torch.zeros(n, 3), torch.full((n,), -20.0), 1.0)
    return means / torch.sigmoid(torch.tensor(0.5))

torch.manual_seed(3)
state = torch.get_rng_state()
first, second = drawn(), drawn()
torch.set_rng_state(state)  # as a resumed run does
assert torch.equal(drawn(), first)
both = torch.cat([first, second], 1)
assert both.mean(0).abs().max() < 0.03, both.mean(0)  # worst seen 0.012
covariance = torch.cov(both.T)
assert (covariance - torch.eye(6)).abs().max() < 0.04, covariance  # worst seen 0.022
assert (both.pow(4).mean(0) - 3).abs().max() < 0.3  # a normal distribution's; worst seen 0.16
"""

UPSAMPLE = """
import torch
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.upsample.in_triton import upsample_add_triton, upsample_triton
for shape in ((3, 7, 8), (3, 30, 45), (2, 3, 17, 150), (4, 1, 1)):
    for grid in ("camera", "even"):
        h, w = shape[-2:]
        coarse, fine = torch.randn(*shape[:-2], (h + 1) // 2, (w + 1) // 2), torch.randn(*shape)
        expected = Pyramid(grid).up(coarse, (h, w)) + fine
        turned = [image.movedim(-3, -1).contiguous().movedim(-1, -3) for image in (coarse, fine)]  # as from gsplat
        for images in ((coarse, fine), turned):
            torch.testing.assert_close(upsample_add_triton(Pyramid(grid), *images), expected, rtol=0, atol=2e-6)
        half = upsample_add_triton(Pyramid(grid), coarse.half(), fine)
        torch.testing.assert_close(half, Pyramid(grid).up(coarse.half().float(), (h, w)) + fine, rtol=0, atol=2e-6)
        ups = [upsample_triton(Pyramid(grid), image, (h, w)) for image in (coarse.half(), coarse.half().float())]
        assert ups[0].dtype == torch.float32
        assert (ups[0] == ups[1]).all()
        shown = upsample_add_triton(Pyramid(grid), coarse, fine, clamped=True)
        torch.testing.assert_close(shown, expected.clamp(0, 1), rtol=0, atol=2e-6)
        leaf = fine.clone().requires_grad_()
        by_fine = torch.autograd.grad((upsample_add_triton(Pyramid(grid), coarse, leaf) * expected).sum(), leaf)
        assert (by_fine[0] == expected).all()
        gradients = []
        adding = lambda image, size: upsample_add_triton(Pyramid(grid), image, fine)
        for up in (Pyramid(grid).up, lambda *arguments: upsample_triton(Pyramid(grid), *arguments), adding):
            leaf = coarse.clone().requires_grad_()
            (up(leaf, (h, w)) * fine).sum().backward()
            gradients.append(leaf.grad)
        for gradient in gradients[1:]:
            torch.testing.assert_close(gradient, gradients[0], rtol=0, atol=1e-5)

# Views of several sizes: each is upsampled as if it were alone, and nothing of the others reaches it.
sizes = [(45, 30), (44, 31), (43, 29)]
for grid in ("camera", "even"):
    pyramid, fine, coarse = Pyramid(grid), torch.randn(3, 3, 31, 45), torch.randn(3, 3, 16, 23)
    leaves = fine.requires_grad_(), coarse.requires_grad_()
    weights = torch.zeros_like(fine)
    for index, (w, h) in enumerate(sizes):
        weights[index, :, :h, :w] = torch.randn(3, h, w)
    found = upsample_add_triton(pyramid, coarse, fine, False, sizes)
    by_all = torch.autograd.grad((found * weights).sum(), leaves)
    expected = torch.zeros_like(found)
    for index, (w, h) in enumerate(sizes):
        half = coarse[index, :, : (h + 1) // 2, : (w + 1) // 2]
        expected[index, :, :h, :w] = pyramid.up(half, (h, w)) + fine[index, :, :h, :w]
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6)
    for one, other in zip(by_all, torch.autograd.grad((expected * weights).sum(), leaves), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-5)
    with torch.no_grad():
        torch.testing.assert_close(upsample_add_triton(pyramid, coarse, fine, False, sizes), found)
"""

ROWS = """
import torch
from lapgs_plugin.ops.masked_updates import triton_works
from lapgs_plugin.ops.masked_updates.in_torch import Update, update_rows_torch
from lapgs_plugin.ops.masked_updates.in_triton import update_rows_triton

def norm(points):  # each operation rounds once, as PyTorch's norm does on a GPU; its square root on a CPU may be off
    squares = points[:, :1] * points[:, :1] + points[:, 1:] * points[:, 1:]
    return squares.double().sqrt().float()

torch.set_default_device(DEVICE)
torch.manual_seed(0)
for n in (1, 511, 1500):
    rows, wide = torch.randn(n, 1), torch.randn(n, 4)
    rows[::7], rows[1::7], wide[::5, 2] = torch.nan, torch.inf, torch.nan
    mask, whole = torch.rand(n) > 0.4, torch.randint(0, 9, (n, 1)).int()
    first, last = norm(wide[:, :2]), norm(wide[:, 2:])
    cases = [
        (True, rows), (False, 1), (True, 0.1), (False, whole), (False, rows, None, whole),
        (False, wide, (None, 2)), (True, wide, (2, None), rows), (False, wide, (2, 4), whole),
        (True, wide, (3, None)),
    ]
    plain = [*cases[:5], (False, first), (True, last, None, rows), (False, last, None, whole)]
    plain.append((True, wide[:, 3:].abs()))
    for together in (1, 2, 3, 9):  # as many as a launch has, fewer and more
        targets, expected = ([torch.randn(n, 1, generator=torch.Generator(DEVICE).manual_seed(i)) for i in range(9)]
                             for _ in range(2))
        updates = [Update(target, *case) for target, case in zip(targets, cases)]
        for start in range(0, 9, together):
            update_rows_triton(mask, updates[start : start + together])
        for target, case in zip(expected, plain):
            value = case[1] * case[3] if len(case) > 3 else case[1]
            after = torch.maximum(target, torch.as_tensor(value)) if case[0] else target + value
            target[mask] = after[mask]
        for one, other in zip(targets, expected):
            torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)
if DEVICE == "cuda":
    assert triton_works.passes_on(torch.device("cuda"))
"""

QUATERNIONS = """
import torch
from torch.nn.functional import normalize
from lapgs_plugin.ops.unit_quaternions.in_triton import unit_quaternions_triton
torch.set_default_device(DEVICE)
torch.manual_seed(0)
for n in (1, 255, 700):
    values, weights = torch.randn(n, 4), torch.randn(n, 4)
    values[::9], values[1::9] = 0.0, 1e-20
    results = []
    for operation, kind in ((unit_quaternions_triton, torch.float32), (normalize, torch.float64)):
        leaf = values.to(kind).requires_grad_()
        units = operation(leaf)
        results.append((units.double(), torch.autograd.grad((units * weights).sum(), leaf)[0].double()))
    for one, other in zip(*results):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
    assert (results[0][0].norm(dim=1) - 1).abs()[2::9].amax() < 1e-6 if n > 2 else True
"""
ROTATIONS = """
import torch
from lapgs_plugin.ops.scaled_rotations.in_torch import scaled_rotations_torch
from lapgs_plugin.ops.scaled_rotations.in_triton import scaled_rotations_triton
torch.set_default_device(DEVICE)
torch.manual_seed(0)
for n in (1, 700):
    scales, quaternions = 4 * torch.rand(n, 3), torch.randn(n, 4)
    expected = scaled_rotations_torch(scales.double(), quaternions.double()).float()
    torch.testing.assert_close(scaled_rotations_triton(scales, quaternions), expected, rtol=0, atol=4e-6)
"""
GRIDS = """
import torch
from lapgs_plugin.ops.bilateral_grid.in_torch import add_variation_torch, slice_grids_torch
from lapgs_plugin.ops.bilateral_grid.in_triton import add_variation_triton, slice_grids_triton
torch.set_default_device(DEVICE)
torch.manual_seed(0)
for shape, nodes, sizes in (
    ((3, 61, 90), (4, 5, 8), None),
    ((2, 3, 40, 51), (3, 4, 5), [(51, 30), (37, 40)]),
    ((1, 3, 7, 5), (4, 4, 1), None),
    ((3, 2, 3), (16, 16, 8), None),  # most cells have no pixel
):
    image, weights = 1.4 * torch.rand(shape) - 0.2, torch.rand(shape)  # beyond black and white, too
    if len(shape) == 4:
        image = image.movedim(-3, -1).contiguous().movedim(-1, -3)
    for (width, height), view in zip(sizes or (), weights):
        view[:, height:], view[:, :, width:] = 0, 0
    grids, results = torch.rand(*shape[:-3], *nodes, 12), []
    for operation, kind in ((slice_grids_torch, torch.float64), (slice_grids_triton, torch.float32)):
        leaves = image.to(kind).requires_grad_(), grids.to(kind).requires_grad_()
        out = operation(*leaves, sizes)
        out = torch.where(weights > 0, out, 0)
        results.append([out, *torch.autograd.grad((out * weights).sum(), leaves)])
    # Seen: 1.0e-6 of 2.8, 2.1e-6 of 6.5, 4.7e-6 of 41. A GPU rounds factors of the last to TF32.
    tolerances = (1e-5, 3e-5, 3e-5) if DEVICE == "cpu" else (1e-5, 3e-5, 2e-3 * float(results[0][2].abs().max()))
    for expected, actual, tolerance in zip(*results, tolerances):
        torch.testing.assert_close(actual.double(), expected.double(), rtol=0, atol=tolerance)
    again = torch.autograd.grad((torch.where(weights > 0, operation(*leaves, sizes), 0) * weights).sum(), leaves)
    assert all((one == other).all() for one, other in zip(again, results[1][1:]))  # the same bits
for shape in ((3, 4, 5, 8, 12), (2, 16, 2, 3, 12)):
    grids, by_grids = torch.rand(shape), torch.rand(shape)
    expected = by_grids.double()
    add_variation_triton(grids, by_grids, 0.3)
    add_variation_torch(grids.double(), expected, 0.3)
    torch.testing.assert_close(by_grids.double(), expected, rtol=0, atol=1e-5)  # 8e-8 seen
if DEVICE == "cuda":
    from lapgs_plugin.ops.bilateral_grid import triton_works
    assert triton_works.passes_on(torch.device("cuda"))
"""
FILTERS = """
import torch
from lapgs_plugin.ops.smoothing_filter import in_torch, in_triton
torch.set_default_device(DEVICE)
torch.manual_seed(0)
kinds = (
    (in_triton.filtered_scales_triton, in_torch.filtered_scales_torch, 1),
    (in_triton.filtered_opacities_triton, in_torch.filtered_opacities_torch, 0),
)
for n in (1, 700):
    tensors, filters = (2 * torch.randn(n, 1), torch.randn(n, 3) - 1), torch.rand(n, 1)
    filters[::7] = 0.0
    for ours, reference, first in kinds:
        results, weights = [], torch.randn_like(tensors[first])
        for version, kind in ((ours, torch.float32), (reference, torch.float64)):
            leaves = [tensor.to(kind, copy=True).requires_grad_() for tensor in tensors[first:]]
            output = version(*leaves, filters.to(kind))
            results.append([output, *torch.autograd.grad((output * weights).sum(), leaves)])
        for one, other in zip(*results):
            torch.testing.assert_close(one.double(), other, rtol=2e-5, atol=1e-6)
with torch.device("cpu"):  # its random numbers are a CPU's
    means, cameras = in_torch.seen_from(DEVICE)
means[0], means[1, 2] = torch.nan, torch.inf
depths, expected = in_triton.nearest_depths_triton(means, cameras), in_torch.nearest_depths_torch(means, cameras)
assert torch.equal(depths.isinf(), expected.isinf()) and 0.3 < depths.isinf().float().mean() < 0.7
torch.testing.assert_close(depths, expected, rtol=1e-5, atol=1e-6)
"""
GIVEN_NOISE = """
import torch
from lapgs_plugin.ops.position_noise.in_triton import shake_triton
from lapgs_plugin.ops.scaled_rotations.in_torch import scaled_rotations_torch
torch.set_default_device(DEVICE)
torch.manual_seed(0)
for n in (1, 700):
    means, noise, quaternions = torch.randn(n, 3), torch.randn(n, 3), torch.randn(n, 4)
    scales, opacities = torch.rand(n, 3), 0.1 * torch.rand(n, 1)
    opacities[::5] = 1.0
    matrices = scaled_rotations_torch(scales.double(), quaternions.double())
    share = 0.7 * torch.sigmoid(100 * (0.005 - opacities.double()))
    moved = (matrices @ matrices.mT @ (noise.double() * share)[:, :, None])[:, :, 0]
    expected = means.double() + moved
    shake_triton(means, noise, scales, quaternions, opacities, 0.7)
    torch.testing.assert_close(means.double(), expected, rtol=0, atol=2e-6)
"""
COMPILED_ROWS = """
import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from lapgs_plugin.ops.masked_updates import in_triton
from lapgs_plugin.ops.masked_updates.in_torch import Update

TYPES = {torch.float32: "*fp32", torch.bool: "*i1", int: "i32"}

def compiled(kernel, programs, *arguments, **constants):
    names = kernel.arg_names
    types = [TYPES[value.dtype if isinstance(value, torch.Tensor) else type(value)] for value in arguments]
    signature = {**dict(zip(names, types)), **dict.fromkeys(constants, "constexpr")}
    constexprs = {(names.index(name),): value for name, value in constants.items()}
    source = ASTSource(kernel, {name: signature[name] for name in names}, constexprs)
    assembly.append(triton.compile(source, GPUTarget("cuda", 90, 32), {"enable_fp_fusion": True}).asm["ptx"])

assembly, in_triton.launch = [], compiled
rows, wide = torch.ones(5, 1), torch.ones(5, 4)
updates = [Update(rows, False, wide, (0, 2)), Update(rows, True, wide, (2, 4), rows)]
updates.append(Update(rows, False, rows, None, rows))
for several in (updates, updates[1:2]):
    in_triton.update_rows_triton(torch.ones(5, dtype=torch.bool), several)
for text in assembly:
    assert "mul.f32" in text and "add.f32" in text and "sqrt.rn.f32" in text
    assert "fma" not in text
assert len(assembly) == 2
"""
OPTIMIZER = """
import copy
import io
import torch
from lapgs_plugin.ops.adam import multi_tensor
from lapgs_plugin.ops.adam.multi_tensor import MultiTensorAdam, fuse_steps

multi_tensor.triton_works = lambda *tensors: True
generator = torch.Generator().manual_seed(0)

def made():
    parameters = [torch.nn.Parameter(torch.linspace(-1, 1, 60).view(10, 6)[:, :i].contiguous().to(DEVICE))
                  for i in (3, 1, 0, 4, 2, 5, 6)]
    groups = [{"params": [one], "lr": 0.1 * i, "name": i} for i, one in enumerate(parameters, start=1)]
    return torch.optim.Adam(groups, lr=0.0, eps=1e-15)

def parameter(optimizer, index):
    return optimizer.param_groups[index]["params"][0]

def replaced(optimizer, change, names=("exp_avg", "exp_avg_sq")):
    # As densification does: the state is moved to another parameter, with other moments.
    for group in optimizer.param_groups:
        state = optimizer.state.pop(group["params"][0])
        for name in names:
            state[name] = change(state[name])
        group["params"][0] = torch.nn.Parameter(change(group["params"][0].detach()).requires_grad_())
        optimizer.state[group["params"][0]] = state

def reset(optimizer):
    optimizer.state[parameter(optimizer, 3)]["exp_avg"].zero_()
    optimizer.state[parameter(optimizer, 1)]["step"].zero_()
    optimizer.state[parameter(optimizer, 4)]["step"] = torch.tensor(1.0)

def resize(optimizer):  # the same objects
    for group in optimizer.param_groups:
        one = group["params"][0]
        one.data = one.data[:6].clone()
        for name in ("exp_avg", "exp_avg_sq"):
            optimizer.state[one][name].data = optimizer.state[one][name][:6].clone()

def checkpoint(optimizer):
    file = io.BytesIO()
    torch.save(optimizer.state_dict(), file)
    file.seek(0)
    optimizer.load_state_dict(torch.load(file))

def other_settings(optimizer):
    optimizer.param_groups[1]["betas"] = 0.5, 0.9
    optimizer.param_groups[4]["eps"] = 1e-3

edits = {
    2: lambda optimizer: replaced(optimizer, lambda rows: rows[:7]),
    4: lambda optimizer: replaced(optimizer, lambda rows: torch.cat((rows, rows[:2] + 1))),
    6: reset, 8: checkpoint, 10: resize, 12: other_settings,
    14: lambda optimizer: replaced(optimizer, lambda rows: rows[:0]),
}
ours, theirs = made(), made()
fuse_steps(ours)
assert type(ours) is MultiTensorAdam
for step in range(16):
    for optimizer in (ours, theirs):
        if step in edits:
            edits[step](optimizer)
        for index in range(7):
            generator.manual_seed(10 * step + index)
            one = parameter(optimizer, index)
            one.grad = torch.randn(one.shape, generator=generator).to(DEVICE)
            if step == 1 and index == 5:
                one.grad = None
            if step == 3 and index == 3:  # stored by columns
                one.grad = one.grad.T.contiguous().T
        optimizer.step()
        optimizer.zero_grad()
    for index in range(7):
        one, other = parameter(ours, index), parameter(theirs, index)
        torch.testing.assert_close(one, other, rtol=0, atol=1e-5)  # moved by 0.7 at most; worst seen 2e-6
        states = ours.state[one], theirs.state[other]
        assert states[0]["step"].device.type == "cpu" and states[0]["step"].item() == states[1]["step"].item()
    if step == 5:  # a copy counts by itself, and one of PyTorch's class goes on
        plain, copied = made(), copy.deepcopy(ours)
        plain.load_state_dict(copy.deepcopy(ours.state_dict()))
        for optimizer in (plain, copied):
            for index in range(7):
                parameter(optimizer, index).data = parameter(ours, index).detach().clone()
                parameter(optimizer, index).grad = torch.ones_like(parameter(ours, index))
            optimizer.step()
        for index in range(7):
            one, other = parameter(plain, index), parameter(copied, index)
            torch.testing.assert_close(one, other, rtol=0, atol=1e-5)
            count = ours.state[parameter(ours, index)]["step"] + 1
            assert plain.state[one]["step"] == copied.state[other]["step"] == count
"""

NAMES = ["all", "noise", "upsample", "rows", "quaternions", "rotations", "grids", "filters", "given noise", "optimizer"]
ALONE = [ROWS, QUATERNIONS, ROTATIONS, GRIDS, FILTERS, GIVEN_NOISE, OPTIMIZER]


def run_checks(checks: str, device: str, **environment: str) -> None:
    command = [sys.executable, "-c", f"DEVICE = {device!r}\n{checks}"]
    done = subprocess.run(command, check=False, env={**os.environ, **environment}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only")
@pytest.mark.parametrize("checks", [CHECKS, NOISE, UPSAMPLE, *ALONE], ids=NAMES)
def test_interpreted(checks: str) -> None:
    run_checks(checks, "cpu", TRITON_INTERPRET="1")


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton comes with PyTorch for CUDA only")
def test_products_of_rows_are_rounded_by_themselves(tmp_path: Path) -> None:
    """Where the sum of squares is one instruction with a product, norms differ from PyTorch's in their last bit."""
    run_checks(COMPILED_ROWS, "cpu", TRITON_INTERPRET="0", TRITON_CACHE_DIR=str(tmp_path))


@pytest.mark.gpu
@pytest.mark.parametrize("checks", [CHECKS, *ALONE], ids=["all", *NAMES[3:]])
def test_compiled(checks: str) -> None:
    run_checks(checks, "cuda")
