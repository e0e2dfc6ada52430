"""Files that other programs and people write: not damaged, but other than what this program writes.

What each stands for: COLMAP models whose observations are made up or outdated, names with spaces or backslashes, split
lists, intrinsics as shares of the size, colours in other types. Each may be damaged besides.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

from tests.fuzz.mutations import TEXTS, as_json, damaged_text, damaged_tree

NAMES = (
    *(
        "-rf",
        "--help",
        "-",
        "a b",
        " ",
        "a\nb",
        "\x1b[2J",
        "a\tb",
        "\x85",
        "\u202egnp.0",
        "\udcff\udcfe",
        "é",
        "n" * 250,
    ),
    *("%s{}", "[0]", "a#b", "~", "$HOME", "'\"", "CON", "a\\b", "*", ".hidden", "trailing.", "\U0001f4f7"),
)
"""Of photos and folders: control characters, no UTF-8, very long, leading dashes, patterns of shells."""

Lines = list[str]


def _lines(*edits: Callable[[Lines, Random], Lines]) -> Callable[[bytes, Random], bytes]:
    """Return damage by one or two of these edits, and now and then of a word besides."""

    def damage(data: bytes, random: Random) -> bytes:
        lines = data.decode().split("\n")
        for edit in random.sample(edits, random.choice((1, 1, 2))):
            lines = edit(lines, random)
        text = "\n".join(lines).encode("utf-8", "surrogateescape")
        return damaged_text(text, random) if random.random() < 0.2 else text

    return damage


def _words(lines: Lines, column: int, words: Sequence[str], random: Random, every: int = 1) -> Lines:
    """Replace a word of the lines 0, `every`, ..., of which some may be empty."""
    changed = list(lines)
    for index in range(0, len(lines), every):
        parts = lines[index].split(" ")
        if column < len(parts) > 1:
            parts[column] = random.choice(words)
            changed[index] = " ".join(parts)
    return changed


def _renamed(lines: Lines, random: Random) -> Lines:
    name = random.choice(("my photo {}.jpg", "a\\{}.jpg", "./{}.jpg", "images/{}.jpg", "{}.JPG", "IMG {} 1 2 3.jpg"))
    return [re.sub(r"(\d)\.jpg$", lambda match: name.format(match[1]), line) for line in lines]


def _strange_name(lines: Lines, random: Random) -> Lines:
    name = random.choice(NAMES).replace("\n", "")
    return [re.sub(r"0\.jpg$", lambda _: f"{name}.jpg", line) for line in lines]


def _rewritten(lines: Lines, random: Random) -> Lines:
    """The same with other line ends, comments, empty lines, tabs or a byte order mark."""
    return random.choice(
        (
            [f"{line}\r" for line in lines],
            ["# comment 1 2 3", *lines, "# end"],
            [f"  {line}  " for line in lines],
            [line.replace(" ", "\t") for line in lines],
            ["\ufeff" + lines[0], *lines[1:]],
            [part for line in lines for part in (line, "")],
        )
    )


colmap_images = _lines(
    _renamed,
    _strange_name,
    _rewritten,
    lambda lines, random: lines[: -random.randrange(1, 3)],  # without the last line, and the one before
    lambda lines, random: lines[::2],  # a line an image
    lambda lines, random: [line if index % 2 == 0 else "" for index, line in enumerate(lines)],
    lambda lines, random: [line if index % 2 == 0 else f"{line} 7 8" for index, line in enumerate(lines)],
    lambda lines, random: _words(lines, 2, ("99", "-5", "0", "1.5", "18446744073709551615"), random),  # point ids
    lambda lines, random: _words(lines, 8, ("9", "0", "-1"), random, 2),  # of a camera
    lambda lines, random: _words(lines, 0, ("1", "7", "0", "-1", "4294967296"), random, 2),  # ids that repeat
    lambda lines, random: [re.sub(r"^(\d) \S+ \S+ \S+ \S+", r"\1 0 0 0 0", line) for line in lines],  # no rotation
)
colmap_cameras = _lines(
    _rewritten,
    lambda lines, random: _words(
        lines, 1, ("SIMPLE_PINHOLE", "OPENCV", "pinhole", "OPENCV_FISHEYE", "SIMPLE_RADIAL", "FOV", "PANO", ""), random
    ),
    lambda lines, random: _words(lines, random.choice((2, 3)), ("20", "80", "0", "40.0", "1e5"), random),
    lambda lines, random: [f"1 OPENCV 40 32 30 30 20 16 {random.choice(('0 0 0 0', '9 9 9 9', '-1 2 0 0'))}"],
    lambda lines, random: [*lines, *lines],
)
colmap_points = _lines(
    _rewritten,
    lambda lines, random: [" ".join(line.split(" ")[: random.choice((4, 7, 8, 9))]) for line in lines],  # no tracks
    lambda lines, random: _words(lines, random.choice((8, 9, 10)), ("99", "0", "-1", "4294967295"), random),
    lambda lines, random: _words(lines, random.choice((4, 5, 6)), ("0.5", "65535", "-1", "256", "x"), random),
    lambda lines, random: [*lines[:-1], *lines],
    lambda lines, random: random.choice(([], ["# 3D points"], lines[:1], lines[:1] * 4)),
)
points_ply = _lines(
    lambda lines, random: _property(lines, ("diffuse_red", "Red", "r", "f_dc_0", "R", "intensity"), random),
    lambda lines, random: [
        line.replace("uchar", random.choice(("int", "float", "double", "ushort"))) for line in lines
    ],
    lambda lines, random: [
        line.replace(" 200 100 50", random.choice((" 65535 0 9", " 1 0 1", " -5 1e9 nan"))) for line in lines
    ],
    lambda lines, random: [line.replace("vertex 12", "vertex 0") for line in lines[: lines.index("end_header") + 1]],
    lambda lines, random: [*lines[: lines.index("end_header") + 1], *[lines[-2]] * 12],  # all in one place
    lambda lines, random: [
        re.sub(r"^\S+ \S+ \S+ (?=200)", random.choice(("1e30 0 0 ", "nan 0 0 ")), each) for each in lines
    ],
)


def _property(lines: Lines, names: Sequence[str], random: Random) -> Lines:
    name = random.choice(names)
    return [line.replace(" red", f" {name}") for line in lines]


Tree = dict[str, Any]


def transforms(data: bytes, random: Random) -> bytes:
    """Keys and spellings of other programs, and now and then a damaged value besides."""
    tree: Tree = json.loads(data)
    for edit in random.sample(TREE_EDITS, random.choice((1, 1, 2))):
        edit(tree, random)
    if random.random() < 0.3:
        tree = damaged_tree(tree, random)
    return as_json(tree).encode("utf-8", "surrogatepass")


def _paths(tree: Tree) -> list[str]:
    return [frame["file_path"] for frame in tree["frames"]]


def _split(tree: Tree, random: Random) -> None:
    paths = _paths(tree)
    change = random.choice(
        (
            str,
            lambda path: path.split("/")[-1],
            lambda path: path.replace("/", "\\"),
            lambda path: f"./{path}",
            str.upper,
        )
    )
    names = [change(path) for path in paths]
    key = random.choice(("{}_filenames", "{}_frames", "{}_files"))
    tree[key.format("train")] = names[: random.randrange(len(names) + 1)]
    tree[key.format(random.choice(("test", "val")))] = random.choice((names[1:], names, [], ["other.png"], "x", [5]))


def _shares(tree: Tree, random: Random) -> None:
    for keys, side in ((("fl_x", "cx"), "w"), (("fl_y", "cy"), "h")):
        tree.update({key: tree[key] / tree[side] for key in keys})


def _frames(tree: Tree, random: Random) -> None:
    key = random.choice(("is_bad", "mask_path", "depth_file_path", "camera_model", "fl_x", "w", "file_path"))
    for frame in tree["frames"]:
        frame[key] = random.choice((True, False, None, "true", 1, frame["file_path"], "x.png"))


def _all_paths(tree: Tree, random: Random) -> None:
    change: Callable[[str], str] = random.choice(
        (
            lambda path: path.replace("/", "\\"),
            lambda path: path.rpartition(".")[0],
            lambda path: f"./{path}",
            lambda path: f"../scene_json/{path}",
            lambda path: f"photos/{random.choice(NAMES)}.png",
        )
    )
    for frame in tree["frames"]:
        frame["file_path"] = change(frame["file_path"])


def _set(key: str, *values: Any) -> Callable[[Tree, Random], None]:
    def edit(tree: Tree, random: Random) -> None:
        tree[key] = random.choice(values)

    return edit


def _matrices(tree: Tree, random: Random) -> None:
    for frame in tree["frames"]:
        matrix = frame["transform_matrix"]
        frame["transform_matrix"] = random.choice(
            (matrix[:3], [x for row in matrix for x in row], [[1e30 * x for x in row] for row in matrix], [[0] * 4] * 4)
        )


TREE_EDITS: tuple[Callable[[Tree, Random], None], ...] = (
    _split,
    _split,
    _shares,
    _frames,
    _all_paths,
    _matrices,
    _set(
        "camera_model",
        "opencv",
        "PINHOLE",
        "Pinhole",
        "SIMPLE_PINHOLE",
        "OPENCV_FISHEYE",
        "equirectangular",
        "",
        None,
        5,
    ),
    _set("ply_file_path", ".\\points3d.ply", "./points3d.ply", "none.ply", "", "../x", "/dev/zero", "points3d", None),
    _set(
        "test_frames",
        [],
        ["photos/0.png"],
        [{"file_path": "photos/0.png"}],
        "x",
        [{"file_path": "photos/0.png", "is_bad": True}],
    ),
    _set("applied_scale", 1e-9, 0, -1, 1e9, "2"),
    _set("applied_transform", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], [[0] * 4] * 3, [], "x"),
    _set("camera_angle_x", 0, 3.2, -1, 1e9, None),
    _set("k1", 0.1, 1e9, None, "0.1"),
    _set("frames", [], None, {}),
)


def config(data: bytes, random: Random) -> bytes:
    """A settings file with another value for one to three options, or keys that are none."""
    lines = data.decode().splitlines()
    for _ in range(random.choice((1, 1, 3))):
        key = lines[random.randrange(len(lines))].partition(" = ")[0]
        value = random.choice((*TEXTS, *NAMES, -1, 0, 1, 1.5, 10**9, 1e300, True, False, [], [1], {"a": 1}))
        key = random.choice((key, key, key, key.upper(), f"{key}-", "config", "resume", f'"{key}"', "", "a.b"))
        lines = [line for line in lines if not line.startswith(f"{key} =")]
        text = json.dumps(value) if not isinstance(value, dict) else "{a = 1}"
        lines.append(f"{key} = {random.choice((text, text, text, json.dumps(str(value)), 'nan', '2026-01-01'))}")
    return "\n".join(lines).encode("utf-8", "surrogatepass")
