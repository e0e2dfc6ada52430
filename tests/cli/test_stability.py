"""Test output, files and refusals of `lapgs eval --trajectory`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import typer

from lapgs_plugin.cli.evaluate import evaluate
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.rendering.run import run_cameras
from lapgs_plugin.rendering.trajectory import trajectory_json
from lapgs_plugin.runs.archive import RunArchive
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_run
from tests.refusals import refuses

app = typer.Typer()
app.command("eval")(evaluate)
lapgs_eval = succeeding(app, columns=120)


def test_a_camera_that_stands_still_sees_no_flicker(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene)
    single = write_run(tmp_path / "single", scene, levels=1)
    camera = next(iter(run_cameras(RunArchive.open(run))[0].values()))
    (tmp_path / "still.json").write_text(json.dumps(trajectory_json([camera] * 3)))
    output = lapgs_eval(run, "--trajectory", tmp_path / "still.json", "--baseline", single)
    figures = json.loads((run / "stability.json").read_text())
    assert figures["frames"] == 3
    assert figures["size"] == [camera.width, camera.height]
    assert figures["baseline"] == str(single)
    assert list(figures["flicker"]) == ["composition", "band 1", "band 0", "single field"]
    assert all(curve["mean"] < 1e-5 and curve["psnr"] > 90 for curve in figures["flicker"].values())  # 1e-7, 100 seen
    for name in figures["flicker"]:
        assert name in output
    assert "stability.json holds these figures" in output


def test_an_orbit_shows_flicker(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene)
    lapgs_eval(run, "--trajectory", "orbit", "--frames", 90)
    figures = json.loads((run / "stability.json").read_text())
    assert figures["baseline"] is None
    assert list(figures["flicker"]) == ["composition", "band 1", "band 0"]
    assert 0 < figures["compared"] < 1
    assert figures["flicker"]["composition"]["mean"] > 1e-4


def test_a_path_whose_frames_show_nothing_in_common_is_refused(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene)
    camera = next(iter(run_cameras(RunArchive.open(run))[0].values()))
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))  # by 180 degrees about the vertical
    away = replace(camera, world_to_camera=turn @ camera.world_to_camera)
    (tmp_path / "jump.json").write_text(json.dumps(trajectory_json([camera, away])))
    refuses(UserInputError, "no two frames .* --frames", lapgs_eval, run, "--trajectory", tmp_path / "jump.json")
    assert not (run / "stability.json").exists()


def test_contradicting_options_are_refused(scene: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", scene)
    refuses(UserInputError, "--baseline needs --trajectory", lapgs_eval, run, "--baseline", run)
    with pytest.raises(UserInputError, match="--lpips does not go with --trajectory"):
        lapgs_eval(run, "--trajectory", "orbit", "--lpips", "vgg")
    with pytest.raises(UserInputError, match="has 2 levels, expected a single field"):
        lapgs_eval(run, "--trajectory", "orbit", "--frames", 3, "--baseline", run)
    refuses(UserInputError, "cannot be read", lapgs_eval, run, "--trajectory", tmp_path / "nowhere.json")
    (tmp_path / "bad.json").write_text(
        '{"w": 8, "h": 8, "fl_x": 9, "frames": [{"transform_matrix": [[1, 0], [0, 1]]}]}'
    )
    refuses(UserInputError, "frame 0 has no transform_matrix", lapgs_eval, run, "--trajectory", tmp_path / "bad.json")
    with pytest.raises(RunFolderError, match="only 1 of 2 levels"):
        lapgs_eval(write_run(tmp_path / "half", scene, finished=1), "--trajectory", "orbit")
    assert not (run / "stability.json").exists()
