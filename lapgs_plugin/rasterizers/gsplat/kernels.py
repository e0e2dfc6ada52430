"""Compute activations, colours and their gradients around gsplat's kernels, in Triton.

As PyTorch operations they would be dozens of launches per render, and for small images launching takes longer than
computing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from lapgs_plugin.ops.self_check import FUSED
from lapgs_plugin.rasterizers.gsplat.blend_gradients import COLOR_IN_RECORD, RECORD

BLOCK = 128
"""Gaussians in a block. Each takes 4 threads, of which 3 have a channel: Triton's sizes are powers of 2."""

# Kernels are only compiled anew for another number of coefficients: the active degree grows during a stage, and bases
# and residuals alternate.
NOT_SPECIALIZED = ("n", "cameras", "active", "signed")


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _basis(k: tl.constexpr, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tl.tensor:  # noqa: PLR0911, PLR0912  # a return for each k, of which Triton compiles one
    """Return the k-th real spherical harmonic of a unit direction, in the order and with the signs of 3DGS."""
    xx, yy, zz = x * x, y * y, z * z
    if k == 0:
        return 0.28209479177387814 + 0.0 * x
    if k == 1:
        return -0.4886025119029199 * y
    if k == 2:
        return 0.4886025119029199 * z
    if k == 3:
        return -0.4886025119029199 * x
    if k == 4:
        return 1.0925484305920792 * x * y
    if k == 5:
        return -1.0925484305920792 * y * z
    if k == 6:
        return 0.31539156525252005 * (2.0 * zz - xx - yy)
    if k == 7:
        return -1.0925484305920792 * x * z
    if k == 8:
        return 0.5462742152960396 * (xx - yy)
    if k == 9:
        return -0.5900435899266435 * y * (3.0 * xx - yy)
    if k == 10:
        return 2.890611442640554 * x * y * z
    if k == 11:
        return -0.4570457994644658 * y * (4.0 * zz - xx - yy)
    if k == 12:
        return 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    if k == 13:
        return -0.4570457994644658 * x * (4.0 * zz - xx - yy)
    if k == 14:
        return 1.445305721320277 * z * (xx - yy)
    return -0.5900435899266435 * x * (xx - 3.0 * yy)


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _basis_x(k: tl.constexpr, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tl.tensor:  # noqa: PLR0911  # a return for each k, of which Triton compiles one
    """Return the derivative of `_basis` by x."""
    xx, yy, zz = x * x, y * y, z * z
    if k == 3:
        return -0.4886025119029199 + 0.0 * x
    if k == 4:
        return 1.0925484305920792 * y
    if k == 6:
        return -2.0 * 0.31539156525252005 * x
    if k == 7:
        return -1.0925484305920792 * z
    if k == 8:
        return 2.0 * 0.5462742152960396 * x
    if k == 9:
        return -6.0 * 0.5900435899266435 * x * y
    if k == 10:
        return 2.890611442640554 * y * z
    if k == 11:
        return 2.0 * 0.4570457994644658 * x * y
    if k == 12:
        return -6.0 * 0.3731763325901154 * x * z
    if k == 13:
        return -0.4570457994644658 * (4.0 * zz - 3.0 * xx - yy)
    if k == 14:
        return 2.0 * 1.445305721320277 * x * z
    if k == 15:
        return -3.0 * 0.5900435899266435 * (xx - yy)
    return 0.0 * x


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _basis_y(k: tl.constexpr, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tl.tensor:  # noqa: PLR0911  # a return for each k, of which Triton compiles one
    """Return the derivative of `_basis` by y."""
    xx, yy, zz = x * x, y * y, z * z
    if k == 1:
        return -0.4886025119029199 + 0.0 * x
    if k == 4:
        return 1.0925484305920792 * x
    if k == 5:
        return -1.0925484305920792 * z
    if k == 6:
        return -2.0 * 0.31539156525252005 * y
    if k == 8:
        return -2.0 * 0.5462742152960396 * y
    if k == 9:
        return -3.0 * 0.5900435899266435 * (xx - yy)
    if k == 10:
        return 2.890611442640554 * x * z
    if k == 11:
        return -0.4570457994644658 * (4.0 * zz - xx - 3.0 * yy)
    if k == 12:
        return -6.0 * 0.3731763325901154 * y * z
    if k == 13:
        return 2.0 * 0.4570457994644658 * x * y
    if k == 14:
        return -2.0 * 1.445305721320277 * y * z
    if k == 15:
        return 6.0 * 0.5900435899266435 * x * y
    return 0.0 * x


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _basis_z(k: tl.constexpr, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tl.tensor:  # noqa: PLR0911  # a return for each k, of which Triton compiles one
    """Return the derivative of `_basis` by z."""
    xx, yy, zz = x * x, y * y, z * z
    if k == 2:
        return 0.4886025119029199 + 0.0 * x
    if k == 5:
        return -1.0925484305920792 * y
    if k == 6:
        return 4.0 * 0.31539156525252005 * z
    if k == 7:
        return -1.0925484305920792 * x
    if k == 10:
        return 2.890611442640554 * x * y
    if k == 11:
        return -8.0 * 0.4570457994644658 * y * z
    if k == 12:
        return 0.3731763325901154 * (6.0 * zz - 3.0 * xx - 3.0 * yy)
    if k == 13:
        return -8.0 * 0.4570457994644658 * x * z
    if k == 14:
        return 1.445305721320277 * (xx - yy)
    return 0.0 * x


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _view_directions(mean: tl.tensor, centre: tl.tensor, channel: tl.tensor, there: tl.tensor) -> tl.tensor:
    """Return unit directions x, y, z (g, 1) from the camera's centre, and one over the distances.

    Means are (g, 4), the last channel without meaning. Every load is of neighbouring channels, because Triton would
    spread Gaussians alone over threads in another way, and each harmonic would go from one thread to another.
    """
    away = mean - tl.load(centre + channel, channel < 3, 0.0)
    away = tl.where(there & (channel < 3), away, 1.0)
    inverse = 1.0 / tl.sqrt(tl.sum(tl.where(channel < 3, away * away, 0.0), 1))[:, None]
    x = tl.sum(tl.where(channel == 0, away, 0.0), 1)[:, None] * inverse
    y = tl.sum(tl.where(channel == 1, away, 0.0), 1)[:, None] * inverse
    z = tl.sum(tl.where(channel == 2, away, 0.0), 1)[:, None] * inverse
    return x, y, z, inverse


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _block_colors(
    means: tl.tensor, centre: tl.tensor, sh: tl.tensor, rows: tl.tensor, channel: tl.tensor, visible: tl.tensor,
    active: int, signed: int, coefficients: tl.constexpr, block: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return colours (g, 4) of a block; the last channel is meaningless."""
    mean = tl.load(means + 3 * rows + channel, visible & (channel < 3), 0.0)
    x, y, z, _ = _view_directions(mean, centre, channel, visible)
    color = tl.zeros((block, 4), tl.float32)
    for k in tl.static_range(coefficients):
        used = tl.full((1, 4), k, tl.int32) < active  # as a block: a number in a mask cannot be interpreted
        wanted = visible & (channel < 3) & used
        color += _basis(k, x, y, z) * tl.load(sh + (rows * coefficients + k) * 3 + channel, wanted, 0.0)
    return tl.where(signed != 0, color, tl.maximum(color + 0.5, 0.0))


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _write_record(
    records: tl.tensor, placed: tl.tensor, pixels: tl.tensor, conics: tl.tensor, rows: tl.tensor,
    opacity: tl.tensor, color: tl.tensor, channel: tl.tensor, visible: tl.tensor, record: tl.constexpr,
) -> None:  # fmt: skip
    """Write to the rows `placed` what blending reads of visible Gaussians, see `blend_gradients.RECORD`."""
    conic = tl.load(conics + 3 * rows + channel - 2, visible & (channel >= 2), 0.0)
    first = tl.load(pixels + 2 * rows + channel, visible & (channel < 2), 0.0) + conic
    last = tl.load(conics + 3 * rows + 2, visible, 0.0)
    start = records + placed * record + channel
    tl.store(start, first, visible)
    tl.store(start + 4, tl.where(channel == 0, last, opacity), visible & (channel < 2))
    tl.store(start + 8, color, visible & (channel < 3))


@triton.jit(do_not_specialize=("n",))  # type: ignore[untyped-decorator]  # Triton ships no types
def _activate_kernel(
    log_scales: tl.tensor, logits: tl.tensor, scales: tl.tensor, opacities: tl.tensor, n: int, block: tl.constexpr
) -> None:
    rows = tl.program_id(0) * block + tl.arange(0, block)  # (g,)
    logit = tl.load(logits + rows, rows < n, 0.0)
    tl.store(opacities + rows, 1.0 / (1.0 + tl.exp(-logit)), rows < n)
    for third in tl.static_range(3):
        places = (tl.program_id(0) * 3 + third) * block + tl.arange(0, block)
        tl.store(scales + places, tl.exp(tl.load(log_scales + places, places < 3 * n, 0.0)), places < 3 * n)


@triton.jit(do_not_specialize=NOT_SPECIALIZED)  # type: ignore[untyped-decorator]  # Triton ships no types
def _color_kernel(
    means: tl.tensor, centre: tl.tensor, sh: tl.tensor, radii: tl.tensor,
    pixels: tl.tensor, conics: tl.tensor, opacities: tl.tensor,
    colors: tl.tensor, visible_radii: tl.tensor, visible_pixels: tl.tensor,
    n: int, cameras: int, active: int, signed: int,
    coefficients: tl.constexpr, describes: tl.constexpr, packs: tl.constexpr, record: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    # Cameras of one block are consecutive, so that its coefficients are still in the cache.
    camera = tl.program_id(0) % cameras
    rows = tl.program_id(0) // cameras * block + tl.arange(0, block)[:, None]  # (g, 1)
    channel = tl.arange(0, 4)[None, :]
    here = rows < n
    seen = rows + camera.to(tl.int64) * n  # in tensors with a row for every camera
    across, down = tl.load(radii + 2 * seen, here, 0), tl.load(radii + 2 * seen + 1, here, 0)
    visible = (across > 0) & (down > 0)
    color = _block_colors(means, centre + 3 * camera, sh, rows, channel, visible, active, signed, coefficients, block)
    if packs:
        opacity = tl.load(opacities + rows, visible, 0.0)
        _write_record(colors, seen, pixels, conics, seen, opacity, color, channel, visible, record)
    else:
        tl.store(colors + seen * 3 + channel, color, here & (channel < 3))
    if describes:
        tl.store(visible_radii + seen, tl.where(visible, tl.maximum(across, down), 0), here)
        for side in tl.static_range(2):
            centred = tl.load(pixels + 2 * seen + side, visible, 0.5) - 0.5
            tl.store(visible_pixels + 2 * seen + side, centred, here)


@triton.jit(do_not_specialize=(*NOT_SPECIALIZED, "start"))  # type: ignore[untyped-decorator]  # Triton ships no types
def _stack_kernel(
    means: tl.tensor, centre: tl.tensor, sh: tl.tensor,
    opacities: tl.tensor, radii: tl.tensor, pixels: tl.tensor, depths: tl.tensor, conics: tl.tensor,
    all_radii: tl.tensor, all_pixels: tl.tensor, all_depths: tl.tensor, records: tl.tensor,
    n: int, active: int, signed: int, start: int,
    coefficients: tl.constexpr, record: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)[:, None]  # (g, 1)
    channel = tl.arange(0, 4)[None, :]
    here, pair = rows < n, (rows < n) & (channel < 2)
    placed = rows + start
    across, down = tl.load(radii + 2 * rows, here, 0), tl.load(radii + 2 * rows + 1, here, 0)
    visible = (across > 0) & (down > 0)
    color = _block_colors(means, centre, sh, rows, channel, visible, active, signed, coefficients, block)
    opacity = tl.load(opacities + rows, visible, 0.0)
    _write_record(records, placed, pixels, conics, rows, opacity, color, channel, visible, record)
    tl.store(all_radii + 2 * placed + channel, tl.load(radii + 2 * rows + channel, pair, 0), pair)
    tl.store(all_pixels + 2 * placed + channel, tl.load(pixels + 2 * rows + channel, pair, 0.0), pair)
    tl.store(all_depths + placed, tl.load(depths + rows, here, 0.0), here)


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _all_of_basis(
    derivative: tl.constexpr, k: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor, coefficients: tl.constexpr
) -> tl.tensor:
    """Return all spherical harmonics (k, g, 1), or with `derivative` 1 to 3 their derivatives by x, y or z."""
    # k is the same in all threads, so that the compiler decides the comparisons.
    found = tl.zeros_like(k + x[None])
    for i in tl.static_range(coefficients):
        if derivative == 0:
            found = tl.where(k == i, _basis(i, x, y, z)[None], found)
        if derivative == 1:
            found = tl.where(k == i, _basis_x(i, x, y, z)[None], found)
        if derivative == 2:
            found = tl.where(k == i, _basis_y(i, x, y, z)[None], found)
        if derivative == 3:
            found = tl.where(k == i, _basis_z(i, x, y, z)[None], found)
    return found


@triton.jit(do_not_specialize=NOT_SPECIALIZED)  # type: ignore[untyped-decorator]  # Triton ships no types
def _gradient_kernel(
    means: tl.tensor, centre: tl.tensor, sh: tl.tensor, radii: tl.tensor, colors: tl.tensor,
    scales: tl.tensor, opacities: tl.tensor,
    by_color: tl.tensor, by_mean: tl.tensor, by_scale: tl.tensor, by_opacity: tl.tensor,
    by_sh: tl.tensor, by_logit: tl.tensor,
    n: tl.tensor, cameras: int, active: int, signed: int,
    of_color: tl.constexpr, of_by_color: tl.constexpr, of_by_opacity: tl.constexpr,
    coefficients: tl.constexpr, padded: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    # A thread has one channel of a Gaussian with all coefficients, whose sums over cameras stay in its registers.
    rows = tl.program_id(0) * block + tl.arange(0, block)[:, None]  # (g, 1)
    channel = tl.arange(0, 4)[None, :]
    here, in_channel = rows < n, (rows < n) & (channel < 3)
    k = tl.arange(0, padded)[:, None, None]
    in_sh = (rows[None] * coefficients + k) * 3 + channel[None]  # (k, g, 4)
    given = in_channel[None] & (k < coefficients)
    sums = tl.zeros((padded, block, 4), tl.float32)
    coefficient = tl.zeros_like(sums)
    for i in tl.static_range(coefficients):  # one by one, which keeps them in the thread
        wanted = in_channel & (tl.full((1, 4), i, tl.int32) < active)
        one = tl.load(sh + (rows * coefficients + i) * 3 + channel, wanted, 0.0)
        coefficient = tl.where(k == i, one[None], coefficient)
    of_opacity = tl.zeros((block, 1), tl.float32)
    of_x, of_y, of_z = tl.zeros_like(of_opacity), tl.zeros_like(of_opacity), tl.zeros_like(of_opacity)
    mean = tl.load(means + 3 * rows + channel, in_channel, 0.0)
    camera = 0
    while camera < cameras:  # `range` of a tensor cannot be interpreted with NumPy 2.4
        seen = rows + camera * n.to(tl.int64)  # in tensors with a row for every camera
        visible = tl.min(tl.load(radii + 2 * seen + channel, here & (channel < 2), 1), 1)[:, None] > 0
        x, y, z, inverse = _view_directions(mean, centre + 3 * camera, channel, here & visible)
        flow = tl.load(by_color + of_by_color * seen + channel, in_channel & visible, 0.0)  # (g, 4)
        color = tl.load(colors + of_color * seen + channel, in_channel & visible, 0.0)
        flow = tl.where((signed != 0) | (color > 0.0), flow, 0.0)
        sums += _all_of_basis(0, k, x, y, z, coefficients) * flow[None]
        if coefficients > 1:
            weighted = coefficient * flow[None]
            in_x = tl.sum(tl.sum(_all_of_basis(1, k, x, y, z, coefficients) * weighted, 0), 1)[:, None]
            in_y = tl.sum(tl.sum(_all_of_basis(2, k, x, y, z, coefficients) * weighted, 0), 1)[:, None]
            in_z = tl.sum(tl.sum(_all_of_basis(3, k, x, y, z, coefficients) * weighted, 0), 1)[:, None]
            radial = in_x * x + in_y * y + in_z * z  # moving along the direction does not change it
            of_x += (in_x - radial * x) * inverse
            of_y += (in_y - radial * y) * inverse
            of_z += (in_z - radial * z) * inverse
        of_opacity += tl.load(by_opacity + of_by_opacity * seen, here, 0.0)
        camera += 1
    tl.store(by_sh + in_sh, tl.where(k < active, sums, 0.0), given)
    tl.debug_barrier()  # all threads have read what is written now
    there = 3 * rows + channel
    if coefficients > 1:
        moved = tl.where(channel == 0, of_x, tl.where(channel == 1, of_y, of_z))
        tl.store(by_mean + there, tl.load(by_mean + there, in_channel) + moved, in_channel)
    tl.store(by_scale + there, tl.load(by_scale + there, in_channel) * tl.load(scales + there, in_channel), in_channel)
    opacity = tl.load(opacities + rows, here, 0.0)
    tl.store(by_logit + rows, of_opacity * opacity * (1.0 - opacity), here)


def activate(log_scales: Tensor, opacity_logits: Tensor) -> tuple[Tensor, Tensor]:
    """Return exp (n, 3) and sigmoid (n,) in one kernel; all tensors of this module are contiguous float32."""
    scales, opacities = torch.empty_like(log_scales), torch.empty_like(opacity_logits)
    _launch(_activate_kernel, len(scales), (log_scales, opacity_logits, scales, opacities))
    return scales, opacities


def visible_colors(
    means: Tensor, centre: Tensor, sh: Tensor, degree: int, signed: bool, radii: Tensor, describes: bool,
    splats: tuple[Tensor, Tensor, Tensor], packs: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Return the colours of Gaussians that are visible to c cameras, and their radii and centres.

    Args:
        means: (n, 3).
        centre: (c, 3) of the cameras.
        sh: (n, k, 3).
        degree: highest to evaluate.
        signed: whether colours are the raw SH values.
        radii: (c, n, 2) gsplat's, int32; 0 where culled.
        describes: whether radii and centres are needed.
        splats: gsplat's centres (c, n, 2) and conics (c, n, 3), and opacities (n,).
        packs: write records.

    Returns:
        (c, n, 3) colours, 0 where culled; (c, n) radii and (c, n, 2) centres as in `RenderResult`, both empty unless
        described; records (c, n, RECORD). If there are records, colours are a view of them and
        neither means anything where culled; otherwise they are empty.
    """
    cameras, n = radii.shape[:2]
    written = means.new_empty(cameras, n, RECORD if packs else 3)
    visible_radii = radii.new_empty(cameras, n if describes else 0)
    visible_pixels = means.new_empty(cameras, n if describes else 0, 2)
    _launch(
        _color_kernel,
        n,
        (means, centre, sh, radii, *splats, written, visible_radii, visible_pixels),
        (cameras, (degree + 1) ** 2, int(signed)),
        programs=cameras,
        coefficients=sh.shape[1],
        describes=describes,
        packs=packs,
        record=RECORD,
    )
    if not packs:
        return written, visible_radii, visible_pixels, means.new_empty(0)
    return written[..., COLOR_IN_RECORD : COLOR_IN_RECORD + 3], visible_radii, visible_pixels, written


def write_to_stack(
    means: Tensor,
    centre: Tensor,
    sh: Tensor,
    opacities: Tensor,
    signed: bool,
    projected: Sequence[Tensor],
    stacked: Sequence[Tensor],
    start: int,
) -> None:
    """Write one field's projection and records to the tensors of a stack of fields.

    Args:
        means, sh, signed: as `visible_colors` takes them; all coefficients are evaluated.
        opacities: (n,).
        centre: (3,) of the camera.
        projected: gsplat's radii (n, 2), centres (n, 2), depths (n,) and conics (n, 3).
        stacked: radii, centres and depths of all fields, and records (m, RECORD); written from
            row `start` on, records where visible.
    """
    _launch(
        _stack_kernel,
        len(means),
        (means, centre, sh, opacities, *projected, *stacked),
        (sh.shape[1], int(signed), start),
        coefficients=sh.shape[1],
        record=RECORD,
    )


def finish_gradients(
    means: Tensor, centre: Tensor, sh: Tensor, degree: int, signed: bool, radii: Tensor, colors: Tensor,
    scales: Tensor, opacities: Tensor, by_color: Tensor, by_mean: Tensor, by_scale: Tensor, by_opacity: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return the gradients by SH (n, k, 3) and by opacities' logits (n,), and complete the others in place.

    Args:
        means, centre, sh, degree, signed, radii: arguments of `visible_colors`.
        colors: its result.
        scales, opacities: results of `activate`.
        by_color: (c, n, 3) gradients of each camera; this and the next may be views with other numbers between rows.
        by_opacity: (c, n) of each camera.
        by_mean: (n, 3) gradient summed over cameras; the part through the view direction is added.
        by_scale: (n, 3) gradient summed over cameras; becomes that by logarithms.
    """
    by_sh, by_logit, coefficients = torch.empty_like(sh), torch.empty_like(opacities), sh.shape[1]
    given = colors, scales, opacities, by_color, by_mean, by_scale, by_opacity
    _launch(
        _gradient_kernel,
        len(means),
        (means, centre, sh, radii, *given, by_sh, by_logit),
        (len(radii), (degree + 1) ** 2, int(signed)),
        block=BLOCK // 4,  # one channel of a Gaussian for each thread
        of_color=colors.stride(1),
        of_by_color=by_color.stride(1),
        of_by_opacity=by_opacity.stride(1),
        coefficients=coefficients,
        padded=triton.next_power_of_2(coefficients),
    )
    return by_sh, by_logit


def _launch(
    kernel: Any,
    n: int,
    given: tuple[Tensor, ...],
    numbers: tuple[int, ...] = (),
    programs: int = 1,
    block: int = BLOCK,
    **constants: int,
) -> None:
    """Start a kernel with `programs` programs for each block of Gaussians."""
    kernel[(triton.cdiv(n, block) * programs,)](*given, n, *numbers, block=block, **constants, **FUSED)
