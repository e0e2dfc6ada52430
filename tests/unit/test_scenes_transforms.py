"""Transforms scenes: axes, intrinsics and points of the Blender, instant-ngp and nerfstudio layouts."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from lapgs_plugin.errors import SceneError
from lapgs_plugin.scenes import Scene, load_cameras, load_scene
from lapgs_plugin.scenes.sample import make_sample_scene
from tests.refusals import refuses

FOV = 0.6911112070083618  # camera_angle_x of NeRF's Blender scenes
NERF_RADIUS = 4.031128874


def look_at(eye: NDArray[np.float64], target: tuple[float, ...] = (0.0, 0.0, 0.0)) -> NDArray[np.float64]:
    """(4, 4) camera to world in OpenGL axes: columns are right, up, backwards and the eye; z is up in the world."""
    back = eye - np.array(target)
    back /= np.linalg.norm(back)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    return matrix


def eyes(count: int, radius: float = NERF_RADIUS) -> NDArray[np.float64]:
    """Camera centres on the upper half of a sphere, as NeRF's Blender scenes have them."""
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(count, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.2
    return radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def frame(name: str, matrix: NDArray[np.float64], **values: object) -> dict[str, object]:
    return {"file_path": name, "transform_matrix": matrix.tolist(), **values}


def write_json(path: Path, frames: list[dict[str, object]], **values: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**values, "frames": frames}))


def write_images(path: Path, names: list[str], size: tuple[int, int]) -> None:
    for name in names:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path / name), np.full((size[1], size[0], 3), 100, np.uint8))


def nerf_scene(path: Path, train: int = 9, test: int = 3, size: tuple[int, int] = (80, 80)) -> Path:
    """The layout of NeRF's synthetic scenes."""
    places = eyes(train + test)
    for part, chosen in (("train", places[:train]), ("test", places[train:])):
        frames = [frame(f"./{part}/r_{i}", look_at(eye), rotation=0.01) for i, eye in enumerate(chosen)]
        write_json(path / f"transforms_{part}.json", frames, camera_angle_x=FOV)
        write_images(path, [f"{part}/r_{i}.png" for i in range(len(chosen))], size)
    return path


def capture(path: Path, count: int = 10, values: dict[str, object] | None = None) -> Path:
    """The layout of instant-ngp and nerfstudio."""
    values = values if values is not None else {"fl_x": 70.0, "fl_y": 72.0, "cx": 41.0, "cy": 29.5, "w": 80, "h": 60}
    names = [f"images/frame_{i:03d}.png" for i in range(count)]
    write_json(
        path / "transforms.json", [frame(n, look_at(e)) for n, e in zip(names, eyes(count), strict=True)], **values
    )
    write_images(path, names, (80, 60))
    return path


def load(path: Path, **options: Any) -> Scene:
    return load_scene(path, progress=False, **options)


def edit(path: Path, change: dict[str, object], in_frame: int | None = None) -> None:
    """Change values of a scene's transforms.json, or those of one of its frames."""
    values = json.loads((path / "transforms.json").read_text())
    target = values if in_frame is None else values["frames"][in_frame]
    target.update(change)
    for key in [key for key, value in target.items() if value is None]:
        del target[key]
    (path / "transforms.json").write_text(json.dumps(values))


# Cameras


def test_a_known_point_in_opengl_axes(tmp_path: Path) -> None:
    """A camera on the y axis looking along -y with z up: world x is to its left."""
    path = capture(tmp_path, 2)
    edit(path, {"transform_matrix": look_at(np.array([0.0, 5.0, 0.0])).tolist()}, in_frame=0)
    camera = load(path).train[0].camera
    point = camera.world_to_camera @ torch.tensor([1.0, 1.0, 0.5, 1.0])
    # 4 in front, 1 to the left, 0.5 above: OpenCV's y points down.
    torch.testing.assert_close(point, torch.tensor([-1.0, -0.5, 4.0, 1.0]))
    assert camera.position.tolist() == pytest.approx([0.0, 5.0, 0.0])


@pytest.mark.parametrize("resolution", ["full", "1/2", "30"])
def test_projection_is_the_opengl_cameras(tmp_path: Path, resolution: str) -> None:
    """Against the definition: components along the matrix's right, up and backward columns, in float64."""
    path = nerf_scene(tmp_path, size=(90, 60))
    scene = load(path, resolution=resolution, eval=True)
    points = np.random.default_rng(6).uniform(-1, 1, (30, 3))
    matrices = {f"train/r_{i}.png": look_at(eye) for i, eye in enumerate(eyes(12)[:9])}
    for view in scene.train:
        right, up, back, eye = matrices[view.name][:3].T
        along = (points - eye) @ -back
        scale = view.camera.width / 2 / math.tan(FOV / 2)
        x = view.camera.width / 2 + scale * ((points - eye) @ right) / along
        y = view.camera.height / 2 - scale * ((points - eye) @ up) / along
        pose = view.camera.world_to_camera.double().numpy()
        local = points @ pose[:3, :3].T + pose[:3, 3]
        camera = view.camera
        # In pixels; float32 poses, seen 4e-6.
        np.testing.assert_allclose(camera.fx * local[:, 0] / local[:, 2] + camera.cx, x, rtol=0, atol=1e-4)
        np.testing.assert_allclose(camera.fy * local[:, 1] / local[:, 2] + camera.cy, y, rtol=0, atol=1e-4)


def test_intrinsics_for_the_file_or_each_frame(tmp_path: Path) -> None:
    path = capture(tmp_path)
    edit(path, {"fl_x": 55.0, "cx": 20.0, "w": 40, "h": 30}, in_frame=3)
    first, fourth = (load(path).train[i].camera for i in (0, 3))
    assert (first.fx, first.fy, first.cx, first.cy) == (70.0, 72.0, 41.0, 29.5)
    assert first.size == (80, 60)
    # The file of the fourth has twice the size that its frame says.
    assert (fourth.fx, fourth.fy, fourth.cx, fourth.cy) == (110.0, 144.0, 40.0, 59.0)
    assert fourth.size == (80, 60)


def test_missing_intrinsics_have_the_usual_meaning(tmp_path: Path) -> None:
    plain = load(capture(tmp_path / "a", values={"fl_x": 70.0})).train[0].camera
    assert (plain.width, plain.height, plain.fx, plain.fy, plain.cx, plain.cy) == (80, 60, 70.0, 70.0, 40.0, 30.0)
    angles = load(capture(tmp_path / "b", values={"camera_angle_x": 1.0, "camera_angle_y": 0.5})).train[0].camera
    assert math.atan(40 / angles.fx) == pytest.approx(0.5)
    assert math.atan(30 / angles.fy) == pytest.approx(0.25)


def test_zero_distortion_is_no_distortion(tmp_path: Path) -> None:
    path = capture(tmp_path)
    edit(path, {"k1": 0.0, "k2": 0, "p1": 0.0, "p2": 0.0, "camera_model": "OPENCV", "is_fisheye": False})
    edit(path, {"camera_model": "SIMPLE_RADIAL", "distortion_params": [0.0] * 6}, in_frame=3)
    for index, name in enumerate(["pinhole", "OpenCV", "simple-pinhole", "Full OpenCV", "perspective", ""]):
        edit(path, {"camera_model": name}, in_frame=4 + index)
    assert len(load(path).train) == 10


@pytest.mark.parametrize("distorted", [False, True])
def test_distortion_of_no_shape_is_refused(tmp_path: Path, distorted: bool) -> None:
    path = capture(tmp_path, 3)
    edit(path, {"distortion_params": [[0.1], [0.2, 0.3]]})
    refuses(SceneError, "distortion_params = ..0.1., .0.2, 0.3", load_cameras, path, distorted=distorted)


@pytest.mark.parametrize(("size", "facts"), [([80], "intrinsics that are no numbers"), ("80", "sees all around; cut")])
def test_sizes_of_panoramas_are_numbers(tmp_path: Path, size: object, facts: str) -> None:
    path = capture(tmp_path, 3)
    edit(path, {"camera_model": "EQUIRECTANGULAR", "w": size, "h": size})
    refuses(SceneError, facts, load_cameras, path, distorted=True)


def test_intrinsics_without_a_size_are_those_of_the_named_photos(tmp_path: Path) -> None:
    names = [f"images/{i}.png" for i in range(3)]
    write_images(tmp_path, names, (80, 60))
    write_images(tmp_path, [name.replace("images", "images_2") for name in names], (40, 30))
    frames = [frame(name, look_at(eye)) for name, eye in zip(names, eyes(3), strict=True)]
    write_json(tmp_path / "transforms.json", frames, fl_x=90.0, cx=42.0, cy=28.0)
    (full, _), (half, _) = (load_cameras(tmp_path, images=images) for images in ("images", "images_2"))
    for name, camera in full.items():
        smaller = half[name.replace("images", "images_2")]
        assert smaller.size == (40, 30)
        assert (camera.fx, camera.cx, camera.cy) == (90.0, 42.0, 28.0)
        assert (smaller.fx, smaller.fy, smaller.cx, smaller.cy) == (45.0, 45.0, 21.0, 14.0)


def test_matrices_with_few_digits_or_three_rows(tmp_path: Path) -> None:
    path = capture(tmp_path)
    exact = look_at(eyes(10)[0])
    edit(path, {"transform_matrix": exact[:3].round(3).tolist()}, in_frame=0)
    pose = load(path).train[0].camera.world_to_camera.double().numpy()
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(-pose[:3, :3].T @ pose[:3, 3], exact[:3, 3], atol=1e-3)


# Views


def test_blender_pair_holds_out_its_test_file(tmp_path: Path) -> None:
    path = nerf_scene(tmp_path)
    scene = load(path, eval=True)
    assert [view.name for view in scene.train] == [f"train/r_{i}.png" for i in range(9)]
    assert [view.name for view in scene.test] == [f"test/r_{i}.png" for i in range(3)]
    assert scene.kind == "transforms"
    everything = load(path)
    assert (len(everything.train), len(everything.test)) == (12, 0)


def test_single_file_holds_out_every_eighth(tmp_path: Path) -> None:
    scene = load(capture(tmp_path), eval=True)
    assert [view.name for view in scene.test] == ["images/frame_000.png", "images/frame_008.png"]
    assert len(scene.train) == 8
    centers = eyes(10)[[1, 2, 3, 4, 5, 6, 7, 9]]
    radius = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    assert scene.extent == pytest.approx(1.1 * radius, rel=1e-9)  # 1.9e-16 seen


def held_out(path: Path) -> list[str]:
    scene = load(path, eval=True)
    assert not {view.name for view in scene.train} & {view.name for view in scene.test}
    return [view.name for view in scene.test]


HELD_OUT = ["images/frame_002.png", "images/frame_003.png"]


@pytest.mark.parametrize("part", ["test", "val"])
@pytest.mark.parametrize(
    "spelling",
    ["./images/{}.png", "{}.png", "{}", "images\\{}.png", "D:\\my scene\\images\\{}.PNG", "/elsewhere/images/{}"],
)
def test_lists_choose_the_views_that_are_held_out(tmp_path: Path, part: str, spelling: str) -> None:
    path = capture(tmp_path)
    edit(path, {f"{part}_filenames": [spelling.format(f"frame_00{i}") for i in (3, 2)]})
    assert held_out(path) == HELD_OUT
    assert len(load(path, eval=True).train) == 8
    assert len(load(path).train) == 10


def test_views_in_none_of_the_lists_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = capture(tmp_path)
    names = [f"frame_{i:03d}.png" for i in range(10)]
    edit(path, {"train_filenames": names[4:9], "val_filenames": names[2:4], "test_filenames": [names[3]]})
    assert held_out(path) == HELD_OUT
    assert [view.name for view in load(path, eval=True).train] == [f"images/{name}" for name in names[4:9]]
    assert len(load(path).train) == 7
    assert "3 frames in none of its lists of file names: left out" in caplog.text
    edit(path, {"val_filenames": None, "test_filenames": None, "train_filenames": names})
    assert held_out(path) == ["images/frame_000.png", "images/frame_008.png"]


def test_names_of_no_frame(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = capture(tmp_path)
    edit(path, {"test_filenames": ["images/frame_002.png", "images/frame_003.png", "images/none.png"]})
    assert held_out(path) == HELD_OUT
    assert "1 of 3 names of test_filenames are of no frame and ignored, the first is images/none.png" in caplog.text
    edit(path, {"file_path": "images/left/frame_002"}, in_frame=5)
    for names, message in (
        (["other/frame_002.png", ""], "test_filenames names no frame, the first is other/frame_002.png"),
        (["frame_002"], r"frame_002 of test_filenames may be images/frame_002.png or images/left/frame_002, expected"),
        ("test.txt", "test_filenames is 'test.txt', expected a list of file names"),
        ([2], r"test_filenames is \[2\], expected a list"),
    ):
        edit(path, {"test_filenames": names})
        refused(path, message)


def test_views_listed_as_training_and_test_views(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A list or a test file may repeat training views, or all of them: 3DGS trains on these scenes."""
    lists = capture(tmp_path / "lists")
    edit(
        lists, {"train_filenames": [f"frame_{i:03d}" for i in range(10)], "test_filenames": ["frame_002", "frame_003"]}
    )
    assert held_out(lists) == HELD_OUT
    pair = nerf_scene(tmp_path / "pair", train=9, test=1)
    train = json.loads((pair / "transforms_train.json").read_text())
    write_json(pair / "transforms_test.json", train["frames"][2:4], camera_angle_x=FOV)
    assert held_out(pair) == ["train/r_2.png", "train/r_3.png"]
    assert len(load(pair).train) == 9
    assert "2 of 9 training views are test views too: held out, not trained on" in caplog.text
    write_json(pair / "transforms_test.json", train["frames"], camera_angle_x=FOV)
    assert held_out(pair) == ["train/r_0.png", "train/r_8.png"]
    assert "all 9 training views are test views too: every eighth view is held out instead" in caplog.text


def test_scannets_test_frames_and_bad_frames(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = capture(tmp_path)
    frames = json.loads((path / "transforms.json").read_text())["frames"]
    frames = [{**values, "is_bad": i in (1, 9)} for i, values in enumerate(frames)]
    edit(path, {"frames": frames[:8], "test_frames": frames[8:]})
    assert held_out(path) == ["images/frame_008.png"]
    assert [view.name for view in load(path, eval=True).train] == [
        f"images/frame_00{i}.png" for i in (0, 2, 3, 4, 5, 6, 7)
    ]
    assert len(load(path).train) == 8
    assert "1 of 8 frames marked is_bad: left out" in caplog.text
    edit(path, {"frames": [{**frame, "is_bad": True} for frame in frames]})
    refused(path, "all of its frames are marked is_bad")
    edit(path, {"frames": frames[:8], "test_frames": {"frame": frames[8]}})
    refused(path, "test_frames is .* expected a list of frames", eval=True)


def test_nerfstudios_masks_are_used(tmp_path: Path) -> None:
    path = capture(tmp_path)
    for i in range(10):
        edit(path, {"mask_path": f"holes/frame_{i:03d}.png"}, in_frame=i)
    refuses(SceneError, r"its masks \(mask_path\) are named in holes, expected one folder", load, path)
    assert load(path, masks="none").train[0].mask is None
    write_images(path, [f"holes/frame_{i:03d}.png" for i in range(10)], (80, 60))
    cv2.imwrite(str(path / "holes" / "frame_004.png"), np.repeat(np.eye(60, 80, dtype=np.uint8), 3).reshape(60, 80, 3))
    masks = {view.name: view.mask for view in load(path).train}
    assert bool(masks["images/frame_003.png"].all())
    assert int(masks["images/frame_004.png"].sum()) == 60
    (path / "holes").rename(path / "masks")
    assert load(path).train[4].mask is not None


def test_transparent_background(tmp_path: Path) -> None:
    path = nerf_scene(tmp_path)
    rgba = np.zeros((80, 80, 4), np.uint8)
    rgba[..., 3], rgba[..., 2] = 128, 255  # half transparent red
    cv2.imwrite(str(path / "train" / "r_0.png"), rgba)
    for background in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)):
        pixel = load(path, background=background).train[3].image[:, 0, 0]  # after the three of test/
        expected = [128 / 255 + 127 / 255 * background[0], 127 / 255 * background[1], 127 / 255 * background[2]]
        assert pixel.tolist() == pytest.approx(expected, abs=1e-6)


def test_images_folder_replaces_the_one_of_the_frames(tmp_path: Path) -> None:
    path = capture(tmp_path)
    write_images(path, [f"images_2/frame_{i:03d}.png" for i in range(10)], (40, 30))
    scene = load(path, images="images_2")
    assert scene.smallest_size == (40, 30)
    assert scene.train[0].camera.fx == 35.0
    assert scene.train[0].name == "images_2/frame_000.png"


@pytest.mark.parametrize("name", ["images\\frame_000.png", "./images/frame_000", "images/FRAME_000.PNG"])
def test_ways_to_write_a_path(tmp_path: Path, name: str) -> None:
    path = capture(tmp_path)
    edit(path, {"file_path": name}, in_frame=0)
    file = path / "transforms.json"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())  # some editors begin UTF-8 with it
    assert load(path).train[0].name == "images/frame_000.png"


@pytest.mark.parametrize("name", ["{}", "C:\\Users\\me\\scene\\images\\{}", "/home/other/scene/images/{}", "left/{}"])
@pytest.mark.parametrize("folder", ["images", "images/left", "photos"])
def test_names_without_the_folder_of_the_photos(tmp_path: Path, name: str, folder: str) -> None:
    """The line that refuses a scene names the folder that --images takes."""
    path = capture(tmp_path)
    (path / "images").rename(path / "all")
    (path / folder).parent.mkdir(exist_ok=True)
    (path / "all").rename(path / folder)
    for index in range(10):
        edit(path, {"file_path": name.format(f"frame_{index:03d}.png")}, in_frame=index)
    if folder == "images/left" and name != "left/{}":
        refused(path, "frame_000.png: no such image.*; put the photos there")
        return
    if folder == "photos":
        refused(path, "frame_000.png: no such image.*; choose photos with --images")
    images = "photos" if folder == "photos" else "images"
    assert [view.name for view in load(path, images=images).train] == [f"{folder}/frame_{i:03d}.png" for i in range(10)]


def test_photos_beside_the_scene(tmp_path: Path) -> None:
    path = capture(tmp_path / "scene")
    write_images(tmp_path, ["photos/a.png"], (80, 60))
    edit(path, {"file_path": "../photos/a.png"}, in_frame=0)
    assert load(path).train[0].name == "a.png"


# Points


def write_ply(file: Path, points: NDArray[np.float64], colors: NDArray[np.generic] | None) -> None:
    kind = [(axis, "f4") for axis in "xyz"]
    if colors is not None:
        kind += [(channel, colors.dtype.str[1:]) for channel in ("red", "green", "blue")]
    rows = np.concatenate([points] if colors is None else [points, colors], axis=1)
    vertices = np.array([tuple(row) for row in rows.tolist()], dtype=kind)
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(file))


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("points3d.ply", None),
        ("points3d.ply", "none.ply"),
        ("sparse_pc.ply", "sparse_pc.ply"),
        ("Points.PLY", "./points.ply"),
        ("points/sparse.ply", "points\\sparse.ply"),
        ("sparse.ply", "C:\\scene\\sparse.ply"),
    ],
)
def test_points_of_a_ply(tmp_path: Path, name: str, named: str | None) -> None:
    path = capture(tmp_path)
    points = np.random.default_rng(0).normal(size=(20, 3))
    colors = np.random.default_rng(1).integers(0, 256, (20, 3)).astype(np.uint8)
    (path / name).parent.mkdir(exist_ok=True)
    write_ply(path / name, points, colors)
    edit(path, {"ply_file_path": named})
    scene = load(path)
    np.testing.assert_allclose(scene.points.numpy(), points, atol=1e-6)  # 5.5e-8 seen
    np.testing.assert_allclose(scene.colors.numpy(), colors / 255, atol=1e-7)  # 3.0e-8 seen


@pytest.mark.parametrize("name", ["sparse_pc.ply", "a" * 300, "/", "\0"])
def test_a_ply_that_is_not_there_is_told(tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    random = load(capture(tmp_path)).points
    assert not caplog.records
    edit(tmp_path, {"ply_file_path": name})
    assert torch.equal(load(tmp_path).points, random)
    assert "no such file; training starts from random points" in caplog.text


def test_points_with_float_colors_or_none(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = capture(tmp_path)
    points = np.random.default_rng(0).normal(size=(5, 3))
    colors = np.random.default_rng(1).random((5, 3)).astype(np.float32)
    write_ply(path / "points3d.ply", points, colors)
    np.testing.assert_allclose(load(path).colors.numpy(), colors, atol=1e-7)  # 0 seen
    write_ply(path / "points3d.ply", points, None)
    assert not caplog.records
    assert bool((load(path).colors == 0.5).all())
    assert "points3d.ply: no colours among x, y, z; its points start grey" in caplog.text


@pytest.mark.parametrize("wrong", [None, "turn", "shift"])
def test_points_of_a_colmap_model_are_moved_to_the_frames(tmp_path: Path, wrong: str | None) -> None:
    make_sample_scene(tmp_path, width=48, height=32, views=6, points=60, progress=False)
    (tmp_path / "colmap").mkdir()
    (tmp_path / "sparse").rename(tmp_path / "colmap" / "sparse")
    model = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    turn, scale, shift = cv2.Rodrigues(np.array([0.4, -1.2, 0.7]))[0], 2.5, np.array([3.0, -4.0, 5.0])
    frames = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        matrix, pose = np.eye(4), image.cam_from_world().inverse().matrix()
        matrix[:3, :3] = turn @ pose[:, :3] @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = scale * turn @ pose[:, 3] + shift
        frames.append(frame(f"images/{image.name}", matrix))
    last = np.array(frames[-1]["transform_matrix"])
    last[:3, :3] = last[:3, :3] @ cv2.Rodrigues(np.array([0.0, 0.1 * (wrong == "turn"), 0.0]))[0]
    last[0, 3] += 0.5 * (wrong == "shift")
    frames[-1]["transform_matrix"] = last.tolist()
    write_json(tmp_path / "transforms.json", frames, fl_x=50.0, w=48, h=32)
    points = load(tmp_path).points.numpy()
    if wrong:
        assert len(points) == 100_000  # random ones
        return
    expected = scale * np.array([point.xyz for point in model.points3D.values()]) @ turn.T + shift
    order, other = np.lexsort(points.T), np.lexsort(expected.astype(np.float32).T)
    np.testing.assert_allclose(points[order], expected[other], rtol=0, atol=1e-4)


def test_a_ply_without_points_starts_from_random_ones(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = capture(tmp_path)
    write_ply(path / "pc.ply", np.empty((0, 3)), np.empty((0, 3), np.float32))
    edit(path, {"ply_file_path": "pc.ply"})
    assert len(load(path).points) == 100_000
    assert "pc.ply: no points in it; training starts from random points" in caplog.text


def test_random_points_of_a_blender_scene_fill_3dgs_cube(tmp_path: Path) -> None:
    """3DGS puts 100,000 points into the cube of +-1.3 around the origin, made for cameras at NeRF's distance."""
    scene = load(nerf_scene(tmp_path))
    assert scene.points.shape == scene.colors.shape == (100_000, 3)
    torch.testing.assert_close(scene.points.amax(dim=0), torch.full((3,), 1.3), rtol=0, atol=2e-3)
    torch.testing.assert_close(scene.points.amin(dim=0), torch.full((3,), -1.3), rtol=0, atol=2e-3)
    assert torch.equal(scene.points, load(tmp_path).points)
    assert bool((scene.colors == 0.5).all())


def test_random_points_follow_the_capture(tmp_path: Path) -> None:
    """They reach the cameras, wherever the scene stands and however large it is."""
    path = capture(tmp_path)
    for index, eye in enumerate(eyes(10, radius=50.0)):
        shifted = eye + np.array([100.0, -20.0, 7.0])
        edit(path, {"transform_matrix": look_at(shifted, target=(100.0, -20.0, 7.0)).tolist()}, in_frame=index)
    scene = load(path)
    middle = (scene.points.amax(dim=0) + scene.points.amin(dim=0)) / 2
    torch.testing.assert_close(middle, torch.tensor([100.0, -20.0, 7.0]), rtol=0, atol=0.1)  # 6.3e-4 seen
    assert float((scene.points.amax(dim=0) - middle).min()) == pytest.approx(50.0, rel=0.01)


def test_random_points_with_parallel_cameras(tmp_path: Path) -> None:
    """Parallel axes meet nowhere; the points then surround the cameras."""
    path = capture(tmp_path, 4)
    for index in range(4):
        eye = np.array([float(index), 3.0, 1.0])
        edit(path, {"transform_matrix": look_at(eye, target=(float(index), 0.0, 1.0)).tolist()}, in_frame=index)
    scene = load(path)
    torch.testing.assert_close(scene.points.mean(dim=0), torch.tensor([1.5, 3.0, 1.0]), rtol=0, atol=0.02)
    assert float(scene.points.std()) > 0.1


# Bad input


def refused(path: Path, message: str, **options: Any) -> None:
    refuses(SceneError, message, load, path, **options)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"k1": 0.02, "p2": -1e-4}, r"distorted camera \(OPENCV, k1 = 0.02, p2 = -0.0001\).*`lapgs prepare"),
        ({"camera_model": "OPENCV_FISHEYE"}, r"distorted camera \(OPENCV_FISHEYE\).*`lapgs prepare"),
        ({"is_fisheye": True}, r"distorted camera \(OPENCV_FISHEYE\).*`lapgs prepare"),
        ({"fl_x": None, "fl_y": None}, "neither fl_x nor camera_angle_x"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 0}, "intrinsics that are no numbers"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": np.pi}, r"focal lengths 2\.4\d*e-15 and .* expected pixels"),
        (
            {"fl_x": 0.875, "fl_y": 1.2, "cx": 0.5, "cy": 0.5},
            r"focal lengths 0.875 and 1.2 and a principal point \(0.5, 0.5\) for 80x60, expected pixels; .*multiply",
        ),
        ({"fl_x": 0.875, "fl_y": None}, r"focal lengths 0.875 and 0.875 .* expected pixels"),
        ({"cx": 0.5, "cy": 0.5}, r"principal point \(0.5, 0.5\) for 80x60, expected pixels"),
        ({"cx": 0, "cy": 0}, r"principal point \(0, 0\) for 80x60, expected pixels"),
        ({"camera_model": "fisheye"}, r"distorted camera \(OPENCV_FISHEYE\).*`lapgs prepare"),
        (
            {"camera_model": "radial-fisheye", "k1": 0.1},
            r"distorted camera \(OPENCV_FISHEYE, k1 = 0.1\).*`lapgs prepare",
        ),
        ({"camera_model": "equirectangular"}, r"distorted camera \(EQUIRECTANGULAR\); it sees all around"),
        (
            {"camera_model": "FISHEYE624"},
            "has the camera_model 'FISHEYE624', expected SIMPLE_PINHOLE, .* or OPENCV_FISHEYE",
        ),
        ({"camera_model": ["PINHOLE"] * 99}, r"has the camera_model \['PINHOLE', .*\], expected"),
        ({"w": 1e400}, "intrinsics that are no numbers"),
        ({"ply_file_path": 5}, "ply_file_path is 5, expected the name of a file"),
        ({"fl_x": "wide"}, "intrinsics that are no numbers"),
        ({"fl_x": -3.0}, "focal lengths -3"),
        ({"fl_x": float("nan")}, "NaN or inf"),
        ({"w": 0}, "expected positive numbers"),
        ({"w": 60}, r"the image is 80x60 pixels, its camera 60x60"),
        ({"frames": []}, "no list of frames"),
        ({"frames": [{"transform_matrix": [[1]]}]}, "frame 0 has no file_path"),
        (
            {"fl_x": 1e300},
            r"frame_000\.png has focal lengths 1e\+300 and 72 .* expected at most 1e\+06 sides of the image",
        ),
        ({"cx": -1e300}, r"principal point \(-1e\+300, 29.5\), expected at most"),
        ({"w": 1e19, "h": 1e19, "fl_x": 1e19, "fl_y": 1e19}, "1e.19 pixels wide or high, expected at most 2147483648"),
        (
            {"fl_x": None, "camera_angle_x": 40.0},
            r"frame 0 .* has camera_angle_x 40, expected radians, less than 3\.14",
        ),
        ({"w": 10**300}, "holds the number of 997 bits, expected 64 bits at most"),
        ({"w": 10**4000}, "holds the number of 13288 bits, expected 64 bits at most"),
        ({"camera_model": "\x1b[2J\n"}, r"has the camera_model '\\x1b\[2J\\n', expected"),
    ],
)
def test_wrong_values_of_the_file(tmp_path: Path, change: dict[str, object], message: str) -> None:
    path = capture(tmp_path)
    edit(path, change)
    refused(path, message)


def test_shares_of_the_size_are_pixels_once_multiplied_as_advised(tmp_path: Path) -> None:
    path = capture(tmp_path)
    edit(path, {"fl_x": 0.875, "fl_y": 1.2, "cx": 0.5125, "cy": 0.4875})
    refused(path, "multiply fl_x and cx by w, fl_y and cy by h")
    edit(path, {"fl_x": 0.875 * 80, "fl_y": 1.2 * 60, "cx": 0.5125 * 80, "cy": 0.4875 * 60})
    camera = load(path).train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((70, 72, 41, 29.25))


def placed(x: float) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix.tolist()


def test_absolute_names_and_far_cameras_work(tmp_path: Path) -> None:
    path = capture(tmp_path / "scene")
    write_images(tmp_path, ["photos/a.png"], (80, 60))
    edit(path, {"file_path": str(tmp_path / "photos" / "a.png"), "transform_matrix": placed(1e6)}, in_frame=0)
    scene = load(path)
    assert scene.train[0].name == "a.png"
    assert scene.train[0].camera.position[0].item() == pytest.approx(1e6)


@pytest.mark.parametrize(
    ("away", "radius", "points_away", "warned"),
    [
        (1e3, NERF_RADIUS, 0.0, False),
        (5e5, NERF_RADIUS, 0.0, True),  # the made-up points are not there
        (1.0, 1e-4, 4.0, False),  # photos from nearly one point, of something 4 away: numbers are 1e-7 apart
        (1e6, NERF_RADIUS, 1e3, False),  # a mountain range
        (1e6, NERF_RADIUS, 4.0, True),
    ],
)
def test_coordinates_of_a_map_are_told(
    tmp_path: Path, away: float, radius: float, points_away: float, warned: bool, caplog: pytest.LogCaptureFixture
) -> None:
    path, there = capture(tmp_path), np.array([away, 0.0, 0.0])
    for i, eye in enumerate(eyes(10, radius)):
        target = there + np.array([0.0, 0.0, points_away])
        edit(path, {"transform_matrix": look_at(eye + there, tuple(target)).tolist()}, in_frame=i)
    if points_away:
        cloud = target + np.random.default_rng(0).normal(size=(50, 3)) * points_away / 10
        write_ply(path / "points.ply", cloud, np.zeros((50, 3), np.uint8))
        edit(path, {"ply_file_path": "points.ply"})
    load(path)
    assert (f"the cameras are {away:.3g} from the origin, where float32 rounds" in caplog.text) == warned


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"file_path": "images/none.png"}, r"images/none\.png: no such image"),
        ({"file_path": "images/frame_003.png"}, r"frame_003\.png is listed twice"),
        ({"file_path": "a" * 300}, r"the name of image a{32}\.\.\. has 300 bytes, expected at most 255"),
        ({"file_path": "images/" + "b" * 252 + ".png"}, "has 256 bytes, expected at most 255"),
        ({"file_path": "/"}, r"frame 4 \(/\) names a folder, expected the name of its image"),
        ({"file_path": ""}, r"frame 4 \(\) names a folder"),
        ({"file_path": "images/.."}, "names a folder"),
        ({"file_path": "images"}, "images cannot be read: Is a directory"),
        ({"file_path": "../../elsewhere.png"}, r"frame 4 .* names .*elsewhere\.png: no such image"),
        ({"file_path": "a\0b"}, r"a\\x00b: no such image"),
        ({"file_path": "\x1b[2Ja\nb\u202e.png"}, r"/\\x1b\[2Ja\\nb\\u202e\.png: no such image"),
        ({"file_path": "\ud800.png"}, "not readable as JSON"),
        ({"transform_matrix": [[10**400] * 4] * 4}, "holds the number of 1329 bits, expected 64 bits at most"),
        (
            {"transform_matrix": placed(1e300)},
            r"frame 4 .* has 1e\+300 in its transform_matrix, expected at most 1e\+12",
        ),
        ({"transform_matrix": (1e300 * np.eye(4)).tolist()}, r"frame 4 .* has 1e\+300 in its transform_matrix"),
        ({"distortion_params": [0.1, 0.0]}, r"distorted camera \(OPENCV, distortion_params = \[0.1, 0.0\]\)"),
        ({"transform_matrix": None}, "frame 4 .* has no transform_matrix"),
        ({"transform_matrix": [[1, 2], [3]]}, "frame 4 .* has no transform_matrix"),
        ({"transform_matrix": np.full((4, 4), np.nan).tolist()}, "frame 4 .* has no transform_matrix"),
        ({"transform_matrix": np.diag([2.0, 2.0, 2.0, 1.0]).tolist()}, "no rotation and translation"),
        ({"transform_matrix": np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()}, "no rotation and translation"),
    ],
)
def test_wrong_values_of_a_frame(tmp_path: Path, change: dict[str, object], message: str) -> None:
    path = capture(tmp_path)
    edit(path, change, in_frame=4)
    refused(path, message)


def test_files_that_are_not_what_they_say(tmp_path: Path) -> None:
    path = capture(tmp_path)
    (path / "points3d.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n")
    refused(path, r"points3d\.ply: not readable as a PLY")
    for text in ("", "{", "[1, 2]", "\x80"):
        (path / "transforms.json").write_text(text, encoding="latin-1")
        refused(path, r"transforms\.json(: no list of frames| is not readable as JSON)")


PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n{}end_header\n{}"
RGB = "".join(f"property {{0}} {channel}\n" for channel in ("red", "green", "blue"))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", ["-5", "9" * 30, "1000000000", "1e3", "many", ""])
def test_points_announced_that_cannot_be_there(tmp_path: Path, count: str, form: str) -> None:
    path = capture(tmp_path, 2)
    (path / "points3d.ply").write_text(PLY.format(form, count, "", "1 2 3\n" * 3))
    refused(
        path, rf"points3d\.ply: not readable as a PLY of points \(.*(counts '{count}'|of {count} \(vertex\)|line 3)"
    )


@pytest.mark.parametrize(
    ("properties", "row", "message"),
    [
        ("property float x\n", "1 2 3 4", "two properties with same name"),
        (
            RGB.format("list uchar float"),
            "1 2 3 1 .5 1 .5 1 .5",
            "blue, green, red missing or a list, expected a number",
        ),
        (RGB.format("uchar"), "1 2 3 300 1 1", "not readable as a PLY of points"),
        (RGB.format("float"), "1 2 3 nan .5 .5", "colours of the sparse points hold NaN or inf, expected 0 to 255"),
        (RGB.format("float"), "1 2 3 .5 inf .5", "colours of the sparse points hold NaN or inf"),
        (RGB.format("double"), "1 2 3 .5 .5 nan", "colours of the sparse points hold NaN or inf"),
        ("", "1 nan 3", "there are no sparse points, or they hold NaN or inf"),
        ("", "1e20 2 3", r"a sparse point lies at 1e\+20, expected at most 1e\+12"),
    ],
)
def test_points_that_cannot_be_used(tmp_path: Path, properties: str, row: str, message: str) -> None:
    path = capture(tmp_path, 2)
    (path / "points3d.ply").write_text(PLY.format("ascii", 3, properties, f"{row}\n" * 3))
    refused(path, message)


def test_ply_cut_anywhere_is_refused(tmp_path: Path) -> None:
    path = capture(tmp_path, 2)
    file = path / "points3d.ply"
    write_ply(file, eyes(3), np.full((3, 3), 9, np.uint8))
    content = file.read_bytes()
    for length in range(len(content)):
        file.write_bytes(content[:length])
        refused(path, r"points3d\.ply: not readable as a PLY|sparse points are none")


def test_pair_without_its_test_file(tmp_path: Path) -> None:
    path = nerf_scene(tmp_path)
    (path / "transforms_test.json").unlink()
    refused(path, r"transforms_test\.json: no such file.*without --eval", eval=True)
    assert len(load(path).train) == 9


def test_views_for_validation_are_held_out_if_there_are_none_for_tests(tmp_path: Path) -> None:
    path = nerf_scene(tmp_path)
    (path / "transforms_test.json").rename(path / "transforms_val.json")
    assert [len(views) for views in (load(path, eval=True).train, load(path, eval=True).test)] == [9, 3]
    assert len(load(path).train) == 12
    values = json.loads((path / "transforms_val.json").read_text())
    (path / "transforms_test.json").write_text(json.dumps({**values, "frames": values["frames"][:1]}))
    assert len(load(path, eval=True).test) == 1


def test_too_few_views(tmp_path: Path) -> None:
    refused(capture(tmp_path, 1), "1 training view, expected at least 2")
