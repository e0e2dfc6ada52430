"""Test the names, matrices and dictionaries for custom training loops."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import lapgs_plugin as lapgs
from lapgs_plugin.errors import FieldError
from tests.training_scene import blob_field, ring_camera


def test_every_public_name_is_there_and_importing_the_package_imports_no_torch() -> None:
    for name in lapgs.__all__:
        assert getattr(lapgs, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = lapgs.nothing
    code = "import sys, lapgs_plugin; sys.exit('torch' in sys.modules or 'gsplat' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@settings(deadline=None)
@given(width=st.integers(16, 500), height=st.integers(16, 500), level=st.integers(0, 3))
def test_intrinsics_of_a_level_are_those_of_its_camera(width: int, height: int, level: int) -> None:
    camera = replace(ring_camera(0.3, width, height), cx=0.4 * width, fy=1.3 * width)
    expected = lapgs.level_camera(camera, level).intrinsics
    found = lapgs.level_intrinsics(camera.intrinsics[None], (width, height), level)[0]
    torch.testing.assert_close(found, expected)
    # A ray through the image's corner leaves it at the same corner on every level.
    size = torch.tensor([*lapgs.level_size((width, height), level), 1.0])
    full = torch.tensor([width, height, 1.0])
    torch.testing.assert_close(torch.linalg.solve(found, size), torch.linalg.solve(camera.intrinsics, full))


def test_intrinsics_of_whole_numbers_are_not_rounded() -> None:
    found = lapgs.level_intrinsics(torch.tensor([[90, 0, 51], [0, 90, 25], [0, 0, 1]]), (102, 51), 1)
    expected = torch.tensor([[45.0, 0.0, 25.5], [0.0, 90 * 26 / 51, 25 * 26 / 51], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(found, expected)


def test_splats_and_fields_are_the_same_tensors() -> None:
    field = replace(blob_field(7), sh=torch.randn(7, 4, 3), signed=True)
    splats = lapgs.splats_from_field(field)
    assert {name: tuple(value.shape[1:]) for name, value in splats.items()} == {
        "means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (3, 3)
    }  # fmt: skip
    back = lapgs.field_from_splats({**splats, "features": torch.zeros(7)}, signed=True)
    for name, value in field.parameters.items():
        assert torch.equal(back.parameters[name], value)
    assert back.signed
    whole = {**{k: v for k, v in splats.items() if not k.startswith("sh")}, "sh": field.sh}
    assert lapgs.field_from_splats({**whole, "opacities": splats["opacities"][:, None]}).sh is field.sh


def test_gradients_arrive_at_the_splats() -> None:
    splats = {name: value.requires_grad_() for name, value in lapgs.splats_from_field(blob_field(5)).items()}
    sum(value.sum() for value in lapgs.field_from_splats(splats).parameters.values()).backward()
    assert all(torch.equal(value.grad, torch.ones_like(value)) for value in splats.values())


def test_splats_without_a_name_are_refused() -> None:
    splats = lapgs.splats_from_field(blob_field(5))
    del splats["quats"]
    with pytest.raises(FieldError, match=r"splats without quats \(they have means, scales"):
        lapgs.field_from_splats(splats)


def test_a_loops_own_run_folder_opens(tmp_path: Path) -> None:
    scene = lapgs.SceneReference("scene", "full", True, (0.0, 0.0, 0.0), "colmap")
    plan = lapgs.StagePlan.create((64, 48), 10, levels=2)
    field = blob_field(9)
    with lapgs.RunArchive.create(tmp_path / "run", lapgs.Manifest.of_loop(scene, 2, "gsplat", sh_degree=0)) as archive:
        archive.finish_level(lapgs.LevelRecord.of(plan[1], field, train_seconds=2.0), field)
    manifest = lapgs.RunArchive.open(tmp_path / "run").manifest
    assert manifest.next_level == 0
    (record,) = manifest.records
    assert (record.image_size, record.iterations, record.num_gaussians, record.train_seconds) == ((32, 24), 5, 9, 2.0)
