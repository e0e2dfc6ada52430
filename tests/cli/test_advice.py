"""Test that the advice of messages works: what it names exists, and a command that follows it succeeds."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

from lapgs_plugin.cli.app import all_commands, app
from lapgs_plugin.errors import LapgsError
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_run, write_scene
from tests.contract.stub_runs import CHECKOUTS
from tests.docs.test_documents import OF_OTHERS, every_option
from tests.package_strings import said

lapgs = succeeding(app, 120)

TRAIN = "train {scene} -o {new} --rasterizer cpu --iterations 30"
EXPERIMENT = """
name = "one"
title = "One run"
iterations = 4
[[scenes]]
name = "garden"
[backbones.cpu]
rasterizer = "cpu"
[[variants]]
name = "one"
method = "bare"
"""
OF_OTHER_PROGRAMS = {
    "--blur_up", "--ray_jitter", "--train_test_exp", "--use_train_speedup", "--white_background",  # of scripts
    "--batch_size", "--camera_model", "--data_type", "--depths",
    "--create-dirs", "--force-reinstall", "--standalone",  # of curl, pip and torchrun
    "--init", "--recursive",  # of git
}  # fmt: skip
CLIP = "render {run} --trajectory orbit --frames 2"
ADVICE = [
    # a command, what its message advises, commands that follow that
    (f"{TRAIN} --levels 9", "use fewer --levels or a larger --resolution", [f"{TRAIN} --levels 2"]),
    (f"{TRAIN} --resolution 20 --levels 3", "a larger --resolution", [f"{TRAIN} --resolution full --levels 2"]),
    (
        f"{TRAIN} --split 1/1000,999/1000",
        "raise --iterations or change --split",
        [f"{TRAIN} --split 1/1000,999/1000 --iterations 2000", f"{TRAIN} --split 1/2,1/2 --overwrite"],
    ),
    (f"{TRAIN} --strategy 3dgs --cap-max 9", "leave it out", [f"{TRAIN} --strategy 3dgs"]),
    (
        f"{TRAIN} --hierarchy nested --joint 0.2",
        "leave it out, or add --hierarchy laplacian",
        [f"{TRAIN} --hierarchy nested", f"{TRAIN} --hierarchy laplacian --joint 0.2 --overwrite"],
    ),
    (
        f"{TRAIN} --protocol paper --joint 0.3",
        "leave one out",
        [f"{TRAIN} --protocol paper", f"{TRAIN} --joint 0.3 --overwrite"],
    ),
    (
        f"{TRAIN} --views-per-step 99",
        "the scene has 10 training views; give at most as many, or auto",
        [f"{TRAIN} --views-per-step 10", f"{TRAIN} --views-per-step auto --overwrite"],
    ),
    (f"{TRAIN} --images-on gpu", "expected memory or disk", [f"{TRAIN} --images-on disk"]),
    *((f"{TRAIN} {option}", "leave it out", [TRAIN]) for option in ("--keep best", "--packed", "--gpu-busy")),
    (f"{TRAIN} --resume --overwrite", "give one of them", [f"{TRAIN} --overwrite", f"{TRAIN} --resume"]),
    (f"{TRAIN} --resume", "leave --resume out to start one", [TRAIN]),
    (
        "train {scene} -o {run}",
        "continue it with --resume .* or replace it with --overwrite",
        ["train {scene} -o {run} --resume", "train {scene} -o {run} --overwrite"],
    ),
    ("train {scene} -o {scene}", "choose a new or empty folder", [TRAIN]),
    ("train {scene} -o {scene}/transforms.json", "choose another name", [TRAIN]),
    ("train {scene} -o {new}/" + "n" * 300, "choose a shorter one", [TRAIN]),
    (
        "train {scene} -o {run} --resume --seed 7",
        "leave the option out to continue it, or start again with --overwrite",
        ["train {scene} -o {run} --resume", "train {scene} -o {run} --overwrite --seed 7"],
    ),
    (
        "train {other} -o {run} --resume",
        "give that one to continue it, or start again with --overwrite",
        ["train {scene} -o {run} --resume", "train {other} -o {run} --overwrite"],
    ),
    (
        "train {scene} -o {run} --resume --iterations 5",
        "give more to extend it",
        ["train {scene} -o {run} --resume --iterations 999"],
    ),
    (f"{TRAIN} --rasterizer gsplat", "`lapgs doctor` says what to install", ["doctor {checkout}", TRAIN]),
    (f"{TRAIN} --masks alpha", "leave the option out", [TRAIN]),
    ("train {masked} -o {new}", "or use no masks .in training: --masks none", ["train {masked} -o {new} --masks none"]),
    ("train {scene}/photos -o {new}", "give {scene}, which has one", [TRAIN]),
    (
        f"{TRAIN} --config {{scene}}/none.toml",
        r"a run folder has one, run\.toml",
        [TRAIN, "train --config {new}/run.toml -o {tmp}/again"],
    ),
    (f"{TRAIN} --levls 2", "see `lapgs train --help`", ["train --help"]),
    (
        "render {all_trained} --views test",
        "render --views train, or train with --eval",
        ["render {all_trained} --views train", "train {scene} -o {new} --eval"],
    ),
    (f"{CLIP} -o {{tmp}}/x.mp4 --format exr", "give --out a folder", [f"{CLIP} -o {{tmp}}/x --format exr"]),
    (f"{CLIP} -o {{tmp}}/x.avi", r"expected an \.mp4 file or a folder for images", [f"{CLIP} -o {{tmp}}/x"]),
    ("render {run} --level 5", "expected 0 to 1", ["render {run} --level 1"]),
    ("eval {moved}", "say where it is now with --scene", ["eval {moved} --scene {scene}"]),
    (
        "eval {half}",
        "finish the run with its own command and --resume, or look .* `lapgs render`",
        ["train {scene} -o {half} --resume", "render {half} --level 1"],
    ),
    ("eval {tmp}/none", "expected a folder of `lapgs train` or `lapgs run`", [TRAIN]),
    ("report {run} {all_trained}", "lapgs report RUN --baseline OTHER", ["report {run} --baseline {all_trained}"]),
    ("report {odd_metrics}", "write it again with `lapgs eval`", ["eval {odd_metrics}", "report {odd_metrics}"]),
    ("report {odd_history}", "delete that line", ["cut {odd_history}/history.jsonl", "report {odd_history}"]),
    (
        "report",
        "name one, or train one with `lapgs train SCENE -o runs/NAME`",
        ["report {run}", "train {scene} -o runs/one --rasterizer cpu"],
    ),
    ("render {run} --frame-rate 5", "leave it out", ["render {run}"]),
    ("render {run} --views some", "expected test, train or all", ["render {run} --views all"]),
    (
        "sample {scene} --size 32x24 --views 3 --points 9",
        "expected an empty or new folder; choose another",
        ["sample {new} --size 32x24 --views 3 --points 9"],
    ),
    (
        "doctor {tmp}/none",
        "expected the root of a 3DGS checkout, or its training script",
        ["doctor {checkout}", "doctor {checkout}/train.py"],
    ),
    (
        "bench {tmp}/none.toml",
        "give an experiment file, or the name of one .* smoke",
        ["bench smoke --dry-run --no-eval"],
    ),
    (
        "bench {experiment} --dry-run --no-eval",
        "give .*--path garden=FOLDER",
        ["bench {experiment} --dry-run --no-eval --path garden={scene}"],
    ),
    (
        "bench smoke --no-eval --out {tmp}/\udcff",
        "not UTF-8, as paths are kept; choose another folder",
        ["bench smoke --no-eval --out {tmp}/x --dry-run"],
    ),
    ("patch apply {scene}", "`lapgs help patches` says how to add one", ["help patches"]),
    ("help train", r"did you mean training\?", ["help training"]),
]


@pytest.fixture
def places(tmp_path: Path) -> dict[str, str]:
    """Folders by the names that commands have for them."""
    scene, other, masked = (write_scene(tmp_path / name) for name in ("scene", "other", "masked"))
    values = json.loads((masked / "transforms.json").read_text())
    for frame in values["frames"]:
        frame["mask_path"] = f"m/{Path(frame['file_path']).name}"
    (masked / "transforms.json").write_text(json.dumps(values))
    (masked / "m").mkdir()
    runs = {name: write_run(tmp_path / name, scene) for name in ("run", "odd_metrics", "odd_history")}
    runs["all_trained"] = write_run(tmp_path / "all_trained", scene, hold_out=False)
    runs["half"] = write_run(tmp_path / "half", scene, finished=1)
    runs["moved"] = write_run(tmp_path / "moved", tmp_path / "gone")
    (runs["odd_metrics"] / "metrics.json").write_text("{")
    with (runs["odd_history"] / "history.jsonl").open("a") as stream:
        stream.write("nonsense\n")
    (tmp_path / "experiment.toml").write_text(EXPERIMENT)
    named = {"scene": scene, "other": other, "masked": masked, **runs, "new": tmp_path / "new", "tmp": tmp_path}
    named |= {"checkout": CHECKOUTS / "graphdeco", "experiment": tmp_path / "experiment.toml"}
    return {name: str(path) for name, path in named.items()}


@pytest.mark.parametrize(("wrong", "advice", "right"), ADVICE, ids=[line[0][:50] for line in ADVICE])
def test_who_follows_the_advice_gets_further(
    wrong: str, advice: str, right: list[str], places: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lapgs_plugin.training.trainer.Trainer.run", lambda *_: None)  # it gets as far as this
    monkeypatch.setattr("lapgs_plugin.viewer.preview.save_run_preview", lambda *_, **__: None)
    monkeypatch.chdir(places["tmp"])
    with pytest.raises(LapgsError, match=advice.format(**places) if advice.startswith("give {") else advice):
        lapgs(*shlex.split(wrong.format(**places)))
    for command in right:
        name, *words = shlex.split(command.format(**places))
        if name == "cut":
            lines = Path(words[0]).read_text().splitlines(keepends=True)
            Path(words[0]).write_text("".join(lines[:-1]))
        else:
            lapgs(name, *words)


def test_options_and_commands_in_messages_exist() -> None:
    messages = [(where, text) for where, text in said() if " " in text]
    options = [(where, option) for where, text in messages for option in re.findall(r"(?<![\w-])--[a-z][\w-]*\w", text)]
    assert len(options) > 300
    known = every_option() | OF_OTHERS | OF_OTHER_PROGRAMS
    assert sorted({pair for pair in options if pair[1] not in known}) == []
    names = {name for _, text in messages for name in re.findall(r"`lapgs ([a-z-]+)", text)}
    assert names <= all_commands().commands.keys()
