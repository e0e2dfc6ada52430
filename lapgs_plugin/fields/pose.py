"""Correct the poses of cameras, and differentiate renders by them.

A correction is six numbers: a rotation vector w in radians and a translation t in world units. It turns a camera about
its own centre and then moves it, both along the axes of the world: R' = R exp([w]x), centre' = centre + t.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.fields.spherical_harmonics import MAX_SH_DEGREE, sh_basis


def corrected(camera: Camera, correction: Sequence[float]) -> Camera:
    """Return a camera with its pose corrected, in its own precision."""
    numbers = torch.tensor(correction, dtype=torch.float64, device=camera.world_to_camera.device)
    vector, shift = numbers[:3], numbers[3:]
    pose = camera.world_to_camera.double()
    rotation = pose[:3, :3] @ torch.linalg.matrix_exp(_cross_matrix(vector))
    centre = camera.to(dtype=torch.float64).position + shift
    moved = torch.cat([torch.cat([rotation, -(rotation @ centre)[:, None]], dim=1), pose[3:]])
    return replace(camera, world_to_camera=moved.to(camera.world_to_camera))


def turned_gradient(vectors: Tensor, by_turn: Tensor) -> Tensor:
    """Return gradients (v, 3) by rotation vectors from those by a small further turn, R exp([w]x) exp([turn]x)."""
    total, term = by_turn.clone(), by_turn
    for order in range(2, 9):  # the transposed right Jacobian of the exponential map, as a series
        term = torch.linalg.cross(vectors, term) / order
        total += term
    return total


def with_pose_gradient(field: GaussianField, movement: Tensor, centre: Tensor, unit: float) -> GaussianField:
    """Return the same field, whose gradients are also passed on to the pose of the camera that renders it.

    A camera that moves sees the scene move the other way. So the gradient by its pose follows from those by the
    Gaussians, for any rasterizer.

    Args:
        field: for one render of one camera; parameters require gradients.
        movement: (6,) of any value; its gradient is that by a small turn of the camera about its centre, in radians,
            and a small shift, both along the axes of the world.
        centre: (3,) of the camera, on the field's device.
        unit: length of a shift by 1, in world units.
    """
    names = ("means", "quaternions", "sh")
    values = _PassOn.apply(movement, centre, unit, *(field.parameters[name] for name in names))  # type: ignore[no-untyped-call]  # torch's
    return field.with_parameters(dict(zip(names, values, strict=True)))


class _PassOn(torch.autograd.Function):
    """Return means, quaternions and SH unchanged, and pass their gradients on to the movement too."""

    @staticmethod
    def forward(
        ctx: Any, movement: Tensor, centre: Tensor, unit: float, means: Tensor, quaternions: Tensor, sh: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        ctx.save_for_backward(centre, means, quaternions, sh)
        ctx.unit = unit
        return means.view_as(means), quaternions.view_as(quaternions), sh.view_as(sh)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_means: Tensor, by_quaternions: Tensor, by_sh: Tensor) -> tuple[Tensor | None, ...]:
        centre, means, quaternions, sh = ctx.saved_tensors
        turn = torch.linalg.cross(means - centre, by_means).sum(0) + _turn_of_gaussians(quaternions, by_quaternions)
        # `by_means` also moves the direction in which colour is seen, which a turn of the camera does not change.
        turn = turn - _turn_of_colors(sh, by_sh)
        by_movement = torch.cat([turn, -ctx.unit * by_means.sum(0)])
        return by_movement, None, None, by_means, by_quaternions, by_sh


def _turn_of_gaussians(quaternions: Tensor, by_quaternions: Tensor) -> Tensor:
    """Return the gradient (3,) by a turn of all Gaussians, each about its centre; quaternions are wxyz."""
    (w, axis), (by_w, by_axis) = ((part[:, :1], part[:, 1:]) for part in (quaternions, by_quaternions))
    turn: Tensor = 0.5 * (w * by_axis - by_w * axis + torch.linalg.cross(axis, by_axis)).sum(0)
    return turn


def _turn_of_colors(sh: Tensor, by_sh: Tensor) -> Tensor:
    """Return the gradient (3,) by a turn of all directions in which colours are seen."""
    columns = sh.shape[1]
    if columns == 1:
        return sh.new_zeros(3)
    products = (sh.flatten(1).T @ by_sh.flatten(1)).view(columns, 3, columns, 3)
    by_pair = products.diagonal(dim1=1, dim2=3).sum(-1)  # (k, k), summed over Gaussians and channels
    return (_generators(sh.dtype, sh.device)[:, :columns, :columns] * by_pair).sum((1, 2))


@lru_cache(maxsize=4)
@torch.inference_mode(False)  # cached for later calls, which may need gradients
def _generators(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return (3, 16, 16) G of (d x grad) Y_k(d) = sum over j of G[:, k, j] Y_j(d), by least squares."""
    directions = torch.randn(100, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(directions, dim=1)
    leaf = directions.clone().requires_grad_()
    slopes: Tensor  # (16, 100, 3)
    slopes = torch.autograd.functional.jacobian(lambda at: sh_basis(at, MAX_SH_DEGREE).sum(0), leaf)  # type: ignore[no-untyped-call]  # torch's
    turned = torch.linalg.cross(directions.expand_as(slopes), slopes).permute(1, 0, 2)  # (100, 16, 3)
    solution: Tensor = torch.linalg.lstsq(sh_basis(directions, MAX_SH_DEGREE), turned.flatten(1)).solution
    return solution.view(16, 16, 3).permute(2, 1, 0).to(device, dtype)  # from j, k, axis


def _cross_matrix(vector: Tensor) -> Tensor:
    """Return the (3, 3) matrix whose product with u is the cross product of a vector with u."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
