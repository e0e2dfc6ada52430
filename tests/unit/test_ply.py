"""PLY headers that promise more than the file holds are refused in one line, before memory is allocated."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from lapgs_plugin.errors import FieldError, SceneError
from lapgs_plugin.fields.gaussian_field import GaussianField, count_gaussians
from lapgs_plugin.fields.ply import read_ply
from lapgs_plugin.scenes import blender
from lapgs_plugin.scenes.point_cloud import read_point_cloud
from tests.cli.run_folder import write_scene
from tests.refusals import refuses

ASCII, BINARY = "format ascii 1.0", "format binary_little_endian 1.0"
XYZ = "property float x\nproperty float y\nproperty float z"


def ply(kind: str, elements: str, data: bytes = b"0 0 0\n") -> bytes:
    return f"ply\n{kind}\n{elements}\nend_header\n".encode() + data


DAMAGED = {
    "empty": (b"", "is not a PLY file"),
    "image": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "is not a PLY file"),
    "no ply": (b"PK\x03\x04", "is not a PLY file"),
    "no end": (b"ply\n" + b"comment a\n" * 100_000, "no end_header in its first"),
    "one line": (b"ply\n" + b"a" * 2_000_000, "no end_header in its first"),
    "negative": (ply(ASCII, f"element vertex -5\n{XYZ}"), "counts '-5', expected a number from 0"),
    "30 digits": (ply(ASCII, f"element vertex {'9' * 30}\n{XYZ}"), "counts '9+', expected a number"),
    "a word": (ply(BINARY, f"element vertex many\n{XYZ}"), "counts 'many'"),
    "1e9, text": (ply(ASCII, f"element vertex 1000000000\n{XYZ}"), "after 1 of 1000000000 "),
    "1e9": (ply(BINARY, f"element vertex 1000000000\n{XYZ}", bytes(24)), "after 2 of 1000000000 "),
    "1e9 lists": (ply(BINARY, "element vertex 1000000000\nproperty list uchar float x"), "after 6 of 1000000000 "),
    "later": (ply(BINARY, f"element vertex 1\n{XYZ}\nelement face 99999\n{XYZ}", bytes(24)), "after 1 of 99999 .face"),
    "nothing": (ply(BINARY, "element vertex 1000000000"), "without any property"),
    "twice": (ply(ASCII, f"element vertex 1\n{XYZ}\nproperty float x", b"0 0 0 0\n"), "two properties with same name"),
    "kind": (ply("format klingon 1.0", f"element vertex 1\n{XYZ}"), "is not a PLY file"),
    "type": (ply(ASCII, "element vertex 1\nproperty complex x"), "is not a PLY file"),
    "no UTF-8": (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float \xff\nend_header\n1\n", "is not a PLY file"),
    "overflow": (ply(ASCII, "element vertex 1\nproperty uchar x", b"300\n"), "PLY file|damaged"),
    "a long list": (
        ply(BINARY, "element vertex 1\nproperty list uint double x", b"\xff\xff\xff\xff" + bytes(80)),
        "cut short or damaged|PLY file",
    ),
    "a list of -1": (ply(ASCII, "element vertex 1\nproperty list int float x", b"-1 2 3\n"), "damaged"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damage_is_one_line_for_fields_and_for_points(name: str, tmp_path: Path) -> None:
    contents, message = DAMAGED[name]
    path = tmp_path / "points3d.ply"
    path.write_bytes(contents)
    tracemalloc.start()
    try:
        for read in (GaussianField.load_ply, count_gaussians):
            line = refuses(FieldError, message, read, path)
            assert str(path) in line
        refuses(SceneError, message, read_point_cloud, tmp_path / "points3d.ply", str(tmp_path / "points3d.ply"))
        assert tracemalloc.get_traced_memory()[1] < 50 * 2**20  # 3 MiB seen
    finally:
        tracemalloc.stop()


def test_a_message_that_quotes_a_header_is_short(tmp_path: Path) -> None:
    path = tmp_path / "long.ply"
    path.write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty " + "x" * 5000 + " a\nend_header\n")
    with pytest.raises(ValueError, match="it is not a PLY file") as caught:
        read_ply(path)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("text", [False, True])
def test_whole_files_of_several_elements_are_read(text: bool, tmp_path: Path) -> None:
    elements = f"comment one\nelement vertex 2\n{XYZ}\nelement face 1\nproperty list uchar int vertex_indices"
    data = b"1 2 3\n4 5 6\n3 0 1 1" if text else np.arange(1, 7, dtype="<f4").tobytes() + b"\x01" + bytes(4)
    for line_break in (b"\n", b"\r\n"):
        header = ply(ASCII if text else BINARY, elements, b"").replace(b"\n", line_break)
        (tmp_path / "a.ply").write_bytes(header + data)
        vertices = read_ply(tmp_path / "a.ply")["vertex"]
        assert [tuple(row) for row in vertices.data] == [(1, 2, 3), (4, 5, 6)]


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        (f"{XYZ}\nproperty list uchar uchar red\nproperty uchar green\nproperty uchar blue", "red missing or a list"),
        ("property list uchar float x\nproperty float y\nproperty float z", "x missing or a list"),
        ("property float x\nproperty float y", "z missing or a list"),
    ],
)
def test_points_need_numbers(elements: str, message: str, tmp_path: Path) -> None:
    values = {"red": "1 7", "x": "1 7", "z": ""}
    names = [line.split()[-1] for line in elements.splitlines()]
    row = " ".join(
        values[name] if "list" in line else "1" for name, line in zip(names, elements.splitlines(), strict=True)
    )
    (tmp_path / "points3d.ply").write_bytes(ply(ASCII, f"element vertex 1\n{elements}", f"{row}\n".encode()))
    refuses(SceneError, message, read_point_cloud, tmp_path / "points3d.ply", str(tmp_path / "points3d.ply"))


def test_a_scene_with_damaged_points_is_one_line(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    (scene / "points3d.ply").write_bytes(DAMAGED["1e9"][0])
    with pytest.raises(SceneError, match=r"points3d\.ply: not readable as a PLY of points \(it is cut short"):
        blender.read_transforms(scene, "images", False)
    assert json.loads((scene / "transforms.json").read_text())["frames"]
