"""`lapgs prepare` of photos whose distorted cameras are known. OpenCV, not COLMAP, says what the lenses do."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
import typer
from numpy.typing import NDArray
from typer.testing import CliRunner

from lapgs_plugin.cli.prepare import prepare
from lapgs_plugin.errors import LapgsError, SceneError, UserInputError
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.scenes.prepare import pipeline
from lapgs_plugin.scenes.prepare.pipeline import PrepareResult, prepare_scene
from lapgs_plugin.scenes.prepare.settings import PrepareSettings
from tests.folders import snapshot
from tests.refusals import refuses

Array = NDArray[np.float64]

CAMERAS: dict[int, tuple[str, int, int, list[float]]] = {
    1: ("OPENCV", 192, 128, [150, 155, 97, 62, -0.12, 0.03, 0.002, -0.001]),
    2: ("SIMPLE_RADIAL", 128, 192, [140, 64, 96, 0.08]),
    3: ("OPENCV_FISHEYE", 160, 160, [110, 111, 80, 79, 0.02, -0.01, 0.05, -0.04]),
}
PHOTOS = {"left/a.jpg": 1, "left/b 1.png": 1, "c.png": 2, "right/d.png": 3, "e.png": 1}
"""Names and cameras; one is in a subfolder, one has a space."""
RANDOM = np.random.default_rng(0)
POINTS = RANDOM.uniform((-1, -1, 4), (1, 1, 6), (30, 3))


def _pose(index: int) -> tuple[Array, Array]:
    rotation, _ = cv2.Rodrigues(np.array([0.05 * index, 0.1 - 0.04 * index, 0.02]))
    return rotation, np.array([0.3 * index - 0.5, 0.1, 0.2])


def _matrix(kind: str, params: list[float]) -> tuple[Array, Array]:
    """Return OpenCV's camera matrix and distortion."""
    if kind == "SIMPLE_RADIAL":
        params = [params[0], *params, 0, 0, 0]
    fx, fy, cx, cy = params[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(params[4:])


def _rays(kind: str, params: list[float], pixels: Array) -> Array:
    """Return where pixels (n, 2) of a lens look, on the plane at depth 1, (n, 2)."""
    matrix, distortion = _matrix(kind, params)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-12)
    undo = cv2.fisheye.undistortPoints if kind == "OPENCV_FISHEYE" else cv2.undistortPoints
    return np.asarray(undo(pixels[:, None], matrix, distortion, criteria=stop)[:, 0], np.float64)


def _project(kind: str, params: list[float], index: int) -> Array:
    """Return the pixels (n, 2) at which a lens shows the points."""
    rotation, shift = _pose(index)
    matrix, distortion = _matrix(kind, params)
    points, turn = POINTS[:, None], cv2.Rodrigues(rotation)[0]
    lens = cv2.fisheye.projectPoints if kind == "OPENCV_FISHEYE" else cv2.projectPoints
    return np.asarray(lens(points, turn, shift, matrix, distortion)[0][:, 0], np.float64)


def _pixels(width: int, height: int) -> Array:
    """Return the centres of all pixels by rows, (width * height, 2)."""
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def _look(rays: Array, width: int, height: int) -> Array:
    """Return what is to be seen along rays as an image (height, width, 3): waves, a few to the image."""
    x, y = rays.T
    waves = np.stack([np.sin(9 * x) * np.cos(8 * y), np.cos(11 * x - 7 * y), np.sin(10 * y)], axis=1)
    return (0.5 + 0.4 * waves).reshape(height, width, 3)


def _is_left(rays: Array, width: int, height: int) -> NDArray[np.bool_]:
    return (rays[:, 0] < 0.1).reshape(height, width)


def _save(path: Path, image: Array) -> None:
    write_image(path, torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1))


def _photos(folder: Path) -> None:
    for name, key in PHOTOS.items():
        kind, width, height, params = CAMERAS[key]
        _save(folder / name, _look(_rays(kind, params, _pixels(width, height)), width, height))


def _masks(folder: Path) -> None:
    for name, key in PHOTOS.items():
        kind, width, height, params = CAMERAS[key]
        inside = _is_left(_rays(kind, params, _pixels(width, height)), width, height)
        _save(folder / f"{name}.png", np.repeat(inside[..., None], 3, axis=2).astype(np.float64))


def _model(tracks: bool = True) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    for key, (kind, width, height, params) in CAMERAS.items():
        camera = pycolmap.Camera(camera_id=key, model=kind, width=width, height=height, params=params)
        model.add_camera_with_trivial_rig(camera)
    for index, (name, key) in enumerate(PHOTOS.items()):
        kind, _, _, params = CAMERAS[key]
        seen = [pycolmap.Point2D(xy) for xy in _project(kind, params, index)] if tracks else []
        image = pycolmap.Image(name=name, points2D=seen, camera_id=key, image_id=index + 1)
        rotation, shift = _pose(index)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), shift))
    for index, point in enumerate(POINTS):
        track = pycolmap.Track()
        for image_id in model.images if tracks else ():
            track.add_element(image_id, index)
        model.add_point3D(point, track, np.array([index, 0, 255], np.uint8))
    return model


def _scene(path: Path, model_folder: str = "sparse/0", photos: str = "images", tracks: bool = True) -> Path:
    _photos(path / photos)
    (path / model_folder).mkdir(parents=True)
    _model(tracks).write_binary(path / model_folder)
    return path


def _run(photos: Path, out: Path, **options: Any) -> PrepareResult:
    return prepare_scene(photos, out, PrepareSettings(**options), progress=False)


def _check_images(out: Path, largest: float) -> pycolmap.Reconstruction:
    """Compare every image with what its pinhole camera has to show, JPEG with less care, and return the model."""
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert camera.model.name == "PINHOLE"
        fx, fy, cx, cy = camera.params
        rays = (_pixels(camera.width, camera.height) - (cx, cy)) / (fx, fy)
        expected = _look(rays, camera.width, camera.height)
        seen = cv2.imread(str(out / "images" / image.name))[..., ::-1] / 255
        assert seen.shape == expected.shape
        assert np.abs(seen - expected)[2:-2, 2:-2].max() < (0.1 if image.name.endswith("jpg") else largest)
    return model


def test_images_are_what_pinhole_cameras_see(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = _scene(tmp_path / "scene")
    _masks(scene / "masks")
    (scene / "images" / "e.png").unlink()
    before = snapshot(scene)
    with caplog.at_level(logging.WARNING):
        result = _run(scene, tmp_path / "out")
    assert "1 of 5 photos are not there, left out: e.png" in caplog.text
    assert result.left_out == ("e.png",)
    assert list(result.seconds) == ["Reading photos", "Reading masks", "Undistorting"]
    assert snapshot(scene) == before
    model = _check_images(tmp_path / "out", 0.01)  # seen 0.0059; half a pixel is 0.017
    assert sorted(image.name for image in model.images.values()) == sorted(set(PHOTOS) - {"e.png"})
    for image in model.images.values():
        index = list(PHOTOS).index(image.name)
        rotation, shift = _pose(index)
        np.testing.assert_allclose(image.cam_from_world().matrix(), np.column_stack([rotation, shift]), atol=1e-12)
        fx, fy, cx, cy = model.cameras[image.camera_id].params
        in_camera = POINTS @ rotation.T + shift
        exact = in_camera[:, :2] / in_camera[:, 2:] * (fx, fy) + (cx, cy)
        assert np.abs(exact - [point.xy for point in image.points2D]).max() < 1e-6  # seen 2e-10
    assert all(len(point.track.elements) == 4 for point in model.points3D.values())
    assert sorted(tuple(point.xyz) for point in model.points3D.values()) == sorted(map(tuple, POINTS))
    views = load_scene(tmp_path / "out", progress=False).train
    assert len(views) == 4
    for view in views:
        assert view.mask is not None
        camera = view.camera
        rays = (_pixels(camera.width, camera.height) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        assert (
            view.mask[0].numpy() != _is_left(rays, camera.width, camera.height)
        ).mean() < 0.02  # its edge; seen 0.004


@pytest.mark.parametrize(
    ("place", "photos"), [("colmap/sparse/0", "images"), ("distorted/sparse/0", "input"), ("sparse", ".")]
)
def test_models_are_found_where_programs_leave_them(tmp_path: Path, place: str, photos: str) -> None:
    scene = _scene(tmp_path / "scene", place, photos, tracks=False)
    refuses(SceneError, rf"`lapgs prepare {scene} OUT`", load_scene, scene, images=photos, progress=False)
    assert _run(scene, tmp_path / "out").left_out == ()
    model = _check_images(tmp_path / "out", 0.01)
    assert model.compute_num_observations() == 0
    assert model.num_points3D() == len(POINTS)


def test_a_model_elsewhere_in_text_and_smaller_copies(tmp_path: Path) -> None:
    photos, exported = tmp_path / "photos", tmp_path / "exported"
    _photos(photos)
    for name in PHOTOS:
        half = cv2.resize(cv2.imread(str(photos / name)), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(photos / name), half, [cv2.IMWRITE_JPEG_QUALITY, 98])
    exported.mkdir()
    _model().write_text(exported)
    assert len(_run(photos, tmp_path / "out", model=exported).registered) == 5
    model = _check_images(tmp_path / "out", 0.02)  # seen 0.0092; half a pixel is 0.034
    focal = {image.name: model.cameras[image.camera_id].params[0] for image in model.images.values()}
    assert focal["c.png"] == pytest.approx(70)
    _run(photos, tmp_path / "smaller", model=exported, max_size=64)
    sides = [max(view.camera.size) for view in load_scene(tmp_path / "smaller", progress=False).train]
    assert max(sides) == 64
    _check_images(tmp_path / "smaller", 0.03)  # seen 0.021


def _without(model: pycolmap.Reconstruction, names: set[str], folder: Path) -> None:
    """Write the model without the images of these names."""
    for image in [image for image in model.images.values() if image.name in names]:
        model.deregister_frame(image.frame_id)
    model.tear_down()
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)


def test_the_largest_of_several_models_is_taken(tmp_path: Path) -> None:
    scene, few = _scene(tmp_path / "scene", "sparse/1"), {"c.png", "e.png", "right/d.png"}
    _without(_model(), few, scene / "sparse/0")
    assert _run(scene, tmp_path / "out").registered == tuple(sorted(PHOTOS))
    _check_images(tmp_path / "out", 0.01)
    assert len(_run(scene, tmp_path / "named", model=scene / "sparse/0").registered) == 2


def test_a_larger_model_that_convert_py_leaves_distorted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = tmp_path / "scene"
    _run(_scene(tmp_path / "photos"), scene)
    (scene / "distorted/sparse").mkdir(parents=True)
    (tmp_path / "photos/sparse/0").rename(scene / "distorted/sparse/1")
    (tmp_path / "photos/images").rename(scene / "input")
    _without(pycolmap.Reconstruction(scene / "sparse/0"), {"c.png", "e.png", "right/d.png"}, scene / "sparse/0")
    assert len(load_scene(scene, progress=False).train) == 2
    larger = scene / "distorted/sparse/1"
    expected = f"sparse/0 places 2 photos and {larger} 5; make a scene of the latter with `lapgs prepare {scene} OUT"
    assert f"{expected} --model {larger}`" in caplog.text
    assert len(_run(scene, tmp_path / "smaller", max_size=64).registered) == 2  # what `lapgs train` reads
    assert _run(scene, tmp_path / "out", model=larger).registered == tuple(sorted(PHOTOS))
    _check_images(tmp_path / "out", 0.01)


def test_observations_that_do_not_fit_are_left_out(tmp_path: Path) -> None:
    scene, edited = _scene(tmp_path / "scene"), tmp_path / "edited"
    edited.mkdir()
    _model().write_text(edited)
    points = edited / "points3D.txt"
    *comments, first, second, third = points.read_text().splitlines()[: 3 + 3]
    taken = "31 0 0 5 1 2 3 0 1 1 2 1"  # features of the second point
    points.write_text("\n".join([*comments, f"{first} 99 0 1 77 1 -1", second, f"{third} 1", taken]))
    result = _run(scene, tmp_path / "out", model=edited)
    assert result.points == 4
    model = _check_images(tmp_path / "out", 0.01)
    assert sorted(len(point.track.elements) for point in model.points3D.values()) == [0, 0, 5, 5]
    assert [image.num_points3D for image in model.images.values()] == [2] * 5


def test_frames_that_were_removed_from_a_transforms_file_stay_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The file is what `lapgs train` reads; the points of the COLMAP model are moved to its world."""
    scene = _transforms(tmp_path / "scene")
    (scene / "colmap/sparse/0").mkdir(parents=True)
    turn, shift, scale = cv2.Rodrigues(np.array([0.3, -1.0, 0.4]))[0], np.array([3.0, -2.0, 7.0]), 2.5
    model = _model()
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn), shift))
    model.write_binary(scene / "colmap/sparse/0")
    values = json.loads((scene / "transforms.json").read_text())
    removed = values["frames"].pop(2)["file_path"]
    (scene / "transforms.json").write_text(json.dumps(values))
    result = _run(scene, tmp_path / "out")
    assert removed.removeprefix("images/") not in result.registered
    assert len(result.registered) == 4
    assert "transforms.json lists 4 photos and" in caplog.text
    assert f"those of {scene}/colmap/sparse/0 are used" in caplog.text
    written = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    points = sorted(tuple(point.xyz) for point in written.points3D.values())
    np.testing.assert_allclose(points, sorted(map(tuple, POINTS)), rtol=0, atol=1e-9)  # seen 4e-15
    everything = _run(scene, tmp_path / "all", model=scene / "colmap/sparse/0")
    assert everything.registered == tuple(sorted(PHOTOS))
    for frame in values["frames"][:2]:  # another world, bent
        frame["transform_matrix"][0][3] += 0.5
    (scene / "transforms.json").write_text(json.dumps(values))
    assert _run(scene, tmp_path / "bent").points == 100_000


def test_images_of_a_rig_have_poses_of_their_own(tmp_path: Path) -> None:
    names, model = ["left/a.jpg", "left/b 1.png", "e.png"], pycolmap.Reconstruction()
    for key in (1, 2):
        kind, width, height, params = CAMERAS[1]
        model.add_camera(pycolmap.Camera(camera_id=key, model=kind, width=width, height=height, params=params))
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    aside = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0.3, 0])), np.array([0.2, 0, 0]))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), aside)
    model.add_rig(rig)
    poses = {}
    for number, names_of in enumerate([names[:2], names[2:]], start=1):
        rotation, shift = _pose(number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), shift)
        frame = pycolmap.Frame(frame_id=number, rig_id=1, rig_from_world=pose)
        images = []
        for key, name in enumerate(names_of, start=1):
            images.append(pycolmap.Image(name=name, camera_id=key, image_id=10 * number + key, frame_id=number))
            frame.add_data_id(images[-1].data_id)
            poses[name] = (aside * pose if key == 2 else pose).matrix()
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
    model.add_point3D(np.zeros(3), pycolmap.Track(), np.zeros(3, np.uint8))
    scene = tmp_path / "scene"
    _photos(scene / "images")
    (scene / "images" / names[0]).unlink()
    (scene / "sparse" / "0").mkdir(parents=True)
    model.write_binary(scene / "sparse" / "0")
    assert _run(scene, tmp_path / "out").left_out == (names[0],)
    written = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    result = {image.name: image.cam_from_world().matrix() for image in written.images.values()}
    assert sorted(result) == sorted(names[1:])
    for name, matrix in result.items():
        np.testing.assert_allclose(matrix, poses[name], atol=1e-12)


def _transforms(scene: Path, **changes: Any) -> Path:
    """Write photos and a transforms.json, as nerfstudio has it."""
    _photos(scene / "images")
    frames = []
    for index, (name, key) in enumerate(PHOTOS.items()):
        kind, width, height, params = CAMERAS[key]
        matrix, distortion = _matrix(kind, params)
        names = ("k1", "k2", "k3", "k4") if kind == "OPENCV_FISHEYE" else ("k1", "k2", "p1", "p2")
        rotation, shift = _pose(index)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation.T * (1, -1, -1), -rotation.T @ shift  # to OpenGL axes
        frames.append(
            {"file_path": f"images/{name}", "transform_matrix": pose.tolist(), "w": width, "h": height}
            | {"fl_x": matrix[0, 0], "fl_y": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
            | dict(zip(names, distortion.tolist(), strict=True))
            | {"camera_model": "fisheye" if kind == "OPENCV_FISHEYE" else "opencv"}
        )
    frames[0] |= changes
    (scene / "transforms.json").write_text(json.dumps({"frames": frames}))
    return scene


def test_a_transforms_file_gives_the_images_and_poses_of_the_model(tmp_path: Path) -> None:
    _run(_scene(tmp_path / "colmap"), tmp_path / "expected")
    result = _run(_transforms(tmp_path / "scene"), tmp_path / "out")
    assert len(result.registered) == 5
    one, other = (snapshot(tmp_path / name / "images") for name in ("expected", "out"))
    assert sorted(one) == sorted(other)
    assert one["right/d.png"] == other["right/d.png"]  # of a fisheye lens, on which both agree to the bit
    model, expected = (pycolmap.Reconstruction(tmp_path / name / "sparse" / "0") for name in ("out", "expected"))
    assert len(model.cameras) == len(CAMERAS)
    poses = {image.name: image.cam_from_world().matrix() for image in expected.images.values()}
    for image in model.images.values():
        np.testing.assert_allclose(image.cam_from_world().matrix(), poses[image.name], atol=1e-12)
    _check_images(tmp_path / "out", 0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"k4": 0.1}, r"a\.jpg: its camera in the transforms file \(OPENCV, .*k4 = 0.1.*\) cannot be undistorted"),
        (
            {"distortion_params": [0.1]},
            r"distortion_params = \[0.1\]\) cannot be undistorted; expected numbers k1, k2, p1, p2, k3",
        ),
        ({"camera_model": "EQUIRECTANGULAR"}, r"an equirectangular photo of .* expected twice as wide as high"),
        ({"k1": "much"}, r"k1 = much.* cannot be undistorted"),
        ({"k1": float("nan")}, r"camera \d \(FULL_OPENCV\) has NaN or inf"),
        ({"w": 191, "h": 140}, r"a\.jpg: the image is 192x128 pixels, its camera 191x140"),
    ],
)
def test_lenses_that_are_not_understood_are_one_line(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    refuses(SceneError, message, _run, _transforms(tmp_path / "scene", **changes), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_does_not_fit_is_one_line(tmp_path: Path) -> None:
    scene, out = _scene(tmp_path / "scene"), tmp_path / "out"
    (tmp_path / "empty").mkdir()

    def refused(kind: type[Exception], message: str, photos: Path = scene, **options: Any) -> None:
        with pytest.raises(kind, match=message) as caught:
            _run(photos, out, **options)
        assert "\n" not in str(caught.value)
        assert not out.exists()

    refused(UserInputError, "--matcher: .*sparse/0 has the cameras already; leave", matcher="sequential")
    refused(UserInputError, "--camera-per: .* has the cameras already", camera_per="one")
    refused(UserInputError, "--model .*empty: no model of COLMAP in it", model=tmp_path / "empty")
    refused(
        SceneError,
        "empty/c.png: no such image, nor any other of the 5 of .*sparse/0; give the folder of the photos",
        tmp_path / "empty",
        model=scene,
    )
    small = cv2.resize(cv2.imread(str(scene / "images" / "e.png")), (96, 64))
    cv2.imwrite(str(scene / "images" / "e.png"), small)
    refused(SceneError, r"(a\.jpg|e\.png|b 1\.png): \d+x\d+ pixels, and other photos of its camera \d+x\d+; expected")
    cv2.imwrite(str(scene / "images" / "e.png"), small[:50])
    refused(SceneError, r"e\.png: the image is 96x50 pixels, its camera 192x128")
    (scene / "images" / "e.png").write_bytes(b"no image")
    refused(SceneError, r"e\.png: not a readable image")
    (scene / "images" / "e.png").unlink()
    model = _model()
    model.images[5].name = "c.tif"
    shutil.copy(scene / "images" / "c.png", scene / "images" / "c.tif")
    model.write_binary(scene / "sparse" / "0")
    refused(SceneError, r"c\.png and c\.tif would both become c\.png")
    model.images[4].name = "../../c.png"
    shutil.copy(scene / "images" / "c.png", tmp_path)
    model.write_binary(scene / "sparse" / "0")
    refused(SceneError, r"\.\./\.\./c\.png is named by a path outside the scene")
    around = pycolmap.Camera.create_from_model_name(9, "EQUIRECTANGULAR", 1.0, 192, 128)
    model.cameras[1].model, model.cameras[1].params = around.model, around.params
    model.write_binary(scene / "sparse" / "0")
    refused(SceneError, r"camera 1 \(EQUIRECTANGULAR\): .* expected twice as wide as high")


def test_exr_keeps_its_range(tmp_path: Path) -> None:
    scene, model = _scene(tmp_path / "scene"), _model()
    model.images[3].name = "c.exr"
    model.write_binary(scene / "sparse" / "0")
    kind, width, height, params = CAMERAS[2]
    _save(scene / "images" / "c.exr", 5 * _look(_rays(kind, params, _pixels(width, height)), width, height) - 1)
    _run(scene, tmp_path / "out")
    (view,) = (view for view in load_scene(tmp_path / "out", progress=False).train if view.name == "c.exr")
    camera = view.camera
    rays = (_pixels(camera.width, camera.height) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    expected = 5 * _look(rays, camera.width, camera.height) - 1
    assert np.abs(view.image.permute(1, 2, 0).numpy() - expected)[2:-2, 2:-2].max() < 0.04  # seen 0.012


def test_cameras_without_distortion_are_refused_and_made_smaller(tmp_path: Path) -> None:
    _run(_scene(tmp_path / "scene"), tmp_path / "done")
    with pytest.raises(UserInputError, match="done/sparse/0: its cameras have no distortion, so that its photos can"):
        _run(tmp_path / "done", tmp_path / "out")
    _run(tmp_path / "done", tmp_path / "out", max_size=100)
    _check_images(tmp_path / "out", 0.02)
    (tmp_path / "done/images/c.png").unlink()
    assert _run(tmp_path / "done", tmp_path / "fewer").left_out == ("c.png",)
    assert max(view.camera.width for view in load_scene(tmp_path / "out", progress=False).train) == 100


def test_unfinished_work_is_not_continued_through_a_link(tmp_path: Path) -> None:
    scene = _scene(tmp_path / "scene")
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "file").write_text("precious")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".prepare").symlink_to(tmp_path / "precious")
    with pytest.raises(LapgsError, match=r"out/\.prepare is a link"):
        prepare_scene(scene, tmp_path / "out", overwrite=True, progress=False)
    assert snapshot(tmp_path / "precious") == {"file": b"precious"}


def test_an_interrupted_call_is_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = _scene(tmp_path / "scene")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "move_into_place", interrupted)
        with pytest.raises(KeyboardInterrupt):
            _run(scene, tmp_path / "out")
    assert [entry.name for entry in (tmp_path / "out").iterdir()] == [".prepare"]
    refuses(UserInputError, "unfinished work with other --max-size", _run, scene, tmp_path / "out", max_size=100)
    _run(scene, tmp_path / "out")
    _run(scene, tmp_path / "other")
    assert snapshot(tmp_path / "out") == snapshot(tmp_path / "other")
    refuses(LapgsError, "already holds a scene", _run, scene, tmp_path / "out")


def test_the_command_that_a_refused_scene_is_given_makes_one(tmp_path: Path) -> None:
    scene, out = _scene(tmp_path / "scene"), tmp_path / "out"
    with pytest.raises(SceneError) as caught:
        load_scene(scene, progress=False)
    assert f"undistort its photos with `lapgs prepare {scene} OUT`" in str(caught.value)
    app = typer.Typer()
    app.command()(prepare)
    result = CliRunner().invoke(app, [str(scene), str(out)])
    assert result.exit_code == 0, result.output
    assert f"{out}: 5 of 5 photos, 30 points, reading photos" in result.output
    assert len(load_scene(out, progress=False).train) == 5
