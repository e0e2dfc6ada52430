"""`lapgs bench tiles`: the tiles of a run trained by workers of every launcher, and merged."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from lapgs_plugin.cli import app
from lapgs_plugin.files import MANIFEST
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CHECKPOINT, HISTORY, JOBS, PLY, TILE_LOG, remove_results
from lapgs_plugin.scenes.sample import make_sample_scene
from tests.experiments.examples import RAY_WARNS
from tests.waiting import wait_for

OPTIONS = ("--iterations", "40", "--sh-degree", "1", "--hierarchy", "nested", "--eval", "--tiles", "1x2")
TILE_FOLDERS = ("tile_0_0", "tile_0_1")

Lapgs = Callable[..., str]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "sample"
    make_sample_scene(path, width=64, height=48, views=10, points=300, progress=False)
    return path


@pytest.fixture
def lapgs(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Lapgs:
    """Return a function that runs a command in this process, and returns its messages; it fails if `fails`."""

    def call(*words: object, fails: bool = False) -> str:
        monkeypatch.setattr(sys, "argv", ["lapgs", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            app.run()
        printed = capfd.readouterr()
        assert ended.value.code == (2 if fails else 0), printed.err
        return printed.err

    return call


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, scene: Path) -> Path:
    """A run whose tiles were trained one after the other."""
    run = tmp_path_factory.mktemp("runs") / "trained"
    command = [sys.executable, "-m", "lapgs_plugin", "train", scene, "-o", run, *OPTIONS]
    subprocess.run(command, check=True, capture_output=True)
    return run


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory, scene: Path) -> Path:
    """The same run when its coarser levels are finished."""
    run = tmp_path_factory.mktemp("runs") / "base"
    command = [sys.executable, "-m", "lapgs_plugin", "train", scene, "-o", run, *OPTIONS, "--only-base"]
    subprocess.run(command, check=True, capture_output=True)
    return run


@pytest.fixture
def run(tmp_path: Path, base: Path) -> Path:
    """A copy of `base` to write to."""
    return shutil.copytree(base, tmp_path / "run")


def fields_of(run: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(run.glob(f"**/{PLY}"))]


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (None, "--launcher local --workers 5"),
        ("submitit", "--launcher slurm --workers 2 --launcher-option cluster=local"),
        pytest.param(
            "ray", "--launcher ray --workers 2 --launcher-option num_cpus=0.5", marks=(pytest.mark.slow, RAY_WARNS)
        ),
    ],
)
def test_tiles_of_every_launcher_have_the_bits_of_one_after_the_other(
    extra: str | None, words: str, run: Path, trained: Path, lapgs: Lapgs
) -> None:
    if extra is not None:
        pytest.importorskip(extra)
    messages = lapgs("bench", "tiles", run, *words.split(" "))
    assert "done   tile 0,0: " in messages
    assert "done   tile 0,1: " in messages
    assert "holds the run; next: `lapgs eval" in messages
    assert fields_of(run) == fields_of(trained)
    assert all("tile 0," in (run / folder / TILE_LOG).read_text() for folder in TILE_FOLDERS)
    messages = lapgs("bench", "tiles", run, *words.split(" "))
    assert "tile 0," not in messages
    assert "holds the run" in messages


def test_a_failed_tile_is_named_and_continued(run: Path, trained: Path, lapgs: Lapgs) -> None:
    stranger = run / "tile_0_1" / "stranger"
    stranger.parent.mkdir()
    stranger.touch()
    *_, last = lapgs("bench", "tiles", run, fails=True).splitlines()
    assert last.startswith("lapgs: 1 of 2 tiles failed, the first is tile 0,1 (exit code 2; ")
    assert str(run / "tile_0_1" / TILE_LOG) in last
    assert "it holds stranger" in last
    assert last.endswith("; the others are kept; once the cause is mended, the same command continues")
    assert not RunArchive.open(run).manifest.complete
    stranger.unlink()
    assert "tile 0,0" not in lapgs("bench", "tiles", run, "--rasterizer", "cpu", "--breakdown")
    assert "--rasterizer cpu --breakdown --resume" in (run / "tile_0_1" / TILE_LOG).read_text()
    assert fields_of(run) == fields_of(trained)
    remove_results(run)
    assert not (run / JOBS).exists()


@pytest.mark.skipif(sys.platform == "win32", reason="uses POSIX signals")
def test_sigterm_ends_the_tiles_which_are_continued(tmp_path: Path, scene: Path, lapgs: Lapgs) -> None:
    run, one = tmp_path / "run", tmp_path / "one"
    longer = (*OPTIONS, "--iterations", "300")  # so that no tile ends before the signal
    lapgs("train", scene, "-o", run, *longer, "--threads", "1", "--only-base")
    shutil.copytree(run, one)
    lapgs("train", scene, "-o", one, "--resume", "--threads", "1")
    command = [sys.executable, "-m", "lapgs_plugin", "bench", "tiles", run, "--workers", "2"]
    options = ["--checkpoint-every", "20", "--threads", "1"]
    with subprocess.Popen([*command, *options], stderr=subprocess.PIPE, text=True) as parent:
        wait_for(lambda: any((run / folder / CHECKPOINT).exists() for folder in TILE_FOLDERS))
        parent.send_signal(signal.SIGTERM)
        messages = parent.communicate()[1]
    assert parent.returncode == 143, messages
    assert messages.splitlines()[-1] == "lapgs: stopped; repeat the command to continue with the remaining tiles"
    begun = [run / folder / HISTORY for folder in TILE_FOLDERS if (run / folder / CHECKPOINT).exists()]
    firsts = [history.read_text().splitlines()[0] for history in begun]
    lapgs("bench", "tiles", run, *options)
    assert [history.read_text().splitlines()[0] for history in begun] == firsts, (
        "its seconds are those of the first start"
    )
    assert fields_of(run) == fields_of(one)


def test_bad_requests_are_one_line(run: Path, trained: Path, scene: Path, tmp_path: Path, lapgs: Lapgs) -> None:
    def refused(*words: object) -> str:
        (line,) = lapgs("bench", "tiles", *words, fails=True).splitlines()
        return line

    assert "--launcher pbs: expected local, slurm, ray" in refused(run, "--launcher", "pbs")
    assert "--launcher-option x: the local launcher has none" in refused(run, "--launcher-option", "x=1")
    assert "--rasterizer none: expected auto, " in refused(run, "--rasterizer", "none")
    assert "--launcher-option gpus: expected NAME=VALUE" in refused(run, "--launcher-option", "gpus")
    assert "expected a folder of `lapgs train` or `lapgs run`" in refused(tmp_path / "none")
    assert f"--scene: {tmp_path / 'gone'}" in refused(run, "--scene", tmp_path / "gone")
    assert "is a tile of another run" in refused(trained / "tile_0_0")
    half = shutil.copytree(run, tmp_path / "half")
    manifest = json.loads((half / MANIFEST).read_text())
    (half / MANIFEST).write_text(json.dumps({**manifest, "records": []}))
    assert "level 1 is not finished" in refused(half)
    plain = tmp_path / "plain"
    lapgs("train", scene, "-o", plain, "--iterations", "4", "--levels", "1")
    assert "is no run with --tiles" in refused(plain)
    assert not (run / JOBS).exists()
