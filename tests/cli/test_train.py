"""`lapgs train` on the command line: one line for each mistake and nothing written, Ctrl-C and --resume."""

from __future__ import annotations

import json
import shutil
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from lapgs_plugin.cli import app
from lapgs_plugin.files import LOCK, MANIFEST
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes import load_scene
from lapgs_plugin.scenes.sample import make_sample_scene
from lapgs_plugin.training.backend import long_on_a_cpu
from lapgs_plugin.viewer.preview import read_preview
from tests.cli.run_folder import write_run, write_scene

SHORT = ("--iterations", "40", "--sh-degree", "1")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "sample"
    make_sample_scene(path, width=64, height=48, views=10, points=300, progress=False)
    return path


@dataclass(frozen=True)
class Ended:
    """Hold the exit code and the messages of a command."""

    returncode: int
    stderr: str


Lapgs = Callable[..., Ended]


@pytest.fixture
def lapgs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Lapgs:
    """Return a function that runs a command in this process: importing torch takes longer than most of them."""

    def call(*words: object) -> Ended:
        monkeypatch.setattr(sys, "argv", ["lapgs", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            app.run()
        return Ended(int(ended.value.code or 0), capsys.readouterr().err)

    return call


def test_everything_of_a_run_by_relative_paths(
    lapgs: Lapgs, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("data").symlink_to(scene.parent, target_is_directory=True)
    words = ("train", "data/sample", "-o", "runs/a", "--eval", "--appearance", "affine", "--refine-poses")
    words = (*words, "--sh-degree", "0")
    commands = (
        (*words, "--iterations", "12"),
        (*words, "--resume", "--iterations", "16"),
        ("eval", "runs/a"),
        ("eval", "runs/a", "--trajectory", "orbit", "--frames", "2"),
        ("render", "runs/a"),
        ("export", "runs/a"),
        ("export", "runs/a", "--merge", "--iterations", "4"),
        ("report", "runs/a"),
    )
    for command in commands:
        ended = lapgs(*command)
        assert ended.returncode == 0, (command, ended.stderr)
        assert str(tmp_path) not in ended.stderr
    assert [path.name for path in Path("runs").iterdir()] == ["a"]
    assert not Path("runs/a/runs").exists()


def test_a_run_trains_and_a_second_one_into_it_is_refused(lapgs: Lapgs, scene: Path, tmp_path: Path) -> None:
    options = ("--eval", "--views-per-step", "3", "--joint", "0.25", "--inherit", "xyz:0.5", *SHORT)
    done = lapgs("train", scene, "-o", tmp_path / "run", *options)
    assert done.returncode == 0, done.stderr
    archive = RunArchive.open(tmp_path / "run")
    assert archive.manifest.complete
    assert archive.manifest.settings["views_per_step"] == "3"
    assert archive.manifest.settings["hierarchy"] == "laplacian", "unless told otherwise"
    assert (archive.manifest.inherit, archive.manifest.settings["joint"]) == ("xyz:0.5", 0.25)
    assert [record.signed for record in archive.manifest.records] == [False, True]
    assert read_preview(tmp_path / "run") is not None
    before = archive.field_path(0).read_bytes()
    again = lapgs("train", scene, "-o", tmp_path / "run", *SHORT)
    assert again.returncode == 2
    assert "--resume" in again.stderr.strip().splitlines()[-1]
    assert archive.field_path(0).read_bytes() == before


def test_training_that_takes_hours_on_a_cpu_is_said_before_and_what_it_advises_is_not() -> None:
    assert "30,000 iterations of 1600x1200 pixels can take hours" in long_on_a_cpu((1600, 1200), 30_000)
    assert not long_on_a_cpu((400, 300), 3_000)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--levels", "3"), "level 2 of 3 would be 16x12 pixels"),
        (("--levels", "1", "--split", "1/3,2/3"), "--split has 2 shares, expected 1"),
        (("--supervision", "magic"), "expected reconstructed, online_residual, gt_laplacian"),
        (("--hierarchy", "nested", "--joint", "0.5"), "add --hierarchy laplacian to train residuals"),
        (("--prune", "0.1", "--densify-until", "40"), "--prune 0.1: prunes when a level's densification ends"),
        (("--rasterizer", "cuda"), "expected auto, gsplat, cpu, oracle or faster-gs"),
        (("--strategy", "luck"), "--strategy luck: expected auto, mcmc, 3dgs, multiview"),
        (("--packed", "--sparse-adam", "--rasterizer", "cpu"), "--packed, --sparse-adam with --rasterizer cpu"),
        (("--strategy", "mcmc", "--absgrad"), "--absgrad True with --strategy mcmc: an option of --strategy auto"),
        (("--strategy", "mcmc", "--error-pixels", "3"), "--error-pixels 3.0 with --strategy mcmc: an option of --str"),
        (("--images-on", "tape"), "--images-on tape: expected auto, gpu, memory or disk"),
        (("--prediction-precision", "int4"), "--prediction-precision int4: expected auto, float32, float16 or uint8"),
        (("--views-per-step", "some"), "--views-per-step some: expected auto, or a number of views"),
        (("--views-per-step", "11"), "--views-per-step 11: the scene has 10 training views; give at most as many"),
        (("--resolution", "8k"), "expected 1k, 2k, 4k"),
        (("--background", "2,0,0"), "from 0 to 1"),
        (("--time", "5"), "--time 5: expected a number with its unit"),
        (("--time", "0s"), "--time 0s: expected a time above 0"),
        (("--time", "5s"), "--time 5s with --iterations: both say how long to train"),
        (("--time", "5s", "--densify-until", "9"), "--densify-until 9 with --time: names an iteration"),
        (("--decay", "0"), "--decay 0.0: expected a share of each stage above 0"),
        (("--resume",), "is not a run, so there is nothing to continue; leave --resume out"),
        (("--resume", "--overwrite"), "contradict"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(
    lapgs: Lapgs, scene: Path, tmp_path: Path, options: tuple[str, ...], message: str
) -> None:
    ended = lapgs("train", scene, "-o", tmp_path / "run", "--iterations", 40, *options)
    assert ended.returncode == 2
    last = ended.stderr.strip().splitlines()[-1]
    assert last.startswith("lapgs: ")
    assert message in last
    assert "Traceback" not in ended.stderr
    assert "Reading images" not in ended.stderr  # nobody waits for a mistake
    assert not (tmp_path / "run" / "manifest.json").exists()


def test_another_scene_does_not_continue_a_run_and_one_that_moved_does(lapgs: Lapgs, tmp_path: Path) -> None:
    scene, other = write_scene(tmp_path / "scene"), write_scene(tmp_path / "other")
    run = write_run(tmp_path / "run", scene, finished=1)
    files = {path: path.read_bytes() for path in run.rglob("*") if path.is_file() and path.name != LOCK}
    refused = lapgs("train", other, "-o", run, "--resume")
    assert refused.returncode == 2
    assert f"was started with the scene {scene}" in refused.stderr.replace("\n", " ")
    assert {path: path.read_bytes() for path in files} == files
    shutil.rmtree(scene)
    smaller = write_scene(tmp_path / "smaller", size=(24, 16))
    assert "give the scene of" in lapgs("train", smaller, "-o", run, "--resume").stderr.replace("\n", " ")
    assert {path: path.read_bytes() for path in files} == files


@pytest.mark.slow
def test_runs_from_before_nesting_continue_with_residuals(lapgs: Lapgs, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", write_scene(tmp_path / "scene"), finished=1)
    manifest = json.loads((run / MANIFEST).read_text())
    assert manifest["settings"].pop("hierarchy") == "laplacian"
    manifest["sh_degree"] = 0  # that of the field that is there
    (run / MANIFEST).write_text(json.dumps(manifest))
    words = ("train", tmp_path / "scene", "-o", run, "--resume")
    other = lapgs(*words, "--hierarchy", "nested")
    assert other.returncode == 2
    assert "--hierarchy asks for nested, but the run" in other.stderr.replace("\n", " ")
    misplaced = lapgs(*words, "--images-on", "gpu")
    assert misplaced.returncode == 2
    assert "gpu: expected memory or disk" in misplaced.stderr.replace("\n", " ")
    done = lapgs(
        *words, "--images-on", "disk", "--prediction-precision", "float16"
    )  # another place than it was started with
    assert done.returncode == 0, done.stderr
    assert [record.signed for record in RunArchive.open(run).manifest.records] == [False, True]


def test_ctrl_c_leaves_a_run_that_resumes(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lapgs: Lapgs
) -> None:
    """`test_training` compares bits, `test_signals` presses Ctrl-C in another process."""
    options, run = (scene, *SHORT), tmp_path / "run"
    append, entries = RunArchive.append_history, []

    def append_and_press(archive: RunArchive, entry: dict[str, Any]) -> None:
        append(archive, entry)
        entries.append(entry)
        if len(entries) == 1:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(RunArchive, "append_history", append_and_press)
        stopped = lapgs("train", *options, "-o", run)
    assert stopped.returncode == 130
    assert "--resume continues" in stopped.stderr.replace("\n", " ")
    other = lapgs("train", scene, "-o", run, "--resume", "--iterations", "500")
    assert other.returncode == 2
    assert "--iterations asks for 500" in other.stderr
    assert lapgs("train", *options, "-o", run, "--resume").returncode == 0
    assert RunArchive.open(run).manifest.complete


def test_a_scene_in_small_units_is_trained_resumed_measured_and_exported(
    lapgs: Lapgs, scene: Path, tmp_path: Path
) -> None:
    small, run = Path(shutil.copytree(scene, tmp_path / "small")), tmp_path / "run"
    model = pycolmap.Reconstruction(str(small / "sparse/0"))
    model.transform(pycolmap.Sim3d(1e-3, pycolmap.Rotation3d(), np.zeros(3)))
    model.write_binary(str(small / "sparse/0"))
    options = ("--eval", "--levels", "1", "--appearance", "none")
    assert lapgs("train", small, "-o", run, *SHORT, *options).returncode == 0
    unit = json.loads((run / MANIFEST).read_text())["scene"]["unit"]
    assert unit == load_scene(small, progress=False).unit < 1e-2
    assert lapgs("train", small, "-o", run, "--resume", "--iterations", "60").returncode == 0
    assert lapgs("eval", run, "--lpips", "none").returncode == 0
    assert json.loads((run / "metrics.json").read_text())["psnr"] > 12.0, "trained and rendered, and not black"
    spread = (
        RunArchive.open(run).field(0).means.norm(dim=1).median()
        / load_scene(scene, progress=False).points.norm(dim=1).median()
    )
    assert float(spread) == pytest.approx(1e-3, rel=0.2)  # in the user's units
    assert lapgs("export", run, "--html").returncode == 0
    assert f'"near": {0.2 * unit}' in (run / "export" / "scene.html").read_text()
