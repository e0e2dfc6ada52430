"""Test the names, matrices and dictionaries for custom training loops."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import lapgs_plugin as lapgs
from lapgs_plugin.errors import FieldError, RunFolderError, UserInputError
from lapgs_plugin.reference_raster import CpuRasterizer
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
    intrinsics = lapgs.level_intrinsics(camera.intrinsics[None], (width, height), level)[0]
    torch.testing.assert_close(intrinsics, expected)
    # A ray through the image's corner leaves it at the same corner on every level.
    size = torch.tensor([*lapgs.level_size((width, height), level), 1.0])
    full = torch.tensor([width, height, 1.0])
    torch.testing.assert_close(torch.linalg.solve(intrinsics, size), torch.linalg.solve(camera.intrinsics, full))


def test_intrinsics_of_whole_numbers_are_not_rounded() -> None:
    intrinsics = lapgs.level_intrinsics(torch.tensor([[90, 0, 51], [0, 90, 25], [0, 0, 1]]), (102, 51), 1)
    expected = torch.tensor([[45.0, 0.0, 25.5], [0.0, 90 * 26 / 51, 25 * 26 / 51], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(intrinsics, expected)


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
    assert manifest.settings == {"hierarchy": "laplacian"}


def test_a_hierarchy_may_be_named() -> None:
    plan = lapgs.StagePlan.create((64, 48), 10, hierarchy="laplacian")
    assert [stage.signed for stage in plan] == [False, True]
    assert not any(stage.signed for stage in lapgs.StagePlan.create((64, 48), 10, hierarchy="nested"))


SCENE = lapgs.SceneReference("scene", "full", True, (0.0, 0.0, 0.0), "colmap")
IMAGE = torch.full((3, 20, 30), 0.5)
LEVELS = (255 * IMAGE).to(torch.uint8)
POINTS = torch.zeros(2, 3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: lapgs.StagePlan.create((64, 48), 10, hierarchy="nestd"), "nestd: expected nested or laplacian"),
        (lambda: lapgs.StagePlan.create((3, 48, 64), 10), r"\(3, 48, 64\): expected \(width, height\)"),
        (lambda: lapgs.StagePlan.create((0, 48), 10, 1), r"\(0, 48\): expected \(width, height\)"),
        (lambda: lapgs.level_size((64, 48), -1), "level -1: expected 0"),
        (lambda: lapgs.level_intrinsics(torch.eye(4), (64, 48), 1), r"\(4, 4\): expected \(\.\.\., 3, 3\)"),
        (lambda: lapgs.Pyramid().down(LEVELS), "uint8: expected floats; divide"),
        (lambda: lapgs.ImageStore("memory", "float32").put("a", LEVELS), "view a is of torch.uint8: expected floats"),
        (lambda: lapgs.ImageStore("disk", "float32"), "expected the folder"),
        (lambda: lapgs.photometric_loss(*[IMAGE.permute(1, 2, 0)] * 2), r"\(20, 30, 3\): expected channels first"),
        (lambda: lapgs.field_from_points(POINTS, 255 * torch.ones(2, 3), 1), "from 255 to 255: expected floats in"),
        (lambda: lapgs.field_from_points(POINTS, torch.ones(2, 3).byte(), 1), "torch.uint8 from 1 to 1: expected fl"),
        (lambda: lapgs.field_from_points(POINTS, torch.ones(3, 3), 1), r"\(2, 3\) and colours \(3, 3\): expected"),
        (lambda: lapgs.field_from_points(POINTS, torch.ones(2, 3), -1), "sh_degree -1: expected 0 to 3"),
        (lambda: lapgs.inherit(blob_field(2), sh_degree=7), "sh_degree 7: expected 0 to 3"),
        (
            lambda: CpuRasterizer()(blob_field(2), ring_camera(0), background=(0, 0, 0)),
            r"background is a tuple, expected a \(3,\) Tensor",
        ),
        (
            lambda: lapgs.field_from_splats({**lapgs.splats_from_field(blob_field(2)), "sh0": torch.zeros(2, 3)}),
            r"sh0 has shape \(2, 3\), expected",
        ),
        (lambda: lapgs.Manifest.of_loop("scene", 2, "cpu"), "scene is a str, expected a SceneReference"),
        (lambda: lapgs.Manifest.of_loop(SCENE, 2, "cpu", grid="x"), "grid x: expected camera or even"),
        (lambda: lapgs.Manifest.of_loop(SCENE, 2, "cpu", sh_degree=4), "sh_degree 4: expected 0 to 3"),
    ],
)
def test_mistakes_are_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(UserInputError, match=message):
        call()


def test_a_loop_that_forgets_what_is_finished_damages_nothing(tmp_path: Path) -> None:
    plan, field, other = lapgs.StagePlan.create((64, 48), 10), blob_field(9), blob_field(8)
    residual = replace(field, signed=True)
    with lapgs.RunArchive.create(tmp_path / "run", lapgs.Manifest.of_loop(SCENE, 2, "cpu", sh_degree=0)) as archive:
        with pytest.raises(RunFolderError, match=r"level 0 cannot be finished now, expected level 1"):
            archive.finish_level(lapgs.LevelRecord.of(plan[0], residual), residual)
        assert not archive.path("level_0").exists()
        archive.finish_level(lapgs.LevelRecord.of(plan[1], field), field)
        with pytest.raises(RunFolderError, match=r"level 1 cannot be finished now, expected level 0"):
            archive.finish_level(lapgs.LevelRecord.of(plan[1], other), other)
        with pytest.raises(FieldError, match=r"level 0 is an ordinary field .* its record says a residual"):
            archive.finish_level(lapgs.LevelRecord.of(plan[0], field), field)
        with pytest.raises(FieldError, match=r"level 0 has 9 Gaussians, its record says 8"):
            archive.finish_level(replace(lapgs.LevelRecord.of(plan[0], residual), num_gaussians=8), residual)
        with pytest.raises(UserInputError, match="it lacks iteration"):
            archive.append_history({"level": 0, "loss": 1.0})
        with pytest.raises(UserInputError, match="holds the Tensor"):
            archive.append_history({"level": 0, "iteration": 1, "loss": torch.ones(())})
        with pytest.raises(UserInputError, match=r"num_gaussians is 2\.5"):
            archive.append_history({"level": 0, "iteration": 1, "num_gaussians": 2.5})
        with pytest.raises(UserInputError, match="expected finite numbers"):
            archive.append_history({"level": 0, "iteration": 1, "loss": float("nan")})
    assert torch.equal(lapgs.RunArchive.open(tmp_path / "run").field(1).means, field.means)


def test_a_checkpoint_that_could_not_be_read_is_not_written(tmp_path: Path) -> None:
    weight = torch.nn.Parameter(torch.ones(2))
    optimizer = torch.optim.Adam([weight])
    weight.sum().backward()
    optimizer.step()
    state = {"splats": torch.nn.ParameterDict({"means": weight}).state_dict(), "optimizer": optimizer.state_dict()}
    others = {"size": weight.shape, "type": weight.dtype, "names": {"a"}, "bytes": b"x", "none": None, "pair": (1, 2.0)}
    with lapgs.RunArchive.create(tmp_path / "run", lapgs.Manifest.of_loop(SCENE, 2, "cpu")) as archive:
        archive.save_checkpoint({**state, **others})
        with pytest.raises(UserInputError, match=r"state\['state'\]\['config'\]\[1\] is a PosixPath, expected tensors"):
            archive.save_checkpoint({"config": [1, Path("x")]})
        checkpoint = archive.load_checkpoint()
    assert checkpoint is not None
    assert torch.equal(checkpoint["optimizer"]["state"][0]["exp_avg"], optimizer.state_dict()["state"][0]["exp_avg"])
    assert {name: checkpoint[name] for name in others} == others
