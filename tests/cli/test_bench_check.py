"""Test experiments that cannot run: all mistakes are refused before the first run, one line each."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from lapgs_bench.experiments import execution, run
from lapgs_bench.experiments.run import option_names
from lapgs_bench.experiments.schema import load_experiment
from lapgs_bench.experiments.standard import EXPERIMENTS
from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import LapgsError
from lapgs_plugin.fields.camera import Camera
from lapgs_plugin.scenes.sample import make_sample_scene
from tests.contract.stub_runs import CHECKOUTS

GOOD = """
name = "tiny"
title = "Tiny"
iterations = 20
seeds = [0, 1]
[[scenes]]
name = "mine"
path = "scene"
resolution = "full"
[backbones.cpu]
rasterizer = "cpu"
options = { sh_degree = 1 }
[backbones.fast]
checkout = "fastgs"
arguments = ["--dense", "0.1"]
[[variants]]
name = "bare"
method = "bare"
backbones = ["cpu"]
[[variants]]
name = "both"
options = { levels = 2 }
[[variants]]
name = "ours"
backbones = ["cpu"]
options = { densify_every = 50 }
[[variants]]
name = "theirs"
backbones = ["fast"]
options = { fused_adam = false }
"""
SAMPLE = 'sample = { size = "64x48", views = 8, points = 100 }'
PATH = 'path = "scene"'
OURS = "densify_every = 50"
THEIRS = "fused_adam = false"
NESTED = 'hierarchy = "nested"'
RESIDUAL = ("is about residuals", "add --hierarchy laplacian")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene of 48x32 pixels."""
    folder = tmp_path_factory.mktemp("experiments")
    make_sample_scene(folder / "scene", width=48, height=32, views=10, points=100, progress=False)
    (folder / "empty").mkdir()
    (folder / "file").write_text("")
    return folder


@pytest.fixture(autouse=True)
def _here(scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(scenes)
    for name in ("MINE", "FASTGS"):
        monkeypatch.delenv(f"LAPGS_{name}", raising=False)

    def started(*_: object) -> None:
        raise AssertionError("something was started or written")

    monkeypatch.setattr(execution, "launch", started)
    monkeypatch.setattr(run, "make_samples", started)


def lines_about(text: str, *words: str) -> list[str]:
    """Return the lines by which `lapgs bench` refuses an experiment, and check that nothing is written."""
    Path("tiny.toml").write_text(text)
    before = everything()
    paths = () if any(word.startswith("fastgs=") for word in words) else ("--path", f"fastgs={CHECKOUTS / 'fastgs'}")
    result = CliRunner().invoke(app, ["bench", "tiny.toml", "--no-eval", "--out", "out", *paths, *words])
    assert everything() == before
    if isinstance(result.exception, SystemExit):  # what typer says of a value that is of no use to it
        assert result.exit_code == 2
        return [result.output]
    assert isinstance(result.exception, LapgsError), result.exception
    assert result.exception.exit_code == 2
    return str(result.exception).split("\n")


def commands_of(text: str) -> str:
    """Return the commands that `lapgs bench` prints of an experiment without mistakes."""
    Path("tiny.toml").write_text(text)
    words = ["bench", "tiny.toml", "--no-eval", "--dry-run", "--path", f"fastgs={CHECKOUTS / 'fastgs'}"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.exception
    return result.stdout


def everything() -> set[str]:
    return {path.as_posix() for path in Path().rglob("*")}


MISTAKES = [
    ("seeds = [0, 1]", "seeds = [0, -1]", ["seeds.1 = -1", "expected 0 to 4294967295"]),
    ("seeds = [0, 1]", "seeds = [3, 3]", ["seeds", "3 is listed twice", "expected different seeds"]),
    ("levels = 2", "levels = 0", ["variants.1.options.levels = 0"]),
    ("levels = 2", "levels = 99", ["variants.1.options.levels = 99", "would be 1x1 pixels, expected at least 16"]),
    ("levels = 2", "levels = 3", ["variants.1.options.levels = 3", "12x8 pixels, expected at least 16"]),
    ("levels = 2", 'levels = "two"', ['variants.1.options.levels = "two"', "valid integer"]),
    ("levels = 2", "levels = true", ["variants.1.options.levels = true", "expected a number or text"]),
    ("levels = 2", "levels = [2]", ["variants.1.options.levels = [2]", "valid integer"]),
    ("levels = 2", 'hierarchy = "flat"', ['variants.1.options.hierarchy = "flat"', "expected nested or laplacian"]),
    ("levels = 2", 'split = "1/3,1/3,1/3"', ['options.split = "1/3,1/3,1/3"', "has 3 shares, expected 2"]),
    ("levels = 2", 'split = "0.001,0.999"', ["iterations = 20", "level 1 would train for 0 iterations"]),
    ("levels = 2", "prune = 1.0", ["variants.1.options.prune = 1.0", "to below 1"]),
    ("levels = 2", r'split = "a\nb\u001b[31m"', [r"\n", r"\x1b", "expected fractions"]),
    ("sh_degree = 1", f"{NESTED}, joint = 0.25", ["backbones.cpu.options.joint = 0.25", *RESIDUAL]),
    (THEIRS, f"{NESTED}, residual_color_rate = 1.0", ["variants.3.options.residual_color_rate = 1.0", *RESIDUAL]),
    (OURS, "densify_every = 0", ["variants.2.options.densify_every = 0", "expected at least 1"]),
    (OURS, "accumulate_views = -1", ["variants.2.options.accumulate_views = -1", "expected at least 1"]),
    (OURS, "threads = 100000", ["variants.2.options.threads = 100000", "1024"]),
    (OURS, 'strategy = "best"', ['variants.2.options.strategy = "best"', "expected auto, mcmc, 3dgs, multiview"]),
    (OURS, "packed = true", ["variants.2.options.packed = true", "only gsplat on a CUDA device"]),
    (OURS, 'packed = "yes"', ['variants.2.options.packed = "yes"', "expected true or false"]),
    (OURS, 'background = "pink"', ['variants.2.options.background = "pink"', "expected black, white or R,G,B"]),
    (OURS, 'images_on = "tape"', ['variants.2.options.images_on = "tape"', "expected auto, "]),
    (OURS, 'images_on = "gpu"', ['variants.2.options.images_on = "gpu"', "expected memory or disk"]),
    (OURS, r'images_on = "a\u0000"', [r'variants.2.options.images_on = "a\u0000"', "expected no NUL"]),
    (THEIRS, 'fused_adam = "no"', ['variants.3.options.fused_adam = "no"', "expected true or false"]),
    (THEIRS, 'images_on = "tape"', ['variants.3.options.images_on = "tape"', "expected auto, gpu"]),
    (THEIRS, 'backbone = "slow"', ['variants.3.options.backbone = "slow"', "--backbone slow: expected "]),
    (THEIRS, 'device = "tpu"', ['variants.3.options.device = "tpu"', "expected auto, cuda or cpu"]),
    (THEIRS, "test_every = 0", ["variants.3.options.test_every = 0", "expected at least 1"]),
    ('rasterizer = "cpu"', 'rasterizer = "gpu"', ['backbones.cpu.rasterizer = "gpu"', "expected auto, gsplat, cpu"]),
    ('checkout = "fastgs"', 'checkout = "fast"', ["backbones.fast.checkout", "its folder is not given"]),
    ('"--dense"', '"-m", "elsewhere", "--dense"', ["variants.1", "arguments '-m'", "other options of the script"]),
    ('resolution = "full"', 'resolution = "big"', ['scenes.0.resolution = "big"', "expected 1k, 2k, 4k"]),
    ('resolution = "full"', 'resolution = "1/2"', ['scenes.0.resolution = "1/2"', "12x8 pixels, expected at least 16"]),
    ('resolution = "full"', f'images = "{"n" * 300}"', ["scenes.0 (mine)", "has no image folder nnn"]),
    ('resolution = "full"', 'images = "photos"', ["scenes.0 (mine)", "has no image folder photos"]),
    (PATH, 'path = "nowhere"', ["scenes.0 (mine)", "nowhere is not a folder"]),
    (PATH, 'path = "file"', ["scenes.0 (mine)", "file is not a folder"]),
    (PATH, 'path = "empty"', ["scenes.0 (mine)", "has no image folder images"]),
    (PATH, f'path = "{"n" * 300}"', ["scenes.0 (mine)", "is not a folder"]),
    (PATH, SAMPLE.replace("64x48", "big"), ["scenes.0 (mine)", "--size 'big': expected WIDTHxHEIGHT"]),
    (PATH, SAMPLE.replace("64x48", "20x20"), ["variants.1.options.levels = 2", "10x10 pixels"]),
    (PATH, SAMPLE.replace("views = 8", "views = -1"), ["scenes.0.sample.views = -1", "greater than or equal to 2"]),
    (PATH, SAMPLE.replace("100", "1000000000000"), ["--points 1000000000000: expected at most 1000000"]),
    ("iterations = 20", "iterations = 1", ["iterations = 1", "at least one for each of the 2 levels"]),
    ('name = "mine"', f'name = "{"n" * 240}"', ["a run called nnnn", "expected at most 230"]),
    ('title = "Tiny"', 'title = "Tiny"\n[table]\ncolumns = ["psrn"]', ["table", "'psrn' is not known"]),
]


@pytest.mark.parametrize(("old", "new", "expected"), MISTAKES, ids=[new[:40] for _, new, _ in MISTAKES])
def test_a_mistake_is_one_line_that_names_file_key_value_and_what_was_expected(
    old: str, new: str, expected: Sequence[str]
) -> None:
    assert old in GOOD
    text = GOOD.replace(old, new, 1)
    if "[table]" in new:
        text = GOOD + new.partition("\n")[2]
    lines = lines_about(text)
    # Two commands may use their own words, and a scene is named for each variant that cannot use it.
    assert all(line.startswith("tiny.toml: ") and line.isprintable() for line in lines)
    (line, *_) = [one for one in lines if all(word in one for word in expected)] or [None]
    assert line is not None, lines
    assert all(one.split(": ")[1] == line.split(": ")[1] or expected[-1] in one for one in lines), lines


def test_every_mistake_is_said_once_and_all_at_once() -> None:
    text = GOOD.replace("levels = 2", "levels = 99").replace("[0, 1]", "[0, 1, 2, -1]").replace(OURS, "cap_max = 0")
    lines = lines_about(text.replace('checkout = "fastgs"', 'checkout = "nowhere"'))
    keys = sorted(line.removeprefix("tiny.toml: ").split(": ")[0] for line in lines)
    assert keys == [
        "backbones.fast.checkout",
        "seeds.3 = -1",
        "variants.1.options.levels = 99",
        "variants.2.options.cap_max = 0",
    ]


def test_mistakes_of_the_file_itself_are_all_said_at_once() -> None:
    text = GOOD.replace("iterations = 20", "iterations = 0\ncolour = 1").replace('method = "bare"', 'method = "naked"')
    assert sorted(line.split(": ")[1].split(";")[0].split(" = ")[0] for line in lines_about(text)) == [
        "iterations",
        "unknown key colour",
        "variants.0.method",
    ]
    text = GOOD.replace("levels = 2", "levles = 2").replace(OURS, "densify_evry = 5")
    assert [line.split(": ")[1] for line in lines_about(text)] == [
        "variants.1.options.levles = 2",
        "variants.2.options.densify_evry = 5",
    ]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--seeds", "-1"), "--seeds = -1: --seed -1: expected 0 to 4294967295"),
        (("--seeds", "3,3"), "--seeds 3,3: expected different numbers"),
        (("--seeds", ""), "--seeds : expected whole numbers"),
        (("--scene", "yours"), "--scene yours: not in the experiment; "),
        (("--iterations", "1"), "--iterations = 1: --iterations 1: expected at least one for each of the 2 levels"),
        (("--iterations", "0"), "--iterations 0: expected at least 1"),
        (("--iterations", "nan"), "--iterations nan: expected a valid integer"),
        (("--workers", "1000000"), "--workers 1000000: expected at most 1024"),
        (("--gpus", "0,,1"), "--gpus '0,,1': expected names separated by commas"),
        (("--launcher", "cloud"), "--launcher cloud: expected local, slurm, ray"),
        (("--launcher", "slurm"), "no sbatch on this machine"),
        (("--launcher", "slurm", "--gpus", "0"), "--gpus 0: slurm assigns GPUs itself"),
        (("--launcher-option", "partition"), "--launcher-option partition: expected NAME=VALUE"),
        (("--launcher-option", "partition=gpu"), "--launcher-option partition: the local launcher has none"),
        (("--path", "fastgs=empty"), "backbones.fast.checkout: checkout fastgs: "),
        (("--path", "fastgs=nowhere"), "nowhere is not a folder"),
        (("--path", "mine"), "--path mine: expected NAME=VALUE"),
        (("--path", "mine=empty"), "scenes.0 (mine): scene mine: "),
        (("--path", "mine=~nobody-of-that-name/x"), "--path mine=~nobody-of-that-name/x: no such user"),
        (("--out", "file"), "--out file: "),
        (("--out", "n" * 300), "a name of more than 255 bytes"),
        (("--eval", "--lpips-weights", "nowhere.pth"), "--lpips-weights nowhere.pth: no such file"),
    ],
)
def test_mistakes_on_the_command_line_are_found_before_anything_is_written(
    words: tuple[str, ...], expected: str
) -> None:
    (line,) = lines_about(GOOD, *words)
    assert expected in re.sub(r"[\s│]+", " ", line)


@pytest.mark.parametrize(
    ("name", "value"), [("num_cpus", "0"), ("num_cpus", "-1"), ("num_gpus", "many"), ("num_gpus", "nan")]
)
def test_options_of_ray_are_numbers(name: str, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lapgs_plugin.errors.find_spec", lambda name: object())
    (line,) = lines_about(GOOD, "--launcher", "ray", "--launcher-option", f"{name}={value}")
    assert line.startswith(f"--launcher-option {name}={value}: expected a number for each worker")


def test_defaults_of_residual_options_are_accepted_for_nested_levels() -> None:
    idle = f'{NESTED}, joint = 0.0, supervision = "reconstructed"'
    assert commands_of(GOOD.replace("sh_degree = 1", idle))


def test_gpus_of_other_machines_are_not_required_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Login nodes have no GPU, and commands are printed anywhere."""
    text = GOOD.replace('rasterizer = "cpu"', 'rasterizer = "gsplat"').replace(THEIRS, 'device = "cuda"')
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    refused = lines_about(text)
    assert sorted(line.split(": ")[1] for line in refused) == [
        'backbones.cpu.rasterizer = "gsplat"',
        'variants.3.options.device = "cuda"',
    ]
    assert commands_of(text).count("\n# ") + 1 == 10, "two seeds of five runs"


STUB_OF = {
    **{name: name for name in ("fastgs", "taming", "graphdeco")},
    **{"original": "graphdeco", "dashgaussian": "dash", "efficientgs": "efficient"},
    **{"mini_splatting": "mini", "speedy_splat": "speedy"},
}
"""Stubs by the checkouts of shipped experiments."""


def test_shipped_experiments_have_nothing_that_is_refused(scenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check each with one scene instead of its data sets, large enough for its levels."""
    scene = scenes / "scene"
    camera = Camera(1600, 1066, 1600.0, 1600.0, 800.0, 533.0, torch.eye(4))
    monkeypatch.setattr("lapgs_plugin.scenes.scene.load_cameras", lambda *_, **__: ({"0.jpg": camera}, {}))
    for shipped, path in EXPERIMENTS.items():
        experiment = load_experiment(path, option_names())
        names = {name for entry in experiment.scenes for name in entry.names}
        for name in names:
            link = scenes / "links" / name
            link.parent.mkdir(exist_ok=True)
            if not link.exists():
                link.symlink_to(scene)
        paths = [f"{name}={scenes / 'links' / name}" for name in names]
        paths += [f"{name}={CHECKOUTS / folder}" for name, folder in STUB_OF.items()]
        words = ["bench", shipped, "--dry-run", "--no-eval", *(word for p in paths for word in ("--path", p))]
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, (shipped, str(result.exception))


def test_runs_of_the_built_in_trainer_that_cannot_read_their_scene_are_refused(scenes: Path) -> None:
    """Scripts have their own way to read scenes."""
    model = scenes / "scene" / "sparse" / "0" / "points3D.bin"
    whole = model.read_bytes()
    model.write_bytes(whole[:50])
    try:
        lines = lines_about(GOOD)
    finally:
        model.write_bytes(whole)
    assert len(lines) == 1
    assert lines[0].startswith("tiny.toml: scenes.0 (mine): ")
    assert "points3D" in lines[0]
