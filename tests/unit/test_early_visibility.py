"""Visible Gaussians found beside blending, against `(radii > 0).nonzero()`."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from lapgs_plugin.runner import early_visibility
from lapgs_plugin.runner.early_visibility import EarlyVisibility
from tests.devices import DEVICES

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


def noting(visibility: EarlyVisibility, busy: int = 0, counts: bool = True) -> Callable[[Tensor], Any]:
    """Return a rasterizer whose radii are noted."""

    def rasterize(values: Tensor) -> Any:
        outputs = _Rasterized.apply(values, busy, counts)  # type: ignore[no-untyped-call]  # torch's
        visibility.note(outputs)
        return outputs

    return rasterize


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("counts", [True, False])
def test_indices_are_the_same(renderers: ModuleType, device: str, counts: bool) -> None:
    visibility = EarlyVisibility()
    render = visibility.in_renderer(renderers.render)
    values = torch.randn(1000, generator=torch.Generator().manual_seed(0)).mul(3).to(device).requires_grad_()

    noted = noting(visibility, counts=counts)
    found = render(noted, values)
    assert torch.equal(found["visible"], (found["radii"] > 0).nonzero())
    changed = render(noted, values, torch.arange(0, 1000, 2, device=device))
    assert torch.equal(changed["visible"], (changed["radii"] > 0).nonzero())
    assert len(changed["visible"]) < len(found["visible"])
    with torch.inference_mode():
        assert torch.equal(render(noted, values.detach())["visible"], found["visible"])


@pytest.mark.gpu
def test_the_image_is_not_waited_for(renderers: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(early_visibility, "COMPARED", 0)
    visibility = EarlyVisibility()
    render = visibility.in_renderer(renderers.render)
    values = torch.ones(1000, device="cuda", requires_grad=True)

    noted = noting(visibility, busy=2_000_000_000)  # about a second
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
        setattr(radii, early_visibility.PROJECTED, radii._version)
        assert visibility.indices(radii).tolist() == [[1], [3], [4]]
    assert len(asked) == 3
    assert [each.levelname for each in caplog.records] == ["WARNING"]


LOOP = """
class Model:
    def __init__(self, count, zeros):
        self.largest, self.sums, self.views, self.scale = zeros(count), zeros(count, 1), zeros(count, 1), 2.0
    def add_densification_stats(self, gradient, update_filter):
        self.sums[update_filter] += gradient[update_filter, :2].norm(dim=-1, keepdim=True) * self.scale
        self.views[update_filter] += 1
    def private(self, mask):
        return self.__scale[mask]

def training(render, rasterizer, model, values, gradients, change=None):
    for i in range(len(gradients)):
        package = render(rasterizer, values * (i + 1))
        visible, radii = package["visible"], package["radii"]
        visibility_filter, shown = package["visibility_filter"], package["visible"].sum()
        if change is not None:
            change(visibility_filter, radii)
        model.largest[visibility_filter] = model.largest[visibility_filter].maximum(radii[visibility_filter] * 1.0)
        model.add_densification_stats(gradients[i], visibility_filter)
    return shown, model.largest[visibility_filter]
"""


@pytest.mark.parametrize("changed", ["nothing", "mask", "radii"])
@pytest.mark.parametrize("device", DEVICES)
def test_masks_index_by_their_indices(
    load_module: Callable[[str], ModuleType], device: str, changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the loop and the statistics alike, found once a render; a mask that was changed is the mask that it is."""
    text = RENDERERS.replace('"visible": radii > 0', '"visible": radii > 0, "visibility_filter": radii > 0')
    module, visibility, found = load_module(text + LOOP), EarlyVisibility(), list[Tensor]()
    monkeypatch.setattr(early_visibility, "COMPARED", 0)
    if device == "cpu":

        def note(outputs: Any) -> None:
            setattr(outputs[1], early_visibility.PROJECTED, outputs[1]._version)

        monkeypatch.setattr(visibility, "note", note)
        monkeypatch.setattr(visibility, "_found_early", lambda radii: found.append(radii) or (radii > 0).nonzero())

    def change(mask: Tensor, radii: Tensor) -> None:
        (mask if changed == "mask" else radii)[::2] = 0

    generator = torch.Generator().manual_seed(0)
    values = torch.randn(500, generator=generator).mul(3).to(device).requires_grad_()
    gradients = [torch.randn(500, 3, generator=generator).to(device) for _ in range(4)]
    states = []
    for early in (False, True):
        model = module.Model(500, lambda *size: torch.zeros(size, device=device))
        render, training = module.render_masked, module.training
        if early:
            render, training = visibility.in_renderer(render), visibility.in_loop(training)
            method = visibility.in_statistics(module.Model.add_densification_stats)
            monkeypatch.setattr(module.Model, "add_densification_stats", method)
        given = None if changed == "nothing" else change
        states.append([*training(render, noting(visibility), model, values, gradients, given), model.sums, model.views])
    assert all(map(torch.equal, *states))
    assert render is not module.render_masked
    assert training is not module.training
    if device == "cpu":
        assert len(found) == (4 if changed == "nothing" else 0)


def test_only_what_looks_like_it_is_changed(renderers: ModuleType, load_module: Callable[[str], ModuleType]) -> None:
    visibility = EarlyVisibility()
    assert visibility.in_renderer(renderers.render) is not renderers.render
    assert visibility.in_renderer(len) is len
    loop = load_module(LOOP)
    assert visibility.in_statistics(loop.Model.private) is loop.Model.private
    assert visibility.in_loop(loop.Model.__init__) is loop.Model.__init__
