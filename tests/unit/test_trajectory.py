"""Compare rigs and camera paths with known circles and cameras, and refuse files with mistakes."""

from __future__ import annotations

import json
import math
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.rendering.rig import Rig, camera_positions, forward
from lapgs_plugin.rendering.trajectory import orbit, read_trajectory, spline, trajectory_json, walking_order, with_size
from tests.training_scene import ring_camera


def ring(count: int, angle: float = 2 * math.pi) -> list[Camera]:
    """Return cameras of `ring_camera`: 4 from the y axis at y = -1, looking at the origin; y points down."""
    return [ring_camera(angle * i / count) for i in range(count)]


def turns(cameras: list[Camera]) -> NDArray[np.float64]:
    """Return the angle between each camera and the next in radians."""
    rotations = Rotation.from_matrix([camera.world_to_camera[:3, :3].double().numpy() for camera in cameras])
    return np.asarray((rotations[1:] * rotations[:-1].inv()).magnitude())


def test_a_ring_looks_at_its_centre() -> None:
    rig = Rig.of(ring(12))
    np.testing.assert_allclose(rig.focus, 0.0, atol=5e-3)  # worst seen 3e-3: the ridge draws it to the guess
    np.testing.assert_allclose(rig.up, [0.0, -1.0, 0.0], atol=1e-6)
    assert rig.distance == pytest.approx(math.sqrt(17.0), rel=2e-3)
    assert rig.surrounds


def test_cameras_on_one_side_do_not_surround() -> None:
    rig = Rig.of(ring(8, angle=1.0))
    assert not rig.surrounds
    np.testing.assert_allclose(rig.focus, 0.0, atol=0.05)


def test_one_camera_looks_somewhere_ahead() -> None:
    camera = ring_camera(0.3)
    rig = Rig.of([camera])
    ahead = rig.focus - camera.position.double().numpy()
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), forward(camera), atol=1e-6)
    assert rig.distance > 0.5
    assert not rig.surrounds


def test_an_orbit_of_a_ring_is_that_ring() -> None:
    path = orbit(Rig.of(ring(12)), 48)
    places = camera_positions(path)
    np.testing.assert_allclose(places[:, 1], -1.0, atol=5e-3)  # worst seen 2e-3, of the focus
    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 2]), 4.0, atol=1e-2)
    ways = np.linalg.norm(np.diff(np.concatenate([places, places[:1]]), axis=0), axis=1)
    np.testing.assert_allclose(ways, 2 * 4.0 * math.sin(math.pi / 48), rtol=5e-3)  # closed, and even
    for camera, position in zip(path, places, strict=True):
        np.testing.assert_allclose(forward(camera), -position / np.linalg.norm(position), atol=2e-3)
        assert torch.linalg.det(camera.world_to_camera[:3, :3]).item() == pytest.approx(1.0, abs=1e-5)


def test_an_orbit_before_one_sided_cameras_stays_among_them() -> None:
    cameras = ring(8, angle=0.8)
    path = orbit(Rig.of(cameras), 20)
    spread = camera_positions(cameras)
    middle = spread.mean(axis=0)
    reach = np.linalg.norm(spread - middle, axis=1).max()
    assert (np.linalg.norm(camera_positions(path) - middle, axis=1) < reach).all()


def test_a_spline_passes_its_cameras_at_an_even_speed() -> None:
    cameras = ring(13, angle=2.0)
    path = spline(cameras, 12 * 10 + 1)
    np.testing.assert_allclose(camera_positions(path)[::10], camera_positions(cameras), atol=1e-5)  # 2.4e-7 seen
    for passed, camera in zip(path[::10], cameras, strict=True):
        torch.testing.assert_close(passed.world_to_camera, camera.world_to_camera, atol=1e-5, rtol=0)
    angle = 2.0 * 12 / 13 / 120
    np.testing.assert_allclose(turns(path)[5:-5], angle, rtol=0.05)  # worst seen 0.01


def test_a_spline_through_many_cameras_begins_and_ends_with_them() -> None:
    cameras = ring(90, angle=3.0)
    path = spline(cameras, 200)
    places, known = camera_positions(path), camera_positions(cameras)
    np.testing.assert_allclose(places[[0, -1]], known[[0, -1]], atol=1e-5)  # 6.0e-8 seen
    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 2]), 4.0, atol=1e-2)  # 3.3e-5 seen


def test_a_spline_through_cameras_at_one_place_stands_or_turns() -> None:
    camera = ring_camera(0.0)
    assert len(spline([camera, camera], 5)) == 5
    turned = Camera(*(56, 40, 50.0, 50.0, 28.0, 20.0), world_to_camera=torch.eye(4))
    other = torch.eye(4)
    other[:3, :3] = torch.from_numpy(Rotation.from_euler("y", 60, degrees=True).as_matrix()).float()
    path = spline([turned, Camera(56, 40, 50.0, 50.0, 28.0, 20.0, other)], 7)
    np.testing.assert_allclose(turns(path), math.radians(10), atol=1e-4)  # 3.6e-8 seen


@settings(deadline=None, max_examples=25)
@given(st.integers(2, 30), st.integers(2, 40), st.integers(0, 2**31))
def test_every_camera_of_a_spline_is_rigid(keys: int, frames: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cameras = []
    for rotation in Rotation.random(keys, random_state=seed).as_matrix():
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, rng.normal(size=3)
        cameras.append(Camera(56, 40, 50.0, 50.0, 28.0, 20.0, torch.from_numpy(pose).float()))
    path = spline(cameras, frames)
    assert len(path) == frames
    for camera in path:
        rotation = camera.world_to_camera[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)  # 1.2e-7 seen


def test_cameras_out_of_order_are_walked_past_in_turn() -> None:
    cameras = ring(30, angle=5.0)
    shuffled = [cameras[0], *(cameras[1 + 7 * i % 29] for i in range(29))]
    assert [id(camera) for camera in walking_order(shuffled)] == [id(camera) for camera in cameras]


def test_an_order_of_many_cameras_takes_little_more_memory_than_their_distances() -> None:
    count = 1000
    cameras = [ring_camera(angle) for angle in np.random.default_rng(0).uniform(0, 6, count)]
    walking_order(cameras[:3])  # imports what it needs
    tracemalloc.start()
    try:
        walking_order(cameras)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.5 * 8 * count**2  # 1.01 seen; differences of all pairs take three times as much


def test_cameras_in_order_are_left_alone() -> None:
    there_and_back = [*ring(20, angle=3.0), *reversed([ring_camera(3.0 * i / 20 + 0.05) for i in range(20)])]
    assert [id(camera) for camera in walking_order(there_and_back)] == [id(camera) for camera in there_and_back]


@settings(deadline=None, max_examples=25)
@given(st.integers(2, 25), st.integers(0, 2**31))
def test_an_order_has_every_camera_once(count: int, seed: int) -> None:
    cameras = [ring_camera(angle) for angle in np.random.default_rng(seed).uniform(0, 6, count)]
    walked = walking_order(cameras)
    assert {id(camera) for camera in walked} == {id(camera) for camera in cameras}
    assert len(walked) == count
    assert walked[0] is cameras[0]


def test_files_come_back_as_written(tmp_path: Path) -> None:
    cameras = ring(5)
    path = tmp_path / "path.json"
    path.write_text(json.dumps(trajectory_json(cameras)))
    for read, camera in zip(read_trajectory(path), cameras, strict=True):
        torch.testing.assert_close(read.world_to_camera, camera.world_to_camera, atol=1e-5, rtol=0)  # 4.8e-7 seen
        assert (read.width, read.height, read.fx, read.cy) == (camera.width, camera.height, camera.fx, camera.cy)


def test_a_file_with_an_angle_of_view(tmp_path: Path) -> None:
    path = tmp_path / "path.json"
    frame = {"transform_matrix": np.eye(4).tolist()}
    path.write_text(json.dumps({"w": 100, "h": 50, "camera_angle_x": math.pi / 2, "frames": [frame]}))
    (camera,) = read_trajectory(path)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((50, 50, 50, 25))
    np.testing.assert_allclose(forward(camera), [0, 0, -1])


GOOD: dict[str, Any] = {"w": 64, "h": 48, "fl_x": 50.0}
EYE = np.eye(4).tolist()


def of_frames(*frames: Any, **intrinsics: Any) -> dict[str, Any]:
    values = {**GOOD, **intrinsics, "frames": frames}
    return {name: value for name, value in values.items() if value is not None}


def with_matrix(matrix: Any = EYE, **intrinsics: Any) -> dict[str, Any]:
    return of_frames({"transform_matrix": np.asarray(matrix, dtype=object).tolist()}, **intrinsics)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], "no cameras in it"),
        (of_frames(), "no cameras in it"),
        (of_frames({"transform_matrix": EYE}, {}), "frame 1 has no transform_matrix"),
        (of_frames({"transform_matrix": EYE}, h=None), "frame 0 has no h, expected w and h"),
        (of_frames({"transform_matrix": EYE}, fl_x=None), "frame 0 has neither fl_x nor camera_angle_x"),
        (with_matrix([[1, 0], [0, 1]]), "no transform_matrix of 4x4 finite numbers"),
        (with_matrix(2 * np.eye(4)), "is no rotation and translation"),
        (with_matrix(np.diag([1, 1, -1, 1])), "is no rotation and"),
        (with_matrix([*EYE[:3], [0, 0, 0, 2]]), "frame 0 has 0 0 0 2 in the last row of .*, expected 0 0 0 1; export"),
        (with_matrix([*EYE[:3], [1.5, -2, 3, 1]]), "frame 0 has 1.5 -2 3 1 in the last row"),  # by columns
        (with_matrix([[math.nan] * 4] * 4), "of 4x4 finite numbers"),
        (with_matrix(fl_x=None, camera_angle_x=0), "frame 0 has intrinsics that"),
        (with_matrix(w=math.inf), "frame 0 has intrinsics that are"),
        (with_matrix(fl_x=-3), "focal lengths -3 and -3"),
        (with_matrix(w="wide"), r"are no numbers \(invalid literal"),
        (of_frames("here"), "frame 0 is 'here', expected a table"),
        (
            with_matrix(w=10**5, h=10**5, fl_x=1e5),
            "frame 0 has 100000x100000 pixels, expected at most 128,000,000 pixels; .* LAPGS_MAX_VIEW_PIXELS",
        ),
        (with_matrix(w=10**300, fl_x=1e300), "holds the number of 997 bits, expected 64 bits at most"),
        (with_matrix(fl_x=1e300), "focal lengths 1e.300"),
        (with_matrix(cx=-1e300), r"principal point \(-1e.300, 24\)"),
        (with_matrix(1e300 * np.eye(4)), "1e.300 in its transform_matrix"),
        (with_matrix([[10**400] * 4] * 4), "holds the number of 1329 bits, expected 64 bits at most"),
    ],
)
def test_a_bad_file_is_one_line_that_names_the_frame(values: object, message: str, tmp_path: Path) -> None:
    path = tmp_path / "path.json"
    path.write_text(json.dumps(values))
    with pytest.raises(UserInputError, match=message) as error:
        read_trajectory(path)
    assert "\n" not in str(error.value)


def test_a_file_of_too_many_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "path.json"
    path.write_text(json.dumps(of_frames(*[{"transform_matrix": EYE}] * 4)))
    monkeypatch.setenv("LAPGS_MAX_FRAMES", "3")
    with pytest.raises(
        UserInputError, match=r"path\.json has 4 frames, expected at most 3 frames; .* LAPGS_MAX_FRAMES"
    ):
        read_trajectory(path)
    monkeypatch.setenv("LAPGS_MAX_FRAMES", "4")
    assert len(read_trajectory(path)) == 4


def test_a_file_that_is_not_there_or_not_json(tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match="give orbit, spline or a JSON file"):
        read_trajectory(tmp_path / "spiral")
    (tmp_path / "path.json").write_text("{")
    with pytest.raises(UserInputError, match="not readable as JSON"):
        read_trajectory(tmp_path / "path.json")


def test_another_shape_keeps_the_vertical_field_of_view() -> None:
    camera = Camera(100, 50, fx=40.0, fy=41.0, cx=52.0, cy=24.0, world_to_camera=torch.eye(4))
    wide = with_size(camera, (400, 100))
    assert wide.tan_half_fov[1] == pytest.approx(camera.tan_half_fov[1])
    assert (wide.fx, wide.fy, wide.cx, wide.cy) == pytest.approx((80, 82, 204, 48))
