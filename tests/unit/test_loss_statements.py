"""Statements of a photometric loss that one function computes, against the statements as they are."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import l1_loss as mean_distance

from lapgs_plugin.ops import photometric_loss
from lapgs_plugin.ops.photometric_loss.in_torch import as_batch, ssim_map_torch
from lapgs_plugin.runner import checkout_loss
from lapgs_plugin.runner.checkout_loss import in_one_kernel

SCRIPT = """
import torch
from tests.unit.test_loss_statements import charbonnier, l1_loss, no_window, signed, ssim

FUSED = True

def training(image, gt, opt):
    W = opt.weight
    {}
    return Ll1, loss
"""
ONE = "loss = (1.0 - opt.weight) * Ll1 + opt.weight * (1.0 - ssim(image, gt))"
BATCHES = "value = ssim(image.unsqueeze(0), gt.unsqueeze(0))"
SET = "loss = (1.0 - opt.weight) * Ll1 + opt.weight * (1.0 - value)"
COMPARED = (3, 29, 43)
"""Size of the images on which functions are compared before."""
L1 = "Ll1 = l1_loss(image, gt)"


def l1_loss(one: Tensor, other: Tensor) -> Tensor:
    return torch.abs(one - other).mean()


def ssim(one: Tensor, other: Tensor) -> Tensor:
    return ssim_map_torch(as_batch(one), as_batch(other)).mean()


def charbonnier(one: Tensor, other: Tensor) -> Tensor:
    return ((one - other).square() + 1e-6).sqrt().mean()


def signed(one: Tensor, other: Tensor) -> Tensor:
    return (one - other).mean()


def no_window(one: Tensor, other: Tensor) -> Tensor:
    return 1 - (one - other).square().mean()


class Options:
    weight: Any = 0.2


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[torch.Size]:
    """Return the shapes of images whose loss our function computed."""
    shapes: list[torch.Size] = []

    def losses(image: Tensor, target: Tensor, weight: float) -> tuple[Tensor, Tensor]:
        if image.shape != COMPARED:
            shapes.append(image.shape)
        return photometric_loss.photometric_loss(image, target, weight), mean_distance(image, target)

    monkeypatch.setattr(checkout_loss.photometric_loss, "loss_and_l1", losses)
    monkeypatch.setattr(checkout_loss, "_has_one_kernel", lambda image: True)
    return shapes


def assert_same(module: ModuleType, image: Tensor, gt: Tensor, opt: Options) -> None:
    """Compare values and gradients, also by L1, which a loop may use for more than its loss."""
    results = []
    for function in (module.training, in_one_kernel(module.training)):
        l1, loss = function(image, gt, opt)
        results.append((l1, loss, *(torch.autograd.grad(v, image, retain_graph=True)[0] for v in (l1, loss))))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one * one.numel(), other * other.numel(), rtol=0, atol=1e-4)  # worst seen 1e-6


def images(*shape: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    image, gt = (torch.rand(shape, generator=generator) for _ in range(2))
    return image.requires_grad_(), gt


@pytest.mark.parametrize(
    "lines",
    [
        (L1, ONE),
        (L1, BATCHES, SET),
        (BATCHES, L1, SET),
        (L1, "if FUSED:", f"    {BATCHES}", "else:", "    value = ssim(image, gt)", SET),
        ("Ll1 = image.mean()", "loss = (1 - W) * l1_loss(image, gt) + W * (1 - ssim(image, gt))"),
        ("for _ in range(1):", f"    {L1}", f"    {ONE}"),
    ],
)
def test_losses_of_the_family(
    lines: tuple[str, ...], load_module: Callable[[str], ModuleType], counted: list[torch.Size]
) -> None:
    module = load_module(SCRIPT.format("\n    ".join(lines)))
    assert_same(module, *images(3, 21, 34), Options())
    assert counted == [(3, 21, 34)]


@pytest.mark.parametrize(
    "lines",
    [
        (L1, "image = image * 0.5", ONE),
        (L1, ONE.replace("Ll1 +", "Ll1.detach() +")),
        (L1, ONE.replace("ssim(image, gt)", "ssim(gt, image)")),
        (L1, ONE.replace("* (1.0", "* (2.0")),
        (L1, ONE.replace("opt.weight * (1", "W * (1")),
        (L1, BATCHES, SET, "loss = loss + value"),
        (L1, BATCHES, SET, "del value"),
        (L1, "value = ssim(image, gt.unsqueeze(0))", SET),
        (L1, "if FUSED:", f"    {BATCHES}", "else:", "    value = ssim(gt, image)", SET),
        (L1.replace("l1_loss", "charbonnier"), ONE),
        (L1.replace("l1_loss", "signed"), ONE),
        (L1, ONE.replace("ssim", "no_window")),
        (L1, BATCHES.replace("ssim", "no_window"), SET),
    ],
)
def test_other_losses_are_left_alone(
    lines: tuple[str, ...], load_module: Callable[[str], ModuleType], counted: list[torch.Size]
) -> None:
    module = load_module(SCRIPT.format("\n    ".join(lines)))
    assert_same(module, *images(3, 21, 34), Options())
    assert not counted


@pytest.mark.parametrize("shape", [(1, 3, 21, 34), (1, 21, 34)])
def test_other_images_are_left_alone(
    shape: tuple[int, ...], load_module: Callable[[str], ModuleType], counted: list[torch.Size]
) -> None:
    assert_same(load_module(SCRIPT.format(f"{L1}\n    {ONE}")), *images(*shape), Options())
    assert not counted


def test_a_weight_that_is_learned_gets_its_gradient(
    load_module: Callable[[str], ModuleType], counted: list[torch.Size]
) -> None:
    opt = Options()
    opt.weight = torch.tensor(0.2, requires_grad=True)
    _, loss = in_one_kernel(load_module(SCRIPT.format(f"{L1}\n    {ONE}")).training)(*images(3, 21, 34), opt)
    loss.backward()
    assert opt.weight.grad is not None
    assert not counted


def test_on_a_cpu_the_statements_are_executed(load_module: Callable[[str], ModuleType]) -> None:
    module = load_module(SCRIPT.format(f"{L1}\n    {ONE}"))
    pairs = [function(*images(3, 21, 34), Options()) for function in (module.training, in_one_kernel(module.training))]
    assert pairs[0] == pairs[1]


@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_gradients_begin_with_one(factor: float, load_module: Callable[[str], ModuleType]) -> None:
    lines = L1, ONE, f"loss = loss * {factor}", "loss.backward()"
    training = in_one_kernel(load_module(SCRIPT.format("\n    ".join(lines))).training)
    image, gt = images(3, 21, 34)
    for count in (1, 2):  # of the images' own sums
        _, loss = training(image, gt, Options())
        expected = photometric_loss.photometric_loss(image, gt, 0.2)
        assert loss.item() == pytest.approx(factor * expected.item(), rel=1e-5)
        gradient = count * factor * torch.autograd.grad(expected, image)[0]
        torch.testing.assert_close(image.grad, gradient, rtol=1e-4, atol=1e-7)
