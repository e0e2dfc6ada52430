"""Evaluate colours by spherical harmonics, and their gradients, in Triton."""

from __future__ import annotations

import triton
import triton.language as tl

from lapgs_plugin.gpu_raster.memory_kernels import load_four, load_three, store_three

# Kernels are only compiled anew for another number of coefficients: the active degree grows during a stage, and bases
# and residuals alternate.
NOT_SPECIALIZED = ("n", "cameras", "active", "signed")


@triton.jit
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


@triton.jit
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


@triton.jit
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


@triton.jit
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


@triton.jit
def is_visible(radii: tl.tensor, placed: tl.tensor) -> tl.tensor:
    return (tl.load(radii + 2 * placed) > 0) & (tl.load(radii + 2 * placed + 1) > 0)


@triton.jit
def direction_to(centre: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor, visible: tl.tensor) -> tl.tensor:
    """Return unit directions from a camera's centre to visible means, and one over their distances."""
    centre_x, centre_y, centre_z = load_three(centre)
    x, y, z = x - centre_x, y - centre_y, z - centre_z
    near = 1.0 / tl.sqrt(tl.where(visible, x * x + y * y + z * z, 1.0))
    return x * near, y * near, z * near, near


@triton.jit
def _coefficient(
    first: tl.tensor, sh: tl.tensor, row: tl.tensor, k: tl.constexpr, coefficients: tl.constexpr, apart: tl.constexpr
) -> tl.tensor:
    """Return where the k-th coefficient of each row is in memory: in `first` (n, 1, 3), if that is apart, or `sh`."""
    if apart:
        return first + 3 * row if k == 0 else sh + row * (3 * (coefficients - 1)) + 3 * (k - 1)
    return sh + row * (3 * coefficients) + 3 * k


@triton.jit
def color_of(
    first: tl.tensor, sh: tl.tensor, row: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor, active: int,
    coefficients: tl.constexpr, apart: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return red, green and blue of rows seen in unit directions, by the first `active` coefficients.

    Without coefficients `sh` (n, 3) are the colours.
    """
    if coefficients == 0:
        return load_three(sh + 3 * row)
    start = sh + row * (3 * coefficients)
    red, green, blue = 0.0 * x, 0.0 * x, 0.0 * x
    if coefficients % 4 == 0 and not apart:  # then rows begin at multiples of 16 bytes
        for k in tl.static_range(0, coefficients, 4):
            if k < active:  # coefficients that are not in use are 0 or wait for their degree
                r0, g0, b0, r1 = load_four(start + 3 * k)
                g1, b1, r2, g2 = load_four(start + 3 * k + 4)
                b2, r3, g3, b3 = load_four(start + 3 * k + 8)
                f0, f1 = _used_basis(k, x, y, z, active), _used_basis(k + 1, x, y, z, active)
                f2, f3 = _used_basis(k + 2, x, y, z, active), _used_basis(k + 3, x, y, z, active)
                red += f0 * r0 + f1 * r1 + f2 * r2 + f3 * r3
                green += f0 * g0 + f1 * g1 + f2 * g2 + f3 * g3
                blue += f0 * b0 + f1 * b1 + f2 * b2 + f3 * b3
    else:
        for k in tl.static_range(coefficients):
            factor = _used_basis(k, x, y, z, active)
            r0, g0, b0 = load_three(_coefficient(first, sh, row, k, coefficients, apart))
            red += factor * r0
            green += factor * g0
            blue += factor * b0
    return red, green, blue


@triton.jit
def _is_used(k: tl.constexpr, active: int) -> tl.tensor:
    return tl.full((1,), k, tl.int32) < active  # as a block: a number in a mask cannot be interpreted


@triton.jit
def _used_basis(k: tl.constexpr, x: tl.tensor, y: tl.tensor, z: tl.tensor, active: int) -> tl.tensor:
    """Return the k-th spherical harmonic, 0 if it is not active."""
    return tl.where(_is_used(k, active), _basis(k, x, y, z), 0.0)


@triton.jit
def _slopes(
    k: tl.constexpr, x: tl.tensor, y: tl.tensor, z: tl.tensor, active: int,
    red: tl.tensor, green: tl.tensor, blue: tl.tensor, of_red: tl.tensor, of_green: tl.tensor, of_blue: tl.tensor,
) -> tl.tensor:  # fmt: skip
    """Return what the k-th spherical harmonic adds to the gradient by x, y and z of the direction."""
    weight = red * of_red + green * of_green + blue * of_blue
    weight = tl.where(_is_used(k, active), weight, 0.0)
    return _basis_x(k, x, y, z) * weight, _basis_y(k, x, y, z) * weight, _basis_z(k, x, y, z) * weight


@triton.jit
def _by_direction(
    first: tl.tensor, sh: tl.tensor, row: tl.tensor, x: tl.tensor, y: tl.tensor, z: tl.tensor, active: int,
    of_red: tl.tensor, of_green: tl.tensor, of_blue: tl.tensor, coefficients: tl.constexpr, apart: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Return the gradient by x, y and z of the directions from that by colours."""
    start = sh + row * (3 * coefficients)
    by_x, by_y, by_z = 0.0 * x, 0.0 * x, 0.0 * x
    if coefficients % 4 == 0 and not apart:
        for k in tl.static_range(0, coefficients, 4):
            if k < active:
                r0, g0, b0, r1 = load_four(start + 3 * k)
                g1, b1, r2, g2 = load_four(start + 3 * k + 4)
                b2, r3, g3, b3 = load_four(start + 3 * k + 8)
                x0, y0, z0 = _slopes(k, x, y, z, active, r0, g0, b0, of_red, of_green, of_blue)
                x1, y1, z1 = _slopes(k + 1, x, y, z, active, r1, g1, b1, of_red, of_green, of_blue)
                x2, y2, z2 = _slopes(k + 2, x, y, z, active, r2, g2, b2, of_red, of_green, of_blue)
                x3, y3, z3 = _slopes(k + 3, x, y, z, active, r3, g3, b3, of_red, of_green, of_blue)
                by_x += x0 + x1 + x2 + x3
                by_y += y0 + y1 + y2 + y3
                by_z += z0 + z1 + z2 + z3
    else:
        for k in tl.static_range(1, coefficients):  # the first one is the same in all directions
            r0, g0, b0 = load_three(_coefficient(first, sh, row, k, coefficients, apart))
            x0, y0, z0 = _slopes(k, x, y, z, active, r0, g0, b0, of_red, of_green, of_blue)
            by_x += x0
            by_y += y0
            by_z += z0
    return by_x, by_y, by_z


@triton.jit
def _store_sh(
    by_first: tl.tensor, by_sh: tl.tensor, rows: tl.tensor, red: tl.tensor, green: tl.tensor, blue: tl.tensor,
    k: tl.tensor, here: tl.tensor, coefficients: tl.constexpr, apart: tl.constexpr,
) -> None:  # fmt: skip
    """Store red, green and blue (k, g) of each coefficient.

    Threads first exchange numbers, so that those beside each other store a row together: Triton gives the channels, and
    then the coefficients, to consecutive threads.
    """
    channel = tl.arange(0, 4)[None, None, :]
    values = tl.reshape(
        tl.join(tl.join(red, blue), tl.join(green, tl.zeros_like(red))), (red.shape[0], red.shape[1], 4)
    )
    k, rows = k[:, :, None], rows[None, :, None]
    wanted = here[None, :, None] & (channel < 3) & (k < coefficients)
    if apart:
        tl.store(by_first + 3 * (rows + 0 * k) + channel, values, wanted & (k == 0))
        tl.store(by_sh + (rows * (coefficients - 1) + k - 1) * 3 + channel, values, wanted & (k > 0))
    else:
        tl.store(by_sh + (rows * coefficients + k) * 3 + channel, values, wanted)


@triton.jit(do_not_specialize=NOT_SPECIALIZED)
def color_gradient_kernel(
    means: tl.tensor, centres: tl.tensor, sh: tl.tensor, first_sh: tl.tensor, radii: tl.tensor, records: tl.tensor,
    by_records: tl.tensor, by_mean: tl.tensor, by_sh: tl.tensor, by_first: tl.tensor,
    n: tl.tensor, cameras: int, active: int, signed: int,
    record: tl.constexpr, color_in_record: tl.constexpr, gradient: tl.constexpr,
    coefficients: tl.constexpr, padded: tl.constexpr, block: tl.constexpr, apart: tl.constexpr,
) -> None:  # fmt: skip
    rows = tl.program_id(0) * block + tl.arange(0, block)
    here, row = rows < n, tl.minimum(rows, n - 1)
    k = tl.arange(0, padded)[:, None]  # of sums, which a thread has in its registers
    red = tl.zeros((padded, block), tl.float32)
    green, blue = tl.zeros_like(red), tl.zeros_like(red)
    mean_x, mean_y, mean_z = load_three(means + 3 * row)
    by_x, by_y, by_z = 0.0 * mean_x, 0.0 * mean_x, 0.0 * mean_x
    camera = 0
    while camera < cameras:
        placed = camera * n + row
        visible = is_visible(radii, placed)
        placed = tl.where(visible, placed, 0)  # so that memory of others is not read
        of_red, of_green, of_blue, _ = load_four(by_records + placed * gradient)
        color_r, color_g, color_b, _ = load_four(records + placed * record + color_in_record)
        of_red = tl.where(visible & ((signed != 0) | (color_r > 0.0)), of_red, 0.0)
        of_green = tl.where(visible & ((signed != 0) | (color_g > 0.0)), of_green, 0.0)
        of_blue = tl.where(visible & ((signed != 0) | (color_b > 0.0)), of_blue, 0.0)
        x, y, z, near = direction_to(centres + 3 * camera, mean_x, mean_y, mean_z, visible)
        basis = tl.zeros_like(red)
        for i in tl.static_range(coefficients):
            basis = tl.where(k == i, _used_basis(i, x, y, z, active)[None], basis)
        red += basis * of_red[None]
        green += basis * of_green[None]
        blue += basis * of_blue[None]
        if coefficients > 1:
            source = tl.where(visible, row, 0)
            in_x, in_y, in_z = _by_direction(
                first_sh, sh, source, x, y, z, active, of_red, of_green, of_blue, coefficients, apart
            )
            radial = in_x * x + in_y * y + in_z * z  # moving along the direction does not change it
            by_x += (in_x - radial * x) * near
            by_y += (in_y - radial * y) * near
            by_z += (in_z - radial * z) * near
        camera += 1
    _store_sh(by_first, by_sh, rows, red, green, blue, k, here, coefficients, apart)
    if coefficients > 1:
        before_x, before_y, before_z = load_three(by_mean + 3 * row)
        store_three(by_mean + 3 * rows, before_x + by_x, before_y + by_y, before_z + by_z, here)
