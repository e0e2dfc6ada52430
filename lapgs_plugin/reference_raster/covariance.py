"""Compute covariances in PyTorch for two options that the CPU kernels lack: given covariances, and antialiasing.

Gradients are those of the CUDA code; DEPARTURE marks where these are not the derivative of the image.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.jit.lanes import Floats
from lapgs_plugin.reference_raster.layout import (
    BLUR,
    FACTOR_SCALE,
    FACTOR_XX,
    FACTOR_XY,
    FACTOR_YY,
    FOCAL_X,
    FOCAL_Y,
    MIN_SHARE,
    NEAR_DEPTH,
    ROTATION,
    SLOT,
    SPLAT,
    SUM_UU,
    SUM_UV,
    SUM_VV,
    TRANSLATION,
    VANISHING,
)
from lapgs_plugin.reference_raster.oracle import projection_jacobians, rotation_matrices
from lapgs_plugin.reference_raster.pipeline import Kept, View


def matrices(covariances: Tensor) -> Tensor:
    """Return symmetric matrices (n, 3, 3) from their entries (n, 6): xx, xy, xz, yy, yz, zz."""
    return covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def principal_axes(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Return standard deviations (n, 3) and rotations (n, 4), wxyz, of Gaussians with these covariances (n, 6).

    Not differentiable: the axes of a covariance with equal eigenvalues are not functions of it.
    """
    variances, axes = torch.linalg.eigh(matrices(covariances.detach().double()))  # (n, 3), (n, 3, 3)
    axes[:, :, 0] *= torch.linalg.det(axes).sign()[:, None]  # no reflections
    xyzw = Rotation.from_matrix(axes.numpy()).as_quat() if len(axes) else np.zeros((0, 4))  # (n, 4)
    quats = torch.from_numpy(np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]]))
    return variances.clamp_min(0).sqrt().to(covariances.dtype), quats.to(covariances.dtype)


def covariances_of(scales: Tensor, quats: Tensor) -> Tensor:
    """Return covariances (n, 6) from standard deviations (n, 3) and quaternions (n, 4), used as they are."""
    root = rotation_matrices(quats) * scales[:, None, :]
    return (root @ root.mT).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]


def screen_covariances(means: Tensor, covariances: Tensor, view: View) -> Tensor:
    """Return entries xx, xy, yy (n, 3) of the 2D covariances in px^2, without the blur.

    Behind the camera they have no meaning.

    Args:
        means: (n, 3) in world coordinates.
        covariances: (n, 6) in world coordinates.
    """
    camera = torch.from_numpy(view.camera).to(means)
    rotation = camera[ROTATION : ROTATION + 9].reshape(3, 3)
    points = means @ rotation.T + camera[TRANSLATION : TRANSLATION + 3]
    points = torch.where(points[:, 2:] > NEAR_DEPTH, points, 1.0)
    focal_x, focal_y = float(view.camera[FOCAL_X]), float(view.camera[FOCAL_Y])
    tangents = view.width / (2 * focal_x), view.height / (2 * focal_y)
    root = projection_jacobians(points, (focal_x, focal_y), tangents) @ rotation  # (n, 2, 3)
    return (root @ matrices(covariances) @ root.mT).reshape(-1, 4)[:, [0, 1, 3]]


class _Antialiasing(torch.autograd.Function):
    """Map 2D covariances (n, 3) without the blur, and its variance, to factors (n,) on the opacities."""

    @staticmethod
    def forward(ctx: Any, covariances: Tensor, blur: float) -> Tensor:
        xx, xy, yy = covariances.unbind(1)
        wide = covariances + covariances.new_tensor([blur, 0, blur])
        share = (xx * yy - xy * xy) / (wide[:, 0] * wide[:, 2] - xy * xy)
        factors = share.clamp_min(MIN_SHARE).sqrt()
        ctx.save_for_backward(wide, share, factors)
        ctx.blur = blur
        return factors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_factors: Tensor) -> tuple[Tensor, None]:
        wide, share, factors = ctx.saved_tensors
        x, z, y = wide.unbind(1)
        w = ctx.blur
        # DEPARTURE: the CUDA code differentiates the share at covariances that already have the blur, and not at those
        # that the share is computed from.
        d_share = torch.where(share <= MIN_SHARE, 0.0, grad_factors / (2 * factors))
        common = w * d_share / ((x + w) * (y + w) - z * z) ** 2
        return torch.stack([(w * y + y * y + z * z) * common, -2 * z * (w + x + y) * common,
                            (w * x + x * x + z * z) * common], 1), None  # fmt: skip


def antialiasing_factors(means: Tensor, covariances: Tensor, view: View, exact: bool) -> Tensor:
    """Return the factors (n, 1) of antialiasing on opacities: sqrt(|Sigma| / |Sigma + blur|).

    They are computed in float64, because the determinant of a long Gaussian is a small difference of large products.

    Args:
        means, covariances, view: as `screen_covariances` takes them.
        exact: as in Mip-Splatting, see `layout.VANISHING`; else with graphdeco's lower bound and gradient.
    """
    on_screen = screen_covariances(means.double(), covariances.double(), view)
    blur = float(view.camera[BLUR])
    factors: Tensor = (
        _exact_factors(on_screen, blur) if exact else _Antialiasing.apply(on_screen, blur)  # type: ignore[no-untyped-call]  # torch's
    )
    return factors[:, None].to(means.dtype)


def _exact_factors(covariances: Tensor, blur: float) -> Tensor:
    xx, xy, yy = covariances.unbind(1)
    own, wide = xx * yy - xy * xy, (xx + blur) * (yy + blur) - xy * xy
    shown = own > VANISHING
    share = torch.where(shown, own, 1.0) / (wide + VANISHING)
    return torch.where(shown, (share + VANISHING).sqrt(), 0.0)


def covariance_gradients(means: Tensor, covariances: Tensor, view: View, kept: Kept, slots: Floats) -> Tensor:
    """Return the derivative of the loss by given covariances, (n, 6), from `Gradients.slots`."""
    n = len(means)
    uu, uv, vv = (torch.from_numpy(np.bincount(kept.members, slots[i::SLOT], n)) for i in (SUM_UU, SUM_UV, SUM_VV))
    seen = torch.from_numpy(np.diff(kept.first_pair) > 0)
    splats = torch.from_numpy(kept.splats.reshape(-1, SPLAT)[:n]).double()
    # With the inverse covariance L^T L the derivative is L^T ((uu, uv), (uv, vv)) L / 2; off the diagonal, twice.
    l_xx, l_xy, l_yy = (splats[:, i] / FACTOR_SCALE for i in (FACTOR_XX, FACTOR_XY, FACTOR_YY))
    mixed = l_xy * uu + l_yy * uv
    entries = torch.stack([l_xx * l_xx * uu / 2, l_xx * mixed, (l_xy * mixed + l_yy * (l_xy * uv + l_yy * vv)) / 2], 1)
    by_screen = torch.where(seen[:, None], entries / FACTOR_SCALE**2, 0.0)
    leaf = covariances.detach().double().requires_grad_(True)
    with torch.enable_grad():
        on_screen = screen_covariances(means.detach().double(), leaf, view)
    (gradient,) = torch.autograd.grad(on_screen, leaf, by_screen)
    return gradient.to(covariances.dtype)
