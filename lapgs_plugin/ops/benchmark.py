"""Time every operation in the versions that this machine has, each against plain PyTorch in one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.ops import adam, densification_statistics, photometric_loss, upsample
from lapgs_plugin.ops.adam.in_numba import FieldAdam
from lapgs_plugin.ops.adam.in_torch import AdamSlot, step_torch
from lapgs_plugin.ops.densification_statistics.in_torch import add_statistics_torch
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch, ssim

NUMBA = "Numba"
TORCH = "PyTorch"
"""The version that the others are compared with."""

Versions = dict[str, Callable[[], Tensor]]
"""By name; a call does the operation once and returns its result."""


@dataclass(frozen=True)
class OpTime:
    """Hold the time of one version of an operation.

    Attributes:
        milliseconds: median over all turns.
        ratio: time of the PyTorch version over this one's.
        difference: largest difference from the PyTorch version's result after one call; None for a peer that computes
            something else.
    """

    op: str
    version: str
    milliseconds: float
    ratio: float
    difference: float | None


def benchmark(device: torch.device, width: int, height: int, gaussians: int, repeats: int) -> list[OpTime]:
    """Time all operations; the versions of one take turns, so that a change in the machine's load meets all of them.

    Args:
        width, height: of the images, in pixels.
        gaussians: in the field.
        repeats: turns.
    """
    ours = "Triton" if device.type == "cuda" else NUMBA
    generator = torch.Generator().manual_seed(0)
    images = [torch.rand(3, height, width, generator=generator).to(device) for _ in range(2)]
    coarse = torch.rand(3, (height + 1) // 2, (width + 1) // 2, generator=generator).to(device)
    operations = {
        "upsample": _upsample_versions(ours, coarse, images[0]),
        "photometric loss": _loss_versions(ours, images[0], images[1]),
        "Adam": _adam_versions(ours, gaussians, device),
        "densification statistics": _statistics_versions(ours, gaussians, device),
    }
    return [found for op, versions in operations.items() for found in _time(op, versions, device, repeats)]


def _time(op: str, versions: Versions, device: torch.device, repeats: int) -> list[OpTime]:
    results = {name: version().clone() for name, version in versions.items()}  # the first call compiles
    seconds: dict[str, list[float]] = {name: [] for name in versions}
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    for _ in range(repeats):
        for name, version in versions.items():
            with one_pool() if name == NUMBA else nullcontext():  # as in training
                wait()
                start = time.perf_counter()
                version()
                wait()
                seconds[name].append(time.perf_counter() - start)
    medians = {name: median(each) for name, each in seconds.items()}
    reference = results[TORCH]
    return [
        OpTime(
            op, name, 1e3 * each, medians[TORCH] / each,
            float((results[name] - reference).abs().max()) if results[name].shape == reference.shape else None,
        )
        for name, each in medians.items()
    ]  # fmt: skip


def _upsample_versions(ours: str, coarse: Tensor, fine: Tensor) -> Versions:
    pyramid, size = Pyramid(), (fine.shape[-2], fine.shape[-1])
    versions: Versions = {TORCH: lambda: pyramid.up(coarse, size) + fine}
    if ours == NUMBA or upsample.triton_works():
        versions[ours] = lambda: upsample.upsample_add(pyramid, coarse, fine)
    if size[0] % 2 == size[1] % 2 == 0:  # kornia doubles sides exactly
        from kornia.geometry.transform import pyrup

        versions["kornia.pyrup"] = lambda: pyrup(coarse[None])[0] + fine
    return versions


def _loss_versions(ours: str, prediction: Tensor, target: Tensor) -> Versions:
    leaf = prediction.clone().requires_grad_()

    def gradient_of(loss: Callable[[Tensor, Tensor], Tensor]) -> Callable[[], Tensor]:
        # In units of one pixel's share of the loss.
        return lambda: torch.autograd.grad(loss(leaf, target), leaf)[0] * leaf.numel()

    versions: Versions = {TORCH: gradient_of(photometric_loss_torch)}
    fused = photometric_loss.fused_ssim()
    if ours == NUMBA or (fused is not None and photometric_loss.triton_works()):
        versions[ours if fused is None else f"{ours} and fused_ssim"] = gradient_of(photometric_loss.photometric_loss)
    kornia_alone = gradient_of(ssim)
    versions["kornia.ssim alone"] = lambda: kornia_alone()[0]  # one channel: not comparable
    return versions


def _adam_versions(ours: str, gaussians: int, device: torch.device) -> Versions:
    generator = torch.Generator().manual_seed(0)
    shapes: list[tuple[int, ...]] = [(3,), (4,), (3,), (), (16, 3)]
    starts, gradients = (
        [torch.randn(gaussians, *shape, generator=generator).to(device) for shape in shapes] for _ in range(2)
    )

    def parameters() -> list[torch.nn.Parameter]:
        made = [torch.nn.Parameter(start.clone()) for start in starts]
        for parameter, gradient in zip(made, gradients, strict=True):
            parameter.grad = gradient
        return made

    def stepped(made: list[torch.nn.Parameter], step: Callable[[], object]) -> Callable[[], Tensor]:
        def call() -> Tensor:
            step()
            return made[-1].detach()

        return call

    plain, theirs, mine = parameters(), parameters(), parameters()
    slots = [
        AdamSlot(one.detach(), gradient, torch.zeros_like(one), torch.zeros_like(one), torch.zeros(()), 1e-3, 1e-3)
        for one, gradient in zip(plain, gradients, strict=True)
    ]

    def step_plain() -> None:
        for slot in slots:
            slot.step.add_(1)
        step_torch(slots)

    peer = torch.optim.Adam(theirs, lr=1e-3, eps=adam.ADAM_EPS, fused=True)
    versions = {TORCH: stepped(plain, step_plain), "torch.optim.Adam, fused": stepped(theirs, peer.step)}
    if ours == NUMBA:
        versions[ours] = stepped(mine, FieldAdam(mine, lr=1e-3).step)
    elif adam.triton_works():
        optimizers = [adam.GpuFieldAdam(one, 1e-3) for one in mine]
        versions[ours] = stepped(mine, lambda: adam.step_together(optimizers))
    return versions


def _statistics_versions(ours: str, gaussians: int, device: torch.device) -> Versions:
    generator = torch.Generator().manual_seed(0)
    gradient = torch.randn(gaussians, 2, generator=generator).to(device)
    radii = torch.randint(0, 3, (gaussians,), generator=generator, dtype=torch.int32).to(device)

    def summed(add: Callable[[Tensor, Tensor, tuple[int, int], Tensor, Tensor], None]) -> Callable[[], Tensor]:
        norms, counts = (torch.zeros(gaussians, device=device) for _ in range(2))

        def call() -> Tensor:
            add(gradient, radii, (2, 2), norms, counts)
            return norms

        return call

    versions = {TORCH: summed(add_statistics_torch)}
    if ours == "Triton" and densification_statistics.triton_works():
        versions[ours] = summed(densification_statistics.add_statistics)
    return versions
