"""Images that are stored at half their size and upsampled."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.hierarchy.settings import GRIDS
from lapgs_plugin.runs.image_store import ImageStore
from lapgs_plugin.runs.upsampled_images import UpsampledImages
from tests.unit.test_imagestore import on_every_device

SIZES = {"a": (6, 10), "b": (7, 9)}
WORST = {"float32": 1e-6, "float16": 2.5e-4, "uint8": 3e-3}
"""Of values between -0.5 and 1: Up averages, so that no pixel can be off by more than what it is made of, half a step.
Seen: 1.8e-7, 2.1e-4 and 2.8e-3."""


@pytest.mark.parametrize("grid", GRIDS)
@on_every_device
@pytest.mark.parametrize("precision", WORST)
def test_images_are_up_of_the_stored_ones(grid: str, device: str, where: str, precision: str, tmp_path: Path) -> None:
    images = UpsampledImages(ImageStore(where, precision, device=device, folder=tmp_path / "images"), Pyramid(grid))
    coarse = {name: torch.rand(3, -(-h // 2), -(-w // 2)) * 1.5 - 0.5 for name, (h, w) in SIZES.items()}
    for name, size in SIZES.items():
        images.put(name, coarse[name].requires_grad_(), size)
    images.prefetch("b")
    for name, size in SIZES.items():
        got = images.get(name)
        assert (got.dtype, got.device.type, got.requires_grad) == (torch.float32, device, False)
        expected = Pyramid(grid).up(coarse[name].detach(), size)
        torch.testing.assert_close(got.cpu(), expected, rtol=0, atol=WORST[precision])
        fine = torch.rand(3, *size, device=device, requires_grad=True)
        added = images.adder([name])(fine)
        torch.testing.assert_close(added.cpu(), expected + fine.cpu(), rtol=0, atol=WORST[precision])
        weights = torch.rand_like(fine)
        (gradient,) = torch.autograd.grad((added * weights).sum(), fine)
        torch.testing.assert_close(gradient, weights, rtol=0, atol=0)
    images.close()
    assert not list(tmp_path.iterdir())


def test_a_quarter_of_the_pixels_is_stored_and_an_image_of_another_size_refused() -> None:
    images = UpsampledImages(ImageStore("memory", "float32"), Pyramid())
    images.put("a", torch.rand(3, 8, 16), (16, 32))
    assert images.store.get("a").numel() == 3 * 16 * 32 // 4
    assert images.get("a").shape == (3, 16, 32)
    with pytest.raises(UserInputError, match=r"Up to 16x32 .* got 16x32"):
        images.put("b", torch.rand(3, 16, 32), (16, 32))
    assert len(images.store) == 1
