"""`lapgs train --config`, the settings file in run folders, and `--log tensorboard`."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import RunFolderError, UserInputError
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.images import write_image
from lapgs_plugin.training import tensorboard
from lapgs_plugin.untrusted import read_json_lines, read_toml
from tests.cli.commands import succeeding
from tests.refusals import refuses

lapgs = succeeding(app, 120)
SHORT = ("--iterations", 8, "--sh-degree", 1, "--rasterizer", "cpu")


def test_a_run_folder_has_the_file_that_makes_it_again(scene: Path, tmp_path: Path) -> None:
    lapgs("train", scene, "-o", tmp_path / "first", "--eval", "--split", "1/4,3/4", *SHORT)
    config = tmp_path / "first" / "run.toml"
    assert read_toml(config)["split"] == "1/4,3/4"
    lapgs("train", "--config", config, "-o", tmp_path / "second")
    first, second = (RunArchive.open(tmp_path / name) for name in ("first", "second"))
    assert second.manifest.settings == first.manifest.settings
    assert second.manifest.scene == first.manifest.scene
    assert [second.field_path(level).read_bytes() for level in (0, 1)] == [
        first.field_path(level).read_bytes() for level in (0, 1)
    ]


def test_masks_are_found_again_from_another_folder(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for view in load_scene(scene).train:
        write_image(tmp_path / "white" / f"{view.name}.png", torch.ones_like(view.image))
    monkeypatch.chdir(tmp_path)
    lapgs("train", scene, "-o", "run", "--masks", "white", "--levels", 1, *SHORT)
    assert read_toml(tmp_path / "run" / "run.toml")["masks"] == str(tmp_path / "white")


def test_the_command_line_comes_before_the_file(scene: Path, tmp_path: Path) -> None:
    config = tmp_path / "mine.toml"
    config.write_text(f'scene = "{scene}"\niterations = 8\nsh-degree = 1\nrasterizer = "cpu"\nseed = 3\n')
    lapgs("train", "--config", config, "-o", tmp_path / "run", "--seed", 5, "--levels", 1)
    manifest = RunArchive.open(tmp_path / "run").manifest
    assert (manifest.seed, manifest.settings["iterations"], manifest.levels) == (5, 8, 1)


def test_a_run_on_few_photos_has_iterations_by_their_number(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lapgs_plugin.training.trainer.Trainer.run", lambda *_: None)
    monkeypatch.setattr("lapgs_plugin.viewer.preview.save_run_preview", lambda *_, **__: None)
    for name, more, expected in (("open", [], 5000), ("given", ["--iterations", "30000"], 30_000)):
        result = CliRunner().invoke(app, ["train", str(scene), "-o", str(tmp_path / name), *more])
        assert result.exit_code == 0, result.output
        assert ("training photos: 5,000 iterations" in result.output) is (name == "open")
        assert read_toml(tmp_path / name / "run.toml")["iterations"] == expected
        assert RunArchive.open(tmp_path / name).manifest.settings["iterations"] == expected


@pytest.mark.parametrize(("more", "split"), [([], "2/3,1/3"), (["--split", "1/2,1/2"], "1/2,1/2")])
def test_a_run_on_large_photos_has_a_longer_base(
    more: list[str], split: str, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lapgs_plugin.hierarchy.settings.LARGE_IMAGE", 1)
    monkeypatch.setattr("lapgs_plugin.training.trainer.Trainer.run", lambda *_: None)
    monkeypatch.setattr("lapgs_plugin.viewer.preview.save_run_preview", lambda *_, **__: None)
    lapgs("train", scene, "-o", tmp_path / "run", *more)
    assert RunArchive.open(tmp_path / "run").manifest.settings["split"] == split


def test_the_file_of_an_extended_run_says_its_iterations(scene: Path, tmp_path: Path) -> None:
    run, words = tmp_path / "run", ("train", scene, "-o", tmp_path / "run", "--resume", "--iterations")
    lapgs("train", scene, "-o", run, "--levels", 1, *SHORT)
    refuses(UserInputError, r"--iterations 7: the run in .* is finished with 8; give more", lapgs, *words, 7)
    (run / "preview.jpg").unlink()  # as if it was killed after its last iteration
    lapgs(*words, 8)
    assert (run / "preview.jpg").exists()
    assert [read_toml(run / "run.toml")[name] for name in ("iterations", "strategy")] == [8, "auto"]
    lapgs(*words, 11, "--strategy", "auto")
    assert [read_toml(run / "run.toml")[name] for name in ("iterations", "strategy")] == [11, "3dgs"]
    settings = RunArchive.open(run).manifest.settings
    assert (settings["iterations"], settings["extended"]) == (11, 3)


def test_a_settings_file_that_is_no_text_is_refused_before_a_run_is_extended(scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    lapgs("train", scene, "-o", run, "--levels", 1, *SHORT)
    (run / "run.toml").write_bytes(b"iterations = 8\n#\xff\n")
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    extend = ("train", scene, "-o", run, "--resume", "--iterations", 11)
    refuses(RunFolderError, r"run\.toml is not readable: byte 16 .* expected UTF-8 .* delete it", lapgs, *extend)
    assert {path: path.read_bytes() for path in before} == before
    (run / "run.toml").unlink()  # as the message advises
    lapgs(*extend)
    assert RunArchive.open(run).manifest.settings["iterations"] == 11


def test_auto_continues_with_the_strategy_of_the_run(scene: Path, tmp_path: Path) -> None:
    """Auto means MCMC for as many iterations as are the default, which the run does not have."""
    run = tmp_path / "run"
    lapgs("train", scene, "-o", run, "--levels", 1, *SHORT)
    lapgs("train", scene, "-o", run, "--resume", "--strategy", "auto")
    for asked, message in (
        (("--strategy", "mcmc"), "--strategy asks for mcmc, but the run in .* was started with 3dgs"),
        (("--cap-max", 50), "--cap-max is no option of --strategy 3dgs, with which the run in .* was started"),
    ):
        refuses(UserInputError, message, lapgs, "train", scene, "-o", run, "--resume", *asked)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("iteratons = 5", r"iteratons is not an option of .*; did you mean iterations\?"),
        ("views_per_stp = 2", r"views_per_stp is not an option of .*; did you mean views-per-step\?"),
        ('exposure = "off"', r"exposure is no option any more; give --appearance \(none, affine or bilateral"),
        ("foo = 5", "foo is not an option of .*; .* --help lists them"),
        ('out = "elsewhere"', "out is not an option of .*; .* --help lists them"),
        ("levels = [2]", r"levels is \[2\], expected a string, a number, true or false"),
        ("levels = true", "levels is true, expected a value of --levels"),
        ('levels = "two"', "--levels two: expected a valid integer"),
        ("levels 2", "is not TOML"),
        ("joint = 2.0", "--joint 2"),
        ('split = "1/2"', "--split has 1 shares"),
        ('masks = "none/here"', "--masks none/here: no such folder"),
        ('resolution = "tiny"', "--resolution 'tiny'"),
    ],
)
def test_a_mistake_in_the_file_is_one_line(scene: Path, tmp_path: Path, text: str, message: str) -> None:
    config = tmp_path / "mine.toml"
    config.write_text(text)
    refuses(UserInputError, f"^{config}.*{message}", lapgs, "train", scene, "--config", config, "-o", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_file_of_a_scene_is_named_whatever_the_scene(tmp_path: Path) -> None:
    config = tmp_path / "mine.toml"
    for scene in (r'"a\u001b[31m\nb"', r'"a\u0000b"', "3"):
        config.write_bytes(b"\xef\xbb\xbf" + f"scene = {scene}\n".encode())  # with the mark of Windows' editors
        refuses(UserInputError, f"^{config}: ", lapgs, "train", "--config", config, "-o", tmp_path / "run")


def test_only_values_of_the_file_are_said_to_be_of_it(scene: Path, tmp_path: Path) -> None:
    config = tmp_path / "mine.toml"
    config.write_text('scene = "gone"\njoint = 2.0\n')
    for words, message in (
        (["--joint", 3], "--joint 3"),
        (["--joint", 0.5], f"{config}: gone: no such scene"),
        ([scene, "--split", "1/2", "--joint", 0.5], "--split has 1 shares"),
    ):
        refuses(UserInputError, f"^{message}", lapgs, "train", *words, "--config", config, "-o", tmp_path / "run")


def test_a_file_that_is_not_there(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(UserInputError, match="no such file"):
        lapgs("train", scene, "--config", tmp_path / "none.toml", "-o", tmp_path / "run")
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    os.mkfifo(tmp_path / "pipe.toml")
    for name, reason in (("loop.toml", "links"), ("pipe.toml", "a pipe, socket or device"), ("", "directory")):
        with pytest.raises(UserInputError, match=rf"{re.escape(name)} cannot be read: .*(?i:{reason}).*; correct it"):
            lapgs("train", scene, "--config", tmp_path / name, "-o", tmp_path / "run")


def test_tensorboard_has_the_figures_of_the_history(scene: Path, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TensorBoard's own
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    lapgs("train", scene, "-o", tmp_path / "run", "--eval", "--log", "tensorboard", *SHORT)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        events = EventAccumulator(str(tmp_path / "run" / "tensorboard"))
        events.Reload()
    entries = read_json_lines(tmp_path / "run" / "history.jsonl")
    steps = [entry["iteration"] + (4 if entry["level"] == 0 else 0) for entry in entries]
    losses = events.Scalars("training/loss")
    assert [event.step for event in losses] == steps
    assert [event.value for event in losses] == pytest.approx([entry["loss"] for entry in entries], rel=1e-6)
    assert len(events.Scalars("held out/PSNR")) == 2
    sampled = [event.value for event in events.Scalars("held out/PSNR of some views")]
    assert sampled == pytest.approx([entry["sampled_psnr"] for entry in entries if "sampled_psnr" in entry], rel=1e-6)


def test_without_tensorboard_nothing_is_written(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "torch.utils.tensorboard.writer", None)
    refuses(UserInputError, "is not installed", tensorboard.require_tensorboard)
    with pytest.raises(UserInputError, match="is not installed"):
        lapgs("train", scene, "-o", tmp_path / "run", "--log", "tensorboard", *SHORT)
    with pytest.raises(UserInputError, match="expected tensorboard"):
        lapgs("train", scene, "-o", tmp_path / "run", "--log", "wandb", *SHORT)
    assert not (tmp_path / "run").exists()
