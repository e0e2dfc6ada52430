"""Exports of other programs, written from known cameras by writers of our own; OpenCV projects, and COLMAP's lenses."""

from __future__ import annotations

import json
import logging
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from lapgs_plugin.errors import SceneError, UserInputError
from lapgs_plugin.scenes import load_cameras, load_scene
from lapgs_plugin.scenes.depth import load_depth, resolve_depth
from lapgs_plugin.scenes.exports.registry import find_export
from lapgs_plugin.scenes.prepare.pipeline import prepare_scene
from lapgs_plugin.scenes.prepare.settings import PrepareSettings
from lapgs_plugin.scenes.scene import require_colmap_or_transforms
from tests.export_writers import WRITERS, Capture, from_colmap, synthetic, write_ply
from tests.plugin_package import install_package
from tests.refusals import refuses

WITH_POINTS = ("metashape", "realitycapture", "bundler", "opensfm", "arkitscenes")
"""Exports whose points come from a file."""


def centred(capture: Capture) -> Capture:
    """Return the capture with its principal point in the middle, and two radial terms, which is all Bundler knows."""
    width, height = capture.size
    return replace(capture, center=(width / 2, height / 2), radial=(*capture.radial[:2], 0.0), tangential=(0.0, 0.0))


def check(name: str, folder: Path, capture: Capture) -> None:
    """Compare what is read with what was written."""
    WRITERS[name](folder, capture)
    found = find_export(folder)
    assert found is not None
    assert found.name == name
    model, source = found.read(folder)
    frames = list(model.images.values())
    assert len(frames) == len(capture.names) == len(source.train)
    assert all(frame.path.is_file() for frame in source.train)
    for view, image in enumerate(frames):
        pose = image.pose.matrix()
        np.testing.assert_allclose(pose[:, :3], capture.turns[view], rtol=0, atol=1e-6)
        np.testing.assert_allclose(pose[:, 3], capture.shifts[view], rtol=1e-6, atol=1e-6)
        camera, seen = model.cameras[image.camera_id], capture.in_front(view)
        local = capture.xyz[seen] @ pose[:, :3].T + pose[:, 3]
        np.testing.assert_allclose(camera.img_from_cam(local), capture.pixels(view), rtol=0, atol=1e-6)
    if name in WITH_POINTS:
        np.testing.assert_allclose(source.points, capture.xyz, rtol=0, atol=1e-6)
        np.testing.assert_allclose(source.colors * 255, capture.rgb, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["metashape", "realitycapture", "opensfm"])
def test_distorted_cameras_are_those_that_were_written(name: str, tmp_path: Path) -> None:
    check(name, tmp_path, synthetic(distorted=True))


def test_bundlers_cameras_are_those_that_were_written(tmp_path: Path) -> None:
    check("bundler", tmp_path, centred(synthetic(distorted=True)))


@pytest.mark.parametrize("name", ["metashape", "realitycapture", "opensfm", "record3d", "polycam", "arkitscenes"])
def test_pinhole_cameras_are_those_that_were_written(name: str, tmp_path: Path) -> None:
    check(name, tmp_path, synthetic())


@pytest.mark.shared
@pytest.mark.parametrize("name", ["metashape", "realitycapture", "bundler", "opensfm"])
def test_cameras_of_south_building_are_colmaps(name: str, tmp_path: Path, shared_data: Path) -> None:
    check(name, tmp_path, from_colmap(shared_data / "south-building/distorted"))


@pytest.mark.shared
@pytest.mark.parametrize("name", ["metashape", "opensfm", "record3d", "polycam", "arkitscenes"])
def test_cameras_of_fox_are_colmaps(name: str, tmp_path: Path, shared_data: Path) -> None:
    check(name, tmp_path, from_colmap(shared_data / "fox/sparse/0"))


def project(terms: dict[str, float], xyz: NDArray[np.float64], fisheye: bool) -> NDArray[np.float64]:
    """Return pixels by appendix D of Metashape's manual, of a lens of 192x128 pixels, for points of the camera."""
    x, y = (xyz[:, :2] / xyz[:, 2:]).T
    if fisheye:
        radius = np.hypot(x, y)
        x, y = (np.arctan(radius) * value / radius for value in (x, y))
    r = np.hypot(x, y)
    radial = 1 + sum(terms[f"k{n}"] * r ** (2 * n) for n in (1, 2, 3, 4))
    p1, p2 = terms["p1"], terms["p2"]
    xd = x * radial + p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y
    yd = y * radial + p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y
    u = 192 * 0.5 + terms["cx"] + xd * terms["f"] + xd * terms["b1"] + yd * 0.0
    return np.stack([u, 128 * 0.5 + terms["cy"] + yd * terms["f"]], 1)


@pytest.mark.parametrize("kind", ["frame", "fisheye"])
def test_lenses_of_metashape_are_those_of_its_manual(kind: str, tmp_path: Path) -> None:
    WRITERS["metashape"](tmp_path, synthetic())
    terms = {
        "f": 150.0,
        "cx": 2.5,
        "cy": -3.25,
        "b1": 1.5,
        "k1": -0.1,
        "k2": 0.04,
        "k3": -0.01,
        "p1": 2e-3,
        "p2": -3e-3,
    }
    terms["k4"] = 0.003 if kind == "fisheye" else 0.0
    lens = "".join(f"<{key}>{value}</{key}>" for key, value in terms.items())
    edit(
        tmp_path / "cameras.xml",
        r'type="frame" class="adjusted">(<resolution [^>]*>).*?</cal',
        rf'type="{kind}" class="adjusted">\1{lens}</cal',
    )
    found = find_export(tmp_path)
    assert found is not None
    model, _ = found.read(tmp_path)
    xyz = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 3), (50, 3))
    np.testing.assert_allclose(
        model.cameras[1].img_from_cam(xyz), project(terms, xyz, kind == "fisheye"), rtol=0, atol=1e-6
    )


def test_a_fourth_radial_term_is_expressed_to_a_tenth_of_a_pixel(tmp_path: Path) -> None:
    WRITERS["metashape"](tmp_path, synthetic())
    terms = {"f": 160.0, "cx": 0.0, "cy": 0.0, "b1": 0.0, "k1": -0.28, "k2": 0.11, "k3": -0.03, "k4": 0.005}
    lens = "".join(f"<{key}>{value}</{key}>" for key, value in terms.items())
    edit(tmp_path / "cameras.xml", r'class="adjusted">(<resolution [^>]*>).*?</cal', rf'class="adjusted">\1{lens}</cal')
    found = find_export(tmp_path)
    assert found is not None
    model, _ = found.read(tmp_path)
    xyz = np.random.default_rng(0).uniform((-0.65, -0.45, 1), (0.65, 0.45, 1), (200, 3))
    pixels = project(terms | {"p1": 0.0, "p2": 0.0}, xyz, fisheye=False)
    # Worst 3e-6 pixels.
    np.testing.assert_allclose(model.cameras[1].img_from_cam(xyz), pixels, rtol=0, atol=1e-3)


def edit(file: Path, pattern: str, by: str) -> None:
    """Replace text in a file."""
    text, count = re.subn(pattern, by, file.read_text(), count=1, flags=re.DOTALL)
    assert count, f"{pattern} is not in {file}"
    file.write_text(text)


XML, CSV, OUT, JSON = "cameras.xml", "registration.csv", "bundle.out", "opensfm/reconstruction.json"
R3D, POLYCAM = "EXR_RGBD/metadata.json", "keyframes/corrected_cameras/12345678.json"
TRAJ = "41069021_frames/lowres_wide.traj"


@pytest.mark.parametrize(
    ("name", "file", "pattern", "by", "facts"),
    [
        ("metashape", XML, "<cameras .*</cameras>", "<cameras/>", "'Chunk 1': has no cameras, expected aligned photos"),
        ("metashape", XML, "</chunk>", '</chunk><chunk label="Two"/>', "2 chunks .'Chunk 1', 'Two'., expected one"),
        ("metashape", XML, "<chunk .*</chunk>", "", "0 chunks, expected one"),
        ("metashape", XML, "<document", "<!DOCTYPE d [<!ENTITY a 'b'>]><document", "declares a document type"),
        ("metashape", XML, ">2.5</scale>", ">-2.5</scale>", "the chunk's scale is -2.5, expected a number above 0"),
        ("metashape", XML, ">2.5</scale>", ">0</scale>", "the chunk's scale is 0, expected a number above 0"),
        ("metashape", XML, "</chunk>.*", "", "not readable as XML"),
        ("metashape", XML, 'frame" class="adj', 'tube" class="adj', "lens model 'tube', expected frame, fisheye"),
        ("metashape", XML, 'frame" class="adj', 'spherical" class="adj', "192x128 pixels, expected twice as wide"),
        ("metashape", XML, "<f>170.0</f>", "<f>60</f><k1>-2</k1><k2>3</k2><k3>-3</k3><k4>2</k4>", "k4 = 2,.*align"),
        ("metashape", XML, "<f>170.0</f>", "<f>0</f><k4>0.1</k4>", "'lens' has the focal lengths 0 and 0, expected"),
        ("metashape", XML, "<f>170.0</f>", "<f>-9</f><k4>0.1</k4>", "'lens' has the focal lengths -9 and -9, expected"),
        ("metashape", XML, "<f>170.0</f>", "<f>1e-200</f><k4>0.1</k4>", "focal lengths 1e-200 and 1e-200, expected"),
        ("metashape", XML, "<f>170.0</f>", "<f>170</f><b2>1</b2>", "skew b2 = 1,.*align again without b1 and b2"),
        ("metashape", XML, "<f>170.0</f>", "<f>nan</f>", "'lens': its f is 'nan', expected a finite number"),
        ("metashape", XML, '0 a"><transform>[^<]*', '0 a"><transform>1 0 0', "'shot 0 a' is '1 0 0', expected 16"),
        ("metashape", XML, '0 a"><transform>[^ <]*', '0 a"><transform>nan', "'shot 0 a' is 'nan .*expected 16"),
        ("metashape", XML, 'label="shot 1 a"', 'label="shot 0 a"', "shot 0 a.png is listed twice"),
        ("metashape", XML, '192" height="128"/><f>17', '128" height="192"/><f>17', "192x128 pixels, its camera 128x"),
        ("realitycapture", CSV, "alt,heading", "alt,altitude", "neither a COLMAP model .* nor an export"),
        ("realitycapture", CSV, "\n[^#].*", "\n", "no cameras in it"),
        ("realitycapture", CSV, ",[^,]*\n$", "\n", "line 8: 15 values .*expected the 16"),
        ("realitycapture", CSV, "shot 2 a.png,[^,]*", "shot 2 a.png,nan", "line 5: x is 'nan', expected a finite"),
        ("realitycapture", CSV, "shot 2 a", "x" * 140_000, "registration.csv: not readable as CSV .*131072"),
        ("realitycapture", CSV, "shot 2 a", "shot 1 a", "shot 1 a.png is listed twice"),
        ("bundler", OUT, "\n[^\n]*\n$", "\n", "635 lines for 7 cameras and 200 points, expected 636"),
        ("bundler", OUT, "0 0 0", "x 0 0", "camera 0 is .*expected 15 finite numbers"),
        ("bundler", "list.txt", "lost.jpg\n", "", "6 photos in its list, expected 7"),
        ("opensfm", JSON, '"brown"', '"dual"', "lens model 'dual', expected perspective, .*undistort the photos"),
        ("opensfm", JSON, '"brown"', '"spherical"', "photo of 192x128 pixels, expected twice as wide"),
        ("opensfm", JSON, '"camera": "v2 a b"', '"camera": "other"', "has the camera 'other', expected one of"),
        ("opensfm", JSON, '"rotation": .[^,]*', '"rotation": [null', "rotation is .None.*expected 3 finite numbers"),
        ("opensfm", JSON, "}}}]$", "", "not readable as JSON"),
        ("opensfm", JSON, '"width": 192', '"width": NaN', "not readable as JSON"),
        ("record3d", R3D, '"poses"', '"positions"', "no poses in it"),
        ("record3d", R3D, '"poses": .*', '"poses": [[0, 0, 0, 1, 1, 2, 3]]}', "1.jpg: metadata.json has 1 poses"),
        ("record3d", R3D, '"poses": ..[^,]*,', '"poses": [[2.0,', "pose 0 begins with no quaternion of length 1"),
        ("polycam", POLYCAM, '"t_00": [^,]*', '"t_00": 5.0', "a matrix that is no rotation"),
        ("polycam", POLYCAM, '"fx": 170.0, ', "", "fx is None, expected a finite number"),
        ("polycam", POLYCAM, '"width": 192', '"width": 19.5', "19.5x128, expected whole numbers of pixels"),
        ("arkitscenes", TRAJ, "^[^ ]* ", "", "line 1 is .*expected 7 finite numbers"),
        ("arkitscenes", TRAJ, "^.*$", "", "of 0 photos|none has a pose within"),
    ],
)  # fmt: skip
def test_damaged_exports_are_refused(name: str, file: str, pattern: str, by: str, facts: str, tmp_path: Path) -> None:
    WRITERS[name](tmp_path, synthetic())
    edit(tmp_path / file, pattern, by)
    refuses(SceneError, facts, load_cameras, tmp_path)


def test_a_photo_without_a_name_is_refused_in_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    WRITERS["metashape"](tmp_path, synthetic())
    edit(tmp_path / XML, 'label="shot 1 a"', 'label=""')
    monkeypatch.chdir(tmp_path)
    refuses(SceneError, "cannot be read: Is a directory", load_cameras, Path())


@pytest.mark.parametrize("name", ["metashape", "opensfm"])
def test_panoramas_start_from_the_points_of_their_export(name: str, tmp_path: Path) -> None:
    capture = replace(synthetic(), size=(192, 96))
    WRITERS[name](tmp_path, capture)
    if name == "metashape":
        file = tmp_path / XML
        file.write_text(re.sub("<sensor [^>]*>", '<sensor id="0" label="lens" type="spherical">', file.read_text()))
    else:
        edit(tmp_path / JSON, '"brown"', '"spherical"')
    export = find_export(tmp_path)
    assert export is not None
    model, source = export.read(tmp_path)
    assert {camera.model.name for camera in model.cameras.values()} == {"EQUIRECTANGULAR"}
    np.testing.assert_allclose(source.points, capture.xyz, rtol=0, atol=1e-6)
    refuses(SceneError, "sees all around; cut its photos", load_cameras, tmp_path)


def test_two_exports_are_refused(tmp_path: Path) -> None:
    WRITERS["metashape"](tmp_path, synthetic())
    (tmp_path / "other.xml").write_text((tmp_path / "cameras.xml").read_text())
    refuses(SceneError, "cameras.xml and other.xml are both cameras of Metashape", load_cameras, tmp_path)
    (tmp_path / "other.xml").unlink()
    write_ply(tmp_path / "mesh.ply", np.zeros((3, 3)), np.zeros((3, 3), np.uint8))
    refuses(SceneError, "mesh.ply and points.ply are beside cameras.xml, expected one", load_cameras, tmp_path)
    (tmp_path / "points.ply").unlink()
    WRITERS["bundler"](tmp_path, synthetic())
    refuses(SceneError, "cameras.xml .* and bundle.out .*expected one of them", load_cameras, tmp_path)


@pytest.mark.parametrize("name", ["metashape", "realitycapture", "opensfm"])
def test_missing_photos_are_refused_or_left_out(name: str, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    WRITERS[name](tmp_path / "in", synthetic())
    for view in (0, 3):
        (tmp_path / f"in/images/shot {view} a.png").unlink()
    refuses(SceneError, "shot 0 a.*no such image .2 of 6 are missing.*lapgs prepare", load_cameras, tmp_path / "in")
    result = prepare_scene(tmp_path / "in", tmp_path / "out", progress=False)
    assert len(result.registered) == 4
    assert len(result.left_out) == 2


def main_in_a_process(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Call lapgs as a user does."""
    command = [sys.executable, "-m", "lapgs_plugin", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_distorted_exports_are_refused_for_training_and_undistorted(tmp_path: Path) -> None:
    capture = synthetic(distorted=True)
    (tmp_path / "in").mkdir()
    WRITERS["metashape"](tmp_path / "in", capture)
    refused = main_in_a_process("train", tmp_path / "in", "-o", tmp_path / "run")
    assert refused.returncode == 2
    assert re.fullmatch("lapgs: .*is distorted .FULL_OPENCV.*lapgs prepare .*\n", refused.stderr)
    assert main_in_a_process("prepare", tmp_path / "in", tmp_path / "out").returncode == 0
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    poses = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    for name, turn, shift in zip(capture.names, capture.turns, capture.shifts, strict=True):
        np.testing.assert_allclose(poses[name], np.c_[turn, shift], rtol=0, atol=1e-6)
    assert model.num_points3D() == len(capture.xyz)


def test_pinhole_exports_are_trained_on_as_they_are_and_written_for_checkouts(tmp_path: Path) -> None:
    capture = synthetic()
    (tmp_path / "in").mkdir()
    WRITERS["realitycapture"](tmp_path / "in", capture)
    scene = load_scene(tmp_path / "in", eval=True, progress=False)
    assert scene.kind == "realitycapture"
    assert [view.name for view in scene.test] == ["images/shot 0 a.png"]
    prepare_scene(tmp_path / "in", tmp_path / "out", progress=False)
    again = load_scene(tmp_path / "out", eval=True, progress=False)
    for view, other in zip(scene.train, again.train, strict=True):
        assert view.name.endswith(other.name)
        np.testing.assert_allclose(view.camera.world_to_camera, other.camera.world_to_camera, rtol=0, atol=1e-6)
        assert float((view.image - other.image).abs().max()) < 0.01


def test_cameras_and_photos_may_be_in_different_folders(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    WRITERS["metashape"](tmp_path / "in", synthetic())
    photos = tmp_path / "photos/card/100MEDIA"
    photos.parent.mkdir(parents=True)
    (tmp_path / "in/images").rename(photos)
    settings = PrepareSettings(model=tmp_path / "in")
    (tmp_path / "photos/depth").mkdir()
    (tmp_path / "photos/depth/shot 0 a.png").write_bytes((photos / "shot 0 a.png").read_bytes())  # no photo
    result = prepare_scene(tmp_path / "photos", tmp_path / "out", settings, progress=False)
    assert len(result.registered) == 6
    (tmp_path / "photos/again").mkdir()
    (tmp_path / "photos/again/shot 1 a.png").write_bytes((photos / "shot 1 a.png").read_bytes())
    again = prepare_scene(tmp_path / "photos", tmp_path / "again", settings, progress=False)
    assert again.left_out == ("shot 1 a",), "two photos of this name"
    refuses(
        UserInputError,
        "no model of COLMAP in it.*or with another program's export",
        prepare_scene,
        tmp_path / "photos",
        tmp_path / "other",
        PrepareSettings(model=tmp_path / "photos"),
    )


def test_advice_about_the_folder_around_an_export(tmp_path: Path) -> None:
    WRITERS["polycam"](tmp_path / "capture", synthetic())
    refuses(SceneError, f"give {tmp_path}/capture, which has one", load_cameras, tmp_path)


def test_checkouts_do_not_read_exports(tmp_path: Path) -> None:
    WRITERS["opensfm"](tmp_path / "in", synthetic())
    facts = "in/opensfm/reconstruction.json: checkouts do not .*lapgs prepare .*in OUT"
    refuses(SceneError, facts, require_colmap_or_transforms, tmp_path / "in")
    require_colmap_or_transforms(tmp_path)  # the checkout's own error is better


def test_cameras_without_a_pose_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    WRITERS["metashape"](tmp_path, synthetic())
    edit(tmp_path / "cameras.xml", 'label="shot 4 a"', 'enabled="0" label="shot 4 a"')
    edit(tmp_path / "cameras.xml", 'component_id="0" label="shot 5 a"', 'component_id="1" label="shot 5 a"')
    with caplog.at_level(logging.WARNING):
        scene = load_scene(tmp_path, progress=False)
    assert len(scene.train) == 4
    assert "of 7 photos 1 disabled, 1 not aligned, 1 in smaller components: left out" in caplog.text


def test_lenses_of_photos_that_are_not_used_may_be_unknown(tmp_path: Path) -> None:
    WRITERS["metashape"](tmp_path, synthetic())
    other = (
        '<sensor id="1" label="scan"><resolution width="9" height="9"/><calibration type="cylindrical" class="adjusted"'
    )
    other += '><resolution width="9" height="9"/></calibration></sensor></sensors>'
    edit(tmp_path / "cameras.xml", "</sensors>", other)
    edit(tmp_path / "cameras.xml", 'sensor_id="0" component_id="0" label="shot 4 a"', 'sensor_id="1" enabled="0"')
    assert len(load_scene(tmp_path, progress=False).train) == 5


PLACES = ("of the earth", "of the chunk", "elsewhere", "none")
OF_THE_EARTH = [(points, cameras) for points in PLACES for cameras in ("oblique", "straight down", "panoramas")]
OF_THE_EARTH += [(points, "wide survey") for points in PLACES[:2]]  # its world is not too far from the origin without


@pytest.mark.parametrize(("points", "cameras"), OF_THE_EARTH)
def test_coordinates_of_the_earth_are_used_only_with_points_in_them(points: str, cameras: str, tmp_path: Path) -> None:
    capture, place = synthetic(), np.array([4.2e6, 1.7e5, 4.8e6])
    if cameras == "panoramas":
        capture = replace(capture, size=(256, 128))
    elif cameras != "oblique":
        place = np.array([0.0, 0.0, -6.4e6])  # cameras look at the centre of the earth, where points of the chunk are
    if cameras == "wide survey":
        capture = replace(capture, shifts=700.0 * capture.shifts, xyz=700.0 * capture.xyz)
    turn, scale, shift = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix(), 2.5, np.array([3.0, -4.0, 5.0])
    WRITERS["metashape"](tmp_path, capture)  # with this transform
    edit(tmp_path / "cameras.xml", "<translation [^<]*<", f"<translation>{' '.join(map(str, shift + place))}<")
    if cameras == "panoramas":
        edit(tmp_path / "cameras.xml", 'type="frame">\\n', 'type="spherical">\\n')
    chunk = (capture.xyz - shift) @ turn / scale
    choices = {"of the earth": capture.xyz + place, "of the chunk": chunk, "elsewhere": chunk - 1e6 * turn[2]}
    (tmp_path / "points.ply").unlink()
    if points in choices:
        write_ply(tmp_path / "points.ply", choices[points], capture.rgb)
    found = find_export(tmp_path)
    assert found is not None
    model, source = found.read(tmp_path)
    pose = model.images[1].pose
    center = pose.inverse().translation
    expected = capture.centers[0] + place if points == "of the earth" else (capture.centers[0] - shift) @ turn / scale
    np.testing.assert_allclose(center, expected, rtol=0, atol=1e-6)
    assert (len(source.points) == len(capture.xyz)) is (points in ("of the earth", "of the chunk"))
    assert any("see few of its points" in line for line in source.warnings) is (points == "elsewhere")


@pytest.mark.parametrize("name", ["record3d", "polycam", "arkitscenes"])
def test_points_are_made_of_depth_maps(name: str, tmp_path: Path) -> None:
    """Photos of a wall at z = 5, which is red to the left of x = 0; the depth maps are smaller than the photos."""
    capture = synthetic()
    WRITERS[name](tmp_path, capture)
    for ply in tmp_path.glob("*.ply"):
        ply.unlink()
    paths = sorted(path for path in tmp_path.rglob("*") if path.suffix in (".jpg", ".png") and "_99." not in path.name)
    for view, path in enumerate(paths):
        _photograph(path, capture, view, {"record3d": "depth", "polycam": "depth"}.get(name, "lowres_depth"), name)
    found = find_export(tmp_path)
    assert found is not None
    _, source = found.read(tmp_path)
    assert 1_000 < len(source.points) <= 100_000
    # Millimetres round; worst 0.0005 along an axis that is up to 40 degrees off.
    np.testing.assert_allclose(source.points[:, 2], 5.0, rtol=0, atol=1e-3)
    clear = np.abs(source.points[:, 0]) > 0.2  # photos are resampled to the size of the map
    red = source.colors[clear, 0] > 0.5
    assert (red == (source.points[clear, 0] < 0)).mean() > 0.99
    scene = load_scene(tmp_path, progress=False)
    depth = load_depth(scene, resolve_depth(tmp_path, "auto"), "images", [].append)
    assert depth is not None
    assert [*depth.names] == [view.name for view in scene.train]
    for view in scene.train:
        small, inverse = view.camera.resized(48, 32), depth.inverse(view.name, (48, 32))
        rows, columns = torch.meshgrid(torch.arange(32) + 0.5, torch.arange(48) + 0.5, indexing="ij")
        local = torch.stack([(columns - small.cx) / small.fx, (rows - small.cy) / small.fy, torch.ones(32, 48)], -1)
        local = local / inverse[..., None] - small.world_to_camera[:3, 3]
        walls = (local @ small.world_to_camera[:3, :3])[..., 2]
        assert walls[:4, :4].isnan().all()
        walls = walls[~walls.isnan()]
        torch.testing.assert_close(walls, torch.full_like(walls, 5.0), atol=1e-3, rtol=0)  # worst seen 8e-5


def _photograph(path: Path, capture: Capture, view: int, depths: str, name: str) -> None:
    """Write the photo of a wall and its depth map at a quarter of the size, without depth in a corner."""
    size = (192, 128)
    for width, height in (size, (48, 32)):
        rows, columns = np.mgrid[:height, :width] + 0.5
        scale = size[0] / width
        local = np.stack(
            [
                (columns * scale - capture.center[0]) / capture.focal[0],
                (rows * scale - capture.center[1]) / capture.focal[1],
                np.ones_like(rows),
            ],
            -1,
        )
        rays = local @ capture.turns[view]
        depth = (5.0 - capture.centers[view][2]) / rays[..., 2]
        x = capture.centers[view][0] + depth * rays[..., 0]
        if width == size[0]:
            Image.fromarray(np.where(x[..., None] < 0, [255, 0, 0], [0, 0, 255]).astype(np.uint8)).save(
                path, quality=95
            )
            continue
        depth[:4, :4] = 0.0
        folder = path.parent.parent / depths
        folder.mkdir(exist_ok=True)
        if name == "record3d":
            depth[:4, 4:8] = np.nan
            target = oiio.ImageOutput.create(str(folder / f"{path.stem}.exr"))
            target.open(str(folder / f"{path.stem}.exr"), oiio.ImageSpec(width, height, 1, "float"))
            target.write_image(depth.astype(np.float32)[..., None])
            target.close()
        else:
            Image.fromarray(np.rint(depth * 1000).astype(np.uint16)).save(folder / f"{path.stem}.png")


def test_a_report_of_opendronemap_is_read_without_the_reconstruction(tmp_path: Path) -> None:
    capture, place = synthetic(), np.array([431_000.0, 5_200_000.0, 300.0])
    WRITERS["opensfm"](tmp_path, capture)
    [_, part] = json.loads((tmp_path / JSON).read_text())
    (tmp_path / "cameras.json").write_text(json.dumps(part["cameras"]))
    features = [
        {
            "type": "Feature",
            "properties": {
                "filename": name,
                "rotation": Rotation.from_matrix(turn).as_rotvec().tolist(),
                "translation": (center + place).tolist(),
            },
        }
        for name, turn, center in zip(capture.names, capture.turns, capture.centers, strict=True)
    ]
    (tmp_path / "odm_report").mkdir()
    shots = {"type": "FeatureCollection", "features": features}
    (tmp_path / "odm_report/shots.geojson").write_text(json.dumps(shots))
    (tmp_path / JSON).unlink()
    found = find_export(tmp_path)
    assert found is not None
    model, _ = found.read(tmp_path)
    centers = np.stack([image.pose.inverse().translation for image in model.images.values()])
    np.testing.assert_allclose(centers - centers[0], capture.centers - capture.centers[0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        [image.pose.rotation.matrix() for image in model.images.values()], capture.turns, atol=1e-6
    )
    assert np.abs(centers).max() < 10


READER = """\
from lapgs_plugin.scenes.exports.base import Export, SceneReader
from lapgs_plugin.scenes.exports.opensfm import OpenSfM

class Renamed(SceneReader):
    title = "a renamed reconstruction"

    def find(self, folder):
        file = folder / "shots.lens"
        return file if file.is_file() else None

    def read(self, source, photos):
        return OpenSfM().read(source, photos)
"""


def test_a_package_adds_a_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_package(
        tmp_path / "site", monkeypatch, "tiny_scenes", "[lapgs.scenes]\nrenamed = tiny_scenes:Renamed\n", READER
    )
    WRITERS["opensfm"](tmp_path / "in", synthetic())
    (tmp_path / "in" / JSON).rename(tmp_path / "in/shots.lens")
    assert load_scene(tmp_path / "in", progress=False).kind == "renamed"
