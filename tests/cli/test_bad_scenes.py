"""Scenes that cannot be trained on: one printable line, exit code 2, and no run folder, from the whole command line."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
import pytest
from PIL import Image

from lapgs_plugin.cli.app import run as command_line
from lapgs_plugin.cli.evaluate import print_views
from lapgs_plugin.runs.archive import RunArchive
from tests.cli.run_folder import write_run, write_scene


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return a function that calls the command line, checks that it refuses, and returns its line."""

    def call(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["lapgs", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            command_line()
        output = capfd.readouterr()
        assert ended.value.code == 2
        assert output.out == ""
        (line,) = output.err.splitlines()
        assert line.isprintable()
        assert line.startswith("lapgs: ")
        return line

    return call


def change(scene: Path, frame: int, **values: Any) -> None:
    file = scene / "transforms.json"
    content = json.loads(file.read_text())
    content["frames"][frame].update(values)
    file.write_text(json.dumps(content))


def test_values_that_training_cannot_square(tmp_path: Path, refused: Callable[..., str]) -> None:
    scene, out = write_scene(tmp_path / "scene"), tmp_path / "run"
    pose = np.eye(4)
    pose[1, 3] = 1e300
    whole = (scene / "transforms.json").read_text()
    change(scene, 3, transform_matrix=pose.tolist())
    assert "frame 3 (photos/03.png) has 1e+300 in its transform_matrix" in refused("train", scene, "-o", out)
    (scene / "transforms.json").write_text(whole)
    header = "".join(f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
    (scene / "points3d.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 2\n{header}end_header\n0 0 0 1 1 1\n1 1 1 nan 0 0\n"
    )
    assert "colours of the sparse points hold NaN" in refused("train", scene, "-o", out)
    assert not out.exists()


def test_names_with_escape_sequences(tmp_path: Path, refused: Callable[..., str]) -> None:
    scene = write_scene(tmp_path / "scene")
    change(scene, 3, file_path="\x1b]0;owned\x07\x1b[2J\nlapgs: done\r\u202egnp")
    line = refused("train", scene, "-o", tmp_path / "run")
    assert r"\x1b]0;owned\x07\x1b[2J\nlapgs: done\r\u202egnp: no such image" in line


def test_damaged_photos_and_a_file_instead_of_a_run(tmp_path: Path, refused: Callable[..., str]) -> None:
    """Libraries print and raise in ways of their own."""
    pillow_heif.register_heif_opener()
    scene = write_scene(tmp_path / "scene")
    photo = scene / "photos" / "03.png"
    photo.write_bytes(photo.read_bytes()[:-40])
    assert "photos/03.png: the image is damaged or cut short" in refused(
        "train", scene, "-o", tmp_path / "run", "--iterations", 9
    )
    pixels = io.BytesIO()
    Image.new("RGB", (96, 64)).save(pixels, "HEIF")
    start = pixels.getvalue().index(b"mdat") + 4
    (scene / "photos" / "04.heic").write_bytes(pixels.getvalue()[:start] + bytes(9000))
    assert "04.heic: the photo cannot be decoded" in refused("prepare", scene / "photos", tmp_path / "made")
    (tmp_path / "scene.ply").write_bytes(b"ply\n")
    for command in ("view", "render", "import-run"):
        out = ("-o", tmp_path / "run") if command == "import-run" else ()
        assert "scene.ply is a file" in refused(command, tmp_path / "scene.ply", *out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene", "scene.ply"]


def test_a_folder_whose_name_is_not_utf8(tmp_path: Path, refused: Callable[..., str]) -> None:
    scene = tmp_path / os.fsdecode(b"scene\xff")
    line = refused("train", scene, "-o", tmp_path / "run", "--rasterizer", "cpu")
    assert r"scene\udcff: not UTF-8" in line


def test_the_table_of_views_prints_names_as_they_are_spelt(capsys: pytest.CaptureFixture[str]) -> None:
    from rich.console import Console

    view = {"name": "[red]a\x1b[2J\nb.png", "psnr": 20.0, "fitted_psnr": 20.0, "ssim": 0.5}
    print_views(Console(file=sys.stdout, width=100), {"views": [view], "lpips_missing": {}})
    assert r"[red]a\x1b[2J\nb.png" in capsys.readouterr().out


def test_a_path_of_a_billion_frames(tmp_path: Path, refused: Callable[..., str]) -> None:
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"))
    wide = {"w": 10**5, "h": 10**5, "fl_x": 1e5, "frames": [{"transform_matrix": np.eye(4).tolist()}]}
    (tmp_path / "path.json").write_text(json.dumps(wide))
    before = sorted(RunArchive.open(run).path().rglob("*"))
    for arguments, message in (
        (("--trajectory", "orbit", "--frames", 10**9), "expected at most 100,000 frames"),
        (("--trajectory", tmp_path / "path.json"), "has 100000x100000 pixels, expected at most 128,000,000 pixels"),
    ):
        for command in (("render", run), ("eval", run)):
            assert message in refused(*command, *arguments)
    assert sorted(run.rglob("*")) == before


@pytest.mark.parametrize("odd", ["loop", "pipe", "/dev/zero"])
@pytest.mark.parametrize(
    "command",
    [
        ("prepare", "{odd}", "out"),
        ("prepare", "scene/photos", "{odd}"),
        ("prepare", "scene/photos", "out", "--masks", "{odd}"),
        ("train", "{odd}", "-o", "out"),
        ("train", "scene", "-o", "{odd}"),
        ("train", "scene", "-o", "out", "--masks", "{odd}"),
        ("train", "scene", "-o", "out", "--config", "{odd}"),
        ("export", "{odd}"),
        ("report", "{odd}"),
        ("import-run", "{odd}"),
    ],
    ids=" ".join,
)
def test_links_to_themselves_pipes_and_devices_where_folders_are_expected(
    command: tuple[str, ...], odd: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path / "scene")
    Path("loop").symlink_to("loop")
    os.mkfifo("pipe")
    assert odd in refused(*(word.format(odd=odd) for word in command))
    assert not Path("out").exists()
