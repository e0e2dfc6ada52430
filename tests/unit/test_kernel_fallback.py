"""A kernel that raises at its first use, as on a Triton that does not compile it: other operations take its place."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.ops.adam import GpuFieldAdam
from lapgs_plugin.ops.color_transform import transform_colors
from lapgs_plugin.ops.densification_statistics import add_statistics
from lapgs_plugin.ops.photometric_loss import photometric_loss
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch
from lapgs_plugin.ops.position_noise import add_noise
from lapgs_plugin.ops.regularization import add_regularization
from lapgs_plugin.ops.self_check import SelfCheck
from lapgs_plugin.ops.upsample import upsample_add
from lapgs_plugin.rasterizers.gsplat.rasterizer import GsplatRasterizer
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.settings import LearningRates
from tests.gsplat_on_cpu import direct_on_cpu, gsplat_on_cpu

Pair = tuple[Tensor, Tensor]


class CompilationError(Exception):
    """As Triton's: its text begins with a place and source code."""

    error_message = "module 'triton.language' has no attribute 'join'\nsecond line"


def raises(*args: Any, **kwargs: Any) -> Any:
    raise RuntimeError("at 3:4:\n    x = tl.join(x, x)") from CompilationError("at 3:4:\n    x = tl.join(x, x)")


def broken(*names: str) -> ModuleType:
    kernels = ModuleType("kernels")
    vars(kernels).update(dict.fromkeys(names, raises))
    return kernels


@pytest.fixture(autouse=True)
def _as_on_a_gpu(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """Check kernels on the CPU and use them there."""
    monkeypatch.setattr(SelfCheck, "__call__", lambda check, *tensors: check.passes_on(torch.device("cpu")))
    caplog.set_level(logging.WARNING)


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == "lapgs_plugin.ops.self_check"]


def loss() -> Pair:
    prediction, target = torch.rand(2, 3, 13, 17, generator=torch.Generator().manual_seed(0))
    return photometric_loss(prediction, target, 0.2), photometric_loss_torch(prediction, target, 0.2)


def statistics() -> Pair:
    sums = torch.zeros(2), torch.zeros(2)
    add_statistics(torch.tensor([[0.75, 2.0], [1.0, 1.0]]), torch.tensor([1, 0]).int(), (8, 2), *sums)
    return torch.stack(sums), torch.tensor([[(3.0**2 + 2.0**2) ** 0.5, 0.0], [1.0, 0.0]])


def colors() -> Pair:
    transform = torch.tensor([[0.0, 2.0, 0.0, 0.5], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    image = torch.rand(3, 4, 5)
    return transform_colors(image, transform), torch.stack([2 * image[1] + 0.5, image[0], image[2] - 1])


def upsampled() -> Pair:
    coarse, fine = torch.rand(3, 4, 5), torch.rand(3, 8, 10)
    return upsample_add(Pyramid(), coarse, fine), Pyramid().up(coarse, (8, 10)) + fine


def moved() -> Pair:
    means, upright = torch.zeros(2, 3), torch.tensor([[2.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.5, 0.5]])
    log_scales = torch.tensor([[0.0, -1.0, 1.0]]).repeat(2, 1)
    torch.manual_seed(0)
    add_noise(means, upright, log_scales, torch.full((2,), -20.0), 1.0)
    torch.manual_seed(0)
    noise = torch.randn(2, 3)
    # The second one is turned so that x becomes y, y z and z x.
    variances = torch.exp(2 * torch.tensor([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0]]))
    return means, noise * variances * torch.sigmoid(torch.tensor(0.5))


def regularized() -> Pair:
    logits, log_scales = torch.zeros(2), torch.zeros(2, 3)
    logits.grad = torch.tensor([0.0, 1.0])
    add_regularization(logits, log_scales, 0.3, 0.25)
    assert log_scales.grad is not None
    result = torch.cat([logits.grad, log_scales.grad.flatten()])
    return result, torch.tensor([0.3 / 8, 1 + 0.3 / 8, *[0.25 / 6] * 6])


@pytest.mark.parametrize(
    ("operation", "kernels", "compute", "instead"),
    [
        ("position_noise", ("add_noise_triton",), moved, "noise of positions in several operations"),
        ("regularization", ("add_regularization_triton",), regularized, "regularization in several operations"),
        (
            "photometric_loss",
            ("photometric_loss_triton", "ssim_map_triton"),
            loss,
            "the photometric loss in many operations",
        ),
        ("densification_statistics", ("add_statistics_triton",), statistics, "densification statistics in several"),
        ("color_transform", ("transform_colors_triton",), colors, "colour transforms as products of matrices"),
        ("upsample", ("upsample_add_triton", "upsample_triton"), upsampled, "upsampling in many small operations"),
    ],
)
def test_an_operation(
    operation: str,
    kernels: tuple[str, ...],
    compute: Callable[[], Pair],
    instead: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setitem(sys.modules, f"lapgs_plugin.ops.{operation}.in_triton", broken(*kernels))
    result, expected = compute()
    torch.testing.assert_close(result, expected, rtol=0, atol=1e-5)  # float32 of about 1; worst seen 2e-7
    (line,) = said(caplog)
    assert line.startswith(instead)
    assert line.endswith(": module 'triton.language' has no attribute 'join'")


def field(device: str = "cpu") -> GaussianField:
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(20, 3, generator=generator) + torch.tensor([0.0, 0.0, 4.0])
    others = torch.randn(20, 4, generator=generator), torch.full((20, 3), -2.0), torch.zeros(20)
    return GaussianField(means, *others, torch.rand(20, 4, 3, generator=generator)).to(device)


def test_adam(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setitem(sys.modules, "lapgs_plugin.ops.adam.in_triton", broken("step_triton"))
    model = TrainableField.create(field("meta"), LearningRates(), extent=1.0)
    assert not any(isinstance(optimizer, GpuFieldAdam) for optimizer in model.optimizers.values())
    (line,) = said(caplog)
    assert line == "Adam in a launch for each tensor: module 'triton.language' has no attribute 'join'"


@pytest.mark.parametrize("name", ["project", "project_backward", "blend_forward", "blend_backward"])
def test_a_kernel_of_rendering(name: str, caplog: pytest.LogCaptureFixture) -> None:
    camera, black = Camera(20, 16, 20.0, 20.0, 10.0, 8.0, torch.eye(4)), torch.zeros(3)
    with gsplat_on_cpu():
        expected = GsplatRasterizer(device="cpu", direct=False).render_image(field(), camera, background=black)
        with direct_on_cpu(**{name: raises}):
            rasterizer = GsplatRasterizer(device="cpu")
            rasterizer._may_be_direct = True
            result = rasterizer.render_image(field(), camera, background=black)
            assert not rasterizer._calls_kernels(field())
    torch.testing.assert_close(result, expected, rtol=0, atol=1e-6)
    line = said(caplog)[0]
    assert line.startswith("rendering by `gsplat.rasterization`, which takes longer: module 'triton.language' has")


def test_a_check_draws_its_numbers_on_the_cpu_whichever_device_is_the_default() -> None:
    with torch.device("meta"):
        assert SelfCheck(lambda device: float(torch.zeros(1).to(device).sum()), "unused", 0.0).passes_on(
            torch.device("cpu")
        )
