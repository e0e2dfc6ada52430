"""SSIM of a checkout in our kernels, against convolutions as the first 3DGS has them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from lapgs_plugin.runner.checkout_loss import in_our_kernels
from tests.devices import DEVICES


class Convolved:
    """Compute SSIM (Wang et al. 2004) with a Gaussian window, and count the calls with float32 images."""

    def __init__(self, sigma: float = 1.5) -> None:
        self.sigma, self.calls = sigma, 0

    def ssim(self, img1: Tensor, img2: Tensor, window_size: int = 11, size_average: bool = True) -> Tensor:
        self.calls += img1.dtype == torch.float32
        taps = [math.exp(-((i - window_size // 2) ** 2) / (2 * self.sigma**2)) for i in range(window_size)]
        line = torch.tensor(taps, dtype=img1.dtype, device=img1.device) / sum(taps)
        channels = img1.shape[-3]
        window = torch.outer(line, line).expand(channels, 1, -1, -1)

        def mean(image: Tensor) -> Tensor:
            return conv2d(image, window, padding=window_size // 2, groups=channels)

        mean1, mean2 = mean(img1), mean(img2)
        variances = mean(img1 * img1) - mean1**2 + mean(img2 * img2) - mean2**2
        covariance = mean(img1 * img2) - mean1 * mean2
        quotient = (2 * mean1 * mean2 + 1e-4) * (2 * covariance + 9e-4)
        quotient = quotient / ((mean1**2 + mean2**2 + 1e-4) * (variances + 9e-4))
        return quotient.mean() if size_average else quotient.mean(1).mean(1).mean(1)


def replacement(convolved: Convolved) -> Callable[..., Tensor]:
    def ssim(img1: Tensor, img2: Tensor, window_size: int = 11, size_average: bool = True) -> Tensor:
        return convolved.ssim(img1, img2, window_size, size_average)

    return in_our_kernels(ssim)


def images(*shape: int, device: str = "cpu") -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    image, other = (torch.rand(shape, generator=generator).to(device) for _ in range(2))
    return image.requires_grad_(), other


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", [(3, 21, 34), (1, 3, 8, 5), (2, 3, 17, 40)])
def test_it_is_the_same(shape: tuple[int, ...], device: str) -> None:
    convolved = Convolved()
    ours, (image, other) = replacement(convolved), images(*shape, device=device)
    exact = convolved.ssim(image.double(), other.double())
    gradient = torch.autograd.grad(exact, image)[0]
    for found in (ours(image, other), ours(img1=image, img2=other, window_size=11), ours(other, image, 11, True)):
        torch.testing.assert_close(found.double(), exact, rtol=0, atol=2e-5)  # worst seen 2e-7
        difference = (torch.autograd.grad(found, image)[0] - gradient).abs().max() / gradient.abs().max()
        assert difference < 1e-4  # worst seen 1e-6
    with torch.no_grad():
        assert ours(image, other) == found
    assert convolved.calls == 0, "it is not convolved"


@pytest.mark.parametrize(
    "call",
    [
        lambda ours, image, other: ours(image, other, 7),
        lambda ours, image, other: ours(image[None], other[None], size_average=False).sum(),
        lambda ours, image, other: ours(image[:1], other[:1]),
        lambda ours, image, other: ours(image, image.flip(1)),
    ],
)
def test_what_the_checkouts_own_function_computes(call: Callable[..., Tensor]) -> None:
    convolved = Convolved()
    image, other = images(3, 21, 34)
    value = call(replacement(convolved), image, other)
    assert convolved.calls == 1
    expected = call(convolved.ssim, image, other)
    assert value == expected
    torch.testing.assert_close(*(torch.autograd.grad(each, image)[0] for each in (value, expected)), rtol=0, atol=0)


def other_window(img1: Tensor, img2: Tensor) -> Tensor:
    return Convolved(sigma=1.4).ssim(img1, img2)


def one_size_only(img1: Tensor, img2: Tensor) -> Tensor:
    return Convolved().ssim(img1, img2 + torch.zeros(3, 21, 34, dtype=torch.float32))


def no_gradient(img1: Tensor, img2: Tensor) -> Tensor:
    return Convolved().ssim(img1.detach(), img2)


def no_image(img1: Any) -> Any:
    return img1


@pytest.mark.parametrize("original", [other_window, one_size_only, no_gradient])
def test_what_differs_is_left_alone(original: Callable[..., Tensor]) -> None:
    image, other = images(3, 21, 34)
    ours = in_our_kernels(original)
    assert [ours(image, other) for _ in range(2)] == [original(image, other)] * 2
    assert in_our_kernels(no_image)(3) == 3
