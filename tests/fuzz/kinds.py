"""The kinds of files that `lapgs` reads: how each is damaged, and which commands read it."""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Callable
from random import Random
from typing import Any

from tests.fuzz import variants
from tests.fuzz.formats import (
    damaged_ascii_ply,
    damaged_clip,
    damaged_colmap,
    damaged_exr,
    damaged_gif,
    damaged_heic,
    damaged_jpeg,
    damaged_lines,
    damaged_ply,
    damaged_png,
    damaged_store,
    damaged_tensors,
    damaged_tiff,
    damaged_webp,
    stored_jpeg,
)
from tests.fuzz.harness import SPECIAL, Damage, Kind
from tests.fuzz.mutations import Emit, as_json, as_namespace, as_toml, damaged_document, damaged_file, damaged_text
from tests.fuzz.variants import NAMES

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def _document(parse: Callable[[str], Any], emit: Emit) -> Damage:
    def damage(data: bytes, random: Random) -> bytes:
        return damaged_document(parse(data.decode()), emit, random)

    return damage


def _text(data: bytes, random: Random) -> bytes:
    return damaged_file(data, random) if random.random() < 0.3 else damaged_text(data, random)


def damaged_layout(data: bytes, random: Random) -> bytes:
    """Steps of `harness.rearrange` over the paths in `data`, one a line."""
    paths = data.decode().split("\n")
    names = (
        "x",
        "L99",
        "L7",
        "L00",
        "iteration_1",
        "iteration_999999999999",
        "iteration_",
        "level_9",
        "n" * 255,
        "a\nb",
        "\x1b[2J",
    )
    steps = []
    for _ in range(random.choice((1, 1, 2))):
        action = random.choice(("remove", "folder", "file", "loop", "dangling", "zero", "fifo", "move", "copy"))
        other = {"move": [random.choice(names)], "copy": [random.choice(paths)]}.get(action, [])
        steps.append([action, random.choice(paths), *other])
    return json.dumps(steps).encode()


def special_files(data: bytes, random: Random) -> bytes:
    """Steps that put links and what is no file where files are, or where a command writes some."""
    paths = [*data.decode().split("\n"), *WRITTEN]
    steps = [[random.choice(list(SPECIAL)), random.choice(paths)] for _ in range(random.choice((1, 1, 2)))]
    return json.dumps(steps).encode()


def strange_names(data: bytes, random: Random) -> bytes:
    """A step that renames the folder, a photo in it, or both."""
    photos = [path for path in data.decode().split("\n") if path.endswith((".png", ".jpg"))]
    names = [name for name in NAMES if "/" not in name]
    paths = random.choice((["", random.choice(photos)], [""], [random.choice(photos)])) if photos else [""]
    return json.dumps([["rename", path, random.choice(names)] for path in paths[::-1]]).encode()


def _options(text: str) -> dict[str, Any]:
    call = ast.parse(text, mode="eval").body
    assert isinstance(call, ast.Call)
    return {str(each.arg): ast.literal_eval(each.value) for each in call.keywords}


WRITTEN = (".lock", "history.jsonl", "checkpoint.pt", "preview.png", "report.html", "metrics.json", "level_0", "export")
"""What commands write into run folders."""

JSON = _document(json.loads, as_json)
TOML = _document(tomllib.loads, as_toml)
NAMESPACE = _document(_options, as_namespace)

ORACLE = ("--rasterizer", "oracle")
RESUME = ("train", "{templates}/scene_json", "-o", "run_part", "--resume")
REPORT = ("report", "run_done", *ORACLE)
EXPORT = ("export", "run_done", "-o", "out")
CLIP = ("render", "run_done", *ORACLE, "--trajectory", "path/trajectory.json", "-o", "clip")
CONFIG = ("train", "{templates}/scene_json", "--config", "run_done/run.toml", *ORACLE, "-o", "run_new")
TRAIN = ("--levels", "1", "--iterations", "4", *ORACLE, "-o", "run_new")


def _prepare(suffix: str) -> tuple[str, ...]:
    return ("prepare", f"scene_{suffix}/photos", "out")


def _scene(name: str, target: str, damage: Damage, also: tuple[str, ...] = ()) -> Kind:
    folder = target.split("/", maxsplit=1)[0]
    resolutions = ("full", "full", "20", *(() if "exr" in name else ("3dgs:24",)))  # Pillow knows no EXR
    reads = [("read-scene", folder, resolution) for resolution in resolutions]
    return Kind(name, target, damage, reads, [("train", folder, *TRAIN)], also)


KINDS = (
    Kind("manifest", "run_done/manifest.json", JSON, [EXPORT, EXPORT, REPORT], [CLIP], also=["path"]),
    Kind("manifest to resume", "run_part/manifest.json", JSON, [RESUME]),
    Kind("settings", "run_done/run.toml", TOML, [CONFIG]),
    Kind("settings as text", "run_done/run.toml", _text, [CONFIG]),
    Kind("history", "run_done/history.jsonl", damaged_lines, [REPORT]),
    Kind("history to resume", "run_part/history.jsonl", damaged_lines, [RESUME]),
    Kind("metrics", "run_done/metrics.json", JSON, [REPORT]),
    Kind("checkpoint", "run_part/checkpoint.pt", damaged_tensors, [RESUME]),
    Kind("optimizer", "run_part/level_1/optimizer.pt", damaged_tensors, [RESUME]),
    Kind(
        "field",
        "run_done/level_0/point_cloud.ply",
        damaged_ply,
        [("read-field", "run_done/level_0/point_cloud.ply")],
        [EXPORT, REPORT],
    ),
    Kind("field in ASCII", "ascii/field.ply", damaged_ascii_ply, [("read-field", "ascii/field.ply")]),
    Kind(
        "trajectory",
        "path/trajectory.json",
        JSON,
        [("read-trajectory", "path/trajectory.json"), CLIP],
        also=["run_done"],
    ),
    _scene("transforms", "scene_json/transforms.json", JSON),
    _scene("points", "scene_json/points3d.ply", damaged_ascii_ply),
    *(
        _scene(f"COLMAP {name}", f"scene_bin/sparse/0/{name}.bin", damaged_colmap)
        for name in ("cameras", "images", "points3D", "rigs", "frames")
    ),
    *(
        _scene(f"COLMAP {name} text", f"scene_txt/sparse/0/{name}.txt", _text)
        for name in ("cameras", "images", "points3D", "rigs", "frames")
    ),
    *(
        _scene(f"photo {index} {suffix}", f"scene_{suffix}/photos/{index}.{suffix}", damage)
        for suffix, damage, indices in (
            ("png", damaged_png, (0, 1, 2)),
            ("jpg", damaged_jpeg, (0, 1)),
            ("gif", damaged_gif, (0,)),
            ("exr", damaged_exr, (0,)),
            ("tif", damaged_tiff, (0, 1, 2)),
        )
        for index in indices
    ),
    Kind(
        "experiment",
        "bench/experiment.toml",
        TOML,
        [("bench", "run", "bench/experiment.toml", "--out", "out", "--dry-run")],
        also=["scene_json"],
    ),
    Kind(
        "store",
        "bench/results.sqlite",
        damaged_store,
        [("bench", "run", "bench/experiment.toml", "--out", "bench", "--tables-only")],
    ),
    Kind("results", "bench/results.csv", _text, [("report", "bench", *ORACLE)]),
    *(
        Kind(f"recipe {name}", f"recipes/{name}.toml", TOML, [("read-recipes", "recipes")])
        for name in ("fastgs", "taming", "graphdeco")
    ),
    Kind("cfg_args", "foreign/cfg_args", NAMESPACE, [("import-run", "foreign", "-o", "out")]),
    Kind("recorded run", "foreign/lapgs_record.json", JSON, [("import-run", "foreign", "-o", "out")]),
    Kind("TRAIN_INFO", "foreign_levels/L1/TRAIN_INFO", _text, [("import-run", "foreign_levels", "-o", "out")]),
    Kind("breakdown", "foreign_levels/runtime_breakdown.json", JSON, [("import-run", "foreign_levels", "-o", "out")]),
    Kind("tables", "bench/tables.md", _text, [("report", "bench", *ORACLE)]),
    Kind("settings of others", "run_done/run.toml", variants.config, [CONFIG]),
    Kind("video", "video/clip.mp4", damaged_clip, [("prepare", "video/clip.mp4", "out")]),
    *(
        Kind(
            f"prepared photo {name}", f"scene_{name[:-2]}/photos/{name[-1]}.{name[:-2]}", damage, [_prepare(name[:-2])]
        )
        for name, damage in (
            ("jpg 0", stored_jpeg),
            ("webp 0", damaged_webp),
            ("webp 1", damaged_webp),
            ("heic 0", damaged_heic),
        )
    ),
    _scene("photo 1 webp", "scene_webp/photos/1.webp", damaged_webp),
    _scene("stored jpg", "scene_jpg/photos/0.jpg", stored_jpeg),
    _scene("transforms of others", "scene_json/transforms.json", variants.transforms),
    _scene("points of others", "scene_json/points3d.ply", variants.points_ply),
    *(
        _scene(f"COLMAP {name} of others", f"scene_txt/sparse/0/{name}.txt", damage)
        for name, damage in (
            ("cameras", variants.colmap_cameras),
            ("images", variants.colmap_images),
            ("points3D", variants.colmap_points),
        )
    ),
    *(
        Kind(f"{name} {what}", folder, damage, commands, layout=True)
        for name, folder, commands in (
            ("run", "run_done", [REPORT, EXPORT]),
            ("run to resume", "run_part", [RESUME]),
            ("scene", "scene_json", [("read-scene", "scene_json", "full"), ("train", "scene_json", *TRAIN)]),
            ("COLMAP", "scene_bin", [("read-scene", "scene_bin", "full"), ("train", "scene_bin", *TRAIN)]),
            ("COLMAP text", "scene_txt", [("read-scene", "scene_txt", "full"), ("train", "scene_txt", *TRAIN)]),
            ("foreign", "foreign_levels", [("import-run", "foreign_levels", "-o", "out")]),
            ("experiment", "bench", [("report", "bench", *ORACLE)]),
        )
        for what, damage in (("layout", damaged_layout), ("links", special_files), ("names", strange_names))
    ),
    Kind(
        "foreign field",
        "foreign/point_cloud/iteration_30/point_cloud.ply",
        damaged_ply,
        [("import-run", "foreign", "-o", "out")],
    ),
)
BY_NAME = {kind.name: kind for kind in KINDS}
