"""Visible Gaussians found beside blending, against `(radii > 0).nonzero()`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.runner import early_visibility
from lapgs_plugin.runner.early_visibility import EarlyVisibility

DEVICES = ["cpu", pytest.param("cuda", marks=[
    pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
])]  # fmt: skip

RENDERERS = """
def render(rasterizer, values, keep=None):
    image, radii = rasterizer(values)
    if keep is not None:
        radii[keep] = 0
    return {"image": image, "visible": (radii > 0).nonzero(), "radii": radii}

def render_masked(rasterizer, values):
    image, radii = rasterizer(values)
    return {"image": image, "visible": radii > 0, "radii": radii}
"""


@pytest.fixture
def renderers(load_module: Callable[[str], ModuleType]) -> ModuleType:
    return load_module(RENDERERS)


class _Rasterized(torch.autograd.Function):
    """Count on the processor, then be busy with an image for a long time."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, busy: int, counts: bool) -> tuple[Tensor, Tensor]:
        radii = values.to(torch.int32)
        count = int((radii > 0).sum())
        if counts:
            ctx.num_rendered = count
        if busy:
            torch.cuda._sleep(busy)
        return values.sum().expand(3, 2, 2).clone(), radii

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, ...]:
        return None, None, None


def rasterize(values: Tensor, busy: int = 0, counts: bool = True) -> Any:
    return _Rasterized.apply(values, busy, counts)  # type: ignore[no-untyped-call]  # torch's


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("counts", [True, False])
def test_indices_are_the_same(renderers: ModuleType, device: str, counts: bool) -> None:
    visibility = EarlyVisibility()
    render = visibility.applied(renderers.render)
    values = torch.randn(1000, generator=torch.Generator().manual_seed(0)).mul(3).to(device).requires_grad_()

    def noted(given: Tensor) -> Any:
        outputs = rasterize(given, counts=counts)
        visibility.note(outputs)
        return outputs

    found = render(noted, values)
    assert torch.equal(found["visible"], (found["radii"] > 0).nonzero())
    changed = render(noted, values, torch.arange(0, 1000, 2, device=device))
    assert torch.equal(changed["visible"], (changed["radii"] > 0).nonzero())
    assert len(changed["visible"]) < len(found["visible"])
    with torch.inference_mode():
        assert torch.equal(render(noted, values.detach())["visible"], found["visible"])


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_the_image_is_not_waited_for(renderers: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(early_visibility, "COMPARED", 0)
    visibility = EarlyVisibility()
    render = visibility.applied(renderers.render)
    values = torch.ones(1000, device="cuda", requires_grad=True)

    def noted(given: Tensor) -> Any:
        outputs = rasterize(given, busy=2_000_000_000)  # about a second
        visibility.note(outputs)
        return outputs

    found = render(noted, values)
    done = torch.cuda.Event()  # type: ignore[no-untyped-call]  # torch's
    done.record()
    assert len(found["visible"]) == 1000
    assert not done.query()


def test_radii_that_are_not_there_yet(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """Of a rasterizer whose number of pairs is no count of theirs: once they differ, they are waited for."""
    visibility, asked = EarlyVisibility(), list[Tensor]()

    def found_early(radii: Tensor) -> Tensor:
        asked.append(radii)
        return (radii > len(asked) // 3).nonzero()

    monkeypatch.setattr(visibility, "_found_early", found_early)
    for _ in range(6):
        radii = torch.tensor([0, 1, 0, 3, 2], dtype=torch.int32)
        setattr(radii, early_visibility.MARK, radii._version)
        assert visibility.indices(radii).tolist() == [[1], [3], [4]]
    assert len(asked) == 3
    assert [each.levelname for each in caplog.records] == ["WARNING"]


def test_only_what_looks_like_it_is_changed(renderers: ModuleType) -> None:
    visibility = EarlyVisibility()
    assert visibility.applied(renderers.render) is not renderers.render
    assert visibility.applied(renderers.render_masked) is renderers.render_masked
    assert visibility.applied(sys.exit) is sys.exit
