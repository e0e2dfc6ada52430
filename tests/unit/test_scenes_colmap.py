"""COLMAP scenes: cameras against pycolmap's own projection, images against where the cameras see things."""

from __future__ import annotations

import logging
import re
import shutil
import struct
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_plugin.errors import SceneError, UserInputError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes import Scene, load_scene
from lapgs_plugin.scenes.colmap import find_model, read_colmap
from lapgs_plugin.scenes.colmap_model import read_model
from lapgs_plugin.scenes.prepare.pipeline import prepare_scene
from lapgs_plugin.scenes.prepare.settings import PrepareSettings
from tests.refusals import refuses

POINTS = np.random.default_rng(3).uniform(-1.0, 1.0, (40, 3))
COLORS = np.random.default_rng(4).integers(0, 256, (40, 3))


@dataclass
class Model:
    """A COLMAP model to write as text, the format's plain definition; cameras on an arc looking at the origin."""

    names: Sequence[str] = tuple(f"{i:02d}.png" for i in range(10))
    cameras: dict[int, str] = field(default_factory=lambda: {1: "PINHOLE 96 64 80 82 47.3 33.1"})
    camera_of: dict[str, int] = field(default_factory=dict)  # 1 unless named
    points: NDArray[np.float64] = field(default_factory=lambda: POINTS)

    def pose(self, index: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotation vector and translation, world to camera."""
        turn = cv2.Rodrigues(np.array([0.1, 0.25 * index - 1.0, 0.05 * index]))[0]
        return cv2.Rodrigues(turn)[0][:, 0], np.array([0.02 * index, -0.03, 4.0 + 0.1 * index])

    def write(self, folder: Path, binary: bool = True) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        lines = [f"{key} {text}" for key, text in self.cameras.items()]
        (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
        lines = []
        for index, name in enumerate(self.names):
            vector, translation = self.pose(index)
            angle = float(np.linalg.norm(vector))
            quaternion = [np.cos(angle / 2), *(np.sin(angle / 2) * vector / angle)]
            numbers = " ".join(repr(float(x)) for x in (*quaternion, *translation))
            # Ids run against name order, as they may in real models.
            lines += [f"{len(self.names) - index} {numbers} {self.camera_of.get(name, 1)} {name}", ""]
        (folder / "images.txt").write_text("\n".join(lines) + "\n")
        rows = zip(self.points.tolist(), COLORS.tolist(), strict=False)
        lines = [f"{i + 1} {x!r} {y!r} {z!r} {r} {g} {b} 0.5" for i, ((x, y, z), (r, g, b)) in enumerate(rows)]
        (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
        if binary:
            model = pycolmap.Reconstruction(str(folder))
            for index, name in enumerate(self.names):
                model.images[len(self.names) - index].name = name  # pycolmap ends a text's name at its first space
            model.write_binary(str(folder))
            for text in folder.glob("*.txt"):
                text.unlink()


def write_images(folder: Path, sizes: dict[str, tuple[int, int]]) -> None:
    for name, (width, height) in sizes.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        value = sum(name.encode()) % 256
        cv2.imwrite(str(folder / name), np.full((height, width, 3), value, np.uint8))


def make_scene(path: Path, model: Model | None = None, size: tuple[int, int] = (96, 64), binary: bool = True) -> Path:
    model = model or Model()
    model.write(path / "sparse" / "0", binary)
    write_images(path / "images", dict.fromkeys(model.names, size))
    return path


def load(path: Path, **options: Any) -> Scene:
    return load_scene(path, progress=False, **options)


def project(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixel coordinates (n, 2) in float64 from the camera as it is stored."""
    pose = camera.world_to_camera.double().numpy()
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)


def refused(path: Path, message: str, **options: Any) -> str:
    """Check that a scene is refused in one line, and return the line."""
    return refuses(SceneError, message, load, path, **options)


# Cameras


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
@pytest.mark.parametrize(
    "camera",
    [
        "PINHOLE 96 64 80 82 47.3 33.1",
        "SIMPLE_PINHOLE 96 64 81 48 32",
        "SIMPLE_RADIAL 96 64 81 48 32 0",
        "OPENCV 96 64 80 82 47.3 33.1 0 0 0 0",
        "FULL_OPENCV 96 64 80 82 47.3 33.1 0 0 0 0 0 0 0 0",
    ],
)
def test_projection_is_pycolmaps(tmp_path: Path, camera: str, binary: bool) -> None:
    path = make_scene(tmp_path, Model(cameras={1: camera}), binary=binary)
    scene = load(path)
    reconstruction = pycolmap.Reconstruction(str(path / "sparse" / "0"))
    by_name = {image.name: image for image in reconstruction.images.values()}
    assert [view.name for view in scene.train] == sorted(by_name)
    for view in scene.train:
        image = by_name[view.name]
        expected = np.array([image.project_point(point) for point in POINTS])
        assert view.camera.size == (96, 64)
        assert view.camera.world_to_camera.dtype == torch.float32
        # In pixels; float32 poses, seen 1.5e-6.
        np.testing.assert_allclose(project(view.camera, POINTS), expected, rtol=0, atol=1e-5)
        np.testing.assert_allclose(view.camera.position.numpy(), image.projection_center(), rtol=0, atol=2e-6)


def blob_image(center: NDArray[np.float64], size: tuple[int, int], sigma: float) -> NDArray[np.uint16]:
    """A Gaussian blob whose centre is at `center` where pixel (j, i) covers [j, j+1) x [i, i+1)."""
    x, y = np.arange(size[0]) + 0.5, np.arange(size[1])[:, None] + 0.5
    blob = np.exp(-((x - center[0]) ** 2 + (y - center[1]) ** 2) / (2 * sigma**2))
    return np.repeat((blob * 65535)[..., None], 3, axis=2).round().astype(np.uint16)


def centroid(image: Tensor) -> NDArray[np.float64]:
    weight = image[0].double().numpy()
    y, x = np.mgrid[0 : weight.shape[0], 0 : weight.shape[1]] + 0.5
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


@pytest.mark.parametrize("resolution", ["full", "1/2", "1/4", "0.3", "100", "77"])
@pytest.mark.parametrize("file_scale", [1, 2], ids=["images", "images_2"])
def test_images_and_cameras_stay_aligned(tmp_path: Path, resolution: str, file_scale: int) -> None:
    """A point's picture is where the camera sees the point, at every size of file and of training."""
    width, height = 384 // file_scale, 256 // file_scale
    model = Model(names=["a.png", "b.png", "c.png"], cameras={1: "PINHOLE 384 256 300 310 180.5 133.25"})
    path = make_scene(tmp_path, model)
    point = np.array([[0.05, -0.1, 0.08]])
    (path / f"images_{file_scale}").mkdir()
    for view in load(path, images="images").train:
        center = project(view.camera.resized(width, height), point)[0]
        cv2.imwrite(str(path / f"images_{file_scale}" / view.name), blob_image(center, (width, height), sigma=9.0))
    scene = load(path, images=f"images_{file_scale}", resolution=resolution)
    for view in scene.train:
        assert view.image.shape == (3, view.camera.height, view.camera.width)
        # In pixels of the resized image; seen 0.0002, and a shifted grid would be 0.25 or more off.
        np.testing.assert_allclose(centroid(view.image), project(view.camera, point)[0], rtol=0, atol=0.002)


@pytest.mark.parametrize("size", [(47, 31), (48, 32), (48, 31), (32, 21), (192, 128), (12, 8)])
def test_pre_resized_photos_rescale_the_camera(tmp_path: Path, size: tuple[int, int]) -> None:
    scene = load(make_scene(tmp_path, size=size))
    camera = scene.train[0].camera
    sx, sy = size[0] / 96, size[1] / 64
    assert camera.size == size
    assert (camera.fx, camera.fy) == pytest.approx((80 * sx, 82 * sy), rel=1e-12)  # 0 seen
    assert (camera.cx, camera.cy) == pytest.approx((47.3 * sx, 33.1 * sy), rel=1e-12)  # 0 seen


@pytest.mark.parametrize("size", [(96, 60), (64, 96), (64, 64), (90, 64)])
def test_size_of_another_shape_is_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    path = make_scene(tmp_path)
    write_images(path / "images", {"03.png": size})
    refused(path, rf"03\.png: the image is {size[0]}x{size[1]} pixels, its camera 96x64")


def test_views_may_differ_in_size(tmp_path: Path) -> None:
    model = Model(
        cameras={1: "PINHOLE 96 64 80 80 48 32", 7: "SIMPLE_PINHOLE 50 70 60 25 35"},
        camera_of={"02.png": 7, "05.png": 7},
    )
    path = make_scene(tmp_path, model)
    write_images(path / "images", {"02.png": (50, 70), "05.png": (50, 70)})
    scene = load(path)
    assert [view.image.shape[1:] for view in scene.train[1:4]] == [(64, 96), (70, 50), (64, 96)]
    assert scene.smallest_size == (50, 64)


# What a scene holds


def test_points_colors_and_extent(tmp_path: Path) -> None:
    scene = load(make_scene(tmp_path), eval=True)
    order = np.lexsort(scene.points.numpy().T)
    expected = np.lexsort(POINTS.T)
    np.testing.assert_allclose(scene.points.numpy()[order], POINTS[expected], atol=1e-6)  # 2.8e-8 seen
    np.testing.assert_allclose(scene.colors.numpy()[order], COLORS[expected] / 255, atol=1e-6)  # 3.0e-8 seen
    assert scene.points.dtype == scene.colors.dtype == torch.float32
    reconstruction = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    names = {view.name for view in scene.train}
    centers = np.array([i.projection_center() for i in reconstruction.images.values() if i.name in names])
    radius = max(float(np.linalg.norm(center - centers.mean(axis=0))) for center in centers)
    assert scene.extent == pytest.approx(1.1 * radius, rel=1e-9)
    assert (scene.kind, scene.path, scene.background) == ("colmap", tmp_path, (0.0, 0.0, 0.0))


def test_every_eighth_image_in_name_order_is_held_out(tmp_path: Path) -> None:
    names = [f"{folder}/{i}.png" for folder in ("b", "a") for i in (10, 9, 1, 2, 33, 5, 4, 6, 7)]
    path = make_scene(tmp_path, Model(names=names))
    ordered = sorted(names)
    scene = load(path, eval=True)
    assert [view.name for view in scene.test] == [ordered[0], ordered[8], ordered[16]]
    assert [view.name for view in scene.train] == [name for i, name in enumerate(ordered) if i % 8 != 0]
    for view in (*scene.train, *scene.test):
        assert float(view.image[0, 0, 0] * 255) == pytest.approx(sum(view.name.encode()) % 256)
    everything = load(path)
    assert [view.name for view in everything.train] == ordered
    assert everything.test == ()


def test_model_directly_in_sparse(tmp_path: Path) -> None:
    path = make_scene(tmp_path)
    shutil.move(path / "sparse" / "0", path / "model")
    (path / "sparse").rmdir()
    shutil.move(path / "model", path / "sparse")
    assert len(load(path).train) == 10


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
def test_names_of_photos_from_phones_and_other_systems(tmp_path: Path, binary: bool) -> None:
    names = ("cam 1/IMG 01.png", "cam 1/Tür 2.png", "cam 2/x.JPG")
    path = make_scene(tmp_path, Model(names), binary=binary)
    (path / "images" / names[1]).rename(path / "images" / unicodedata.normalize("NFD", names[1]))
    (path / "images" / names[2]).rename(path / "images" / "cam 2" / "X.jpg")
    assert tuple(view.name for view in load(path).train) == names
    (path / "images" / "cam 2" / "x.jpg").write_bytes(b"")
    refused(path, r"cam 2/x\.JPG: no such image; put it there")  # two files differ in case alone
    (path / "images" / names[0]).unlink()
    refused(path, r"IMG 01\.png: no such image \(2 of 3 are missing\).*, or leave them out with")


def test_smaller_copies_may_have_another_format(tmp_path: Path) -> None:
    path = make_scene(tmp_path, Model(("a.1.JPG", "a.2.JPG", "b/c.jpg")))
    copies = {"a.1.png": (24, 16), "a.2.PNG": (24, 16), "b/c.tif": (24, 16)}
    write_images(path / "images_4_png", copies)
    (path / "images_4_png" / "a.1.txt").write_text("no photo")
    scene = load(path, images="images_4_png")
    assert [view.name for view in scene.train] == ["a.1.JPG", "a.2.JPG", "b/c.jpg"]
    for view, name in zip(scene.train, copies, strict=True):
        assert view.camera.size == (24, 16)
        torch.testing.assert_close(view.image, torch.full((3, 16, 24), sum(name.encode()) % 256 / 255.0))
    (path / "images_4_png" / "a.1.bmp").write_bytes(b"")
    refused(path, r"images_4_png/a\.1\.JPG: no such image", images="images_4_png")


def test_two_names_of_one_photo_are_refused(tmp_path: Path) -> None:
    path = make_scene(tmp_path, Model(("a.png", "A.png", "c.png")))
    (path / "images" / "A.png").unlink()
    refused(path, r"image A\.png is listed twice")


def test_photos_that_are_not_in_the_model_are_left_out(tmp_path: Path) -> None:
    path = make_scene(tmp_path)
    (path / "images" / "unregistered.png").write_bytes(b"not even an image")
    assert len(load(path).train) == 10


def test_background_shows_through_alpha(tmp_path: Path) -> None:
    path = make_scene(tmp_path)
    clear = np.zeros((64, 96, 4), np.uint8)
    cv2.imwrite(str(path / "images" / "00.png"), clear)
    image = load(path, background=(0.25, 0.5, 1.0)).train[0].image
    assert image[:, 5, 5].tolist() == [0.25, 0.5, 1.0]


# Progress and threads


def test_progress_callback_counts_every_image(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    load_scene(make_scene(tmp_path), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(i, 10) for i in range(1, 11)]


def test_progress_bar_goes_to_stderr(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    load_scene(make_scene(tmp_path))
    output = capfd.readouterr()
    assert output.out == ""
    assert re.search(r"Reading images 10 of 10 images \(100 %\)", output.err)
    load(tmp_path)
    assert capfd.readouterr().err == ""


def test_loading_twice_gives_the_same_and_leaves_torch_alone(tmp_path: Path) -> None:
    path = make_scene(tmp_path)
    threads = torch.get_num_threads()
    first, second = load(path, resolution="1/2"), load(path, resolution="1/2")
    assert torch.get_num_threads() == threads
    for one, other in zip(first.train, second.train, strict=True):
        assert torch.equal(one.image, other.image)


def test_too_large_a_resolution_is_a_note(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        scene = load(make_scene(tmp_path), resolution="1k")
    assert scene.smallest_size == (96, 64)
    assert [record.getMessage() for record in caplog.records] == [
        "--resolution 1k: 10 of 10 images are only 96 pixels wide or less and keep their size, images only shrink"
    ]


# Bad input


def overwrite(file: Path, old: float, new: float) -> None:
    """Replace the one float64 of a binary file that is `old`."""
    content = file.read_bytes()
    assert content.count(struct.pack("<d", old)) == 1
    file.write_bytes(content.replace(struct.pack("<d", old), struct.pack("<d", new)))


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ("SIMPLE_RADIAL 96 64 81 48 32 0.01", r"camera 1 is distorted \(SIMPLE_RADIAL with parameters 0.01\)"),
        ("OPENCV 96 64 80 82 47.3 33.1 0 0 0 1e-5", r"\(OPENCV with parameters 0, 0, 0, 1e-05\)"),
        ("OPENCV_FISHEYE 96 64 80 82 47.3 33.1 0 0 0 0", r"\(OPENCV_FISHEYE with parameters 0, 0, 0, 0\)"),
        ("FOV 96 64 80 82 47.3 33.1 0", r"\(FOV with parameters 0\)"),
    ],
)
def test_distorted_camera_names_prepare(tmp_path: Path, camera: str, message: str) -> None:
    path = make_scene(tmp_path, Model(cameras={1: camera}))
    refused(path, message + ".*`lapgs prepare")


def test_photos_that_see_all_around_are_to_be_cut(tmp_path: Path) -> None:
    path = make_scene(tmp_path, Model(cameras={1: "EQUIRECTANGULAR 96 64 96 64"}))
    assert "cut its photos into pinhole images with `lapgs prepare" in refused(path, "sees all around")


def test_cameras_of_every_model_of_colmap_are_whole(tmp_path: Path) -> None:
    model, names = pycolmap.Reconstruction(), [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
    for key, name in enumerate(names, start=1):
        model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(key, name, 80.0, 96, 64))
    model.write_binary(tmp_path)
    binary = read_model(tmp_path)
    for file in tmp_path.glob("*.bin"):
        file.unlink()
    model.write_text(tmp_path)
    for read in (binary, read_model(tmp_path)):
        assert {key: repr(camera) for key, camera in read.cameras.items()} == {
            key: repr(camera) for key, camera in model.cameras.items()
        }


def test_distorted_camera_that_no_image_uses_does_not_matter(tmp_path: Path) -> None:
    cameras = {1: "PINHOLE 96 64 80 82 47.3 33.1", 2: "SIMPLE_RADIAL 96 64 81 48 32 0.01"}
    assert len(load(make_scene(tmp_path, Model(cameras=cameras))).train) == 10


def test_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "none", tmp_path / "file"):
        refused(path, f"{path.name}: no such scene folder")


def test_neither_model_nor_transforms(tmp_path: Path) -> None:
    refused(tmp_path, r"neither a COLMAP model .* nor transforms\.json.*`lapgs prepare")


@pytest.mark.parametrize("name", ["garden", "dense/0"])
def test_a_folder_around_a_scene_is_told_where_it_is(tmp_path: Path, name: str) -> None:
    (tmp_path / name / "sparse" / "0").mkdir(parents=True)
    (tmp_path / name / "sparse" / "0" / "cameras.bin").write_bytes(b"")
    refused(tmp_path, rf"neither .* in it; give \S+/{name}, which has one")


@pytest.mark.parametrize("name", ["images", "sparse", "sparse/0"])
def test_a_folder_in_a_scene_is_told_which_it_is(tmp_path: Path, name: str) -> None:
    path = make_scene(tmp_path / "garden")
    refused(path / name, rf"garden/{name}: neither .* in it; give \S+/garden, which has one")


def test_photos_of_a_polycam_export_are_to_be_prepared(tmp_path: Path) -> None:
    write_images(tmp_path, {"one.png": (8, 8), "keyframes/images/1.png": (8, 8)})
    refused(tmp_path, r"make a scene from photos with `lapgs prepare \S+/keyframes/images OUT`")
    refused(tmp_path / "keyframes" / "images", r"`lapgs prepare \S+/keyframes/images OUT`")


def test_a_model_beside_its_photos_is_to_be_prepared(tmp_path: Path) -> None:
    """COLMAP's window exports a model to the folder that it is given."""
    path = make_scene(tmp_path / "export")
    (path / "sparse/0").rename(tmp_path / "model")
    for file in (*(tmp_path / "model").iterdir(), *(path / "images").iterdir()):
        file.rename(path / file.name)
    refused(path, f"its model with `lapgs prepare {path} OUT --model {path}`")
    prepare_scene(path, tmp_path / "out", PrepareSettings(model=path), progress=False)
    assert len(load(tmp_path / "out").train) == 10


def test_wrong_resolution_comes_first(tmp_path: Path) -> None:
    refuses(UserInputError, "--resolution", load, tmp_path / "none", resolution="huge")


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_incomplete_model(tmp_path: Path, name: str, binary: bool) -> None:
    path = make_scene(tmp_path, binary=binary)
    (path / "sparse" / "0" / f"{name}.{'bin' if binary else 'txt'}").unlink()
    assert name not in refused(path, "the sparse model is incomplete").split("it has only")[1].split(";")[0]


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_binary_file_cut_anywhere_is_told(tmp_path: Path, name: str) -> None:
    cameras = {1: "PINHOLE 96 64 80 80 48 32", 2: "SIMPLE_RADIAL 50 70 60 25 35 0"}
    model = Model(names=["a.png", "b.png"], cameras=cameras, camera_of={"b.png": 2}, points=POINTS[:4])
    path = make_scene(tmp_path, model)
    folder = find_model(path)
    assert folder is not None
    file = folder / f"{name}.bin"
    if not file.is_file():
        pytest.skip(f"pycolmap {pycolmap.__version__} writes no {file.name}")
    content = file.read_bytes()
    for length in range(len(content)):
        file.write_bytes(content[:length])
        if name in ("rigs", "frames"):  # which training does not need
            (line,) = read_colmap(path, folder, "images", evaluate=False).warnings
            assert f"{folder}/frames.bin: damaged" in line
            continue
        refuses(SceneError, re.escape(file.name), read_colmap, path, folder, "images", evaluate=False)


@pytest.mark.parametrize("name", ["cameras", "images"])
def test_text_file_of_something_else(tmp_path: Path, name: str) -> None:
    path = make_scene(tmp_path, binary=False)
    (path / "sparse" / "0" / f"{name}.txt").write_text("these are not numbers\n\n" * 3)
    refused(path, rf"{name}\.txt: line 1 is 'these are not numbers', expected ")


def test_a_model_without_points_starts_from_random_ones(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = load(make_scene(tmp_path, Model(points=np.empty((0, 3)))))
    assert "points3D.bin: the model has no 3D points; training starts from random ones" in caplog.text
    middle, reach = scene.points.mean(dim=0), (scene.points.amax(dim=0) - scene.points.amin(dim=0)).min() / 2
    assert middle.norm() < 0.2  # the cameras look past the origin by at most 0.19; seen 0.13
    assert scene.train[0].camera.position.norm() / 2 < reach


def test_image_folder_that_is_not_there(tmp_path: Path) -> None:
    path = make_scene(tmp_path)
    refused(path, "images_4: no such folder of images; choose images with --images", images="images_4")
    (path / "images").rename(path / "Fotos März")
    refused(path, "images: no such folder of images; choose Fotos März with --images")
    assert len(load(path, images="Fotos März").train) == len(Model().names)
    shutil.rmtree(path / "Fotos März")
    refused(path, "images: no such folder of images; put the photos")


@pytest.mark.parametrize(
    "name", ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin", "images/06.png"]
)
def test_files_that_a_clone_without_git_lfs_lacks(tmp_path: Path, name: str) -> None:
    path = make_scene(tmp_path)
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 128\n"
    (path / name).write_text(pointer)
    refused(path, rf"{name}: a pointer of Git LFS, .*`git lfs pull`")


@pytest.mark.parametrize("how", ["missing", "empty", "cut"])
def test_image_that_cannot_be_read_is_named(tmp_path: Path, how: str) -> None:
    path = make_scene(tmp_path)
    file = path / "images" / "06.png"
    content = file.read_bytes()
    file.unlink()
    if how != "missing":
        file.write_bytes(content[: len(content) - 20] if how == "cut" else b"")
    refused(path, r"images/06\.png: ")


def test_first_of_several_broken_images_is_the_one_named(tmp_path: Path) -> None:
    path = make_scene(tmp_path)
    for name in ("08.png", "04.png", "05.png"):
        file = path / "images" / name
        file.write_bytes(file.read_bytes()[:-20])  # the header is whole: found when the pixels are read
    refused(path, r"images/04\.png: the image is damaged or cut short")


def test_fewer_than_two_training_views(tmp_path: Path) -> None:
    one = make_scene(tmp_path / "one", Model(names=["a.png"]))
    refused(one, "1 training view, expected at least 2; add photos")
    two = make_scene(tmp_path / "two", Model(names=["a.png", "b.png"]))
    assert len(load(two).train) == 2
    refused(two, "1 training view besides 1 held out, expected at least 2; train without --eval", eval=True)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("points3D", POINTS[3, 1], np.nan, "sparse points, or they hold NaN or inf"),
        ("images", Model().pose(4)[1][2], np.nan, r"the camera of 04\.png has NaN or inf"),
        ("images", Model().pose(4)[1][2], np.inf, r"the camera of 04\.png has NaN or inf"),
        *(("cameras", 82.0, focal, r"the camera of 0\d\.png") for focal in (np.nan, 0.0, -5.0)),
        ("cameras", 82.0, 0.75, r"focal lengths .*0\.75.*expected pixels"),
        ("cameras", 82.0, 1e-60, r"focal lengths .*1e-60.*expected pixels"),
    ],
)
def test_numbers_that_cannot_be_used(tmp_path: Path, name: str, old: float, new: float, message: str) -> None:
    path = make_scene(tmp_path)
    overwrite(path / "sparse" / "0" / f"{name}.bin", old, new)
    refused(path, message)


def test_all_cameras_at_one_point(tmp_path: Path) -> None:
    class Turning(Model):
        def pose(self, index: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            vector = np.array([0.0, 0.1 * index + 0.1, 0.0])
            return vector, -cv2.Rodrigues(vector)[0] @ np.array([1.0, 2.0, 3.0])

    refuses(SceneError, "all 10 training cameras are at the same point", load, make_scene(tmp_path, Turning()))


def test_same_name_twice(tmp_path: Path) -> None:
    path = make_scene(tmp_path, binary=False)
    file = path / "sparse" / "0" / "images.txt"
    file.write_text(file.read_text().replace("07.png", "06.png"))
    refused(path, r"06\.png is listed twice|cannot be read")


@pytest.mark.parametrize("name", ["../beside.png", "/tmp/elsewhere.png"])
def test_names_that_lead_out_of_the_scene(tmp_path: Path, name: str) -> None:
    path = tmp_path / "scene"
    Model(names=["a.png", "b.png", name]).write(path / "sparse" / "0")
    write_images(path / "images", {"a.png": (96, 64), "b.png": (96, 64)})
    refused(path, "is named by a path outside the scene")


def test_names_that_no_file_can_have(tmp_path: Path) -> None:
    path = tmp_path / "scene"
    for name, message in (
        ("b" * 300 + ".png", r"images: the name of image b{32}\.\.\. has 304 bytes, expected at most 255"),
        ("/", "image / is named by a path outside the scene"),
        ("..", r"image \.\. is named by a path outside the scene"),
        (".", "images cannot be read: Is a directory"),
        ("\x1b[2J\x07.png", r"images/\\x1b\[2J\\x07\.png: no such image"),
    ):
        Model(names=["a.png", name, "c.png"]).write(path / "sparse" / "0", binary=False)
        write_images(path / "images", {"a.png": (96, 64), "c.png": (96, 64)})
        line = refuses(SceneError, message, load, path)
        assert line.isprintable()


def test_a_name_that_is_no_utf_8(tmp_path: Path) -> None:
    path = make_scene(tmp_path)
    model = path / "sparse" / "0" / "images.bin"
    model.write_bytes(model.read_bytes().replace(b"03.png", b"\xff\xfe.png"))
    refused(path, r"the name of image \d+ is b'\\xff\\xfe\.png.*', expected UTF-8")


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (
            "cameras",
            r"^1 PINHOLE.*",
            "1 PINHOLE 96 64 80 82 47.3",
            r"line 1 is '1 PINHOLE .*', expected 4 parameters of PINHOLE, not 3",
        ),
        ("cameras", r"^1 PINHOLE.*", "1 PINHOLE 96 64 80 82 47.3 33.1 5", "expected 4 parameters of PINHOLE, not 5"),
        ("cameras", r"^1 PINHOLE.*", "1 PINHOLE 96 64 80 82 nan 33.1", "expected 4 finite parameters of PINHOLE"),
        ("cameras", r"^1 PINHOLE.*", "1 PINHOLE 96 64 80 1e400 4 5", "expected 4 finite parameters of PINHOLE"),
        (
            "cameras",
            r"^1 PINHOLE",
            "1 PINPOINT",
            "expected a camera model of COLMAP in place of PINPOINT; calibrate with OPENCV, with OPENCV_FISHEYE",
        ),
        (
            "cameras",
            r"^1 PINHOLE 96",
            "1 PINHOLE -96",
            "expected CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS with positive",
        ),
        ("cameras", r"^1 PINHOLE 96", "1 PINHOLE " + "9" * 5000, r"9\.\.\.', expected CAMERA_ID MODEL WIDTH HEIGHT"),
        ("cameras", r"^1 PINHOLE.*", "1", "line 1 is '1', expected CAMERA_ID MODEL"),
        ("cameras", r"^1 (.*)", r"1 \1\n1 \1", "line 2 .* expected each id once, 1 was there before"),
        ("images", r"^10( \S+){4}", "10 0 0 0 0", r"the quaternion \(0, 0, 0, 0\), expected one of length 1"),
        ("images", r"^10( \S+){4}", "10 nan 0 0 0", "line 1 .* with finite numbers"),
        (
            "images",
            r"^10( \S+){4}",
            "10 5 0 0 0",
            r"the rotation of 00\.png is the quaternion .* expected one of length 1",
        ),
        (
            "images",
            r"^(10( \S+){4}) \S+",
            r"\1 1e300",
            r"the camera of 00\.png has 1e\+300 in its pose, expected at most 1e\+12",
        ),
        ("images", r"1 03\.png", "77 03.png", r"image 7 \(03\.png\) of images\.txt has camera 77, expected one of cam"),
        ("images", r"^9 ", "10 ", "line 3 .* expected each id once, 10 was there before"),
        ("images", r"^9 ", "-1 ", "line 3 .* expected an id from 0 to"),
        ("images", r" 03\.png", "", "line 7 .* expected IMAGE_ID QW"),
        ("images", r"00\.png\n\n", "00.png\n\n1.0 2.0\n", "line 3 is '1.0 2.0', expected IMAGE_ID QW"),
        ("images", r"00\.png\n", "00.png\nnot an image\n", "line 2 is 'not an image', expected IMAGE_ID QW"),
        (
            "points3D",
            r"^1 \S+",
            "1 x",
            r"points3D\.txt: line 1 is '1 x .*', expected POINT3D_ID X Y Z R G B",
        ),
        ("points3D", r"^1 .*", "1 0.5", r"line 1 is '1 0\.5', expected POINT3D_ID"),
        ("points3D", r"^(1 \S+ \S+ \S+) \S+", r"\1 999", "expected whole colours R G B from 0 to 255"),
        ("points3D", r"^(1 \S+ \S+ \S+) \S+", r"\1 12.5", "expected whole colours R G B from 0 to 255"),
        ("points3D", r"^1 \S+", "1 1e300", r"a sparse point lies at 1e\+300, expected at most 1e\+12"),
    ],
)
def test_text_models_name_the_line(tmp_path: Path, file: str, old: str, new: str, message: str) -> None:
    path = make_scene(tmp_path, binary=False)
    text = path / "sparse" / "0" / f"{file}.txt"
    before = text.read_text()
    text.write_text(re.sub(old, new, before, count=1, flags=re.MULTILINE))
    assert text.read_text() != before
    refused(path, message)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("count", [10**18, 2**64 - 1, 2**63, 10**9])
def test_absurd_counts_of_binary_files(tmp_path: Path, name: str, count: int) -> None:
    path = make_scene(tmp_path)
    file = path / "sparse" / "0" / f"{name}.bin"
    file.write_bytes(struct.pack("<Q", count) + file.read_bytes()[8:])
    refused(path, rf"{name}\.bin: the file is damaged or cut short at \d+ bytes")


@pytest.mark.parametrize(
    ("name", "offset", "value", "message"),
    [
        ("cameras", 12, struct.pack("<i", 999), "the camera model of number 999, .* if it is damaged, else calibrate"),
        ("cameras", 16, struct.pack("<Q", 2**63), r"9\.22e\+18 pixels wide or high, expected at most"),
        ("cameras", 32, struct.pack("<d", 1e300), r"focal lengths 1e\+300 and 82"),
        ("images", 68, struct.pack("<I", 77), r"image 10 \(00\.png\) of images\.bin has camera 77, expected one"),
        ("images", 8, struct.pack("<I", 9), r"images\.bin holds id 9 twice, expected each once"),
        ("images", 8, struct.pack("<I", 2**32 - 1), r"images\.bin holds id 4294967295, expected at most"),
        ("images", 12, struct.pack("<4d", 0, 0, 0, 0), r"the quaternion \(0, 0, 0, 0\), expected one of length 1"),
        ("images", 44, struct.pack("<d", 1e300), r"has 1e\+300 in its pose"),
    ],
)
def test_values_of_binary_files(tmp_path: Path, name: str, offset: int, value: bytes, message: str) -> None:
    path = make_scene(tmp_path)
    file = path / "sparse" / "0" / f"{name}.bin"
    content = bytearray(file.read_bytes())
    content[offset : offset + len(value)] = value
    file.write_bytes(content)
    refused(path, message)


# A real scene


@pytest.mark.shared
def test_fox(shared_data: Path) -> None:
    scene = load(shared_data / "fox", resolution="1/4", eval=True)
    assert (len(scene.train), len(scene.test)) == (43, 7)
    assert scene.smallest_size == (266, 474)
    assert scene.points.shape == (12540, 3)
    reconstruction = pycolmap.Reconstruction(str(shared_data / "fox" / "sparse" / "0"))
    by_name = {image.name: image for image in reconstruction.images.values()}
    points = scene.points.double().numpy()
    inside = np.zeros(len(points), int)
    for view in (*scene.train, *scene.test):
        pixels = project(view.camera, points)
        pose = view.camera.world_to_camera.double().numpy()
        in_front = points @ pose[2, :3] + pose[2, 3] > 0
        inside += in_front & (pixels > 0).all(axis=1) & (pixels < (266, 474)).all(axis=1)
        # pycolmap projects into the full image of 1062x1894.
        for index in range(0, len(points), 997):
            expected = by_name[view.name].project_point(points[index])
            if expected is not None:
                scaled = np.asarray(expected) * (266 / 1062, 474 / 1894)
                # In pixels, relative where points far outside project far away; seen 6e-5.
                np.testing.assert_allclose(pixels[index], scaled, rtol=1e-4, atol=1e-3)
    # Every point was triangulated from two or more photos; a few lie within rounding of an image's edge.
    assert inside.min() >= 1
    assert (inside >= 2).mean() > 0.999
