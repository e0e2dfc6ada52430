"""What is done for each Gaussian before and after gsplat's own kernels, in Triton.

As PyTorch operations the activations, colours and gradients of one render are some forty launches, and at 800x533 a
processor launches for longer than a GPU computes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

GAUSSIANS = 128
"""In a block. A row of 4 threads takes one: its 3 channels and, which is what Triton's powers of 2 cost, nothing."""

# Compiled anew, for half a second each, is what differs in the number of coefficients alone: the degree in use grows
# while a stage is trained, and bases and residuals come by turns.
OF_ANY_VALUE = ("n", "cameras", "active", "signed")


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _basis(k: tl.constexpr, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tl.tensor:  # noqa: PLR0911, PLR0912  # a return for each k, of which Triton compiles one
    """The k-th real spherical harmonic of a unit direction, in the order and with the signs of 3DGS."""
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
    """The derivative of `_basis` by x."""
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
    """The derivative of `_basis` by y."""
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
    """The derivative of `_basis` by z."""
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
def _towards(means: tl.tensor, centre: tl.tensor, rows: tl.tensor, there: tl.tensor) -> tl.tensor:
    """Unit directions x, y, z from the camera's centre, and one over the distances."""
    x = tl.load(means + 3 * rows, there, 1.0) - tl.load(centre)
    y = tl.load(means + 3 * rows + 1, there, 1.0) - tl.load(centre + 1)
    z = tl.load(means + 3 * rows + 2, there, 1.0) - tl.load(centre + 2)
    inverse = 1.0 / tl.sqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@triton.jit  # type: ignore[untyped-decorator]  # Triton ships no types
def _colored(
    means: tl.tensor, centre: tl.tensor, sh: tl.tensor, rows: tl.tensor, channel: tl.tensor, shown: tl.tensor,
    active: int, signed: int, coefficients: tl.constexpr, block: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Colours (g, 4) of a block, the last channel of no meaning."""
    x, y, z, _ = _towards(means, centre, rows, shown)
    color = tl.zeros((block, 4), tl.float32)
    for k in tl.static_range(coefficients):
        wanted = shown & (channel < 3) & (k < active)
        color += _basis(k, x, y, z) * tl.load(sh + (rows * coefficients + k) * 3 + channel, wanted, 0.0)
    return tl.where(signed != 0, color, tl.maximum(color + 0.5, 0.0))


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


@triton.jit(do_not_specialize=OF_ANY_VALUE)  # type: ignore[untyped-decorator]  # Triton ships no types
def _color_kernel(
    means: tl.tensor, centre: tl.tensor, sh: tl.tensor, radii: tl.tensor, pixels: tl.tensor,
    colors: tl.tensor, shown_radii: tl.tensor, shown_pixels: tl.tensor,
    n: int, cameras: int, active: int, signed: int,
    coefficients: tl.constexpr, describes: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    # Cameras of one block follow each other, so that its coefficients are still in the cache.
    camera = tl.program_id(0) % cameras
    rows = tl.program_id(0) // cameras * block + tl.arange(0, block)[:, None]  # (g, 1)
    channel = tl.arange(0, 4)[None, :]
    here = rows < n
    seen = rows + camera.to(tl.int64) * n  # in what there is of every camera
    across, down = tl.load(radii + 2 * seen, here, 0), tl.load(radii + 2 * seen + 1, here, 0)
    shown = (across > 0) & (down > 0)
    color = _colored(means, centre + 3 * camera, sh, rows, channel, shown, active, signed, coefficients, block)
    tl.store(colors + seen * 3 + channel, color, here & (channel < 3))
    if describes:
        tl.store(shown_radii + seen, tl.where(shown, tl.maximum(across, down), 0), here)
        for side in tl.static_range(2):
            centred = tl.load(pixels + 2 * seen + side, shown, 0.5) - 0.5
            tl.store(shown_pixels + 2 * seen + side, centred, here)


@triton.jit(do_not_specialize=(*OF_ANY_VALUE, "start"))  # type: ignore[untyped-decorator]  # Triton ships no types
def _place_kernel(
    means: tl.tensor, centre: tl.tensor, sh: tl.tensor,
    radii: tl.tensor, pixels: tl.tensor, depths: tl.tensor, conics: tl.tensor,
    all_radii: tl.tensor, all_pixels: tl.tensor, all_depths: tl.tensor, all_conics: tl.tensor, all_colors: tl.tensor,
    n: int, active: int, signed: int, start: int, coefficients: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)[:, None]  # (g, 1)
    channel = tl.arange(0, 4)[None, :]
    here, pair, triple = rows < n, (rows < n) & (channel < 2), (rows < n) & (channel < 3)
    placed = rows + start
    across, down = tl.load(radii + 2 * rows, here, 0), tl.load(radii + 2 * rows + 1, here, 0)
    shown = (across > 0) & (down > 0)
    color = _colored(means, centre, sh, rows, channel, shown, active, signed, coefficients, block)
    tl.store(all_colors + 3 * placed + channel, color, triple)
    tl.store(all_radii + 2 * placed + channel, tl.load(radii + 2 * rows + channel, pair, 0), pair)
    tl.store(all_pixels + 2 * placed + channel, tl.load(pixels + 2 * rows + channel, pair, 0.0), pair)
    tl.store(all_conics + 3 * placed + channel, tl.load(conics + 3 * rows + channel, triple, 0.0), triple)
    tl.store(all_depths + placed, tl.load(depths + rows, here, 0.0), here)


@triton.jit(do_not_specialize=OF_ANY_VALUE)  # type: ignore[untyped-decorator]  # Triton ships no types
def _gradient_kernel(
    means: tl.tensor, centre: tl.tensor, sh: tl.tensor, radii: tl.tensor, colors: tl.tensor,
    scales: tl.tensor, opacities: tl.tensor,
    by_color: tl.tensor, by_mean: tl.tensor, by_scale: tl.tensor, by_opacity: tl.tensor, by_sh: tl.tensor,
    n: tl.tensor, cameras: int, active: int, signed: int, coefficients: tl.constexpr, block: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)[:, None]  # (g, 1)
    channel = tl.arange(0, 4)[None, :]
    here, in_channel = rows < n, (rows < n) & (channel < 3)
    of_opacity = tl.zeros((block, 1), tl.float32)
    for camera in range(cameras):
        seen = rows + camera * n.to(tl.int64)  # in what there is of every camera
        shown = (tl.load(radii + 2 * seen, here, 0) > 0) & (tl.load(radii + 2 * seen + 1, here, 0) > 0)
        x, y, z, inverse = _towards(means, centre + 3 * camera, rows, shown)
        flow = tl.load(by_color + 3 * seen + channel, shown & (channel < 3), 0.0)  # (g, 4)
        color = tl.load(colors + 3 * seen + channel, shown & (channel < 3), 0.0)
        flow = tl.where((signed != 0) | (color > 0.0), flow, 0.0)
        along_x, along_y, along_z = tl.zeros_like(flow), tl.zeros_like(flow), tl.zeros_like(flow)
        first = camera == 0
        for k in tl.static_range(coefficients):
            there = (rows * coefficients + k) * 3 + channel
            used = tl.where(k < active, flow, 0.0)
            # Of the cameras before; the first one writes every row, later ones what they show.
            before = tl.load(by_sh + there, shown & (channel < 3) & (camera > 0), 0.0)
            tl.store(by_sh + there, before + _basis(k, x, y, z) * used, in_channel & (shown | first))
            weighed = used * tl.load(sh + there, shown & (channel < 3) & (k < active), 0.0)
            along_x += _basis_x(k, x, y, z) * weighed
            along_y += _basis_y(k, x, y, z) * weighed
            along_z += _basis_z(k, x, y, z) * weighed
        if coefficients > 1:
            in_x = tl.sum(along_x, 1)[:, None]
            in_y = tl.sum(along_y, 1)[:, None]
            in_z = tl.sum(along_z, 1)[:, None]
            radial = in_x * x + in_y * y + in_z * z  # a direction does not change along itself
            mean = by_mean + 3 * rows
            tl.store(mean, tl.load(mean, shown, 0.0) + (in_x - radial * x) * inverse, shown)
            tl.store(mean + 1, tl.load(mean + 1, shown, 0.0) + (in_y - radial * y) * inverse, shown)
            tl.store(mean + 2, tl.load(mean + 2, shown, 0.0) + (in_z - radial * z) * inverse, shown)
        of_opacity += tl.load(by_opacity + seen, here, 0.0)
        tl.debug_barrier()  # the next camera's threads read what others of this block have written
    there = 3 * rows + channel
    tl.store(by_scale + there, tl.load(by_scale + there, in_channel) * tl.load(scales + there, in_channel), in_channel)
    opacity = tl.load(opacities + rows, here, 0.0)
    tl.store(by_opacity + rows, of_opacity * opacity * (1.0 - opacity), here)


def activated(log_scales: Tensor, opacity_logits: Tensor) -> tuple[Tensor, Tensor]:
    """exp (n, 3) and sigmoid (n,) in one kernel; contiguous float32, as all that follows."""
    scales, opacities = torch.empty_like(log_scales), torch.empty_like(opacity_logits)
    _launch(_activate_kernel, len(scales), (log_scales, opacity_logits, scales, opacities))
    return scales, opacities


def colors_of_shown(
    means: Tensor, centre: Tensor, sh: Tensor, degree: int, signed: bool, radii: Tensor, pixels: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours of the Gaussians that each of c cameras shows, and what densification looks at.

    Args:
        means: (n, 3).
        centre: (c, 3) of the cameras.
        sh: (n, k, 3).
        degree: highest to evaluate.
        signed: whether colours are the raw values.
        radii: (c, n, 2) gsplat's, int32; 0 where culled.
        pixels: (c, n, 2) gsplat's centres, or None where nobody looks at them.

    Returns:
        (c, n, 3) colours, 0 where culled; (c, n) radii and (c, n, 2) centres as `RenderResult` has them, both empty
        where `pixels` is None.
    """
    (cameras, n), describes = radii.shape[:2], pixels is not None
    colors = means.new_empty(cameras, n, 3)
    shown_radii = radii.new_empty(cameras, n if describes else 0)
    shown_pixels = means.new_empty(cameras, n if describes else 0, 2)
    _launch(
        _color_kernel,
        n,
        (means, centre, sh, radii, means if pixels is None else pixels, colors, shown_radii, shown_pixels),
        (cameras, (degree + 1) ** 2, int(signed)),
        programs=cameras,
        coefficients=sh.shape[1],
        describes=describes,
    )
    return colors, shown_radii, shown_pixels


def place_seen(
    means: Tensor,
    centre: Tensor,
    sh: Tensor,
    signed: bool,
    found: Sequence[Tensor],
    placed: Sequence[Tensor],
    start: int,
) -> None:
    """Put what a camera sees of one field, and its colours, where the fields of a view are in one list.

    Args:
        means, sh, signed: as `colors_of_shown` takes them; all coefficients are evaluated.
        centre: (3,) of the camera.
        found: gsplat's radii (n, 2), centres (n, 2), depths (n,) and conics (n, 3).
        placed: the same of all fields, and colours (m, 3); written from row `start` on.
    """
    _launch(
        _place_kernel,
        len(means),
        (means, centre, sh, *found, *placed),
        (sh.shape[1], int(signed), start),
        coefficients=sh.shape[1],
    )


def finish_gradients(
    means: Tensor, centre: Tensor, sh: Tensor, degree: int, signed: bool, radii: Tensor, colors: Tensor,
    scales: Tensor, opacities: Tensor, by_color: Tensor, by_mean: Tensor, by_scale: Tensor, by_opacity: Tensor,
) -> Tensor:  # fmt: skip
    """The gradient by SH (n, k, 3), summed over c cameras; others become by mean, logarithm and logit in place.

    Args:
        means, centre, sh, degree, signed, radii: as `colors_of_shown` took them.
        colors: what it gave.
        scales, opacities: what `activated` gave.
        by_color: (c, n, 3) gradients of each camera.
        by_mean, by_scale: (n, 3) gradients, summed over cameras; by_mean without the way over the direction of view.
        by_opacity: (c, n) of each camera; the first row becomes the sum by logits.
    """
    by_sh = torch.empty_like(sh)
    _launch(
        _gradient_kernel,
        len(means),
        (means, centre, sh, radii, colors, scales, opacities, by_color, by_mean, by_scale, by_opacity, by_sh),
        (len(radii), (degree + 1) ** 2, int(signed)),
        coefficients=sh.shape[1],
    )
    return by_sh


def _launch(
    kernel: Any, n: int, given: tuple[Tensor, ...], numbers: tuple[int, ...] = (), programs: int = 1, **constants: int
) -> None:
    """Start a kernel with so many programs for each block of Gaussians."""
    kernel[(triton.cdiv(n, GAUSSIANS) * programs,)](*given, n, *numbers, block=GAUSSIANS, **constants)
