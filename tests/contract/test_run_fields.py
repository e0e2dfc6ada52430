"""Test importing fields into checkouts' models and exporting them."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.runner.context import StageResult, TrainingRun
from lapgs_plugin.runner.settings import RunSettings
from lapgs_plugin.runner.stage_model import StageModel
from tests.contract.stub_runs import NAMES, STUBS, drive_residuals, loaded, run_hierarchy

PARTS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def some_field(count: int = 50, degree: int = 3, signed: bool = True) -> GaussianField:
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    sh = normal(count, (degree + 1) ** 2, 3)
    return GaussianField(normal(count, 3), normal(count, 4), normal(count, 3), 3 * normal(count), sh, signed)


def model_of(adapter: Any, degree: int = 3) -> Any:
    return adapter.train.GaussianModel(degree)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("degree", [0, 3])
def test_a_field_comes_out_as_it_went_in(name: str, degree: int, scene: Path, tmp_path: Path) -> None:
    field = some_field(degree=degree)
    with loaded(STUBS[name], scene, tmp_path) as adapter:
        model = model_of(adapter, degree)
        adapter.import_field(model, field)
        out = adapter.export_field(model, signed=True)
        # In the layout of the checkout's own parameters.
        shapes = [tuple(getattr(model, part).shape) for part in ("_opacity", "_features_dc", "_features_rest")]
        assert shapes == [(50, 1), (50, 1, 3), (50, (degree + 1) ** 2 - 1, 3)]
        assert model._xyz.requires_grad
    assert out.signed
    for part in PARTS:
        assert torch.equal(getattr(out, part), getattr(field, part)), part
        assert getattr(out, part).data_ptr() != getattr(field, part).data_ptr(), "no shared memory"


@pytest.mark.parametrize("thin", [0, 1, 2, None])
def test_flat_gaussians_are_flat_along_the_models_axis(
    thin: int | None, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their models have two scales: 2DGS renders these, TrimGS puts a thin one before them."""
    field = some_field()
    with loaded(STUBS["graphdeco"], scene, tmp_path) as adapter:
        model, axis = model_of(adapter), 2 if thin is None else thin
        adapter.import_field(model, field)
        model._scaling = torch.nn.Parameter(field.log_scales[:, :2].clone())
        scales = model._scaling.exp()
        three = torch.cat([scales[:, :axis], torch.full((50, 1), 1e-8), scales[:, axis:]], 1)
        monkeypatch.setattr(type(model), "get_scaling", property(lambda _: scales if thin is None else three))
        out = adapter.export_field(model, signed=False)
        torch.testing.assert_close(out.log_scales.exp(), three.detach(), atol=1e-6, rtol=1e-6)
        again = model_of(adapter)
        adapter.import_field(again, out)
        torch.testing.assert_close(again._scaling, model._scaling)


@pytest.mark.parametrize("name", NAMES)
def test_the_checkouts_ply_is_the_exported_field(name: str, scene: Path, tmp_path: Path) -> None:
    """We read the checkout's files, and it exports the same field that we write."""
    field = some_field()
    with loaded(STUBS[name], scene, tmp_path) as adapter:
        model = model_of(adapter)
        adapter.import_field(model, field)
        model.save_ply(str(tmp_path / "theirs" / "point_cloud.ply"))
        adapter.export_field(model, signed=False).save_ply(tmp_path / "ours.ply")
    theirs, ours = (GaussianField.load_ply(tmp_path / path) for path in ("theirs/point_cloud.ply", "ours.ply"))
    for part in PARTS:
        assert torch.equal(getattr(theirs, part), getattr(ours, part)), part


def test_released_opacities_are_archived_as_logits(
    scene: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Taming-3DGS replaces opacities by absolute values, which may exceed 1."""
    with loaded(STUBS["taming"], scene, tmp_path) as adapter, torch.no_grad():
        model = model_of(adapter)
        adapter.import_field(model, some_field())
        before = model.get_opacity.clone()
        model.modify_functions()
        assert torch.equal(model.get_opacity, before)
        model._opacity[0], model._opacity[1] = -0.25, 1.5
        out = adapter.export_field(model, signed=True)
    opacities = torch.sigmoid(out.opacity_logits)
    assert torch.allclose(opacities[2:], before[2:, 0], atol=1e-6)
    assert opacities[0] == pytest.approx(0.25)
    assert opacities[1] == pytest.approx(1.0, abs=1e-5)
    assert "1 of 50 Gaussians have opacities above 1" in caplog.text


def test_a_run_with_released_opacities_is_archived(scene: Path, tmp_path: Path) -> None:
    """Opacities of the base are released during densification, and after it; those of a nested field once."""
    for ho_iteration, hierarchy, times in ((12, "laplacian", 2), (25, "laplacian", 2), (25, "nested", 1)):
        folder = tmp_path / f"{hierarchy}_{ho_iteration}"
        archive, result = run_hierarchy(
            STUBS["taming"], scene, folder, "--ho_iteration", ho_iteration, hierarchy=hierarchy
        )
        assert result.output.count("Release opacity limit") == times
        for level in (1, 0):
            archive.field(level).require_finite()


@pytest.mark.parametrize("name", NAMES)
def test_full_inheritance_takes_colours_and_optimizers_along(name: str, scene: Path, tmp_path: Path) -> None:
    moments: list[dict[str, Tensor]] = []
    values: list[dict[str, Tensor]] = []
    with loaded(STUBS[name], scene, tmp_path / "run", "--quiet") as adapter:
        model = adapter.train.GaussianModel
        # Every model begins an iteration here: the last state of the base, and the first one of the residual.
        update = model.update_learning_rate

        def spy(self: Any, iteration: int) -> Any:
            if iteration in (1, 30):
                state = self.optimizer.state
                values.append({g["name"]: p.detach().clone() for g, p in parameters(self)})
                moments.append({g["name"]: state[p]["exp_avg"].clone() for g, p in parameters(self) if p in state})
            return update(self, iteration)

        model.update_learning_rate = spy
        drive_residuals(adapter, inherit="full")
    none, base, residual, *_ = moments
    assert none == {}
    assert residual.keys() == base.keys() >= {"xyz", "f_dc", "opacity", "scaling", "rotation"}
    for group in base:
        # The last iteration of a stage takes no step, and here it does not densify either.
        assert torch.equal(base[group], residual[group]), group
    assert values[1].keys() == values[2].keys()
    assert all(torch.equal(value, values[2][group]) for group, value in values[1].items())


def parameters(model: Any) -> list[tuple[dict[str, Any], Tensor]]:
    return [(group, group["params"][0]) for group in model.optimizer.param_groups]


class Points(NamedTuple):
    """Points of a fork that has no normals, and an error and a colour map besides."""

    points: np.ndarray
    colors: np.ndarray
    normals: None
    errors: np.ndarray
    palette: str


def test_points_of_a_residual_have_what_a_fork_has_of_points() -> None:
    clouds: list[Points] = []
    points = Points(np.ones((7, 3)), np.ones((7, 3)), None, np.ones((7, 2), np.float32), "viridis")
    context = SimpleNamespace(adapter=None)
    model = SimpleNamespace(create_from_pcd=lambda cloud, *others: clouds.append(cloud))
    field = some_field(5)
    stage, before = Stage(0, (8, 6), 20, signed=True), StageResult(field, None, {}, {})
    scene = SimpleNamespace(points=points, others=(1.0,))
    others: Any = dict.fromkeys(field.name for field in fields(TrainingRun))
    run = TrainingRun(**{**others, "settings": RunSettings(inherit="xyz"), "context": context, "scene": scene})
    StageModel(run, stage, before).initialise(model)
    (cloud,) = clouds
    np.testing.assert_array_equal(cloud.points, field.means.double().numpy())
    assert (cloud.colors == 0.5).all()
    assert (cloud.normals, cloud.palette) == (None, "viridis")
    np.testing.assert_array_equal(cloud.errors, np.zeros((5, 2), np.float32))
