"""Filters of a checkout's Gaussians, made and applied by our operations only where its model does the same."""

from __future__ import annotations

import operator
from collections.abc import Callable
from contextlib import nullcontext
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

CALLS = []

class Model:
    def __init__(self, xyz, logits, log_scales, filters):
        self._xyz, self._opacity, self._scaling, self.filter_3D = xyz, logits, log_scales, filters
        self.scaling_activation, self.opacity_activation = torch.exp, torch.sigmoid

    @property
    def get_xyz(self):
        return self._xyz

    @property
    def get_scaling(self):
        return self.scaling_activation(self._scaling)

    @property
    def get_scaling_with_3D_filter(self):
        CALLS.append("scales")
        return (self.get_scaling ** 2 + self.filter_3D ** 2) ** 0.5

    @property
    def get_opacity_with_3D_filter(self):
        CALLS.append("opacities")
        before = self.get_scaling ** 2
        share = (before / (before + self.filter_3D ** 2)).prod(1, keepdim=True) ** 0.5
        return self.opacity_activation(self._opacity) * share

    @torch.no_grad()
    def compute_3D_filter(self, cameras):
        print("Filters")
        CALLS.append("filters")
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
"""


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


def _results(module: ModuleType, *, replaced: bool) -> list[Tensor]:
    model, values = _model(module), []
    replacements = checkout_filters.replacements(module.Model, "the test") if replaced else []
    with Attachment(replacements):
        for _ in range(2):
            opacities, scales = model.get_opacity_with_3D_filter, model.get_scaling_with_3D_filter
            total = (opacities * opacities.detach().cos()).sum() + (scales * scales.detach().sin()).sum()
            values += [opacities, scales, *torch.autograd.grad(total, [model._opacity, model._scaling])]
            model.compute_3D_filter(cameras=_cameras())
            values.append(model.filter_3D)
    return values


def test_ours_do_the_same(
    load_module: Callable[[str], ModuleType], on_gpu: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    module = load_module(MODEL)
    expected = _results(module, replaced=False)
    printed = capsys.readouterr().out
    assert on_gpu == []
    values = _results(module, replaced=True)
    assert capsys.readouterr().out == printed == 2 * "Filters\n"
    assert sorted(set(on_gpu)) == ["filtered_opacities", "filtered_scales", "nearest_depths"]
    for ours, theirs in zip(values, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)  # worst seen 3e-7
    properties = [vars(module.Model)[name] for name in (checkout_filters.SCALES, checkout_filters.OPACITIES)]
    assert all(isinstance(value, property) for value in properties)


def test_without_gradients_they_are_its_own(load_module: Callable[[str], ModuleType], on_gpu: list[str]) -> None:
    """As in resets of opacities, which divide by the share that filters leave: above 1, no logit gives a quotient."""
    module = load_module(MODEL)
    model = _model(module)
    with Attachment(checkout_filters.replacements(module.Model, "the test")):
        assert model.get_opacity_with_3D_filter.requires_grad
        module.CALLS.clear()
        on_gpu.clear()
        with torch.no_grad():
            model.get_opacity_with_3D_filter, model.get_scaling_with_3D_filter  # noqa: B018  # properties
    assert module.CALLS == ["opacities", "scales"]
    assert on_gpu == []


def test_one_filter_for_all(load_module: Callable[[str], ModuleType], on_gpu: list[str]) -> None:
    """As models of archived fields have it, whose filters are in their scales."""
    module = load_module(MODEL)
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
        ("self.filter_3D ** 2) ** 0.5", "self.filter_3D ** 2).clamp(min=1e-6) ** 0.5", "scales"),
        ("* share", "* share.detach()", "opacities"),
        ("* share", "* share.clamp(min=0.005)", "opacities"),
        ("before = self.get_scaling ** 2", "before = self.get_scaling.clamp(max=30.0) ** 2", "opacities"),
        ("here & (z < best), z, best", "here & (z < best), z.clamp(max=50.0), best", "filters"),
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
        ('print("Filters")', 'print("Filters of", len(self.get_xyz))', "filters"),
    ],
)
def test_what_differs_stays(
    load_module: Callable[[str], ModuleType], on_gpu: list[str], written: str, instead: str, unreplaced: str
) -> None:
    names = {"scales": "filtered_scales", "opacities": "filtered_opacities", "filters": "nearest_depths"}
    assert written in MODEL
    module = load_module(MODEL.replace(written, instead))
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


def _read(model: Any) -> None:
    _ = model.get_opacity_with_3D_filter, model.get_scaling_with_3D_filter


@pytest.mark.parametrize("kind", ["cpu", "activation", "no rows", "strided", "recorded"])
def test_properties_of_what_does_not_fit_are_the_checkouts(
    load_module: Callable[[str], ModuleType], on_gpu: list[str], monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    module = load_module(MODEL)
    model = _model(module)
    if kind == "activation":
        model.scaling_activation = model.opacity_activation = torch.nn.functional.softplus
    elif kind == "no rows":
        model.filter_3D = torch.zeros(1)
    elif kind == "strided":
        model._scaling = model._scaling.detach().T.contiguous().T
    elif kind == "recorded":
        model.filter_3D.requires_grad_()
    with Attachment(checkout_filters.replacements(module.Model, "the test")):
        for read in (_model(module), _model(module), model):  # the first time it is compared with ours
            if read is model and kind == "cpu":
                monkeypatch.undo()
            on_gpu.clear()
            module.CALLS.clear()
            _read(read)
            if read is not model:
                continue
            assert (module.CALLS, on_gpu) == (["opacities", "scales"], [])


@pytest.mark.parametrize("kind", ["none seen", "no array", "numbers", "focal", "two arguments", "other centres"])
def test_filters_of_what_does_not_fit_are_the_checkouts(
    load_module: Callable[[str], ModuleType], on_gpu: list[str], kind: str
) -> None:
    module = load_module(MODEL.replace("compute_3D_filter(self, cameras)", "compute_3D_filter(self, cameras, _=None)"))
    model, cameras = _model(module), _cameras()
    with Attachment(checkout_filters.replacements(module.Model, "the test")):
        for _ in range(2):
            module.CALLS.clear()
            model.compute_3D_filter(cameras)
        assert module.CALLS == []  # ours does it
        if kind == "none seen":
            model._xyz = torch.full_like(model._xyz, torch.nan)
        elif kind == "no array":
            cameras[0].R = cameras[0].R.tolist()
        elif kind == "numbers":
            cameras[0].T = cameras[0].T.round().astype(int)
        elif kind == "focal":
            cameras[0].focal_x = torch.tensor(50.0)
        elif kind == "other centres":
            module.Model.get_xyz = property(lambda self: self._xyz + 1)
        arguments = (cameras, None) if kind == "two arguments" else (cameras,)
        with pytest.raises((RuntimeError, IndexError)) if kind == "none seen" else nullcontext():
            model.compute_3D_filter(*arguments)
    assert module.CALLS == ["filters"]


def test_properties_without_a_function_are_left(load_module: Callable[[str], ModuleType]) -> None:
    module = load_module(MODEL)
    setattr(module.Model, checkout_filters.SCALES, property(operator.attrgetter("_scaling")))
    setattr(module.Model, checkout_filters.OPACITIES, property())
    names = [replacement.name for replacement in checkout_filters.replacements(module.Model, "the test")]
    assert names == [checkout_filters.COMPUTE]


def test_models_without_filters_are_left() -> None:
    assert checkout_filters.replacements(SimpleNamespace, "the test") == []
