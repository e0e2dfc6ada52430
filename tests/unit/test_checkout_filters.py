"""Filters of a checkout's Gaussians, made and applied by our operations only where its model does the same."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from lapgs_plugin.checkouts.attachment import Attachment
from lapgs_plugin.ops import smoothing_filter
from lapgs_plugin.runner import checkout_filters

MODEL = """
import torch

class Model:
    def __init__(self, xyz, logits, log_scales, filters):
        self._xyz, self._opacity, self._scaling, self.filter_3D = xyz, logits, log_scales, filters
        self.scaling_activation, self.opacity_activation = torch.exp, torch.sigmoid
        self.calls = []

    @property
    def get_scaling(self):
        return self.scaling_activation(self._scaling)

    @property
    def get_scaling_with_3D_filter(self):
        self.note("scales")
        return (self.get_scaling ** 2 + self.filter_3D ** 2) ** 0.5

    @property
    def get_opacity_with_3D_filter(self):
        self.note("opacities")
        before = self.get_scaling ** 2
        share = (before / (before + self.filter_3D ** 2)).prod(1, keepdim=True) ** 0.5
        return self.opacity_activation(self._opacity) * share

    @torch.no_grad()
    def compute_3D_filter(self, cameras):
        print("Filters")
        self.note("filters")
        best = torch.full((len(self._xyz),), 100000.0)
        found = torch.zeros(len(best), dtype=torch.bool)
        for camera in cameras:
            rotation = torch.tensor(camera.R, dtype=torch.float32)
            x, y, z = (self._xyz @ rotation + torch.tensor(camera.T, dtype=torch.float32)).T
            u = x / z.clamp(min=0.001) * camera.focal_x / camera.image_width
            v = y / z.clamp(min=0.001) * camera.focal_y / camera.image_height
            here = (z > 0.2) & (u.abs() <= 0.65) & (v.abs() <= 0.65)
            best = torch.where(here & (z < best), z, best)
            found |= here
        best[~found] = best[found].max()
        self.filter_3D = (best * 0.2 ** 0.5 / max(camera.focal_x for camera in cameras))[:, None]

    def note(self, name):
        getattr(self, "calls", []).append(name)
"""


def _plain(text: str) -> str:
    """Return the model without its list of calls, which only tests can see."""
    return "\n".join(line for line in text.split("\n") if "self.note(" not in line)


@pytest.fixture
def on_gpu(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace on a CPU, too, and count what is done by our operations."""
    done: list[str] = []

    def counted(name: str) -> Callable[..., Tensor]:
        original = getattr(smoothing_filter, name)

        def operation(*arguments: Any) -> Any:
            done.append(name)
            return original(*arguments)

        return operation

    for name in ("filtered_scales", "filtered_opacities", "nearest_depths"):
        monkeypatch.setattr(smoothing_filter, name, counted(name))
    monkeypatch.setattr(checkout_filters, "_has_kernels", lambda tensor: True)
    return done


def _model(module: ModuleType, n: int = 400) -> Any:
    generator = torch.Generator().manual_seed(1)
    xyz = torch.randn(n, 3, generator=generator)
    leaves = [torch.randn(n, columns, generator=generator).requires_grad_() for columns in (1, 3)]
    return module.Model(xyz, *leaves, torch.rand(n, 1, generator=generator))


def _cameras(count: int = 6) -> list[Any]:
    random = np.random.default_rng(2)
    cameras = []
    for index in range(count):
        rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
        size = {"image_width": 60 + index, "image_height": 40}
        cameras.append(SimpleNamespace(R=rotation, T=random.normal(size=3), focal_x=50.0 + index, focal_y=45.0, **size))
    return cameras


def _results(module: ModuleType, *, replaced: bool) -> tuple[list[Tensor], list[str]]:
    model, values = _model(module), []
    replacements = checkout_filters.replacements(module.Model, "the test") if replaced else []
    with Attachment(replacements):
        for _ in range(2):
            opacities, scales = model.get_opacity_with_3D_filter, model.get_scaling_with_3D_filter
            total = (opacities * opacities.detach().cos()).sum() + (scales * scales.detach().sin()).sum()
            values += [opacities, scales, *torch.autograd.grad(total, [model._opacity, model._scaling])]
            model.compute_3D_filter(cameras=_cameras())
            values.append(model.filter_3D)
    return values, model.calls


def test_ours_do_the_same(
    load_module: Callable[[str], ModuleType], on_gpu: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    module = load_module(_plain(MODEL))
    expected, _ = _results(module, replaced=False)
    printed = capsys.readouterr().out
    assert on_gpu == []
    values, _ = _results(module, replaced=True)
    assert capsys.readouterr().out == printed == 2 * "Filters\n"
    assert sorted(set(on_gpu)) == ["filtered_opacities", "filtered_scales", "nearest_depths"]
    for ours, theirs in zip(values, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)  # worst seen 3e-7
    properties = [vars(module.Model)[name] for name in (checkout_filters.SCALES, checkout_filters.OPACITIES)]
    assert all(isinstance(value, property) for value in properties)


def test_one_filter_for_all(load_module: Callable[[str], ModuleType], on_gpu: list[str]) -> None:
    """As models of archived fields have it, whose filters are in their scales."""
    module = load_module(_plain(MODEL))
    model = _model(module)
    model.filter_3D = torch.full((1, 1), 0.3)
    expected = model.get_opacity_with_3D_filter, model.get_scaling_with_3D_filter
    with Attachment(checkout_filters.replacements(module.Model, "the test")):
        ours = model.get_opacity_with_3D_filter, model.get_scaling_with_3D_filter
    for one, other in zip(ours, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
    assert set(on_gpu) == {"filtered_opacities", "filtered_scales"}


@pytest.mark.parametrize(
    ("written", "instead", "unreplaced"),
    [
        ("self.get_scaling ** 2 + self.filter_3D ** 2)", "self.get_scaling ** 2 + 2 * self.filter_3D ** 2)", "scales"),
        ("self.get_scaling ** 2 + self.filter_3D ** 2)", "self.get_scaling ** 2 + self.floor)", "scales"),
        ("* share", "* share.detach()", "opacities"),
        ("prod(1, keepdim=True) ** 0.5", "prod(1, keepdim=True)", "opacities"),
        ("u.abs() <= 0.65", "u.abs() <= 0.6", "filters"),
        ("v.abs() <= 0.65", "v.abs() <= 0.7", "filters"),
        ("z > 0.2", "z > 0.1", "filters"),
        ("here & (z < best), z, best", "here & (z < best), z.clamp(max=2.0), best", "filters"),
        ("camera.focal_x for camera", "camera.focal_y for camera", "filters"),
        ("found |= here", "found |= here & camera.sharp", "filters"),
        ('print("Filters")', "self.count = len(cameras)", "filters"),
        ("before = self.get_scaling ** 2", "before = self.kept = self.get_scaling ** 2", "opacities"),
        ("best[~found] = best[found].max()", "best[~found] = best[found].mean()", "filters"),
    ],
)
def test_what_differs_stays(
    load_module: Callable[[str], ModuleType], on_gpu: list[str], written: str, instead: str, unreplaced: str
) -> None:
    names = {"scales": "filtered_scales", "opacities": "filtered_opacities", "filters": "nearest_depths"}
    assert written in MODEL
    module = load_module(_plain(MODEL.replace(written, instead)))
    module.Model.floor = 0.25
    model = _model(module)
    cameras = [SimpleNamespace(**vars(camera), sharp=True) for camera in _cameras()]
    with Attachment(checkout_filters.replacements(module.Model, "the test")):
        for _ in range(2):
            on_gpu.clear()
            _ = model.get_opacity_with_3D_filter, model.get_scaling_with_3D_filter
            model.compute_3D_filter(cameras)
    # Ours was called by the comparison alone.
    assert names[unreplaced] not in on_gpu
    assert set(on_gpu) == {name for key, name in names.items() if key != unreplaced}


@pytest.mark.parametrize("kind", ["cpu", "activation", "no rows", "strided", "none seen", "other cameras"])
def test_what_does_not_fit_is_the_checkouts(
    load_module: Callable[[str], ModuleType], on_gpu: list[str], monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    module = load_module(MODEL)
    model, cameras = _model(module), _cameras()
    if kind == "cpu":
        monkeypatch.undo()
    elif kind == "activation":
        model.scaling_activation = model.opacity_activation = torch.nn.functional.softplus
    elif kind == "no rows":
        model.filter_3D = torch.zeros(1)
    elif kind == "strided":
        model._scaling = model._scaling.detach().T.contiguous().T
    elif kind == "none seen":
        model._xyz = torch.full_like(model._xyz, torch.nan)
    else:
        cameras[0].R = cameras[0].R.tolist()
    with Attachment(checkout_filters.replacements(module.Model, "the test")):
        if kind in ("none seen", "other cameras"):
            on_gpu.clear()
            model.calls.clear()
            if kind == "none seen":
                with pytest.raises((RuntimeError, IndexError)):
                    model.compute_3D_filter(cameras)
            else:
                model.compute_3D_filter(cameras)
            assert model.calls == ["filters"]
        else:
            _ = model.get_opacity_with_3D_filter, model.get_scaling_with_3D_filter
            assert model.calls == ["opacities", "scales"]
            assert on_gpu == []


def test_models_without_filters_are_left() -> None:
    assert checkout_filters.replacements(SimpleNamespace, "the test") == []
