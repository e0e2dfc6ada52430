"""Whole files of every kind, as this program or another writes them: what `kinds` damages.

scene_json/    transforms.json, points3d.ply, photos/
scene_bin/, scene_txt/   COLMAP models, images/
scene_<suffix>/  two photos of a format, in several ways of storing pixels
run_done/      complete and measured, with history
run_part/      a level finished with its optimizer.pt, and a checkpoint of the next
foreign/       what a 3DGS codebase leaves; foreign_levels/ what the release does
bench/         an experiment's folder, experiment.toml beside its store
recipes/       of `lapgs patch`
path/          a trajectory
video/         a clip
"""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import cv2
import imageio_ffmpeg
import numpy as np
import pillow_heif
import pycolmap
import torch
from PIL import Image
from plyfile import PlyData

from lapgs_bench.experiments.commands import Locations
from lapgs_bench.experiments.execution import STORE, prepare
from lapgs_bench.experiments.expansion import plan_runs, scenes_of
from lapgs_bench.experiments.mistakes import Mistakes
from lapgs_bench.experiments.rows import result_row
from lapgs_bench.experiments.schema import load_experiment
from lapgs_bench.experiments.settings import Selection
from lapgs_bench.experiments.store import ResultStore
from lapgs_plugin import __version__
from lapgs_plugin.files import BARE_RECORD, shipped
from lapgs_plugin.runner.imported import BREAKDOWN, CFG_ARGS, TRAIN_INFO
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes.images import write_image
from tests.experiments.examples import SMALL
from tests.fuzz.harness import Reader
from tests.fuzz.mutations import as_json, as_namespace, as_toml
from tests.training_scene import blob_field, ring_camera

SIZE = (40, 32)
VIEWS = 3
POINTS = 12
PHOTOS = ("png", "jpg", "gif", "exr", "tif", "webp", "heic")


def make_templates(folder: Path, reader: Reader) -> Path:
    """Fill a new folder; training is done by `reader`'s process.

    Returns:
        The folder.
    """
    folder.mkdir(parents=True)
    write_transforms_scene(folder / "scene_json")
    for suffix in PHOTOS:
        write_transforms_scene(folder / f"scene_{suffix}", suffix)
    _write_colmap(folder / "scene_bin", binary=True)
    _write_colmap(folder / "scene_txt", binary=False)
    _write_runs(folder, reader)
    _write_ascii_field(folder)
    _write_foreign(folder)
    _write_clip(folder / "video")
    _write_experiment(folder, reader)
    shutil.copytree(shipped("patches"), folder / "recipes")
    (folder / "path").mkdir()
    (folder / "path" / "trajectory.json").write_text(as_json({**_intrinsics(), "frames": _frames(["a", "b"])}))
    return folder


def _intrinsics() -> dict[str, Any]:
    camera = ring_camera(0.0, *SIZE)
    return {"w": SIZE[0], "h": SIZE[1], "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}


def _frames(names: list[str]) -> list[dict[str, Any]]:
    frames = []
    for index, name in enumerate(names):
        camera = ring_camera(2 * math.pi * index / len(names), *SIZE)
        pose = np.linalg.inv(camera.world_to_camera.double().numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    return frames


def _stripes(index: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float64)
    levels = np.stack([0.5 + 0.4 * np.sin(0.3 * (c + 1) * x + 0.2 * y + index) for c in range(3)], axis=2)
    return np.rint(levels * 255).astype(np.uint8)


def write_transforms_scene(folder: Path, suffix: str = "png") -> None:
    names = [f"photos/{index}.{suffix}" for index in range(VIEWS)]
    (folder / "photos").mkdir(parents=True)
    for index, name in enumerate(names):
        write_photo(folder / name, index)
    # Where the file does not say the size of its photos, their own is taken.
    intrinsics = _intrinsics() if folder.name == "scene_json" else {"camera_angle_x": 1.0}
    lists = {"train_filenames": names, "test_filenames": [Path(names[0]).name], "camera_model": "opencv"}
    values = {**intrinsics, **lists, "ply_file_path": "points3d.ply", "frames": _frames(names)}
    (folder / "transforms.json").write_text(as_json(values))
    rows = [f"{x:.4f} {y:.4f} {z:.4f} 200 100 50" for x, y, z in torch.rand(POINTS, 3).tolist()]
    properties = [f"property float {axis}" for axis in "xyz"]
    properties += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    header = ["ply", "format ascii 1.0", f"element vertex {POINTS}", *properties, "end_header"]
    (folder / "points3d.ply").write_text("\n".join([*header, *rows]) + "\n")


def write_photo(path: Path, index: int) -> None:
    """The first of a scene is plain; the others are stored in ways that photos are stored in now and then."""
    picture = Image.fromarray(_stripes(index))
    if path.suffix == ".exr":
        write_image(path, torch.from_numpy(_stripes(index)).permute(2, 0, 1) / 255.0)
    elif path.suffix == ".gif":
        picture.convert("P").save(path)
    elif path.suffix == ".png" and index == 1:
        cv2.imwrite(str(path), _stripes(index).astype(np.uint16) * 257)
    elif path.suffix == ".png" and index == 2:
        picture.convert("P").save(path)
    elif path.suffix == ".heic":
        pillow_heif.from_pillow(picture).save(path)
    elif path.suffix == ".webp":
        picture.save(path, lossless=index == 1)
    elif path.suffix in (".tif", ".jpg") and index == 1:
        picture.convert("L").save(path)
    elif path.suffix == ".tif" and index == 2:
        picture.convert("RGBA").save(path, compression="tiff_lzw")
    else:
        picture.save(path)


def _write_colmap(folder: Path, binary: bool) -> None:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (folder / "images").mkdir()
    poses = []
    for index in range(VIEWS):
        write_photo(folder / "images" / f"{index}.jpg", 0)
        camera = ring_camera(2 * math.pi * index / VIEWS, *SIZE)
        pose = pycolmap.Rigid3d(camera.world_to_camera[:3].double().numpy())
        x, y, z, w = pose.rotation.quat
        numbers = " ".join(map(repr, map(float, (w, x, y, z, *pose.translation))))
        poses += [f"{index + 1} {numbers} 1 {index}.jpg", f"5.0 5.0 1 7.5 8.5 {2 if index else -1}"]
    focal = ring_camera(0.0, *SIZE).fx
    (model / "cameras.txt").write_text(f"1 PINHOLE {SIZE[0]} {SIZE[1]} {focal} {focal} 20 16\n")
    (model / "images.txt").write_text("\n".join(poses) + "\n")
    (model / "points3D.txt").write_text(
        "1 0.1 0.2 0.3 200 100 50 0.5 1 0 2 0 3 0\n2 -0.3 0.1 0.2 10 20 30 0.5 2 1 3 1\n"
        + "".join(f"{number} 0.{number} -0.1 0.{number} 90 80 70 0.5\n" for number in range(3, 7))  # without tracks
    )
    (model / "rigs.txt").write_text("1 1 CAMERA 1\n")
    frames = [f"{index} 1 {' '.join(pose.split()[1:8])} 1 CAMERA 1 {index}" for index, pose in enumerate(poses[::2], 1)]
    (model / "frames.txt").write_text("\n".join(frames) + "\n")
    if binary:
        pycolmap.Reconstruction(str(model)).write_binary(str(model))
        for text in model.glob("*.txt"):
            text.unlink()


def _write_runs(folder: Path, reader: Reader) -> None:
    scene = str(folder / "scene_json")
    options = ["--iterations", "6", "--levels", "2", "--rasterizer", "oracle", "--sh-degree", "1", "--split", "1/3,2/3"]
    options += ["--resolution", "full", "--hierarchy", "nested"]
    part = folder / "run_part"
    _succeed(reader, folder, "train", scene, "-o", str(part), *options, "--checkpoint-every", "1")
    assert (part / "checkpoint.pt").exists(), "training was to be stopped before its end"
    assert (part / "level_1" / "optimizer.pt").exists(), "nested levels go on with Adam's state"
    archive = RunArchive.open(part)
    done = folder / "run_done"
    shutil.copytree(part, done)
    for name in ("checkpoint.pt", "level_1/optimizer.pt"):
        (done / name).unlink()
    manifest = json.loads((done / "manifest.json").read_text())
    record = manifest["records"][0]
    manifest["records"].append({**record, "level": 0, "image_size": list(SIZE)})
    (done / "level_0").mkdir()
    shutil.copy(archive.field_path(1), done / "level_0" / "point_cloud.ply")
    (done / "manifest.json").write_text(json.dumps(manifest, indent=2))
    lines = [
        {
            "level": level,
            "iteration": 5 * i,
            "elapsed": 1.0 * i + 9 * (1 - level),
            "loss": 0.1,
            "num_gaussians": 9,
            "psnr": 20.0,
        }
        for level in (1, 0)
        for i in range(1, 4)
    ]
    (done / "history.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    _succeed(reader, folder, "eval", str(done), "--lpips", "none", "--rasterizer", "oracle")


def _write_clip(folder: Path) -> None:
    folder.mkdir()
    writer = imageio_ffmpeg.write_frames(str(folder / "clip.mp4"), SIZE, fps=10, quality=10, macro_block_size=1)
    writer.send(None)
    for index in range(12):
        writer.send(np.roll(_stripes(index), 3 * index, axis=1).tobytes())
    writer.close()


def _write_ascii_field(folder: Path) -> None:
    """A field's PLY as text, doubles among its floats."""
    blob_field(4).save_ply(folder / "whole.ply")
    whole = PlyData.read(str(folder / "whole.ply"))
    (folder / "ascii").mkdir()
    PlyData([whole["vertex"]], text=True).write(str(folder / "ascii" / "field.ply"))
    (folder / "whole.ply").unlink()


def _succeed(reader: Reader, folder: Path, *command: str) -> None:
    answer = reader.run(command, folder)
    assert isinstance(answer, dict), f"{command}: {answer}"
    assert answer["code"] in (0, 130), f"{command}: {answer}"


def _write_foreign(folder: Path) -> None:
    for name in ("foreign", "foreign_levels"):
        options = {
            **{"sh_degree": 0, "source_path": str(folder / "scene_json"), "model_path": "x", "images": "images"},
            **{"resolution": -1, "white_background": False, "data_device": "cuda", "eval": True},
        }
        (folder / name).mkdir()
        (folder / name / CFG_ARGS).write_text(as_namespace(options))
        (folder / name / BREAKDOWN).write_text('{"backbone": "taming", "config": {"blur_up": true}}')
    _foreign_field(folder / "foreign")
    for level in (1, 0):
        _foreign_field(folder / "foreign_levels" / f"L{level}")
        (folder / "foreign_levels" / f"L{level}" / TRAIN_INFO).write_text(
            f"Training Time: {10 - level:.2f} seconds, 0.1 minutes\nGS Number: 1\nPeak GS number: 9\n"
            "Peak GPU allocated: 12.00 MB\n"
        )
    noted = {
        **{"train_seconds": 5.0, "peak_gaussians": 9, "mean_gaussians": 8.0, "iterations": 30, "saving_seconds": 0.5},
        **{"num_gaussians": 8, "timeline": [{"iteration": 10, "elapsed": 1.0, "num_gaussians": 8}]},
        **{"memory_bytes": {"peak": 100, "images": 10}, "backbone": "graphdeco"},
    }
    (folder / "foreign" / BARE_RECORD).write_text(as_json(noted))


def _foreign_field(folder: Path) -> None:
    folder_of_ply = folder / "point_cloud" / "iteration_30"
    folder_of_ply.mkdir(parents=True)
    blob_field(8).save_ply(folder_of_ply / "point_cloud.ply")


def _write_experiment(folder: Path, reader: Reader) -> None:
    bench = folder / "bench"
    bench.mkdir()
    values = {
        **SMALL,
        "scenes": [{"name": "scene_json", "path": "../scene_json"}],
        "backbones": {"cpu": SMALL["backbones"]["cpu"]},
        "variants": SMALL["variants"][:2],
        "table": {"columns": ["train_seconds", "psnr"]},
    }
    file = bench / "experiment.toml"
    file.write_text(as_toml(values))
    experiment = load_experiment(file, {"train": {"levels"}, "run": {"levels"}})
    planned, scenes = plan_runs(experiment, Selection()), scenes_of(experiment, Selection())
    mistakes = Mistakes(file, experiment, Selection())
    jobs, _ = prepare(planned, scenes, Locations({}, bench), bench, [], mistakes)
    mistakes.refuse()
    store = ResultStore.create(bench / STORE)
    store.plan(jobs)
    for job in jobs:
        claim = store.claim([job.run_id])
        assert claim is not None
        shutil.copytree(folder / "run_done", job.folder)
        started = {"started": "2026-01-01T00:00:00+00:00", "lapgs_version": __version__, "folder": job.folder}
        assert store.record(claim, {**result_row(job), **started})
    _succeed(reader, folder, "bench", "run", str(file), "--out", str(bench), "--tables-only")
