"""Test which groups of placed photos are told to be glued together, on captures whose cameras are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from lapgs_plugin.scenes.prepare.undistort import QUARTER_TURN
from lapgs_plugin.scenes.prepare.view_graph import (
    HELD,
    LINKED,
    find_seam,
    placed_images,
    remove_unlinked,
    rolled_images,
)

Poses = NDArray[np.float64]
"""Camera from world, (n, 3, 4)."""
SEED = 7
SIDE = 640
"""Of a photo; its focal length is 480 pixels."""


def look(eye: object, at: object, up: object = (0, 0, 1)) -> Poses:
    """Return the pose of a camera that is held without roll."""
    forward = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
    right = np.cross(forward, up)
    rotation = np.stack([right / np.linalg.norm(right), np.cross(forward, right) / np.linalg.norm(right), forward])
    return np.column_stack([rotation, -rotation @ np.asarray(eye, float)])


def walls(count: int, low: object, high: object) -> NDArray[np.float64]:
    """Return points (n, 3) on the sides of a box."""
    random = np.random.default_rng(SEED)
    points = random.uniform(low, high, (count, 3))
    side = random.integers(0, 3, count)
    points[np.arange(count), side] = np.where(random.random(count) < 0.5, np.array(low)[side], np.array(high)[side])
    return points


def captured(
    poses: list[Poses], points: NDArray[np.float64], reach: float = 9.0, share: float = 0.5
) -> pycolmap.Reconstruction:
    """Make the model of photos 1.jpg, 2.jpg, ... that see this share of the points in their view within reach."""
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=SIDE, height=SIDE, params=[480, 320, 320])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    random = np.random.default_rng(SEED)
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points]
    for number, pose in enumerate(poses, start=1):
        seen = points @ pose[:, :3].T + pose[:, 3]
        pixels = 480 * seen[:, :2] / np.maximum(seen[:, 2:], 1e-9) + 320
        inside = (seen[:, 2] > 0.2) & (seen[:, 2] < reach) & (np.abs(pixels - 320) < 320).all(axis=1)
        chosen = np.flatnonzero(inside & (random.random(len(points)) < share))
        for index, point in enumerate(chosen):
            tracks[point].append(pycolmap.TrackElement(number, index))
        image = pycolmap.Image(f"{number}.jpg", keypoints=pixels[chosen], camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for xyz, track in zip(points, tracks, strict=True):
        if len(track) > 1:
            model.add_point3D(xyz, pycolmap.Track(track), np.zeros(3, np.uint8))
    return model


def ring(
    count: int, centre: tuple[float, float], radius: float, look_out: bool, tilt: float = 0.0, height: float = 1.5
) -> list[Poses]:
    """Return poses on a circle that look at its centre, or away from it."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        way = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array([*centre, height]) + radius * way + (0, 0, 0.2 * np.sin(5 * angle))
        poses.append(look(eye, eye + (way if look_out else -way) + (0, 0, tilt)))
    return poses


def rolled(pose: Poses, quarters: int) -> Poses:
    """Return the pose of a camera that is turned about its view axis, counterclockwise as seen by the photographer."""
    return np.asarray(np.linalg.matrix_power(QUARTER_TURN, 4 - quarters) @ pose)


ROOM = walls(2500, (-3, -3, 0), (3, 3, 3))


def walk() -> pycolmap.Reconstruction:
    """Two rooms, and a bare corridor between them."""
    rooms = [walls(2500, (-3, -3, 0), (3, 3, 3)), walls(2500, (12, -3, 0), (18, 3, 3))]
    corridor = walls(400, (3, -1, 0), (12, 1, 3))
    way = [look((x, 0.1 * np.sin(3 * x), 1.5), (x + 1, 0.0, 1.5)) for x in np.arange(0.0, 13.0, 1.1)]
    poses = [*ring(12, (0, 0), 0.8, True), *way, *ring(12, (15, 0), 0.8, True)]
    return captured(poses, np.concatenate([*rooms, corridor]))


def survey() -> pycolmap.Reconstruction:
    """A drone that flies to and fro and looks straight down."""
    ground = np.random.default_rng(SEED).uniform((-3, -3, 0), (27, 12, 1), (4000, 3))
    return captured(
        [look((x, y, 9), (x, y, 0), (1 - y / 4 % 2 * 2, 0, 0)) for y in (0, 4, 8) for x in range(0, 24, 2)], ground, 12
    )


def flight() -> pycolmap.Reconstruction:
    """A drone that looks straight down to and fro, then flies around and looks at the middle."""
    ground = np.random.default_rng(SEED).uniform((-12, -12, 0), (12, 12, 1), (4000, 3))
    strips = [
        look((x, y, 14), (x, y, 0), ((-1) ** row, 0, 0)) for row, y in enumerate((-6, 0, 6)) for x in range(-8, 9, 4)
    ]
    around = [pose for height in (8.0, 11.0) for pose in ring(16, (0, 0), 14.0, False, -height / 14, height)]
    return captured([*strips, *around], ground, 30)


def sideways(count: int) -> pycolmap.Reconstruction:
    """A loop through a room, and as much of a second one with the phone held sideways, which no EXIF data tell."""
    loop = ring(20, (0, 0), 0.8, True)
    return captured([*loop, *(rolled(pose, 1) for pose in ring(20, (0.1, 0), 0.9, True)[:count])], ROOM)


def clip() -> pycolmap.Reconstruction:
    """A clip along a wall, of which each frame shows what a few others show; the phone is turned half way."""
    wall = np.random.default_rng(SEED).uniform((-3, -0.3, 0), (33, 0.3, 3), (4000, 3))
    poses = [look((x, -2.5, 1.5), (x + 0.3, 0, 1.5)) for x in np.arange(0.0, 30.0, 1.0)]
    return captured([pose if number < 15 else rolled(pose, 1) for number, pose in enumerate(poses)], wall)


def turned_on_the_way(count: int) -> pycolmap.Reconstruction:
    """A loop through a room, its last photos with the phone held sideways."""
    loop = ring(24, (0, 0), 0.8, True)
    return captured([*loop[:16], *(rolled(pose, 1) for pose in loop[16 : 16 + count])], ROOM)


HONEST: dict[str, Callable[[], pycolmap.Reconstruction]] = {
    "a room from its middle": lambda: captured(ring(24, (0, 0), 0.8, True), ROOM),
    "an orbit": lambda: captured(ring(24, (0, 0), 2.5, False), walls(1500, (-1, -1, 0), (1, 1, 2))),
    "a table top from above": lambda: captured(ring(16, (0, 0), 1.5, False, -1.8), walls(1500, (-1, -1, 0), (1, 1, 1))),
    "one direction": lambda: captured(
        [look((0.3 * x, -2.5, 1.2 + 0.3 * z), (0.3 * x, 3, 1.2)) for x in range(5) for z in range(4)], ROOM
    ),
    "two rooms and a corridor": walk,
    "a drone that looks down": survey,
    "a drone that looks down and around": flight,
    "a loop sideways": lambda: sideways(20),
    "a wall sideways": lambda: sideways(6),
    "sideways for a few photos": lambda: turned_on_the_way(4),
    "sideways for a third of the loop": lambda: turned_on_the_way(8),
    "a clip while the phone is turned": clip,
    "six photos of little": lambda: captured(ring(30, (0, 0), 0.3, True)[:6], ROOM[::2]),
}


@pytest.mark.parametrize("name", HONEST)
def test_captures_as_people_make_them_stay_whole(name: str) -> None:
    model = HONEST[name]()
    photos = model.num_reg_images()
    remove_unlinked(model)
    assert find_seam(model, lambda _: 0) is None
    assert model.num_reg_images() == photos


def glued(
    points: int, degrees: float, quarters: int = 0, photos: tuple[int, int] = (20, 14)
) -> pycolmap.Reconstruction:
    """Two halves of a room with points of their own, the second turned about y, held together by wrong points."""
    turn = pycolmap.Rotation3d(np.radians(degrees) * np.array([0.0, 1.0, 0.0])).matrix()
    poses, count = ring(sum(photos), (0, 0), 0.8, True), photos[0]
    first, second = poses[:count], [np.column_stack([pose[:, :3] @ turn.T, pose[:, 3]]) for pose in poses[count:]]
    both = captured(first, ROOM, share=0.9)
    other = captured(second, ROOM @ turn.T, share=0.9)
    camera_of = {number: number + len(first) for number in other.images}
    for number in sorted(other.images):
        image = other.images[number]
        pixels = np.array([point.xy for point in image.points2D])
        pose = pycolmap.Rigid3d(rolled(image.cam_from_world().matrix(), quarters))
        copied = pycolmap.Image(f"{camera_of[number]}.jpg", keypoints=pixels, camera_id=1, image_id=camera_of[number])
        both.add_image_with_trivial_frame(copied, pose)
    wrong = 0
    in_first = [key for key, point in both.points3D.items() if any(e.image_id == 5 for e in point.track.elements)]
    for point in other.points3D.values():
        elements = [pycolmap.TrackElement(camera_of[e.image_id], e.point2D_idx) for e in point.track.elements]
        if wrong < points and (
            of_glue := [element for element in elements if element.image_id == count + min(photos[1], 5)]
        ):
            both.add_observation(in_first[wrong], of_glue[0])
            elements.remove(of_glue[0])
            wrong += 1
        if len(elements) > 1:
            both.add_point3D(point.xyz, pycolmap.Track(elements), np.zeros(3, np.uint8))
    assert wrong == points
    return both


@pytest.mark.parametrize(("points", "degrees"), [(20, 0), (20, 100), (60, 100), (75, 100), (60, 180)])
def test_groups_that_a_few_wrong_points_hold_together_are_told(points: int, degrees: float) -> None:
    model = glued(points, degrees)
    assert len(placed_images(model)) == 34
    remove_unlinked(model)
    assert len(placed_images(model)) == 34, f"{LINKED} points link them"
    seam = find_seam(model, lambda _: 0)
    assert seam is not None
    assert seam.apart == tuple(range(21, 35))
    assert seam.points == points
    assert seam.angle == (pytest.approx(degrees, abs=1e-3) if degrees else None)  # 1.4e-14 seen


def test_two_verticals_are_wrong_however_strong_the_link_is() -> None:
    """Photos of one direction may have been rolled, unless EXIF data tell that they were not."""
    wide, narrow = glued(95, 100, photos=(18, 17)), turned_on_the_way(4)
    for model, held_upright, wrong in (
        (wide, False, range(19, 36)),
        (narrow, False, None),
        (narrow, True, range(17, 21)),
    ):
        seam = find_seam(model, lambda _: 0, held_upright)
        assert (None if seam is None else seam.apart) == (None if wrong is None else tuple(wrong))


def test_few_points_and_one_vertical_are_no_seam_if_they_place_a_photo() -> None:
    assert find_seam(glued(HELD, 0), lambda _: 0) is None


@pytest.mark.parametrize("told", [True, False])
def test_photos_that_exif_turns_are_upright(told: bool) -> None:
    """Landscape photos, and photos of a phone on one side that are stored sideways."""
    model = glued(60, 0, quarters=1, photos=(20, 4))
    seam = find_seam(model, lambda name: 1 if told and int(name.split(".")[0]) > 20 else 0)
    assert (seam is None) == told


def test_photos_of_another_roll_are_named_if_they_are_more_than_a_few() -> None:
    poses = ring(30, (0, 0), 0.8, True)
    for sideways, expected in ((2, 0), (8, 8)):
        mixed = [
            rolled(pose, 1) if number % 3 == 0 and number < 3 * sideways else pose for number, pose in enumerate(poses)
        ]
        model = captured(mixed, ROOM)
        assert find_seam(model, lambda _: 0) is None
        assert len(rolled_images(model, lambda _: 0)) == expected
    assert rolled_images(survey(), lambda _: 0) == []
