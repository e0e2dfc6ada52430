"""Read the files of `lapgs export` as other viewers do, and test how they mark residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import typer
from plyfile import PlyData

from lapgs_plugin.cli.export import export
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.runs.archive import RunArchive
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_run, write_scene
from tests.folders import files_in
from tests.refusals import refuses
from tests.unit.test_spz import read_spz

app = typer.Typer()
app.command("export")(export)

VIEWERS_NEED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity")
VIEWERS_NEED += ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
"""What SuperSplat, antimatter15's viewer and gsplat.js look for in a PLY's vertices."""
lapgs_export = succeeding(app, columns=200)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run", write_scene(tmp_path / "scene"))


def test_ply_of_every_level_for_other_viewers(run: Path) -> None:
    output = lapgs_export(run)
    assert "level_1_base.ply: 250 Gaussians" in output
    assert "level_0_residual.ply: 200 Gaussians" in output
    for name, level in (("level_1_base", 1), ("level_0_residual", 0)):
        ply = PlyData.read(str(run / "export" / f"{name}.ply"))
        assert not ply.text
        assert ply.byte_order == "<"
        (vertices,) = ply.elements
        assert vertices.name == "vertex"
        assert {p.name: p.val_dtype for p in vertices.properties}.items() >= dict.fromkeys(VIEWERS_NEED, "f4").items()
        field = RunArchive.open(run).field(level)
        np.testing.assert_array_equal(vertices["x"], field.means[:, 0].numpy())
        np.testing.assert_array_equal(vertices["f_dc_2"], field.sh[:, 0, 2].numpy())
    note = PlyData.read(str(run / "export" / "level_0_residual.ply")).comments
    assert note[0] == "lapgs_signed 1"
    assert "residual of level 0 of run: signed colours over zero" in note[1]
    assert PlyData.read(str(run / "export" / "level_1_base.ply")).comments == ["base of run, a hierarchy of 2 levels"]


def test_nested_levels_are_ordinary_fields(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"), nested=True)
    output = lapgs_export(run)
    assert "residual" not in output
    data = PlyData.read(run / "export" / "level_0_field.ply")
    assert any("field of level 0" in comment and "nested levels" in comment for comment in data.comments)
    assert not any("signed" in comment for comment in data.comments)


def test_spz_of_one_level(run: Path, tmp_path: Path) -> None:
    lapgs_export(run, "--format", "spz", "--level", 0, "--out", tmp_path / "out")
    assert files_in(tmp_path / "out") == {"level_0_residual.spz"}
    path = tmp_path / "out" / "level_0_residual.spz"
    assert b"residual of level 0 of run" in path.read_bytes()[:200]
    assert len(read_spz(path)[0]) == 200


def test_mistakes(run: Path, tmp_path: Path) -> None:
    refuses(UserInputError, "--format splat: expected ply, spz, spz4 or glb", lapgs_export, run, "--format", "splat")
    refuses(RunFolderError, "level 7 is not in this run", lapgs_export, run, "--level", 7)
    (tmp_path / "link").symlink_to("gone")
    refuses(UserInputError, r"--out .*link is no folder; expected a folder", lapgs_export, run, "-o", tmp_path / "link")
    (tmp_path / "file").touch()
    for merge in ((), ("--merge",)):  # before the fit, which takes minutes
        with pytest.raises(UserInputError, match=r"--out .*file is a file; expected a folder"):
            lapgs_export(run, "--out", tmp_path / "file", *merge)
    assert not (run / "export").exists()
    with pytest.raises(RunFolderError, match="level 1 is not in this run"):
        lapgs_export(write_run(tmp_path / "none", tmp_path / "scene", finished=0))
