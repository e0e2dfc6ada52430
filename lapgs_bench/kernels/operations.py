"""Time every operation in the versions that this machine has, each against plain PyTorch in one run."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.ops import (
    adam,
    bilateral_grid,
    color_transform,
    densification_statistics,
    photometric_loss,
    position_noise,
    regularization,
    upsample,
)
from lapgs_plugin.ops.adam import multi_tensor
from lapgs_plugin.ops.adam.in_torch import AdamSlot, step_torch
from lapgs_plugin.ops.adam.on_cpu import FieldAdam
from lapgs_plugin.ops.bilateral_grid.in_torch import add_variation_torch, slice_grids_torch
from lapgs_plugin.ops.color_transform.in_torch import transform_colors_torch
from lapgs_plugin.ops.densification_statistics.in_torch import add_statistics_torch
from lapgs_plugin.ops.photometric_loss.in_torch import DEFAULT_SSIM_WEIGHT, photometric_loss_torch
from lapgs_plugin.ops.position_noise.in_torch import displacements
from lapgs_plugin.ops.regularization.in_torch import add_regularization_torch
from lapgs_plugin.ops.self_check import SelfCheck

NUMBA = "Numba"
TORCH = "PyTorch"
"""The version that the others are compared with; its SSIM is kornia's."""


class Version(NamedTuple):
    """Do an operation once with `run`, which returns the result or updates the tensor `result`."""

    run: Callable[[], object]
    result: Tensor | None = None


Versions = dict[str, Version]
_Operation = TypeVar("_Operation", bound=Callable[..., object])


@dataclass(frozen=True)
class OpTime:
    """Hold the time of one version of an operation.

    Attributes:
        milliseconds: median over all turns.
        busy: milliseconds in which the GPU runs it, without waiting for the processor; None on a CPU.
        ratio: time of the PyTorch version over this one's.
        difference: largest difference from the PyTorch version's result after one call.
    """

    op: str
    version: str
    milliseconds: float
    busy: float | None
    ratio: float
    difference: float


def benchmark(
    device: torch.device, width: int, height: int, gaussians: int, repeats: int, only: str = ""
) -> list[OpTime]:
    """Time operations; the versions of one take turns, so that a change in the machine's load meets all of them.

    Args:
        device: of all tensors.
        width, height: of images.
        gaussians: of the field.
        repeats: turns of each version.
        only: part of the names of the operations to time.
    """
    ours = "Triton" if device.type == "cuda" else NUMBA
    generator = torch.Generator().manual_seed(0)
    images = [torch.rand(3, height, width, generator=generator).to(device) for _ in range(2)]
    coarse = torch.rand(3, (height + 1) // 2, (width + 1) // 2, generator=generator).to(device)
    operations: dict[str, Callable[[], Versions]] = {
        "upsample": lambda: _upsample_versions(ours, coarse, images[0]),
        "photometric loss": lambda: _loss_versions(ours, images[0], images[1]),
        "residual's loss": lambda: _loss_versions(ours, images[0], images[1], coarse),
        "Adam": lambda: _adam_versions(ours, gaussians, device),
        "densification statistics": lambda: _statistics_versions(ours, gaussians, device),
        "regularization": lambda: _regularization_versions(ours, gaussians, device),
        "position noise": lambda: _noise_versions(ours, gaussians, device),
        "colour transform": lambda: _transform_versions(images[0]),
        "bilateral grid": lambda: _grid_versions(images[0]),
        "variation of 50 grids": lambda: _variation_versions((width, height), device),
    }
    if device.type == "cuda":
        operations["Adam of a checkout"] = lambda: _checkout_adam_versions(gaussians, device)
    return [one for op, versions in operations.items() if only in op for one in _time(op, versions(), device, repeats)]


def _time(op: str, versions: Versions, device: torch.device, repeats: int) -> list[OpTime]:
    results = {}
    for name, version in versions.items():
        returned = version.run()  # the first call compiles
        result = returned if version.result is None else version.result
        assert isinstance(result, Tensor)
        results[name] = result.detach().clone()
    seconds: dict[str, list[float]] = {name: [] for name in versions}
    wait: Callable[[], object] = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    for name, version in [*versions.items()] * repeats:
        with one_pool() if name == NUMBA else nullcontext():  # as in training
            wait()
            start = time.perf_counter()
            version.run()
            wait()
            seconds[name].append(time.perf_counter() - start)
    medians = {name: median(turns) for name, turns in seconds.items()}
    busy = {name: _busy(version.run) if device.type == "cuda" else None for name, version in versions.items()}
    differences = {name: float((result - results[TORCH]).abs().max()) for name, result in results.items()}
    return [
        OpTime(op, name, 1e3 * own, busy[name], medians[TORCH] / own, differences[name])
        for name, own in medians.items()
    ]


def _busy(run: Callable[[], object], calls: int = 10) -> float:
    """Return the GPU's milliseconds for one of several calls that wait for it in its queue."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]  # torch's
    torch.cuda._sleep(50_000_000)  # type: ignore[no-untyped-call]  # cycles, longer than it takes to start the calls
    start.record()
    for _ in range(calls):
        run()
    end.record()
    end.synchronize()
    return float(start.elapsed_time(end)) / calls


def _upsample_versions(ours: str, coarse: Tensor, fine: Tensor) -> Versions:
    pyramid, size = Pyramid(), (fine.shape[-2], fine.shape[-1])
    versions = {TORCH: Version(lambda: pyramid.up(coarse, size) + fine)}
    if ours == NUMBA or upsample.triton_works():
        versions[ours] = Version(lambda: upsample.upsample_add(pyramid, coarse, fine))
    if size[0] % 2 == size[1] % 2 == 0:  # kornia doubles sides exactly
        from kornia.geometry.transform import pyrup

        versions["kornia.pyrup"] = Version(lambda: pyrup(coarse[None])[0] + fine)
    return versions


def _loss_versions(ours: str, render: Tensor, target: Tensor, coarse: Tensor | None = None) -> Versions:
    """Return versions of the loss and its gradient, of a render or of Up(coarse) + render, with images as in training.

    A GPU renders interleaved colours, and stores the target as uint8 and the coarse image as float16.
    """
    pyramid, size = Pyramid(), (render.shape[-2], render.shape[-1])
    leaf = (render if ours == NUMBA else render.permute(1, 2, 0).contiguous().permute(2, 0, 1)).clone()
    leaf.requires_grad_()
    if ours != NUMBA:
        target, coarse = (255 * target).to(torch.uint8), None if coarse is None else coarse.half()

    def in_parts(loss: Callable[[Tensor, Tensor, float], Tensor]) -> Callable[[], Tensor]:
        """Return a loss of the composed image, with Up, decoding and the loss as operations of their own."""

        def composed_loss() -> Tensor:
            image = leaf if coarse is None else leaf + upsample.upsample(pyramid, coarse.float(), size)
            return loss(image, photometric_loss.decoded(target), DEFAULT_SSIM_WEIGHT)

        return composed_loss

    def whole() -> Tensor:
        image = leaf if coarse is None else upsample.upsample_add(pyramid, coarse, leaf)
        return photometric_loss.photometric_loss(image, target)

    losses = {TORCH: in_parts(photometric_loss_torch)}
    if ours != NUMBA and (fused := photometric_loss.fused_ssim()) is not None:
        losses["fused_ssim"] = in_parts(partial(photometric_loss_torch, mean_ssim=fused))
    if ours == NUMBA or photometric_loss.triton_works():
        losses[ours] = whole

    def gradient(loss: Callable[[], Tensor]) -> Tensor:
        return torch.autograd.grad(loss(), leaf)[0] * leaf.numel()  # times so many, so that values are about 1

    return {name: Version(partial(gradient, loss)) for name, loss in losses.items()}


def _transform_versions(image: Tensor) -> Versions:
    transform = torch.eye(3, 4, device=image.device).requires_grad_()
    leaf = image.clone().requires_grad_()

    def gradients_of(apply: Callable[[Tensor, Tensor], Tensor]) -> Version:
        return Version(lambda: torch.autograd.grad(apply(leaf, transform).sum(), (leaf, transform))[0])

    versions = {TORCH: gradients_of(transform_colors_torch)}
    if color_transform.triton_works(image):
        versions["Triton"] = gradients_of(color_transform.transform_colors)
    return versions


def _grid_versions(image: Tensor) -> Versions:
    """Return versions of slicing a grid and of both gradients, of an image with interleaved colours."""
    size = image.shape[-1], image.shape[-2]
    leaf = image.permute(1, 2, 0).contiguous().permute(2, 0, 1).requires_grad_()
    (grids,) = bilateral_grid.uniform_grids(torch.eye(3, 4, device=image.device)[None], bilateral_grid.grid_nodes(size))
    grids.requires_grad_()
    by_out = leaf.detach().flip(-1)

    def gradients_of(slice_grids: Callable[[Tensor, Tensor], Tensor]) -> Version:
        return Version(lambda: torch.autograd.grad(slice_grids(leaf, grids), (leaf, grids), by_out)[0])

    versions = {TORCH: gradients_of(slice_grids_torch)}
    if bilateral_grid.triton_works(image):
        versions["Triton"] = gradients_of(bilateral_grid.slice_grids)
    return versions


def _variation_versions(size: tuple[int, int], device: torch.device) -> Versions:
    nodes = bilateral_grid.grid_nodes(size)
    grids = torch.rand(50, *nodes, 12, generator=torch.Generator().manual_seed(0)).to(device)

    def version(add: Callable[[Tensor, Tensor, float], None]) -> Version:
        by_grids = torch.zeros_like(grids)
        return Version(lambda: add(grids, by_grids, 1.0), by_grids)

    versions = {TORCH: version(add_variation_torch)}
    if bilateral_grid.triton_works(grids):
        versions["Triton"] = version(bilateral_grid.add_variation)
    return versions


def _adam_versions(ours: str, gaussians: int, device: torch.device) -> Versions:
    version = _stepping([(3,), (4,), (3,), (), (16, 3)], gaussians, device)

    def plain(parameters: list[torch.nn.Parameter]) -> Callable[[], object]:
        count = itertools.count(1)
        slots = [
            AdamSlot(one, one.grad, torch.zeros_like(one), torch.zeros_like(one), 0, 1e-3, 1e-3)
            for one in parameters
            if one.grad is not None
        ]

        def step() -> None:
            done = next(count)
            step_torch([slot._replace(step=done) for slot in slots])

        return step

    def triton(parameters: list[torch.nn.Parameter]) -> Callable[[], object]:
        optimizers = [adam.GpuFieldAdam(parameter, 1e-3) for parameter in parameters]
        return lambda: adam.step_together(optimizers)

    versions = {
        TORCH: version(plain),
        "torch.optim.Adam": version(lambda params: torch.optim.Adam(params, 1e-3, eps=adam.ADAM_EPS, fused=True).step),
    }
    if ours == NUMBA:
        versions[ours] = version(lambda params: FieldAdam(params, 1e-3).step)
    elif adam.triton_works():
        versions[ours] = version(triton)
    return versions


def _checkout_adam_versions(gaussians: int, device: torch.device) -> Versions:
    """Return versions of the optimizer that 3DGS's scripts make, whose SH are two tensors."""
    version = _stepping([(3,), (1, 3), (15, 3), (1,), (3,), (4,)], gaussians, device)

    def make(parameters: list[torch.nn.Parameter], fused: bool | None = None) -> torch.optim.Adam:
        return torch.optim.Adam([{"params": [one]} for one in parameters], 1e-3, eps=adam.ADAM_EPS, fused=fused)

    def ours(parameters: list[torch.nn.Parameter]) -> Callable[[], object]:
        optimizer = make(parameters)
        multi_tensor.fuse_steps(optimizer)
        return optimizer.step

    versions = {
        TORCH: version(lambda parameters: make(parameters).step),
        "its fused Adam": version(lambda parameters: make(parameters, fused=True).step),
    }
    if multi_tensor.triton_works():
        versions["Triton"] = version(ours)
    return versions


def _stepping(
    shapes: Sequence[tuple[int, ...]], gaussians: int, device: torch.device
) -> Callable[[Callable[[list[torch.nn.Parameter]], Callable[[], object]]], Version]:
    """Return a function that makes a version of an optimizer's step for parameters of these shapes."""
    generator = torch.Generator().manual_seed(0)
    starts, gradients = (
        [torch.randn(gaussians, *shape, generator=generator).to(device) for shape in shapes] for _ in range(2)
    )

    def version(make: Callable[[list[torch.nn.Parameter]], Callable[[], object]]) -> Version:
        """Give an optimizer its own copy of the parameters."""
        parameters = [torch.nn.Parameter(start.clone()) for start in starts]
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        return Version(make(parameters), parameters[-1])

    return version


def _with_triton(
    ours: str, works: SelfCheck, version: Callable[[_Operation], Version], plain: _Operation, own: _Operation
) -> Versions:
    """Return PyTorch's version and, on a GPU where it works, the one that calls our kernel."""
    versions = {TORCH: version(plain)}
    if ours != NUMBA and works():
        versions[ours] = version(own)
    return versions


def _statistics_versions(ours: str, gaussians: int, device: torch.device) -> Versions:
    generator = torch.Generator().manual_seed(0)
    gradient = torch.randn(gaussians, 2, generator=generator).to(device)
    radii = torch.randint(0, 3, (gaussians,), generator=generator, dtype=torch.int32).to(device)

    def version(add: Callable[[Tensor, Tensor, tuple[int, int], Tensor, Tensor], None]) -> Version:
        norms, counts = (torch.zeros(gaussians, device=device) for _ in range(2))
        return Version(lambda: add(gradient, radii, (2, 2), norms, counts), norms)

    return _with_triton(
        ours,
        densification_statistics.triton_works,
        version,
        add_statistics_torch,
        densification_statistics.add_statistics,
    )


def _regularization_versions(ours: str, gaussians: int, device: torch.device) -> Versions:
    generator = torch.Generator().manual_seed(0)
    starts = [torch.randn(gaussians, *columns, generator=generator).to(device) for columns in ((), (3,))]

    def in_torch(logits: Tensor, log_scales: Tensor, opacity_weight: float, scale_weight: float) -> None:
        assert logits.grad is not None
        assert log_scales.grad is not None
        add_regularization_torch(logits, log_scales, logits.grad, log_scales.grad, opacity_weight, scale_weight)

    def version(add: Callable[[Tensor, Tensor, float, float], None]) -> Version:
        logits, log_scales = (start.clone() for start in starts)
        logits.grad, log_scales.grad = torch.zeros_like(logits), torch.zeros_like(log_scales)
        return Version(lambda: add(logits, log_scales, 1.0, 1.0), log_scales.grad)

    return _with_triton(ours, regularization.triton_works, version, in_torch, regularization.add_regularization)


def _noise_versions(ours: str, gaussians: int, device: torch.device) -> Versions:
    generator = torch.Generator().manual_seed(0)
    quaternions, log_scales, logits = (
        torch.randn(gaussians, *columns, generator=generator).to(device) for columns in ((4,), (3,), ())
    )

    def in_torch(means: Tensor, quaternions: Tensor, log_scales: Tensor, logits: Tensor, amount: float) -> None:
        means += displacements(quaternions, log_scales, logits, torch.randn_like(means), amount)

    def version(add: Callable[[Tensor, Tensor, Tensor, Tensor, float], None]) -> Version:
        means = torch.zeros(gaussians, 3, device=device)
        # By nothing, because each version draws noise of its own; it takes as long.
        return Version(lambda: add(means, quaternions, log_scales, logits, 0.0), means)

    return _with_triton(ours, position_noise.triton_works, version, in_torch, position_noise.add_noise)
