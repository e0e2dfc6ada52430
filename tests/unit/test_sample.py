"""The sample scene against COLMAP's own geometry, closed forms and brute force."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import typer
from numpy.typing import NDArray
from typer.testing import CliRunner

from lapgs_plugin.cli.sample import sample
from lapgs_plugin.errors import LapgsError, UserInputError
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.sample import make_sample_scene
from lapgs_plugin.scenes.sample import scene as scene_module
from lapgs_plugin.scenes.sample.points import NOISE
from lapgs_plugin.scenes.sample.ray_kernels import nearest_hits
from lapgs_plugin.scenes.sample.raycast import camera_rays, first_hits
from lapgs_plugin.scenes.sample.scene import orbit_camera
from lapgs_plugin.scenes.sample.solids import Solid, ball, box, rod
from lapgs_plugin.scenes.sample.world import build_world
from tests.folders import snapshot
from tests.refusals import refuses

SMALL = {"width": 48, "height": 32, "views": 3, "points": 40, "progress": False}
WIDTH, HEIGHT = 240, 160
VIEWS, POINTS = 10, 500


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sample") / "scene"
    make_sample_scene(path, width=WIDTH, height=HEIGHT, views=VIEWS, points=POINTS, progress=False)
    return path


@pytest.fixture(scope="module")
def model(scene: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(scene / "sparse" / "0")


@pytest.fixture(scope="module")
def pictures(scene: Path) -> dict[str, NDArray[np.float32]]:
    """Images by name as COLMAP reads them, (h, w, 3) RGB in [0, 1]."""
    return {
        file.name: pycolmap.Bitmap.read(file, as_rgb=True).to_array().astype(np.float32) / 255
        for file in sorted((scene / "images").iterdir())
    }


def _colors_at(picture: NDArray[np.float32], pixels: NDArray[np.float64]) -> NDArray[np.float32]:
    """Bilinear colours (n, 3) at COLMAP image positions (n, 2), where the first pixel's centre is at 0.5."""
    x, y = (pixels - 0.5).astype(np.float32).T
    return cv2.remap(picture, x[None], y[None], cv2.INTER_LINEAR)[0]


def _observations(model: pycolmap.Reconstruction, point: pycolmap.Point3D) -> list[tuple[pycolmap.Image, NDArray]]:
    return [
        (model.images[element.image_id], model.images[element.image_id].points2D[element.point2D_idx].xy)
        for element in point.track.elements
    ]


def _triangulate(model: pycolmap.Reconstruction, point: pycolmap.Point3D) -> NDArray[np.float64]:
    """The point nearest to all rays of its track, in the least-squares sense: where the surface is."""
    left, right = np.zeros((3, 3)), np.zeros(3)
    for image, pixel in _observations(model, point):
        ray = np.append(model.cameras[image.camera_id].cam_from_img(pixel), 1.0)
        pose = image.cam_from_world()
        ray = pose.rotation.matrix().T @ (ray / np.linalg.norm(ray))
        off_ray = np.eye(3) - np.outer(ray, ray)
        left += off_ray
        right += off_ray @ image.projection_center()
    return np.linalg.solve(left, right)


@pytest.fixture(scope="module")
def surface_points(model: pycolmap.Reconstruction) -> dict[int, NDArray[np.float64]]:
    return {key: _triangulate(model, point) for key, point in model.points3D.items()}


def test_it_is_a_colmap_scene(scene: Path, model: pycolmap.Reconstruction) -> None:
    assert [(c.model.name, c.width, c.height) for c in model.cameras.values()] == [("PINHOLE", WIDTH, HEIGHT)]
    assert sorted(image.name for image in model.images.values()) == [f"{view:04d}.png" for view in range(VIEWS)]
    assert len(model.points3D) == POINTS
    loaded = load_scene(scene, eval=True, progress=False)
    assert (len(loaded.train), len(loaded.test)) == (8, 2)
    assert loaded.train[0].image.shape == (3, HEIGHT, WIDTH)


def test_tracks_hold_the_exact_positions_of_one_surface_point(
    model: pycolmap.Reconstruction, surface_points: dict[int, NDArray[np.float64]]
) -> None:
    for key, point in model.points3D.items():
        observations = _observations(model, point)
        assert len(observations) >= 2
        for image, pixel in observations:
            np.testing.assert_allclose(image.project_point(surface_points[key]), pixel, atol=1e-8)  # worst seen 3e-12


def test_points_are_off_the_surface_by_the_noise_that_is_promised(
    model: pycolmap.Reconstruction, surface_points: dict[int, NDArray[np.float64]]
) -> None:
    off = np.array([model.points3D[key].xyz - surface_points[key] for key in model.points3D])
    # 1500 normal numbers: their deviation is known to 1.8 %, their mean to 2.6 % of it; four times that.
    np.testing.assert_allclose(off.std(), NOISE, rtol=0.075)  # 0.016 seen
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=0.18 * NOISE)


def test_views_show_a_surface_point_in_its_colour(
    model: pycolmap.Reconstruction, pictures: dict[str, NDArray[np.float32]]
) -> None:
    def errors(shift: float) -> NDArray[np.float64]:
        return np.array(
            [
                np.abs(_colors_at(pictures[image.name], pixel[None] + shift)[0] - point.color / 255).max()
                for point in model.points3D.values()
                for image, pixel in _observations(model, point)
            ]
        )

    right, shifted = errors(0.0), errors(2.0)
    # Seen: medians 0.028 and 0.120. Fine texture and highlights look different from elsewhere.
    assert np.median(right) < 0.06
    assert np.median(right) < 0.5 * np.median(shifted)


def test_no_solid_stands_between_a_view_and_the_points_it_sees(
    model: pycolmap.Reconstruction, surface_points: dict[int, NDArray[np.float64]]
) -> None:
    globe, column = np.array([0.0, 0.0, 1.42]), 0.16
    for key, point in model.points3D.items():
        end = surface_points[key]
        for image, _ in _observations(model, point):
            path = np.linspace(image.projection_center(), end, 400)
            assert np.linalg.norm(path - globe, axis=1).min() > 0.42 - 5e-3
            in_column = (np.hypot(path[:, 0], path[:, 1]) < column - 5e-3) & (path[:, 2] > 0.22) & (path[:, 2] < 1.0)
            in_plinth = (np.hypot(path[:, 0], path[:, 1]) < 1.05 - 5e-3) & (path[:, 2] < 0.22 - 5e-3)
            assert not (in_column | in_plinth | (path[:, 2] < -5e-3)).any()


def test_the_red_ring_of_the_plinth_is_where_colmap_projects_it(
    model: pycolmap.Reconstruction, pictures: dict[str, NDArray[np.float32]]
) -> None:
    def share_of_red(radius: float) -> float:
        turn = np.linspace(0, 2 * np.pi, 200, endpoint=False)
        circle = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full_like(turn, 0.22)], axis=1)
        red = []
        for image in model.images.values():
            pixels = np.array([image.project_point(point) for point in circle])
            r, g, b = _colors_at(pictures[image.name], pixels).T
            red.append((r > 1.7 * g) & (r > 1.7 * b))
        return float(np.mean(red))

    # Seen: 0.62 on the ring, which things in front hide in part; at most 0.03 beside it.
    assert share_of_red(0.965) > 0.55
    assert share_of_red(1.12) < 0.05
    assert share_of_red(0.90) < 0.05


def test_a_larger_image_shows_the_same_and_more(tmp_path: Path, pictures: dict[str, NDArray]) -> None:
    half = (WIDTH // 2, HEIGHT // 2)
    make_sample_scene(tmp_path / "half", width=half[0], height=half[1], views=2, points=20, progress=False)
    small = cv2.imread(str(tmp_path / "half" / "images" / "0001.png"))[:, :, ::-1].astype(np.float32) / 255
    halved = cv2.resize(pictures["0001.png"], half, interpolation=cv2.INTER_AREA)
    shifted = np.roll(halved, 1, axis=1)
    same, other = (float(np.sqrt(np.mean((small - image) ** 2))) for image in (halved, shifted))
    # Seen: 0.038 (averages are taken after encoding here, before it in the scene) against 0.16.
    assert same < 0.05
    assert same < other / 3
    enlarged = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    error = np.sqrt(np.mean((pictures["0001.png"] - enlarged) ** 2))
    assert error > 0.05  # seen 0.099: detail that the smaller image cannot hold


def test_images_have_energy_at_high_frequencies(pictures: dict[str, NDArray[np.float32]]) -> None:
    shares = []
    for picture in pictures.values():
        grey = picture.mean(axis=2)
        window = np.outer(np.hanning(grey.shape[0]), np.hanning(grey.shape[1]))
        energy = np.abs(np.fft.fft2((grey - grey.mean()) * window)) ** 2
        frequency = np.hypot(np.fft.fftfreq(grey.shape[0])[:, None], np.fft.fftfreq(grey.shape[1])[None])
        shares.append(energy[frequency > 0.25].sum() / energy.sum())  # half of Nyquist is 0.25 cycles a pixel
    assert min(shares) > 0.07  # seen: 0.13 to 0.35


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    make_sample_scene(tmp_path / "a", **SMALL)
    make_sample_scene(tmp_path / "b", **SMALL)
    make_sample_scene(tmp_path / "c", **SMALL, seed=1)
    first, second, other = (snapshot(tmp_path / name) for name in "abc")
    assert first == second
    assert len(first) >= 6
    assert all(first[name] != other[name] for name in first if name.startswith("images"))


def test_fewer_views_are_the_first_of_more(tmp_path: Path) -> None:
    make_sample_scene(tmp_path / "few", **SMALL)
    make_sample_scene(tmp_path / "more", **{**SMALL, "views": 5})
    few, more = snapshot(tmp_path / "few"), snapshot(tmp_path / "more")
    assert [few[f"images/{view:04d}.png"] for view in range(3)] == [more[f"images/{view:04d}.png"] for view in range(3)]


@pytest.mark.parametrize("step", [1, 8])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_cameras_stand_all_around_and_so_do_those_held_out(step: int, seed: int) -> None:
    centres = np.array([orbit_camera(index, (480, 320), seed).position.numpy() for index in range(0, 40, step)])
    turn = np.sort(np.arctan2(centres[:, 1], centres[:, 0]))
    gaps = np.diff(np.append(turn, turn[0] + 2 * np.pi))
    # Even spacing would be 9 and 72 degrees; seen at most 17 and 115.
    assert np.degrees(gaps.max()) < {1: 20, 8: 150}[step]
    assert (np.hypot(centres[:, 0], centres[:, 1]) < 6.0).all()  # the wall is at 6.5
    assert np.ptp(centres[:, 2]) > 1.0


Inside = Callable[[NDArray[np.float64]], NDArray[np.bool_]]


def _no_paint(points: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.zeros(points.shape[1], np.uint8)


def _in_ball(p: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.linalg.norm(p - np.array([[0.2], [0.1], [0.8]]), axis=0) < 0.6


def _in_box(p: NDArray[np.float64]) -> NDArray[np.bool_]:
    """A box of 0.9 x 0.6 x 1.1 around (-0.1, 0.2, 0.5), turned by 0.7."""
    x, y, z = p - np.array([[-0.1], [0.2], [0.5]])
    c, s = np.cos(0.7), np.sin(0.7)
    return (np.abs(c * x + s * y) < 0.45) & (np.abs(c * y - s * x) < 0.3) & (np.abs(z) < 0.55)


START, END = np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.4, 1.0])


def _in_rod(radius: float) -> Inside:
    def inside(p: NDArray[np.float64]) -> NDArray[np.bool_]:
        length = np.linalg.norm(END - START)
        along = (END - START) / length @ (p - START[:, None])
        off = np.linalg.norm(p - START[:, None] - (END - START)[:, None] / length * along, axis=0)
        return (off < radius) & (along > 0) & (along < length)

    return inside


def _outside_hall(p: NDArray[np.float64]) -> NDArray[np.bool_]:
    return (np.hypot(p[0], p[1]) > 3.0) | (p[2] < 0) | (p[2] > 2.5)


SOLIDS: dict[str, tuple[Solid, Inside]] = {
    "ball": (ball((0.2, 0.1, 0.8), 0.6, _no_paint), _in_ball),
    "box": (box((-0.1, 0.2, 0.5), (0.9, 0.6, 1.1), _no_paint, 0.7), _in_box),
    "rod": (rod((0.1, -0.2, 0.3), (0.5, 0.4, 1.0), 0.3, _no_paint), _in_rod(0.3)),
    "wire": (rod((0.1, -0.2, 0.3), (0.5, 0.4, 1.0), 0.006, _no_paint), _in_rod(0.006)),
    "hall": (rod((0, 0, 0), (0, 0, 2.5), 3.0, _no_paint, room=True), _outside_hall),
}


def _hit(solid: Solid, origin: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Distances (n,) at which rays hit one solid."""
    distance, index = np.empty(directions.shape[1], np.float32), np.empty(directions.shape[1], np.intp)
    nearest_hits(solid.row[None], origin, directions, distance, index)
    return distance


def _rays(count: int, spread: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A point and directions (3, count) from it towards the solids."""
    origin = np.array([1.3, -1.9, 1.1])
    aims = np.array([[0.3], [0.1], [0.65]]) + spread * np.random.default_rng(0).normal(size=(3, count))
    return origin, (aims - origin[:, None]) / np.linalg.norm(aims - origin[:, None], axis=0)


@pytest.mark.parametrize("name", SOLIDS)
def test_rays_hit_solids_where_marching_along_them_does(name: str) -> None:
    solid, inside = SOLIDS[name]
    origin, directions = _rays(300, 0.015 if name == "wire" else 0.5)
    step = 3e-4 if name == "wire" else 2e-3
    ways = np.arange(0, 8, step) if name == "hall" else np.arange(0.5, 4.0, step)
    distance = _hit(solid, origin.astype(np.float32), directions.astype(np.float32))
    hits = disagreements = 0
    for ray in range(300):
        entered = np.flatnonzero(inside(origin[:, None] + ways * directions[:, ray : ray + 1]))
        if (entered.size > 0) != np.isfinite(distance[ray]):
            disagreements += 1  # a chord shorter than a step
        elif entered.size:
            hits += 1
            assert distance[ray] == pytest.approx(ways[entered[0]] - step / 2, abs=step / 2 + 1e-4)
    assert hits >= 50
    assert disagreements <= 3  # none seen


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_stand_on_the_surface(name: str) -> None:
    solid, inside = SOLIDS[name]
    origin, directions = _rays(2000, 0.015 if name == "wire" else 0.3)
    distance = _hit(solid, origin.astype(np.float32), directions.astype(np.float32))
    hit = np.isfinite(distance)
    points = (origin[:, None] + distance[hit] * directions[:, hit]).astype(np.float32)
    _, normals = solid.surface(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1.0, atol=1e-5)
    # A short step along the normal leaves the solid, and one against it enters it; in a hall the other way round.
    ahead, behind = (inside((points + s * 5e-4 * normals).astype(np.float64)) for s in (1, -1))
    assert np.mean((ahead, behind)[name != "hall"]) > 0.98  # seen: all; next to an edge both may lie outside
    assert np.mean((ahead, behind)[name == "hall"]) < 0.02


def test_blocks_of_an_image_miss_no_solid() -> None:
    """Solids are left out of blocks of rays that cannot hit them: all together are hit as each by itself."""
    world = build_world(0)
    camera = orbit_camera(3, (480, 320), 0)
    for left in range(0, 480, 96):
        columns, rows = np.meshgrid(np.arange(left, left + 96, 3) + 0.5, np.arange(0, 320, 40) + 0.5)
        origin, directions = camera_rays(camera, np.stack([columns.ravel(), rows.ravel()]))
        nearest = np.min([_hit(solid, origin, directions) for solid in world], axis=0)
        np.testing.assert_array_equal(first_hits(world, origin, directions)[0], nearest)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"views": 1}, "--views 1: expected 2 to 9999"),
        ({"points": 0}, "--points 0: expected at least 1"),
        ({"width": 8}, "--size 8x32: expected at least 16x16"),
        ({"width": 99_999}, "--size 99999x32: expected at most 8192x8192"),
        ({"seed": -1}, "--seed -1: expected 0 or more"),
    ],
)
def test_arguments_out_of_range_are_refused(tmp_path: Path, change: dict[str, int], message: str) -> None:
    refuses(UserInputError, message, make_sample_scene, tmp_path / "scene", **{**SMALL, **change})
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_anything_in_it_is_refused(tmp_path: Path) -> None:
    scene, file = tmp_path / "scene", tmp_path / "file"
    make_sample_scene(scene, **SMALL)
    before = snapshot(scene)
    refuses(UserInputError, "--overwrite", make_sample_scene, scene, **SMALL, seed=1)
    assert snapshot(scene) == before
    make_sample_scene(scene, **SMALL, seed=1, overwrite=True)
    assert snapshot(scene) != before
    (scene / "thesis.txt").write_text("years of work")
    refuses(UserInputError, "holds thesis", make_sample_scene, scene, **SMALL, overwrite=True)
    assert (scene / "thesis.txt").exists()
    file.write_text("")
    refuses(UserInputError, "a file, expected a folder", make_sample_scene, file, **SMALL, overwrite=True)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "scene"]


def test_an_interruption_leaves_the_old_scene_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tmp_path / "scene"
    make_sample_scene(scene, **SMALL)
    before = snapshot(scene)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(scene_module, "sample_points", interrupt)
    with pytest.raises(KeyboardInterrupt):
        make_sample_scene(scene, **SMALL, seed=1, overwrite=True)
    assert snapshot(scene) == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene"]


def test_an_interruption_while_folders_are_renamed_leaves_the_old_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, rename = tmp_path / "scene", Path.rename
    make_sample_scene(scene, **SMALL)
    before = snapshot(scene)

    def interrupt(self: Path, target: Path) -> Path:
        if self.name == "scene.partial":
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", interrupt)
    with pytest.raises(KeyboardInterrupt):
        make_sample_scene(scene, **SMALL, seed=1, overwrite=True)
    assert snapshot(scene) == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene"]


def test_the_scene_of_a_call_that_was_killed_between_renames_is_kept_until_another_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tmp_path / "scene"
    make_sample_scene(scene, **SMALL)
    before = snapshot(scene)
    scene.rename(tmp_path / "scene.replaced")  # what a kill leaves there

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(scene_module, "sample_points", interrupt)
        with pytest.raises(KeyboardInterrupt):
            make_sample_scene(scene, **SMALL, seed=1)
    assert snapshot(scene) == before
    make_sample_scene(scene, **SMALL, seed=1, overwrite=True)
    assert snapshot(scene) != before
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene"]


def test_leftovers_of_a_killed_run_do_not_matter(tmp_path: Path) -> None:
    (tmp_path / "scene.partial" / "images").mkdir(parents=True)
    (tmp_path / "scene.partial" / "images" / "0099.png").write_bytes(b"half")
    make_sample_scene(tmp_path / "scene", **SMALL)
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene"]
    assert len(list((tmp_path / "scene" / "images").iterdir())) == 3


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource", reason="Windows has no limits on file sizes")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, hard))  # no file may grow beyond
    try:
        refuses(LapgsError, "check free space", make_sample_scene, tmp_path / "scene", **SMALL)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_command_line(tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(sample)
    arguments = [str(tmp_path / "scene"), "--size", "64x48", "--views", "2", "--points", "10"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "2 images of 64x48, 10 points" in result.output
    assert "--eval --iterations 2000" in result.output, "minutes on a CPU; without a number it would take 10,500"
    assert load_scene(tmp_path / "scene", progress=False).train[0].image.shape == (3, 48, 64)
    refused = CliRunner().invoke(app, [str(tmp_path / "other"), "--size", "640"])
    assert isinstance(refused.exception, UserInputError)
    assert "WIDTHxHEIGHT" in str(refused.exception)
