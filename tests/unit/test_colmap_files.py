"""COLMAP's files as people and programs write them: only what training needs has to be right."""

from __future__ import annotations

import json
import os
import re
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from lapgs_plugin.errors import SceneError
from lapgs_plugin.scenes.colmap import find_model, largest_model, read_colmap, why_no_points
from lapgs_plugin.scenes.colmap_model import read_model
from lapgs_plugin.scenes.point_cloud import RANGES, read_point_cloud
from tests.refusals import refuses
from tests.unit.test_scenes_colmap import COLORS, POINTS, Model, load, make_scene, refused

NAMES = ("my photo 01.png", "b.png", "0007", "left cam/d 2.png")
"""With spaces, and one that is a number."""

Layout = Callable[[Sequence[str]], str]


def between(text: str) -> Layout:
    """Return a layout with this text after each image."""
    return lambda images: "".join(image + text for image in images)


LAYOUTS: dict[str, Layout] = {
    "as COLMAP writes it": between("\n1.5 2 -1 3.25 4 17\n"),
    "without features": between("\n\n"),
    "without its last line": "\n\n".join,
    "without the end of its last line": "\n1.5 2.5 -1\n".join,
    "one line an image": between("\n"),
    "one line an image, not ended": "\n".join,
    "empty lines in between": between("\n\n\n"),
    "features after an empty line": between("\n\n1.5 2.5 -1\n\n"),
    "Windows": between("\r\n1.5 2.5 -1\r\n"),
    "a byte-order mark": lambda images: "\ufeff" + between("\n\n")(images),
    "comments": lambda images: "# images\n\n" + between("\n# features\n\n # next\n")(images),
    "tabs": lambda images: between("\n\n")([re.sub(" ", "\t", image, count=9) for image in images]),
    "spaces around": lambda images: between(" \n \n")([f"  {image}  " for image in images]),
    "numpy's whole numbers": lambda images: between("\n\n")([re.sub("^([0-9]+)", r"\1.000e+00", i) for i in images]),
    "features cut short": between("\n1.5 2.5 -1 3.5\n"),
    "features of NaN": between("\nnan nan -1\n"),
    "made-up features": between("\n0 0 1 0 0 1 0 0 1 0 0 1\n"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_images(tmp_path: Path, layout: str) -> None:
    model = Model(NAMES)
    model.write(tmp_path, binary=False)
    file = tmp_path / "images.txt"
    images = file.read_text().split("\n\n")[: len(NAMES)]
    file.write_bytes(LAYOUTS[layout](images).encode())
    read = read_model(tmp_path)
    assert tuple(image.name for image in read.images.values()) == NAMES
    for index, image in enumerate(read.images.values()):
        vector, translation = model.pose(index)
        expected = np.column_stack([cv2.Rodrigues(vector)[0], translation])
        np.testing.assert_allclose(image.pose.matrix(), expected, rtol=0, atol=1e-12)  # seen 5e-16


@pytest.mark.parametrize("layout", ["as COLMAP writes it", "without features", "one line an image"])
def test_images_that_end_inside_a_line_lose_none_silently(tmp_path: Path, layout: str) -> None:
    Model(NAMES).write(tmp_path, binary=False)
    file = tmp_path / "images.txt"
    images = file.read_text().split("\n\n")[: len(NAMES)]
    whole = LAYOUTS[layout](images)
    first = whole.index(images[-1])
    for end in range(first + 1, first + len(images[-1])):
        file.write_text(whole[:end])
        if len(whole[first:end].split()) < 10:
            refuses(SceneError, rf"images\.txt: line {whole[:end].count(chr(10)) + 1} is", read_model, tmp_path)
        else:  # a name that is cut is told when its photo is not there
            assert len(read_model(tmp_path).images) == len(NAMES)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (r"$", " 1 0"),  # made up
        (r"$", " 1 0 99 0"),  # of a photo that was removed
        (r"$", " 1 4000000000 -1 -1"),
        (r"$", " 1"),
        (r"$", " a track"),
        (r" \S+$", ""),  # no error
        (r" \S+$", " nan"),
        (r"^\S+", "1"),  # ids
        (r"^\S+", "-1"),
        (r" (\S+) (\S+) (\S+) (\S+)$", r" \1.0 \2.0 \3.0 \4"),
    ],
)
def test_what_training_does_not_need_of_points(tmp_path: Path, old: str, new: str) -> None:
    path = make_scene(tmp_path, binary=False)
    file = path / "sparse" / "0" / "points3D.txt"
    file.write_text("\n".join(re.sub(old, new, line) for line in file.read_text().splitlines()))
    scene = load(path)
    np.testing.assert_allclose(scene.points.numpy(), POINTS, rtol=0, atol=1e-7)
    np.testing.assert_allclose(scene.colors.numpy(), COLORS / 255, rtol=0, atol=1e-7)


def test_binary_files_with_made_up_tracks_ids_and_bytes_at_the_end(tmp_path: Path) -> None:
    path = make_scene(tmp_path)
    rows = zip(POINTS, COLORS.astype(np.uint8), strict=True)
    records = [struct.pack("<Q3d3BdQ4I", 1, *xyz, *rgb, np.nan, 2, 99, 0, 1, 7) for xyz, rgb in rows]
    folder = path / "sparse" / "0"
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(POINTS)) + b"".join(records))
    for file in folder.glob("*.bin"):
        file.write_bytes(file.read_bytes() + b"more")
    scene = load(path)
    assert len(scene.train) == 10
    np.testing.assert_allclose(scene.points.numpy(), POINTS, rtol=0, atol=1e-7)
    np.testing.assert_allclose(scene.colors.numpy(), COLORS / 255, rtol=0, atol=1e-7)


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
def test_names_with_backslashes(tmp_path: Path, binary: bool) -> None:
    names = ("left/a.png", "left/b.png")
    path = make_scene(tmp_path, Model(names), binary=False)
    folder = path / "sparse" / "0"
    text = (folder / "images.txt").read_text().replace("left/", "left\\")
    (folder / "images.txt").write_text(text)
    if binary:
        pycolmap.Reconstruction(folder).write_binary(folder)
        for file in folder.glob("*.txt"):
            file.unlink()
        assert b"left\\a.png" in (folder / "images.bin").read_bytes()
    assert [view.name for view in load(path).train] == list(names)


@pytest.mark.parametrize("folder", ["images", "/home/me/photos", "../images", "C:\\photos"])
def test_names_with_a_folder_that_is_not_there(tmp_path: Path, folder: str) -> None:
    """As 3DGS reads them: by what follows the last slash."""
    path = make_scene(tmp_path, Model(NAMES[:2]), binary=False)
    file = path / "sparse" / "0" / "images.txt"
    file.write_text(re.sub(r"(?m)(my photo|b\.png)", lambda name: f"{folder}/{name[0]}", file.read_text()))
    assert {view.name for view in load(path).train} == set(NAMES[:2])
    (path / "images" / "b.png").unlink()
    refuses(SceneError, r"b\.png", load, path)


# Files that contradict each other


def rig_of_two(folder: Path) -> None:
    """Write a model of two frames of a rig of two cameras."""
    model = pycolmap.Reconstruction()
    for key in (1, 2):
        model.add_camera(pycolmap.Camera(camera_id=key, model="PINHOLE", width=96, height=64, params=[80, 80, 48, 32]))
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    aside = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0.3, 0])), np.array([0.2, 0, 0]))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), aside)
    model.add_rig(rig)
    for number in (1, 2):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1 * number, 0, 0])), np.array([number, 0.5, 2]))
        frame = pycolmap.Frame(frame_id=number, rig_id=1, rig_from_world=pose)
        images = [
            pycolmap.Image(name=f"{number}{key}.png", camera_id=key, image_id=10 * number + key, frame_id=number)
            for key in (1, 2)
        ]
        for image in images:
            frame.add_data_id(image.data_id)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
    model.add_point3D(np.zeros(3), pycolmap.Track(), np.zeros(3, np.uint8))
    model.write_text(folder)
    model.write_binary(folder)


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("edit", ["none", "pose", "sensor", "removed", "cut"])
def test_poses_are_those_of_the_images_not_of_the_frames(tmp_path: Path, kind: str, edit: str) -> None:
    """Frames and rigs of COLMAP 3.12 are not edited by scripts that edit images."""
    rig_of_two(tmp_path)
    for file in tmp_path.glob(f"*.{'txt' if kind == 'bin' else 'bin'}"):
        file.unlink()
    expected = pycolmap.Reconstruction(tmp_path)
    poses = {image.name: image.cam_from_world().matrix() for image in expected.images.values()}
    if edit == "cut":
        frames = tmp_path / f"frames.{kind}"
        frames.write_bytes(frames.read_bytes()[:-3] if kind == "bin" else frames.read_bytes()[:-30])
    elif edit == "sensor":
        model = pycolmap.Reconstruction(tmp_path)
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2)
        model.rigs[1].set_sensor_from_rig(sensor, pycolmap.Rigid3d())
        before = {file: file.read_bytes() for file in tmp_path.glob("images.*")}
        (model.write_binary if kind == "bin" else model.write_text)(tmp_path)
        for file, content in before.items():
            file.write_bytes(content)
    elif edit != "none":
        before = {file: file.read_bytes() for file in (*tmp_path.glob("frames.*"), *tmp_path.glob("rigs.*"))}
        model = pycolmap.Reconstruction(tmp_path)
        if edit == "pose":
            model.frames[2].rig_from_world = pycolmap.Rigid3d()
        else:
            model.deregister_frame(2)
        (model.write_binary if kind == "bin" else model.write_text)(tmp_path)
        for file, content in before.items():
            file.write_bytes(content)
        poses = {image.name: image.cam_from_world().matrix() for image in model.images.values() if image.has_pose}
    read = read_model(tmp_path)
    assert {image.name for image in read.images.values()} == set(poses)
    for image in read.images.values():
        np.testing.assert_allclose(image.pose.matrix(), poses[image.name], rtol=0, atol=1e-12)
    if edit == "none":
        assert read.warnings == ()
    else:
        (line,) = read.warnings
        difference = "damaged" if edit == "cut" else "2 of 4 entries"
        assert re.search(rf"frames\.{kind}: {difference}.*; images\.{kind} is used, COLMAP uses the frames", line)


def test_images_that_were_numbered_anew_are_none_of_the_frames(tmp_path: Path) -> None:
    rig_of_two(tmp_path)
    file = tmp_path / "images.txt"
    for other in tmp_path.glob("*.bin"):
        other.unlink()
    file.write_text(re.sub(r"(?m)^([12][12] \S+ \S+ \S+ )", r"9\1", file.read_text()))
    (line,) = read_model(tmp_path).warnings
    assert "frames.txt: 4 of 4 entries differ" in line


def test_text_beside_binary_files(tmp_path: Path) -> None:
    folder = tmp_path
    Model(NAMES).write(folder, binary=False)
    texts = {file: file.read_text() for file in folder.glob("*.txt")}
    Model(NAMES).write(folder)
    for file, text in texts.items():
        file.write_text(text)
    assert read_model(folder).warnings == ()
    for name, old, new, difference in (
        ("cameras", "80", "90", "1 of 1 entries"),
        ("images", "b.png", "c.png", "1 of 4 entries"),
        ("images", "4.0 ", "4.5 ", "1 of 4 entries"),
        ("images", r" 1 b\.png", "", "damaged"),
        ("points3D", r"^1 .*\n", "", "39 points in place of 40"),
    ):
        file = folder / f"{name}.txt"
        file.write_text(re.sub(old, new, texts[file], count=1))
        (line,) = read_model(folder).warnings
        assert re.search(rf"{name}\.txt: {difference}.*; {name}\.bin is used, remove", line)
        file.write_text(texts[file])
    (folder / "images.bin").unlink()
    (folder / "images.txt").write_text(texts[folder / "images.txt"].replace("b.png", "c.png"))
    assert "c.png" in {image.name for image in read_model(folder).images.values()}  # as in 3DGS, which needs both


def write_ply(
    file: Path, points: NDArray[Any], colors: NDArray[Any], names: Sequence[str] = ("red", "green", "blue")
) -> None:
    kinds = [*((axis, "f4") for axis in "xyz"), *((name, colors.dtype.str) for name in names)]
    rows = np.empty(len(points), kinds)
    for name, column in zip(("x", "y", "z", *names), (*points.T, *colors.T), strict=True):
        rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(file))


def test_a_ply_beside_the_points_is_for_codebases(tmp_path: Path) -> None:
    path = make_scene(tmp_path)
    file = path / "sparse" / "0" / "points3D.ply"
    write_ply(file, POINTS, COLORS.astype(np.uint8))
    assert read_model(file.parent).warnings == ()
    assert f"{file}: its 40 points are not readable for this codebase, expected the 40 of" in why_no_points(path)
    write_ply(file, POINTS[:0], COLORS[:0].astype(np.uint8))
    source = read_colmap(path, file.parent, "images", evaluate=False)
    assert len(source.points) == len(POINTS)
    (line,) = source.warnings
    assert f"{file}: 0 points in place of 40; points3D.bin is used, codebases of 3DGS use the PLY" in line
    why = why_no_points(path)
    assert f"{file}: no points in it, expected the 40 of the model; none of these has 3 photos in its track" in why
    assert f"remove points3D.ply, or train with `lapgs train {path}`" in why
    (file.parent / "points3D.bin").unlink()
    write_ply(file, POINTS, COLORS.astype(np.uint8))
    np.testing.assert_allclose(load(path).points.numpy(), POINTS, rtol=0, atol=1e-6)  # 3DGS needs no other file then
    file.unlink()
    refused(path, r"incomplete, it has only cameras\.bin, images\.bin; expected")


@pytest.mark.parametrize("written", ["ply", "bin", "ply and bin"])
def test_a_scene_without_a_point_names_the_empty_file(tmp_path: Path, written: str) -> None:
    path = make_scene(tmp_path, Model(points=POINTS[:0]))
    folder = path / "sparse" / "0"
    if "ply" in written:
        write_ply(folder / "points3D.ply", POINTS[:0], COLORS[:0].astype(np.uint8))
    if "bin" not in written:
        (folder / "points3D.bin").unlink()
    why = why_no_points(path)
    assert why.startswith(f"{folder / 'points3D'}.{written.partition(' ')[0]}: no points in it, expected some")
    assert "triangulate points with COLMAP" in why
    assert f"train with `lapgs train {path}`" in why


def test_points_that_three_photos_see_only_need_their_ply_again(tmp_path: Path) -> None:
    path = make_scene(tmp_path, binary=False)
    model = path / "sparse" / "0" / "points3D.txt"
    model.write_text(model.read_text().replace("\n", " 1 0 2 0 3 0\n"))
    ply = model.with_suffix(".ply")
    write_ply(ply, POINTS[:0], COLORS[:0].astype(np.uint8))
    assert f"{ply}: no points in it, expected the 40 of the model; remove points3D.ply, so" in why_no_points(path)
    ply.unlink()
    assert f"{model}: this codebase takes none of its points, expected the 40 of the model" in why_no_points(path)


def test_a_transforms_file_beside_a_model(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = make_scene(tmp_path, Model(NAMES[:2]))
    (path / "transforms.json").write_text(json.dumps({"frames": [{}] * 2}))
    load(path)
    assert not caplog.records
    (path / "transforms.json").write_text(json.dumps({"frames": [{}]}))
    assert len(load(path).train) == 2
    assert f"{path}/transforms.json lists 1 photo and {path}/sparse/0 2, which are used" in caplog.text


def test_the_largest_of_text_models(tmp_path: Path) -> None:
    few, many = make_scene(tmp_path, Model(NAMES[:2])), tmp_path / "sparse" / "1"
    Model(NAMES).write(many, binary=False)
    model = find_model(few)
    assert model is not None
    assert largest_model(tmp_path, model) == many
    (model / "images.bin").write_bytes(struct.pack("<Q", 2**63))  # counts more images than it has bytes
    assert largest_model(tmp_path, model) == many
    (many / "images.txt").write_text("no image")
    assert largest_model(tmp_path, model) == model


# Colours of points


@pytest.mark.parametrize(
    ("kind", "scale"),
    [
        ("u1", 255),
        ("i4", 255),
        ("u2", 255),
        ("f4", 255),
        ("f8", 255),
        ("f4", 1),
        ("f8", 1),
        ("u2", 65535),
        ("f4", 65535),
    ],
)
def test_colours_by_their_values(tmp_path: Path, kind: str, scale: float) -> None:
    colors = (COLORS / 255 * scale).astype(kind)
    for names in (
        ("red", "green", "blue"),
        ("Red", "Green", "Blue"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        ("r", "g", "b"),
        ("R", "G", "B"),
    ):
        write_ply(tmp_path / "a.ply", POINTS, colors, names)
        cloud = read_point_cloud(tmp_path / "a.ply", "a.ply")
        np.testing.assert_allclose(cloud.rgb, COLORS / 255, rtol=0, atol=2e-5)  # 16 bits; seen 1.5e-5
        np.testing.assert_allclose(cloud.xyz, POINTS, rtol=0, atol=1e-7)
        assert cloud.warning == ""


def test_colours_of_gaussians(tmp_path: Path) -> None:
    coefficients = (COLORS / 255 - 0.5) * np.sqrt(4 * np.pi)
    write_ply(tmp_path / "a.ply", POINTS, coefficients.astype("f4"), ("f_dc_0", "f_dc_1", "f_dc_2"))
    np.testing.assert_allclose(read_point_cloud(tmp_path / "a.ply", "").rgb, COLORS / 255, rtol=0, atol=1e-6)


def test_colours_that_are_none(tmp_path: Path) -> None:
    file = tmp_path / "a.ply"
    write_ply(file, POINTS, COLORS.astype("f4"), ("cyan", "magenta", "yellow"))
    cloud = read_point_cloud(file, str(file))
    assert (cloud.rgb == 0.5).all()
    assert f"{file}: no colours among x, y, z, cyan, magenta, yellow" in cloud.warning
    for kind, least, most in (("f4", -1, 1), ("i1", -128, 127), ("i4", 0, 200_000)):
        write_ply(file, POINTS, np.linspace(least, most, POINTS.size).reshape(POINTS.shape).astype(kind))
        with pytest.raises(SceneError, match=r"a\.ply: most of its colours are from .*, expected 0 to 1, 0 to 255"):
            read_point_cloud(file, str(file))


@pytest.mark.parametrize(("kind", "most", "full"), [("u2", 4095, 65535), ("f4", 1023, 65535), ("u1", 1, 255)])
def test_colours_of_another_range_are_a_line(tmp_path: Path, kind: str, most: int, full: int) -> None:
    """Twelve bits in sixteen, and shares of 1 that were cast to bytes."""
    path = make_scene(tmp_path)
    write_ply(path / "sparse" / "0" / "points3D.ply", POINTS, (COLORS / 255 * most).astype(kind))
    (path / "sparse" / "0" / "points3D.bin").unlink()
    (line,) = read_colmap(path, path / "sparse" / "0", "images", evaluate=False).warnings
    assert re.search(rf"points3D\.ply: its colours are at most \d+\S* of {full}, so that its points start dark", line)


@pytest.mark.parametrize("scale", RANGES)
def test_colours_a_little_outside_of_their_range(tmp_path: Path, scale: float) -> None:
    """Resampling overshoots, and highlights of HDR photos are far above 1."""
    colors = np.linspace(-0.02, 1.02, POINTS.size).reshape(POINTS.shape)
    colors[7, 1] = 6.5
    write_ply(tmp_path / "a.ply", POINTS, scale * colors)
    np.testing.assert_allclose(read_point_cloud(tmp_path / "a.ply", "").rgb, colors, rtol=1e-12)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_files_that_are_none(tmp_path: Path, name: str) -> None:
    file = make_scene(tmp_path) / "sparse" / "0" / name
    file.unlink()
    with file.open("wb") as stream:
        stream.truncate(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") + 1)  # takes no room on the disk
    refuses(SceneError, f"{file} cannot be read: .* more than this machine's memory", load, tmp_path)
    for aim in (name, "nowhere", "/dev/zero"):
        file.unlink()
        file.symlink_to(aim)
        line = refuses(SceneError, "sparse model is incomplete", load, tmp_path)
        assert name not in line
