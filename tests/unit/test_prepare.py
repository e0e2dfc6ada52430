"""`lapgs prepare` on photos whose cameras are known exactly: renderings by the sample scene's ray caster."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
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
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.scenes.prepare import colmap, pipeline
from lapgs_plugin.scenes.prepare.colmap_worker import __main__ as colmap_worker
from lapgs_plugin.scenes.prepare.pipeline import PrepareResult, prepare_scene
from lapgs_plugin.scenes.prepare.settings import PrepareSettings
from lapgs_plugin.scenes.prepare.writing import move_into_place
from lapgs_plugin.scenes.sample.raycast import render
from lapgs_plugin.scenes.sample.solids import ball, box, rod
from lapgs_plugin.scenes.sample.world import PALETTE
from tests.folders import snapshot
from tests.refusals import refuses

SIZE, WIDE = (288, 192), (336, 228)
"""Of the photos, and of images that hold all that a bent lens sees."""
FOCAL = 292.5
COUNT = 8
DISTORTION = np.array([-0.16, 0.03, 0.001, -0.001])  # k1, k2, p1, p2 as OpenCV and COLMAP define them


COLORS = np.random.default_rng(0).integers(PALETTE.shape[1], size=1 << 16).astype(np.uint8)


def _speckled(points: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Cubes of 12 cm in random colours: unlike the patterns of the sample scene, no place looks like another."""
    x, y, z = np.floor(points / 0.12 + 0.5).astype(np.int64)
    return COLORS[(x * 73856093 ^ y * 19349663 ^ z * 83492791) % len(COLORS)]


WORLD = (
    rod((0, 0, 0), (0, 0, 5.2), 6.5, _speckled, room=True),
    box((0.9, 0.8, 0.5), (0.9, 0.9, 1.0), _speckled, 0.4),
    box((-1.2, -0.4, 0.3), (0.7, 0.7, 0.6), _speckled, 1.1),
    rod((0, 0, 0), (0, 0, 0.9), 0.35, _speckled),
    ball((0, 0, 1.4), 0.5, _speckled),
)


def _arc(size: tuple[int, int], focal: float) -> list[Camera]:
    """Cameras eight degrees apart around the scene's centre, going up and down."""
    cameras = []
    for index in range(COUNT):
        turn, rise = np.radians(200 + 8 * index), np.radians(16 + 8 * np.sin(1.3 * index))
        target = np.array([0.0, 0.0, 0.85])
        outwards = np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        centre = target + (4.6 + 0.2 * np.cos(2.1 * index)) * outwards
        right = np.cross(-outwards, (0.0, 0.0, 1.0)) / np.cos(rise)
        rotation = np.stack([right, np.cross(-outwards, right), -outwards])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
        cameras.append(Camera(*size, focal, focal, size[0] / 2, size[1] / 2, torch.from_numpy(pose)))
    return cameras


def _save(path: Path, image: NDArray[np.float32]) -> None:
    write_image(path, torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1))


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    for index, camera in enumerate(_arc(SIZE, FOCAL)):
        _save(folder / f"{index:02d}.png", render(WORLD, camera))
    return folder


@pytest.fixture(scope="module")
def few(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four of the photos, for what does not depend on their number."""
    folder = tmp_path_factory.mktemp("few")
    for index in range(4):
        shutil.copy(photos / f"{index:02d}.png", folder)
    return folder


@pytest.fixture(scope="module")
def prepared(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PrepareResult]:
    out = tmp_path_factory.mktemp("prepared") / "scene"
    return out, prepare_scene(photos, out, progress=False)


@pytest.fixture(scope="module")
def distorted_photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same views through a lens that bends straight lines, as JPEG."""
    folder = tmp_path_factory.mktemp("distorted")
    matrix = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    columns, rows = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    straight = cv2.undistortPoints(pixels[:, None], matrix, DISTORTION)[:, 0].reshape(SIZE[1], SIZE[0], 2)
    source = (straight * FOCAL + np.array(WIDE) / 2 - 0.5).astype(np.float32)
    for index, camera in enumerate(_arc(WIDE, FOCAL)):
        image = cv2.remap(render(WORLD, camera), source[..., 0], source[..., 1], cv2.INTER_CUBIC)
        _save(folder / f"{index:02d}.jpg", image.clip(0, 1))
    return folder


def _align(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """`source` (n, 3) after the similarity that brings it closest to `target` (Umeyama 1991)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, values, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(values) @ sign) / (a**2).sum()
    return scale * a @ (u @ sign @ vt).T + target.mean(axis=0)


def _centre_errors(model: pycolmap.Reconstruction) -> NDArray[np.float64]:
    """How far the recovered camera centres are from the exact ones, in parts of their distance from the scene."""
    images = sorted(model.images.values(), key=lambda image: image.name)
    exact = {f"{index:02d}": camera.position.numpy() for index, camera in enumerate(_arc(SIZE, FOCAL))}
    target = np.array([exact[Path(image.name).stem] for image in images])
    centers = np.array([image.projection_center() for image in images])
    return np.linalg.norm(_align(centers, target) - target, axis=1) / 4.6


def test_cameras_are_recovered_up_to_a_similarity(prepared: tuple[Path, PrepareResult]) -> None:
    out, result = prepared
    assert len(result.registered) == COUNT
    assert (result.left_out, result.parts) == ((), 1)
    assert result.points > 500
    assert result.reprojection_error < 1.0
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert _centre_errors(model).max() < 6e-3  # seen 7.6e-4
    assert sorted(entry.name for entry in out.iterdir()) == ["images", "sparse"]


def test_the_scene_is_pinhole_and_loads(prepared: tuple[Path, PrepareResult]) -> None:
    scene = load_scene(prepared[0], eval=True, progress=False)
    assert (len(scene.train), len(scene.test)) == (7, 1)
    camera = scene.train[0].camera
    assert abs(camera.width - SIZE[0]) <= 8  # cropped where the lens that was found bends by a pixel or two
    assert camera.fx == pytest.approx(FOCAL, rel=0.05)  # seen 0.2 % and 0.7 % off, on an arc of 56 degrees
    assert camera.fy == pytest.approx(FOCAL, rel=0.05)


def test_a_bent_lens_is_straightened(distorted_photos: Path, tmp_path: Path) -> None:
    result = prepare_scene(distorted_photos, tmp_path / "scene", progress=False)
    assert len(result.registered) == COUNT
    model = pycolmap.Reconstruction(tmp_path / "scene" / "sparse" / "0")
    (camera,) = model.cameras.values()
    assert camera.model.name == "PINHOLE"
    assert _centre_errors(model).max() < 0.01  # seen 4.8e-4
    # Straight images taken from one place differ by a homography, whatever their focal length and direction.
    exact = render(WORLD, _arc(WIDE, FOCAL)[4])
    straightened = cv2.imread(str(tmp_path / "scene" / "images" / "04.jpg"))[:, :, ::-1] / 255
    bent = cv2.imread(str(distorted_photos / "04.jpg"))[:, :, ::-1] / 255
    # Seen: 0.004 against 0.032.
    assert _error_after_homography(straightened, exact) < 0.35 * _error_after_homography(bent, exact)


def _error_after_homography(image: NDArray[np.float64], exact: NDArray[np.float32]) -> float:
    """Root mean square difference to what the homography that fits best makes of `exact`."""
    size = image.shape[1::-1]
    blurred, target = (cv2.GaussianBlur(i.mean(axis=2).astype(np.float32), (0, 0), 1.5) for i in (exact, image))
    start = np.eye(3, dtype=np.float32)
    start[:2, 2] = (np.array(exact.shape[1::-1]) - size) / 2
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-6)
    _, warp = cv2.findTransformECC(target, blurred, start, cv2.MOTION_HOMOGRAPHY, stop)
    warped = cv2.warpPerspective(blurred, warp, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return float(np.sqrt(np.mean((warped - target)[8:-8, 8:-8] ** 2)))


def test_points_project_onto_their_features_in_the_undistorted_images(prepared: tuple[Path, PrepareResult]) -> None:
    out, result = prepared
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    errors = [
        np.linalg.norm(
            model.images[element.image_id].project_point(point.xyz)
            - model.images[element.image_id].points2D[element.point2D_idx].xy
        )
        for point in model.points3D.values()
        for element in point.track.elements
    ]
    assert np.mean(errors) == pytest.approx(result.reprojection_error, rel=0.1)


def test_an_interrupted_run_goes_on_and_ends_the_same(
    photos: Path,
    prepared: tuple[Path, PrepareResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "scene"
    rows = colmap.count_rows

    def interrupted_rows(file: Path, table: str) -> int:
        done = rows(file, table)
        if table == interrupted and done >= 3:
            raise KeyboardInterrupt
        return done

    monkeypatch.setattr(colmap, "POLL_SECONDS", 0.02)
    monkeypatch.setattr(colmap, "count_rows", interrupted_rows)
    for interrupted in ("descriptors", "two_view_geometries"):
        with pytest.raises(KeyboardInterrupt):
            prepare_scene(photos, out, progress=True)
        assert [entry.name for entry in out.iterdir()] == [".prepare"]
        with sqlite3.connect(out / ".prepare" / "database.db") as database:
            assert database.execute(f"SELECT COUNT(*) FROM {interrupted}").fetchone()[0] >= 3
    with pytest.raises(UserInputError, match=r"unfinished work with other --camera-model; .* --overwrite"):
        prepare_scene(photos, out, PrepareSettings(camera_model="RADIAL"), progress=False)
    interrupted, tables = "nothing", []
    with sqlite3.connect(out / ".prepare" / "database.db") as database:
        database.execute("CREATE TABLE kept (row)")
    database.close()

    def listed_then_moved(work: Path, folder: Path) -> None:
        with sqlite3.connect(work / "database.db") as database:
            tables.extend(name for (name,) in database.execute("SELECT name FROM sqlite_master"))
        database.close()
        move_into_place(work, folder)

    monkeypatch.setattr(pipeline, "move_into_place", listed_then_moved)
    prepare_scene(photos, out, progress=False)
    assert "kept" in tables, "it started over"
    assert snapshot(out) == snapshot(prepared[0])


@pytest.mark.parametrize("done", range(4))
def test_an_interruption_while_scenes_change_places_is_made_good(
    done: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, work = tmp_path / "scene", tmp_path / "scene" / ".prepare"
    rename, left = Path.rename, done

    def until_killed(path: Path, target: Path) -> Path:
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        return rename(path, target)

    def write(folder: Path, text: str) -> None:
        for name in ("images", "sparse"):
            (folder / name).mkdir(parents=True, exist_ok=True)
            (folder / name / "file").write_text(text)

    write(out, "old")
    write(work / "scene", "new")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", until_killed)
        with pytest.raises(KeyboardInterrupt):
            move_into_place(work, out)
    texts = {name: (out / name / "file").read_text() for name in ("images", "sparse") if (out / name).exists()}
    assert "sparse" not in texts or len(set(texts.values())) == 1, "a model with images of another"
    shutil.rmtree(work / "scene")
    write(work / "scene", "new")
    move_into_place(work, out)
    assert [(out / name / "file").read_text() for name in ("images", "sparse")] == ["new", "new"]
    assert not work.exists()


@pytest.mark.parametrize(("features", "threads"), [(24_999, 1), (25_000, -1)])
def test_few_features_are_mapped_by_one_thread(
    features: int, threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More race for the photos to start from: eight threads made three scenes of the same matches in twelve runs."""
    database = SimpleNamespace(num_keypoints=lambda: features)
    used = []
    monkeypatch.setattr(pycolmap.Database, "open", lambda path: nullcontext(database))
    monkeypatch.setattr(pycolmap, "incremental_mapping", lambda *args, **callbacks: used.append(args[3].num_threads))
    job = {"database": "", "photos": "", "models": "", "placed": str(tmp_path / "placed"), "mapper": "incremental"}
    colmap_worker.map_photos({**job, "rig": False})
    assert used == [threads]


def test_colmap_leaves_no_log_files(tmp_path: Path, prepared: tuple[Path, PrepareResult]) -> None:
    assert pycolmap.logging.logtostderr, "this process writes them, too"
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    pycolmap.Database.open(tmp_path / "database.db").close()
    job = {"step": "pairs", "database": str(tmp_path / "database.db"), "matcher": "exhaustive"}
    worker = subprocess.Popen(
        [sys.executable, str(colmap.WORKER)],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"TMPDIR": str(temporary)},
    )
    assert worker.stdin is not None
    assert worker.stderr is not None
    worker.stdin.write(json.dumps(job).encode() + b"\n")
    worker.stdin.flush()
    assert worker.wait() == 0
    assert b"Feature matching" in worker.stderr.read()
    worker.stdin.close()
    worker.stderr.close()
    assert list(temporary.iterdir()) == []


@pytest.fixture
def noise(tmp_path: Path) -> Path:
    """Photos that have nothing in common, which is quickly found."""
    folder = tmp_path / "noise"
    random = np.random.default_rng(0)
    for index in range(14):
        _save(folder / f"{index:02d}.png", random.random((64, 80, 3), dtype=np.float32))
    return folder


def test_photos_of_nothing_in_common_are_an_error_and_a_scene_that_is_there_stays(
    noise: Path, prepared: tuple[Path, PrepareResult], tmp_path: Path
) -> None:
    out = tmp_path / "scene"
    shutil.copytree(prepared[0], out)
    with pytest.raises(SceneError, match="none of the 14 photos could be placed"):
        prepare_scene(noise, out, PrepareSettings(matcher="sequential"), overwrite=True, progress=False)
    with sqlite3.connect(out / ".prepare" / "database.db") as database:
        compared = database.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0]
    assert compared == 13 + 12 + 10 + 6  # 1, 2, 4 and 8 photos ahead
    assert colmap.neighbour_pairs(14) == compared  # what the progress bar counts to
    shutil.rmtree(out / ".prepare")
    assert snapshot(out) == snapshot(prepared[0])


def test_what_cannot_be_photos_is_named(noise: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene"

    def refused(kind: type[Exception], message: str, photos: Path = noise, **options: Any) -> None:
        with pytest.raises(kind, match=message):
            prepare_scene(photos, out, PrepareSettings(**options), progress=False)
        assert not out.exists()

    refused(SceneError, "no such folder of photos", tmp_path / "nowhere")
    empty = tmp_path / "empty"
    empty.mkdir()
    refused(SceneError, "0 photos, expected at least 2", empty)
    (empty / "a.dng").write_bytes(b"")
    refused(SceneError, r"0 photos \(and files of type \.dng\)", empty)
    shutil.copy(noise / "00.png", empty)
    refused(SceneError, r"1 photo \(and files of type \.dng\), expected", empty)
    shutil.copy(noise / "00.png", empty / "00.tif")
    refused(SceneError, r"00\.png and 00\.tif would both become 00\.png", empty)
    refused(
        UserInputError,
        "--matcher vocabulary: expected auto, exhaustive, sequential or retrieval",
        matcher="vocabulary",
    )
    refused(UserInputError, "--camera-model 'LENS': expected auto or one of SIMPLE_PINHOLE", camera_model="LENS")
    refused(UserInputError, "--max-size 10: expected at least 64", max_size=10)
    _save(noise / "larger.png", np.zeros((90, 90, 3), np.float32))
    refused(UserInputError, r"--camera-per one: .*80x64 pixels and .*90x90", camera_per="one")
    (noise / "half.png").write_bytes((noise / "00.png").read_bytes()[:3000])
    refused(SceneError, r"half\.png: .*damaged or cut short")
    (noise / "half.png").write_text("no image")
    refused(SceneError, r"half\.png: not a readable image")


def test_folders_inside_each_other_are_refused(noise: Path) -> None:
    before = snapshot(noise.parent)
    for photos, out in ((noise, noise / "scene"), (noise, noise.parent), (noise, noise)):
        refuses(UserInputError, "lies in the other", prepare_scene, photos, out, overwrite=True, progress=False)
    assert snapshot(noise.parent) == before


def test_a_full_disk_is_one_line(few: Path, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource", reason="Windows has no limits on file sizes")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))  # no file may grow beyond
    try:
        refuses(LapgsError, "check free space", prepare_scene, few, tmp_path / "scene", progress=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("raise ValueError('the words of COLMAP')", "ValueError: the words of COLMAP"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "exit code -9"),
        (
            "import sys; sys.stderr.write('E20261121 10:00:00.0 1 sift.cc:1] no features\\n'); sys.exit(3)",
            "no features",
        ),
    ],
)
def test_a_failure_of_colmap_is_one_line(
    noise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, reason: str
) -> None:
    (tmp_path / "worker.py").write_text(program)
    monkeypatch.setattr(colmap, "WORKER", tmp_path / "worker.py")
    with pytest.raises(LapgsError, match=f"COLMAP failed at finding features .*{reason}") as caught:
        prepare_scene(noise, tmp_path / "scene", progress=False)
    assert "\n" not in str(caught.value)


def test_the_worker_ends_with_the_process_that_started_it(photos: Path, tmp_path: Path) -> None:
    job = {"step": "features", "database": str(tmp_path / "database.db"), "photos": str(photos), "max_size": None}
    job |= {"masks": None, "camera_model": "OPENCV", "camera_mode": "SINGLE", "rig": []}
    job |= {"names": [file.name for file in photos.iterdir()]}
    command = [sys.executable, str(colmap.WORKER)]
    worker = subprocess.run(command, input=json.dumps(job).encode() + b"\n", capture_output=True, check=False)
    assert worker.returncode == 1
    assert b"Traceback" not in worker.stderr


def test_each_folder_has_a_camera(photos: Path, tmp_path: Path) -> None:
    for index in range(6):
        target = tmp_path / "in" / ("left", "right")[index % 2] / f"{index}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(photos / f"{index:02d}.png", target)
    settings = PrepareSettings(camera_per="folder", camera_model="SIMPLE_PINHOLE")
    prepare_scene(tmp_path / "in", tmp_path / "out", settings, progress=False)
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert len(model.cameras) == 2
    assert len({(Path(image.name).parent, image.camera_id) for image in model.images.values()}) == 2


def test_command_line_replaces_a_scene_by_smaller_images_of_the_same_view(
    few: Path, prepared: tuple[Path, PrepareResult], tmp_path: Path
) -> None:
    out = tmp_path / "scene"
    shutil.copytree(prepared[0], out)
    app = typer.Typer()
    app.command()(prepare)
    arguments = [str(few), str(out), "--max-size", "216", "--camera-model", "pinhole"]
    refused = CliRunner().invoke(app, arguments)
    assert isinstance(refused.exception, UserInputError)
    assert "the folder already holds a scene; choose another or replace it with --overwrite" in str(refused.exception)
    result = CliRunner().invoke(app, [*arguments, "--overwrite"])
    assert result.exit_code == 0, result.output
    assert "4 of 4 photos" in result.output
    assert "mean reprojection error" in result.output
    assert sorted(entry.name for entry in out.iterdir()) == ["images", "sparse"]
    assert sorted(file.name for file in (out / "images").iterdir()) == ["00.png", "01.png", "02.png", "03.png"]
    (camera,) = pycolmap.Reconstruction(out / "sparse" / "0").cameras.values()
    assert (camera.width, camera.height) == (216, 144)
    image = cv2.imread(str(out / "images" / "01.png")).astype(np.float32)
    smaller = cv2.resize(cv2.imread(str(few / "01.png")), (216, 144), interpolation=cv2.INTER_AREA)
    assert np.sqrt(np.mean((image - smaller) ** 2)) < 6  # of 255, seen 3.2: another filter
