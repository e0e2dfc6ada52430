"""Read clips of `lapgs render --trajectory` with OpenCV, and compare frames with images rendered one by one."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import typer

from lapgs_plugin.cli.render import render
from lapgs_plugin.errors import MissingExtraError, UserInputError
from lapgs_plugin.hierarchy.pyramid import Pyramid
from lapgs_plugin.rendering.run import run_cameras, run_renderer
from lapgs_plugin.rendering.trajectory import trajectory_json
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes.images import read_image
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_run, write_scene
from tests.folders import files_in
from tests.refusals import refuses

app = typer.Typer()
app.command("render")(render)

needs_video = pytest.mark.skipif(
    importlib.util.find_spec("imageio_ffmpeg") is None, reason="needs the extra 'video' (imageio-ffmpeg)"
)
lapgs_render = succeeding(app, columns=100)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    return write_run(folder / "run", write_scene(folder / "scene"))


@pytest.fixture
def path_file(run: Path, tmp_path: Path) -> Path:
    """Write a file with the first three training cameras."""
    train, _ = run_cameras(RunArchive.open(run))
    path = tmp_path / "path.json"
    path.write_text(json.dumps(trajectory_json(list(train.values())[:3])))
    return path


def video_frames(path: Path) -> list[np.ndarray]:
    capture = cv2.VideoCapture(str(path))
    frames = []
    while True:
        there, frame = capture.read()
        if not there:
            return frames
        frames.append(frame[:, :, ::-1])


@needs_video
def test_a_video_plays_and_shows_the_path(run: Path, path_file: Path, tmp_path: Path) -> None:
    output = lapgs_render(run, "--trajectory", path_file, "--out", tmp_path / "clip.mp4", "--frame-rate", 12)
    assert "3 frames" in output
    lapgs_render(run, "--trajectory", path_file, "--out", tmp_path / "frames")
    frames = video_frames(tmp_path / "clip.mp4")
    assert cv2.VideoCapture(str(tmp_path / "clip.mp4")).get(cv2.CAP_PROP_FPS) == pytest.approx(12)
    assert len(frames) == 3
    for index, frame in enumerate(frames):
        exact = cv2.imread(str(tmp_path / "frames" / f"frame_{index:05d}.png"))[:, :, ::-1].astype(float)
        # H.264 with halved colour: worst seen 4.1 of 255
        assert np.sqrt(np.mean((frame.astype(float) - exact) ** 2)) < 8.0
    assert files_in(tmp_path) == {"path.json", "clip.mp4", *(f"frames/frame_0000{i}.png" for i in range(3))}


@needs_video
@pytest.mark.parametrize("trajectory", ["orbit", "spline"])
def test_paths_of_the_scene_at_any_size(run: Path, trajectory: str, tmp_path: Path) -> None:
    out = tmp_path / "new" / "clip.MP4"
    lapgs_render(run, "--trajectory", trajectory, "--frames", 7, "--size", "80x32", "--panels", "--out", out)
    frames = video_frames(out)
    assert [frame.shape for frame in frames] == [(32, 3 * 80, 3)] * 7
    assert any(np.abs(frames[0].astype(int) - frame).mean() > 2 for frame in frames[1:])


def test_frames_are_the_renderers(run: Path, path_file: Path, tmp_path: Path) -> None:
    lapgs_render(run, "--trajectory", path_file, "--format", "exr", "--panels", "--out", tmp_path / "out")
    archive = RunArchive.open(run)
    camera = list(run_cameras(archive)[0].values())[1]
    composition = run_renderer(archive).render(camera)
    base = Pyramid("camera").up(composition.base, (40, 56))
    expected = torch.cat([base, composition.residuals[0], composition.composed[0]], dim=2)
    read = read_image(tmp_path / "out" / "frame_00001.exr")
    torch.testing.assert_close(read, expected, atol=1e-3, rtol=0)  # poses through JSON in float32; worst seen 2e-5


def test_a_coarser_level_fills_the_same_size(run: Path, path_file: Path, tmp_path: Path) -> None:
    lapgs_render(run, "--trajectory", path_file, "--format", "exr", "--level", 1, "--out", tmp_path / "coarse")
    lapgs_render(run, "--trajectory", path_file, "--format", "exr", "--panels", "--out", tmp_path / "panels")
    coarse = read_image(tmp_path / "coarse" / "frame_00000.exr")
    base = read_image(tmp_path / "panels" / "frame_00000.exr")[:, :, :56]
    torch.testing.assert_close(coarse, base)


def test_frames_through_the_cameras_of_a_file(run: Path, path_file: Path, tmp_path: Path) -> None:
    lapgs_render(run, "--trajectory", path_file, "--frames", 5, "--out", tmp_path / "out")
    assert len(files_in(tmp_path / "out")) == 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--frames", 5), "--frames needs --trajectory"),
        (("--panels",), "--panels needs --trajectory"),
        (("--trajectory", "orbit", "--views", "test"), "--views does not go with --trajectory"),
        (("--trajectory", "orbit", "--size", "big"), "--size 'big': expected WIDTHxHEIGHT"),
        (("--trajectory", "orbit", "--size", "81x40", "--out", "clip.mp4"), "a video's sides are even; use 82x40"),
        (("--trajectory", "orbit", "--out", "clip.avi"), r"expected an \.mp4 file or a folder"),
        (("--trajectory", "orbit", "--out", "clip.mp4", "--format", "exr"), "a video has 8 bits"),
        (("--trajectory", "orbit", "--out", "frames", "--frame-rate", 10), r"--frame-rate needs an \.mp4"),
        (
            ("--trajectory", "orbit", "--frames", 10**9),
            "--frames 1000000000, expected at most 100,000 ",
        ),
        (("--trajectory", "spline", "--frames", 10**9), "expected at most 100,000 frames"),
        (
            ("--trajectory", "orbit", "--size", "16384x16384"),
            "expected at most 128,000,000 pixels; ",
        ),
        (("--trajectory", "helix"), "give orbit, spline or a JSON file"),
        (("--trajectory", "orbit", "--level", 3), "level 3 cannot be rendered"),
    ],
)
def test_mistakes_are_one_line(run: Path, arguments: tuple[object, ...], message: str) -> None:
    refuses(UserInputError, message, lapgs_render, run, *arguments)


def test_without_ffmpeg_it_names_the_extra(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lapgs_plugin.errors.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"lapgs_plugin\[video\]"):
        lapgs_render(run, "--trajectory", "orbit", "--out", tmp_path / "clip.mp4")


def test_a_place_that_cannot_be_written(run: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (("--out", tmp_path / "file"), ("--trajectory", "orbit", "--out", tmp_path / "file" / "clip.mp4")):
        refuses(UserInputError, r"--out .*file is a file; expected a folder", lapgs_render, run, *out)
