"""Zeros that renderers make in each call: to ask for gradients of projected centres, and as settings."""

from __future__ import annotations

import ast
from collections.abc import Callable
from types import ModuleType

import pytest
import torch
from torch import Tensor

from lapgs_plugin.checkouts.rewriting import Change
from lapgs_plugin.checkouts.screen_points import ScreenPoints, SettingsZeros
from lapgs_plugin.rasterizers.signed_color import ColorPath
from lapgs_plugin.runner.rasterizer_wrapper import RasterizerWrapper
from lapgs_plugin.runner.running_stage import Stages
from lapgs_plugin.runner.stage_rendering import StageRendering

RENDERER = """
import torch

def render(means):
    points = torch.zeros({}, dtype=means.dtype, requires_grad=True, device="cpu") + 0
    try:
        points.retain_grad()
    except:
        pass
    return points, (points[:, :2] * means[:, :2]).sum()
"""


@pytest.mark.parametrize("arguments", ["(len(means), 4)", "[len(means), 4]", "len(means), 4"])
def test_gradients_are_the_same(load_module: Callable[[str], ModuleType], arguments: str) -> None:
    source = RENDERER.format(arguments).replace("points[:, :2]", "columns(points)")
    module = load_module(source + "\ndef columns(points):\n    return points[:, :2]\n")
    ours = RasterizerWrapper(Stages()).renderer(module.render)
    addresses = set()
    for count in (5, 5, 7):
        means = torch.rand(count, 3)
        seen: list[Tensor] = []
        for render in (ours, module.render, ours):
            points, value = render(means)
            assert points.shape == (count, 4)
            assert not points.any()
            value.backward()
            seen.append(points.grad)
            if render is ours:
                assert points.is_leaf
                addresses.add((count, points.data_ptr()))
        assert torch.equal(seen[0], seen[1]), "and no sum over renders"
        assert torch.equal(seen[2], seen[1])
    assert len(addresses) == 2, "zeros are kept as long as the model keeps its size"
    with torch.no_grad():
        assert not ours(means)[0].requires_grad
    with torch.inference_mode(), torch.enable_grad():
        assert ours(torch.rand(9, 3))[0].shape == (9, 4)


def test_renders_before_one_backward_pass_have_gradients_of_their_own(load_module: Callable[[str], ModuleType]) -> None:
    module = load_module(RENDERER.format("len(means), 4").replace("points[:, :2]", "torch.narrow(points, 1, 0, 2)"))
    gradients = []
    for render in (RasterizerWrapper(Stages()).renderer(module.render), module.render):
        views = [render(means) for means in (torch.ones(5, 3), 2 * torch.ones(5, 3))]
        torch.stack([value for _, value in views]).sum().backward()
        gradients.append([points.grad for points, _ in views])
    for ours, theirs in zip(*gradients, strict=True):
        assert torch.equal(ours, theirs)


def test_zeros_that_were_written_are_made_again(load_module: Callable[[str], ModuleType]) -> None:
    source = RENDERER.format("len(means), 4").replace("points[:, :2]", "points.sum()")
    ours = RasterizerWrapper(Stages()).renderer(load_module(source).render)
    for _ in range(3):
        points, _ = ours(torch.rand(5, 3))
        assert not points.any()
        with torch.no_grad():
            points.add_(1)


def test_fields_that_are_rendered_in_turn_keep_their_own_zeros(load_module: Callable[[str], ModuleType]) -> None:
    """As in joint training, where the fields have different numbers of Gaussians."""
    source = RENDERER.format("len(means), 4").replace("points[:, :2]", "torch.narrow(points, 1, 0, 2)")
    module, stages, kept = load_module(source), Stages(), []
    ours = RasterizerWrapper(stages).renderer(module.render)
    renderings = {count: StageRendering(False, ColorPath.NATIVE, {}) for count in (5, 7)}
    for _ in range(2):
        for count, rendering in renderings.items():
            with stages.rendering_as(rendering):
                kept.append(ours(torch.rand(count, 3))[0].data_ptr())
    assert kept[:2] == kept[2:]
    assert kept[0] != kept[1]


def count_changes(change_of: Callable[[ast.FunctionDef], Change], function: str) -> int:
    (tree,) = ast.parse(function).body
    assert isinstance(tree, ast.FunctionDef)
    change = change_of(tree)
    change.visit(tree)
    return change.changes


@pytest.mark.parametrize(
    ("lines", "changes"),
    [
        ("x = torch.zeros_like(m, requires_grad=True) + 0", 1),
        ("x = torch.zeros_like(m, requires_grad=True)", 0),
        ("x = torch.zeros_like(m) + 0", 0),
        ("x = torch.zeros_like(input=m, requires_grad=True) + 0", 0),
        ("x = torch.ones_like(m, requires_grad=True) + 0", 0),
        ("x = torch.zeros_like(m, requires_grad=True) + 1", 0),
        ("x = torch.zeros_like(m, requires_grad=True) + 0\n    x[:, 0] = 1", 0),
        ("x = torch.zeros_like(m, requires_grad=True) + 0\n    x += m", 0),
        ("x = torch.zeros_like(m, requires_grad=True) + 0\n    x.add_(m)", 0),
        ("x = torch.zeros_like(m, requires_grad=True) + 0\n    x.data.add_(m)", 0),
    ],
)
def test_what_is_replaced(lines: str, changes: int) -> None:
    assert count_changes(ScreenPoints, f"def render(m):\n    {lines}") == changes


@pytest.mark.parametrize(
    ("lines", "changes"),
    [
        (
            "if x == None:\n        x = torch.zeros(4, device='cpu')\n    s = TheSettings(a=1, x=x)",
            1,
        ),
        ("if x is None:\n        x = torch.zeros((4, 2))\n    s = raster.Settings(x=x)", 1),
        ("x = torch.zeros(4, requires_grad=True)\n    s = Settings(x=x)", 0),
        ("x = torch.zeros(4)\n    s = Settings(x)", 0),
        ("x = torch.zeros(4)\n    s = rasterizer(x=x)", 0),
        ("x = torch.zeros(4)\n    x[0] = 1\n    s = Settings(x=x)", 0),
        ("x = torch.zeros(4)\n    x += 1\n    s = Settings(x=x)", 0),
        ("x = torch.zeros(4)\n    x.fill_(1)\n    s = Settings(x=x)", 0),
        ("x = torch.zeros(4)\n    s = Settings(x=x)\n    return x", 0),
        ("x = torch.ones(4)\n    s = Settings(x=x)", 0),
    ],
)
def test_which_settings_are_kept(lines: str, changes: int) -> None:
    assert count_changes(SettingsZeros, f"def render(x=None):\n    {lines}") == changes


def test_zeros_of_settings_are_kept_for_our_rasterizer_alone(
    load_module: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = load_module(
        """
import torch
from types import SimpleNamespace as Settings

def render(size):
    mask = torch.zeros(size, dtype=torch.int, device="cpu")
    return Settings(mask=mask)
"""
    )
    wrapper = RasterizerWrapper(Stages())
    render = wrapper.renderer(module.render)
    for ours in (False, True):
        monkeypatch.setattr(RasterizerWrapper, "_renders_by_ours", ours)
        settings = [render(size).mask for size in (4, 4, 5)]
        assert [(mask.shape, mask.dtype, bool(mask.any())) for mask in settings] == [
            ((size,), torch.int32, False) for size in (4, 4, 5)
        ]
        assert (settings[0] is settings[1]) == ours
    settings[2].add_(1)
    assert not render(5).mask.any(), "made again once it was written"
    render(5).mask.data = torch.ones(5, dtype=torch.int)
    assert not render(5).mask.any(), "made again once it has other memory"
    with torch.inference_mode():
        assert not render(6).mask.any()
