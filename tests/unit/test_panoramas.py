"""`lapgs prepare` of panoramas and wide lenses. The tests stitch, look and project by formulas of their own."""

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
import typer
from numpy.typing import NDArray
from PIL import ExifTags, Image
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from lapgs_plugin.cli.prepare import prepare
from lapgs_plugin.errors import SceneError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.prepare.pipeline import PrepareResult, prepare_scene
from lapgs_plugin.scenes.prepare.settings import PrepareSettings
from lapgs_plugin.scenes.scene import Scene, View
from tests.panoramas import Renderer, cloud_view, panorama, psnr, room_view, save, walk
from tests.refusals import refuses

Array = NDArray[np.float64]

WIDTH = 512
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
RANDOM = np.random.default_rng(0)


def rays_of(camera: Camera) -> Array:
    """Return unit directions of a camera's pixels in the world, (h, w, 3)."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], -1)
    rays = local @ camera.world_to_camera[:3, :3].double().numpy()
    unit: Array = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return unit


def waves(camera: Camera) -> Array:
    """Return smooth colours by direction."""
    return color_of(rays_of(camera))


def color_of(rays: Array) -> Array:
    """Return the colours of unit directions (h, w, 3)."""
    x, y, z = np.moveaxis(rays, -1, 0)
    return 0.5 + 0.4 * np.stack([np.sin(7 * x) * np.cos(6 * z), np.cos(8 * y - 5 * x), np.sin(9 * z + 4 * y)], -1)


def blank(folder: Path, count: int = 2, size: tuple[int, int] = (64, 32)) -> list[str]:
    """Write grey photos and return their names."""
    for index in range(count):
        save(folder / f"{index:02d}.png", np.full((size[1], size[0], 3), 0.5))
    return [f"{index:02d}.png" for index in range(count)]


def transforms(folder: Path, names: list[str], poses: list[Array], **more: Any) -> Path:
    """Write nerfstudio's file for photos in images/."""
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (np.linalg.inv(pose) @ OPENGL).tolist()}
        for name, pose in zip(names, poses, strict=True)
    ]
    values = {"camera_model": "EQUIRECTANGULAR", "frames": frames, **more}
    (folder / "transforms.json").write_text(json.dumps(values))
    return folder


def run(photos: Path, out: Path, **options: Any) -> PrepareResult:
    return prepare_scene(photos, out, PrepareSettings(**options), overwrite=True, progress=False)


def loaded(folder: Path, **options: Any) -> Scene:
    return load_scene(folder, progress=False, **options)


def shown(view: View) -> Array:
    pixels: Array = view.image.permute(1, 2, 0).double().numpy()
    return pixels


# Worst: 55.5 dB of waves. 8 bits and the filter leave 32.0 of Gaussians, whose shapes are linearized in each camera,
# and 31.1 of a room with sharp edges. Panoramas averaged with themselves, shifted by a pixel, have 41.0, 31.7 and 27.0.
@pytest.mark.parametrize(("view", "least"), [(waves, 55.0), (cloud_view, 31.8), (room_view, 30.8)])
def test_faces_show_what_pinhole_cameras_see(view: Renderer, least: float, tmp_path: Path) -> None:
    poses, names = walk(2), ["a 0.png", "b.png"]
    for name, pose in zip(names, poses, strict=True):
        save(tmp_path / "in/images" / name, panorama(view, pose, WIDTH))
    run(transforms(tmp_path / "in", names, poses, w=WIDTH, h=WIDTH // 2, fl_x=3.0, fl_y=7.0), tmp_path / "out")
    scene = loaded(tmp_path / "out")
    assert [face.name for face in scene.train] == [f"{stem}_f{face}.png" for stem in ("a 0", "b") for face in range(10)]
    worst = min(psnr(shown(face), view(face.camera)) for face in scene.train)
    assert worst > least


def pose_errors(out: Path, poses: list[Array], names: list[str]) -> None:
    """Compare positions, and where the first faces look, with those of the panoramas."""
    images = {image.name: image for image in pycolmap.Reconstruction(out / "sparse/0").images.values()}
    assert len(images) == 10 * len(poses)
    for name, pose in zip(names, poses, strict=True):
        stem, suffix = name.rsplit(".", 1)
        center = -pose[:3, :3].T @ pose[:3, 3]
        for face in range(10):
            image = images[f"{stem}_f{face}.{suffix}"]
            np.testing.assert_allclose(image.projection_center(), center, rtol=0, atol=1e-6)
            relative = image.cam_from_world().matrix()[:, :3] @ pose[:3, :3].T
            azimuth = math.radians(45 * face)
            forward = {8: (0.0, -1.0, 0.0), 9: (0.0, 1.0, 0.0)}.get(face, (math.sin(azimuth), 0.0, math.cos(azimuth)))
            np.testing.assert_allclose(relative[2], forward, rtol=0, atol=1e-6)
        np.testing.assert_allclose(images[f"{stem}_f0.{suffix}"].cam_from_world().matrix(), pose[:3], rtol=0, atol=1e-6)


def tilted(count: int = 2) -> list[Array]:
    poses = []
    for _ in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(RANDOM.uniform(-1, 1, 3)).as_matrix()
        pose[:3, 3] = RANDOM.uniform(-3, 3, 3)
        poses.append(pose)
    return poses


def test_poses_of_transforms(tmp_path: Path) -> None:
    names, poses = blank(tmp_path / "in/images"), tilted()
    run(transforms(tmp_path / "in", names, poses), tmp_path / "out")
    pose_errors(tmp_path / "out", poses, names)


@pytest.mark.parametrize("calibrated", [True, False])
def test_poses_of_metashape(calibrated: bool, tmp_path: Path) -> None:
    names, poses = blank(tmp_path / "in/images"), tilted()
    size = '<resolution width="64" height="32"/>'
    calibration = (
        f'<calibration type="spherical" class="initial">{size}<f>10.18</f></calibration>' if calibrated else ""
    )
    cameras = "".join(
        f'<camera id="{index}" sensor_id="0" label="{name.removesuffix(".png")}"><transform>'
        f"{' '.join(map(repr, np.linalg.inv(pose).ravel().tolist()))}</transform></camera>"
        for index, (name, pose) in enumerate(zip(names, poses, strict=True))
    )
    (tmp_path / "in/cameras.xml").write_text(
        f'<?xml version="1.0"?><document version="2.0.0"><chunk label="c"><sensors><sensor id="0" label="s" '
        f'type="spherical">{size}{calibration}</sensor></sensors><cameras>{cameras}</cameras></chunk></document>'
    )
    run(tmp_path / "in", tmp_path / "out")
    pose_errors(tmp_path / "out", poses, names)


@pytest.mark.parametrize("kind", ["spherical", "equirectangular"])
def test_poses_of_opensfm(kind: str, tmp_path: Path) -> None:
    names, poses = blank(tmp_path / "in/images"), tilted()
    shots = {
        name: {
            "rotation": Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist(),
            "translation": pose[:3, 3].tolist(),
            "camera": "c",
        }
        for name, pose in zip(names, poses, strict=True)
    }
    cameras = {"c": {"projection_type": kind, "width": 64, "height": 32}}
    (tmp_path / "in/reconstruction.json").write_text(json.dumps([{"cameras": cameras, "shots": shots, "points": {}}]))
    run(tmp_path / "in", tmp_path / "out")
    pose_errors(tmp_path / "out", poses, names)


def colmap_scene(folder: Path, poses: list[Array], points: Array) -> list[str]:
    """Write panoramas with a COLMAP model in which all see all points, at pixels by the closed form."""
    names = blank(folder / "images", len(poses), (400, 200))
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(camera_id=1, model="EQUIRECTANGULAR", width=400, height=200, params=[400, 200])
    model.add_camera_with_trivial_rig(lens)
    for number, (name, pose) in enumerate(zip(names, poses, strict=True), start=1):
        x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
        across = (np.arctan2(x, z) / (2 * math.pi) + 0.5) * 400
        down = (np.arctan2(y, np.hypot(x, z)) / math.pi + 0.5) * 200
        image = pycolmap.Image(name, keypoints=np.stack([across, down], 1), camera_id=1, image_id=number)
        rotation = pycolmap.Rotation3d(pose[:3, :3])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, pose[:3, 3]))
    for index, point in enumerate(points):
        track = pycolmap.Track()
        for number in range(1, len(poses) + 1):
            track.add_element(number, index)
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    (folder / "sparse/0").mkdir(parents=True)
    model.write_binary(folder / "sparse/0")
    return names


def test_points_keep_their_features_on_the_faces_of_a_colmap_model(tmp_path: Path) -> None:
    poses, points = tilted(3), 6.0 * RANDOM.standard_normal((60, 3))
    names = colmap_scene(tmp_path / "in", poses, points)
    run(tmp_path / "in", tmp_path / "out")
    pose_errors(tmp_path / "out", poses, names)
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert model.num_points3D() == 60
    assert len(model.cameras) == 2
    seen: dict[int, set[str]] = {}
    for image in model.images.values():
        for feature in image.points2D:
            assert feature.has_point3D()
            pixel = image.project_point(model.points3D[feature.point3D_id].xyz)
            np.testing.assert_allclose(pixel, feature.xy, rtol=0, atol=1e-6)
            seen.setdefault(feature.point3D_id, set()).add(image.name.split("_")[0])
    assert all(photos == {"00", "01", "02"} for photos in seen.values())  # faces show all around
    assert len(seen) == 60


def test_photos_and_panoramas_of_one_model(tmp_path: Path) -> None:
    poses = tilted(3)
    names = colmap_scene(tmp_path / "in", poses, 6.0 * RANDOM.standard_normal((60, 3)))
    model = pycolmap.Reconstruction(tmp_path / "in/sparse/0")
    lens = pycolmap.Camera(camera_id=2, model="SIMPLE_RADIAL", width=90, height=60, params=[70, 45, 30, 0.05])
    model.add_camera_with_trivial_rig(lens)
    model.add_image_with_trivial_frame(pycolmap.Image("phone.jpg", camera_id=2, image_id=9), pycolmap.Rigid3d())
    model.write_binary(tmp_path / "in/sparse/0")
    save(tmp_path / "in/images/phone.jpg", np.full((60, 90, 3), 0.5))
    run(tmp_path / "in", tmp_path / "out", tripod=20)
    scene = loaded(tmp_path / "out")
    assert len(scene.train) == 10 * len(names) + 1
    phone = next(view for view in scene.train if view.name == "phone.jpg")
    assert phone.mask is not None
    assert bool(phone.mask.all())


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Panoramas of four places in the room."""
    folder = tmp_path_factory.mktemp("walked")
    for index, pose in enumerate(walk(4)):
        save(folder / f"{index}.jpg", panorama(room_view, pose, WIDTH))
    return folder


@pytest.fixture(scope="module")
def placed(walked: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene that the command makes of them."""
    out = tmp_path_factory.mktemp("placed") / "scene"
    app = typer.Typer()
    app.command()(prepare)
    result = CliRunner().invoke(app, [str(walked), str(out), "--tripod", "45"])
    assert result.exit_code == 0, result.output
    assert "4 of 4 photos" in result.output
    assert "next: lapgs train" in result.output
    return out


def test_colmap_places_panoramas(placed: Path) -> None:
    model = pycolmap.Reconstruction(placed / "sparse/0")
    images = {image.name: image for image in model.images.values()}
    assert set(images) == {f"{index}_f{face}.jpg" for index in range(4) for face in range(9)}
    exact = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in walk(4)])
    centers = np.stack([images[f"{index}_f0.jpg"].projection_center() for index in range(4)])
    # Umeyama 1991
    a, b = centers - centers.mean(0), exact - exact.mean(0)
    u, values, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation, scale = u @ sign @ vt, np.trace(np.diag(values) @ sign) / (a**2).sum()
    assert np.abs(scale * a @ rotation.T - b).max() < 0.004  # metres in a room of 6.4; worst 0.0014
    first = images["0_f0.jpg"].cam_from_world().matrix()[:, :3]
    for index, pose in enumerate(walk(4)):
        for face in range(9):
            image = images[f"{index}_f{face}.jpg"]
            np.testing.assert_allclose(image.projection_center(), centers[index], rtol=0, atol=1e-9)
        relative = images[f"{index}_f0.jpg"].cam_from_world().matrix()[:, :3] @ first.T
        turned = Rotation.from_matrix(relative @ (pose[:3, :3] @ walk(4)[0][:3, :3].T).T).magnitude()
        assert math.degrees(turned) < 0.1  # worst 0.035


def test_points_of_placed_panoramas_are_where_their_features_are(placed: Path) -> None:
    model = pycolmap.Reconstruction(placed / "sparse/0")
    errors = [
        np.linalg.norm(image.project_point(model.points3D[feature.point3D_id].xyz) - feature.xy)
        for image in model.images.values()
        for feature in image.points2D
    ]
    assert model.num_points3D() > 300  # 736 were seen
    assert np.median(errors) < 0.5  # pixels; 0.2
    assert len(loaded(placed).train) == 36
    assert all(view.masked for view in loaded(placed).train)


def metadata(folder: Path, name: str, says: bytes) -> None:
    """Append a comment to a JPEG, or EXIF data with a focal length."""
    with Image.open(folder / name) as picture:
        picture.load()
    exif = Image.Exif()
    if says == b"focal":
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    picture.save(folder / name, exif=exif, comment=says, quality=95)


def test_folders_that_are_not_all_panoramas_are_one_line(tmp_path: Path) -> None:
    out, folder = tmp_path / "out", tmp_path / "in"
    save(folder / "a.jpg", RANDOM.random((32, 64, 3)))
    save(folder / "b.jpg", RANDOM.random((40, 60, 3)))
    line = r"in: 1 panorama \(a.jpg\) mixed with 1 other photo \(b.jpg\), expected one kind; move either elsewhere"
    refuses(SceneError, line, run, folder, out)
    whole = "b.jpg: an equirectangular photo of 60x40 pixels, expected twice as wide as high"
    refuses(SceneError, whole, run, folder, out, camera_model="EQUIRECTANGULAR")
    metadata(folder, "b.jpg", b'GPano:ProjectionType="equirectangular"')
    refuses(SceneError, whole, run, folder, out)
    save(folder / "b.jpg", RANDOM.random((64, 128, 3)))
    refuses(
        SceneError, r"panoramas of 64x32 pixels \(a.jpg\) and of 128x64 \(b.jpg\), expected one size", run, folder, out
    )
    save(folder / "b.jpg", RANDOM.random((32, 64, 3)))
    refuses(UserInputError, "--camera-per one: panoramas need no", run, folder, out, camera_per="one")
    apart = "none of the 2 panoramas could be placed; .*if they are ordinary photos, give --camera-model OPENCV"
    refuses(SceneError, apart, run, folder, out)
    for name in ("a.jpg", "b.jpg"):
        metadata(folder, name, b"focal")
    refuses(UserInputError, "--tripod 9: .*in has no panoramas", run, folder, out, tripod=9)


Lens = tuple[str, tuple[int, int], list[float]]
WIDE_LENSES: list[Lens] = [
    ("OPENCV_FISHEYE", (240, 240), [75, 75, 120, 120, 0.01, 0.002, 0, 0]),  # 90 degrees to all sides
    ("SIMPLE_FISHEYE", (240, 160), [70, 118, 81]),  # and more, of which COLMAP knows 90
    ("OPENCV", (240, 180), [100, 102, 120, 92, -0.26, 0.06, 0.001, -0.002]),  # 119x94 degrees
]


def lens_rays(lens: Lens) -> tuple[Array, NDArray[np.bool_]]:
    """Return unit directions of a lens's pixels, (h, w, 3), and which are less than 89 degrees from its axis."""
    kind, (width, height), params = lens
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    if kind == "OPENCV":
        matrix = np.array([[params[0], 0, params[2]], [0, params[1], params[3]], [0, 0, 1.0]])
        pixels = np.stack([columns.ravel(), rows.ravel()], 1)[:, None]
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 500, 1e-12)
        plane = cv2.undistortPoints(pixels, matrix, np.array(params[4:]), criteria=stop)[:, 0]
        rays = np.column_stack([plane, np.ones(len(plane))]).reshape(height, width, 3)
        unit: Array = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit, np.ones((height, width), bool)
    focal, x, y, *terms = params if kind == "SIMPLE_FISHEYE" else params[1:]
    polar = np.linspace(0, 2, 20001)
    radii = focal * polar * (1 + sum(term * polar ** (2 * n) for n, term in enumerate(terms, 1)))
    away = np.hypot(columns - x, rows - y)
    angle, turn = np.interp(away, radii, polar), np.arctan2(rows - y, columns - x)
    rays = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], -1)
    return rays, angle < math.radians(89)


def wide_scene(folder: Path, lens: Lens, poses: list[Array]) -> None:
    """Write photos of a lens of the waves, and their COLMAP model."""
    kind, size, params = lens
    rays, _ = lens_rays(lens)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=kind, width=size[0], height=size[1], params=params)
    )
    for number, pose in enumerate(poses, start=1):
        save(folder / "images" / f"{number}.png", color_of(rays @ pose[:3, :3]))
        image = pycolmap.Image(f"{number}.png", camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3]))
    for point in RANDOM.standard_normal((9, 3)):
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    (folder / "sparse/0").mkdir(parents=True)
    model.write_binary(folder / "sparse/0")


@pytest.mark.parametrize("lens", WIDE_LENSES, ids=lambda lens: lens[0])
def test_faces_of_a_wide_lens_show_what_it_sees(lens: Lens, tmp_path: Path) -> None:
    poses = tilted()
    wide_scene(tmp_path / "in", lens, poses)
    run(tmp_path / "in", tmp_path / "out")
    faces = [view for view in loaded(tmp_path / "out").train if view.name.startswith("1_")]
    rays, known = lens_rays(lens)
    directions = rays[known] @ poses[0][:3, :3]
    seen = np.zeros(len(directions), bool)
    for face in faces:
        camera, mask = face.camera, face.mask
        assert mask is not None
        inside = mask[0].numpy()
        difference = shown(face)[inside] - waves(camera)[inside]
        assert np.sqrt((difference**2).mean()) < 0.003  # worst 0.0018, mostly of 8 bits
        local = directions @ camera.world_to_camera[:3, :3].double().numpy().T
        x, y = camera.fx * local[:, 0] / local[:, 2] + camera.cx, camera.fy * local[:, 1] / local[:, 2] + camera.cy
        on_it = (local[:, 2] > 0) & (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
        row, column = (np.clip(at, 0, side - 1).astype(int) for at, side in ((y, camera.height), (x, camera.width)))
        seen |= on_it & inside[row, column]
    assert seen.mean() > 0.99  # borders of masks are those of pixels


def test_colmap_places_photos_of_a_fisheye_lens(walked: Path, tmp_path: Path) -> None:
    rays, known = lens_rays(("OPENCV_FISHEYE", (320, 320), [105, 105, 160, 160, 0, 0, 0, 0]))
    for index in range(4):
        with Image.open(walked / f"{index}.jpg") as image:
            around = np.asarray(image, np.float64) / 255
        x, y, z = np.moveaxis(rays, -1, 0)
        rows = (np.arcsin(y) / math.pi + 0.5) * 256 - 0.5
        columns = (np.arctan2(x, z) / (2 * math.pi) + 0.5) * 512 - 0.5
        channels = [map_coordinates(around[..., c], [rows, columns], order=1, mode="grid-wrap") for c in range(3)]
        save(tmp_path / "in" / f"{index}.jpg", np.stack(channels, -1) * known[..., None])
    result = run(tmp_path / "in", tmp_path / "out", camera_model="OPENCV_FISHEYE")
    assert result.registered == ("0.jpg", "1.jpg", "2.jpg", "3.jpg")
    assert len(pycolmap.Reconstruction(tmp_path / "out/sparse/0").images) == 36
    assert all(view.masked for view in loaded(tmp_path / "out").train)


def test_faces_are_not_said_to_be_turned_by_exif(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    wide_scene(tmp_path / "in", WIDE_LENSES[-1], tilted())
    run(tmp_path / "in", tmp_path / "out")
    faces = {view.name: view.image for view in loaded(tmp_path / "out").train}
    for photo in (tmp_path / "in/images").iterdir():
        with Image.open(photo) as opened:
            exif = opened.getexif()
            exif[ExifTags.Base.Orientation] = 6
            opened.save(photo, exif=exif)
    with caplog.at_level("INFO", "lapgs_plugin"):
        run(tmp_path / "in", tmp_path / "again")
    assert "turned" not in caplog.text
    again = loaded(tmp_path / "again").train
    assert all(torch.equal(view.image, faces[view.name]) for view in again)


def test_lenses_that_see_less_are_one_image(tmp_path: Path) -> None:
    wide_scene(tmp_path / "in", ("OPENCV_FISHEYE", (160, 120), [90, 90, 80, 60, 0.01, 0, 0, 0]), tilted())
    run(tmp_path / "in", tmp_path / "out")
    scene = loaded(tmp_path / "out")
    assert [view.name for view in scene.train] == ["1.png", "2.png"]
    assert not any(view.masked for view in scene.train)


def below(camera: Camera, pose: Array) -> Array:
    """Return the angle in degrees of a face's pixels from straight down in its panorama, (h, w)."""
    down = pose[1, :3]
    angles: Array = np.degrees(np.arccos(np.clip(rays_of(camera) @ down, -1, 1)))
    return angles


def test_the_tripod_is_hidden(tmp_path: Path) -> None:
    names, poses = blank(tmp_path / "in/images", size=(256, 128)), tilted()
    run(transforms(tmp_path / "in", names, poses), tmp_path / "out", tripod=30)
    for index, face in enumerate(loaded(tmp_path / "out").train):
        angle = below(face.camera, poses[index // 10])
        clear = np.abs(angle - 30) > 1e-3
        assert face.mask is not None
        np.testing.assert_array_equal(face.mask[0].numpy()[clear], (angle > 30)[clear])


def test_faces_that_show_nothing_else_are_left_out(tmp_path: Path) -> None:
    names, poses = blank(tmp_path / "in/images"), tilted()
    source = transforms(tmp_path / "in", names, poses)
    run(source, tmp_path / "low", tripod=43)
    assert {face.name[2:] for face in loaded(tmp_path / "low").train} == {f"_f{face}.png" for face in range(9)}
    right = np.tile(np.arange(64) >= 32, (32, 1)).astype(float)  # to the right of the middle
    for name in names:
        save(tmp_path / "in/masks" / f"{name}.png", right)
    run(source, tmp_path / "right")
    scene = loaded(tmp_path / "right")
    # Those that look to the left by 45 to 135 degrees reach at most to 15 degrees from the middle.
    assert {face.name[2:] for face in scene.train} == {f"_f{face}.png" for face in (0, 1, 2, 3, 4, 8, 9)}
    for index, face in enumerate(scene.train):
        assert face.mask is not None
        local = rays_of(face.camera) @ poses[index // 7][:3, :3].T
        azimuth = np.abs(np.arctan2(local[..., 0], local[..., 2]))
        clear = np.minimum(azimuth, math.pi - azimuth) > 0.2  # a mask's pixel is 0.1 wide
        clear &= np.hypot(local[..., 0], local[..., 2]) > 0.3  # away from the poles
        np.testing.assert_array_equal(face.mask[0].numpy()[clear], (local[..., 0] > 0)[clear])


def test_a_panorama_that_shows_nothing_else_is_refused(tmp_path: Path) -> None:
    names = blank(tmp_path / "in/images")
    source = transforms(tmp_path / "in", names, tilted())
    low = np.repeat(np.arange(32) >= 28, 64).reshape(32, 64).astype(float)  # within 22.5 degrees of straight down
    for name, mask in zip(names, (low, np.ones((32, 64))), strict=True):
        save(tmp_path / "in/masks" / f"{name}.png", mask)
    run(source, tmp_path / "out", tripod=10)
    facts = "images/00.png: its mask and --tripod 60 hide all that it shows, expected a part to train on"
    refuses(SceneError, facts, run, source, tmp_path / "out", tripod=60)
    assert len(loaded(tmp_path / "out").train) > 10, "the scene that was there stays"


@pytest.mark.parametrize("tripod", [0.0, 42.0, 43.0])
def test_every_direction_is_on_a_face(tripod: float, tmp_path: Path) -> None:
    names, poses = blank(tmp_path / "in/images", size=(256, 128)), tilted()
    run(transforms(tmp_path / "in", names, poses), tmp_path / "out", tripod=tripod)
    directions = RANDOM.standard_normal((4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions[np.degrees(np.arccos(directions @ poses[0][1, :3])) > tripod + 0.5]
    on_one = np.zeros(len(directions), bool)
    for face in loaded(tmp_path / "out").train:
        if face.name.startswith("00"):
            camera = face.camera
            local = directions @ camera.world_to_camera[:3, :3].double().numpy().T
            x, y = camera.fx * local[:, 0] / local[:, 2] + camera.cx, camera.fy * local[:, 1] / local[:, 2] + camera.cy
            on_one |= (local[:, 2] > 0) & (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
    assert on_one.all()


def test_faces_have_the_pixels_a_degree_of_the_panorama_unless_a_size_is_asked_for(tmp_path: Path) -> None:
    names, poses = blank(tmp_path / "in/images", size=(720, 360)), tilted()
    source = transforms(tmp_path / "in", names, poses)
    run(source, tmp_path / "full")
    assert {round(face.camera.fx * math.pi / 180, 6) for face in loaded(tmp_path / "full").train} == {2.0}
    run(source, tmp_path / "small", max_size=100)
    sizes = {max(face.camera.size) for face in loaded(tmp_path / "small").train}
    assert max(sizes) in (100, 101)


def refused_lens(folder: Path) -> None:
    refuses(SceneError, "expected twice as wide as high; export whole panoramas", run, folder, folder.parent / "out")


def test_bad_panoramas_are_one_line(tmp_path: Path) -> None:
    names, poses = blank(tmp_path / "in/images", size=(60, 40)), tilted()
    refused_lens(transforms(tmp_path / "in", names, poses))
    (tmp_path / "in/transforms.json").unlink()
    shot = {"rotation": [0, 0, 0], "translation": [0, 0, 0], "camera": "c"}
    cameras = {"c": {"projection_type": "spherical", "width": 60, "height": 40}}
    parts = [{"cameras": cameras, "shots": dict.fromkeys(names, shot), "points": {}}]
    (tmp_path / "in/reconstruction.json").write_text(json.dumps(parts))
    refused_lens(tmp_path / "in")


def test_a_photo_named_as_a_face_is_one_line(tmp_path: Path) -> None:
    names = colmap_scene(tmp_path / "in", tilted(), RANDOM.standard_normal((9, 3)))
    model = pycolmap.Reconstruction(tmp_path / "in/sparse/0")
    model.images[2].name = "00_f3.png"
    model.write_binary(tmp_path / "in/sparse/0")
    (tmp_path / "in/images" / names[1]).rename(tmp_path / "in/images/00_f3.png")
    lens = pycolmap.Camera(camera_id=2, model="SIMPLE_RADIAL", width=400, height=200, params=[300, 200, 100, 0.05])
    model.add_camera_with_trivial_rig(lens)
    model.add_image_with_trivial_frame(pycolmap.Image("00_f3.png", camera_id=2, image_id=9), pycolmap.Rigid3d())
    model.deregister_frame(model.images[2].frame_id)
    model.write_binary(tmp_path / "in/sparse/0")
    refuses(SceneError, "would both become 00_f3.png; rename one", run, tmp_path / "in", tmp_path / "out")


def test_a_panorama_is_not_trained_on_before_it_is_cut(tmp_path: Path) -> None:
    poses = tilted()
    names = blank(tmp_path / "transforms/images")
    transforms(tmp_path / "transforms", names, poses)
    colmap_scene(tmp_path / "colmap", poses, RANDOM.standard_normal((9, 3)))
    for kind in ("transforms", "colmap"):
        hint = "EQUIRECTANGULAR.*cut its photos into pinhole images with `lapgs prepare .* OUT`"
        refuses(SceneError, hint, loaded, tmp_path / kind)


def test_a_tripod_without_panoramas_is_one_line(tmp_path: Path) -> None:
    names, poses = blank(tmp_path / "in/images", size=(60, 40)), tilted()
    transforms(tmp_path / "in", names, poses, camera_model="OPENCV", fl_x=50.0, k1=0.1)
    refuses(UserInputError, "--tripod 30: .* has no panoramas", run, tmp_path / "in", tmp_path / "out", tripod=30)


def test_photos_that_may_be_panoramas_are_asked_about(tmp_path: Path) -> None:
    """That those are not which have a focal length, another shape, or a camera model is seen by what refuses them."""
    out, folder = tmp_path / "out", tmp_path / "in"
    for name in ("a.jpg", "b.jpg"):
        save(folder / name, RANDOM.random((198, 400, 3)))
    may_be = "in: photos of 400x198 pixels, almost twice as wide as high .*; give --camera-model OPENCV if"
    refuses(SceneError, may_be, run, folder, out)
    assert not out.exists()
    ordinary = "--tripod 9: .*in has no panoramas"
    refuses(UserInputError, ordinary, run, folder, out, tripod=9, camera_model="OPENCV")
    metadata(folder, "a.jpg", b"focal")
    refuses(UserInputError, ordinary, run, folder, out, tripod=9)
    for name in ("a.jpg", "b.jpg"):
        save(folder / name, RANDOM.random((190, 400, 3)))  # 2.1:1
    refuses(UserInputError, ordinary, run, folder, out, tripod=9)
