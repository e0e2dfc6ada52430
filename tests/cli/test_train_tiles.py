"""`lapgs train --tiles`: the base, the tiles and their merge, in one process or by their own commands."""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from lapgs_plugin.cli import app
from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.files import MANIFEST
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CHECKPOINT, EXPOSURE, HISTORY, PLY, TILE_LOG, TILES
from lapgs_plugin.scenes.sample import make_sample_scene
from lapgs_plugin.tiles.grid import read_grid
from tests.waiting import wait_for

OPTIONS = ("--iterations", "40", "--sh-degree", "1", "--hierarchy", "nested", "--eval", "--appearance", "affine")
TILE_FOLDERS = ("tile_0_0", "tile_0_1")

Lapgs = Callable[..., str]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "sample"
    make_sample_scene(path, width=64, height=48, views=10, points=300, progress=False)
    return path


@pytest.fixture
def lapgs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Lapgs:
    """Return a function that runs a command in this process; it fails if `fails`.

    It returns messages, of --only-base what a queue reads.
    """

    def call(*words: object, fails: bool = False) -> str:
        monkeypatch.setattr(sys, "argv", ["lapgs", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            app.run()
        printed = capsys.readouterr()
        assert ended.value.code == (2 if fails else 0), printed.err
        return printed.out if "--only-base" in words and not fails else printed.err

    return call


def fields_of(run: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(run.glob(f"**/{PLY}"))]


def resuming(scene: Path, run: Path) -> list[str]:
    """Return the command that continues a run with two tiles at the same time."""
    words = ["train", str(scene), "-o", str(run), "--resume", "--processes", "2"]
    return [sys.executable, "-m", "lapgs_plugin", *words]


def tile_commands(printed: str) -> list[list[str]]:
    return [shlex.split(line)[1:] for line in printed.splitlines()]


def test_tiles_end_as_one_run(tmp_path: Path, scene: Path, lapgs: Lapgs) -> None:
    run = tmp_path / "run"
    lapgs("train", scene, "-o", run, *OPTIONS, "--tiles", "1x2")
    archive, grid = RunArchive.open(run), read_grid(run)
    assert archive.manifest.complete
    parts = []
    for tile, folder in zip(grid, TILE_FOLDERS, strict=True):
        trained = GaussianField.load_ply(run / folder / "level_0" / PLY)
        cut = trained.means.double() @ torch.tensor(grid.across).double() >= grid.column_cuts[0][0]
        parts.append(trained.kept(cut if tile == (0, 1) else ~cut))
    merged = archive.field(0)
    assert torch.equal(merged.means, torch.cat([part.means for part in parts]))
    assert torch.equal(merged.sh, torch.cat([part.sh for part in parts]))
    colors, *of_tiles = (
        json.loads((run / folder / EXPOSURE).read_text())
        for folder in ("level_0", *(f"{each}/level_0" for each in TILE_FOLDERS))
    )
    for photo, color in colors.items():
        learned = torch.tensor([own[photo] for own in of_tiles if photo in own], dtype=torch.float64)
        assert torch.allclose(torch.tensor(color, dtype=torch.float64), learned.mean(0), rtol=0, atol=1e-12)
    lapgs("eval", run)
    assert json.loads((run / "metrics.json").read_text())
    finished = fields_of(run)
    assert "is finished" in lapgs("train", scene, "-o", run, "--resume")
    assert fields_of(run) == finished

    # The same by a command for each tile, of which one is left to --resume.
    queue = tmp_path / "queue"
    commands = tile_commands(lapgs("train", scene, "-o", queue, *OPTIONS, "--tiles", "1x2", "--only-base"))
    assert len(commands) == 2
    assert not list(queue.glob("tile_*"))
    lapgs(*commands[1])
    first = (queue / "tile_0_1" / MANIFEST).stat().st_mtime_ns
    lapgs("train", scene, "-o", queue, "--resume", "--tiles", "1x2")
    assert (queue / "tile_0_1" / MANIFEST).stat().st_mtime_ns == first
    assert fields_of(queue) == finished

    assert "--tile 0,1 --base" in lapgs("train", scene, "-o", run / "tile_0_1", "--resume", fails=True)
    assert "merged already" in lapgs("train", scene, "-o", tmp_path / "t", "--tile", "0,1", "--base", run, fails=True)
    assert "not extended" in lapgs("train", scene, "-o", run, "--resume", "--iterations", "60", fails=True)
    assert fields_of(run) == finished


def test_tiles_at_the_same_time_have_the_bits_of_one_after_the_other(tmp_path: Path, scene: Path, lapgs: Lapgs) -> None:
    one, several = tmp_path / "one", tmp_path / "several"
    lapgs("train", scene, "-o", one, *OPTIONS, "--tiles", "1x2")
    messages = lapgs("train", scene, "-o", several, *OPTIONS, "--tiles", "1x2", "--processes", "3")
    assert "Tiles 2 of 2 tiles" in messages
    assert fields_of(several) == fields_of(one)
    assert all("tile 0," in (several / folder / TILE_LOG).read_text() for folder in TILE_FOLDERS)


def test_a_failed_tile_is_named_and_continued(tmp_path: Path, scene: Path, lapgs: Lapgs) -> None:
    run = tmp_path / "run"
    command = ("train", scene, "-o", run, *OPTIONS, "--tiles", "1x2")
    printed = lapgs(*command, "--only-base", "--rasterizer", "cpu", "--threads", "1")
    assert all(words[-4:] == ["--rasterizer", "cpu", "--threads", "1"] for words in tile_commands(printed))
    stranger = run / "tile_0_1" / "stranger"
    stranger.parent.mkdir()
    stranger.touch()
    messages = lapgs("train", scene, "-o", run, "--resume", "--processes", "2", fails=True)
    assert "tile 0,1 failed" in messages
    assert str(run / "tile_0_1" / TILE_LOG) in messages
    stranger.unlink()
    lapgs("train", scene, "-o", run, "--resume", "--processes", "2")
    assert RunArchive.open(run).manifest.complete


@pytest.mark.skipif(sys.platform == "win32", reason="uses POSIX signals")
def test_sigterm_reaches_running_tiles_which_write_checkpoints(tmp_path: Path, scene: Path, lapgs: Lapgs) -> None:
    run = tmp_path / "run"
    longer = (*OPTIONS, "--iterations", "1200")  # so that no tile ends before the other has begun
    lapgs("train", scene, "-o", run, *longer, "--tiles", "1x2", "--only-base")
    with subprocess.Popen(resuming(scene, run), stderr=subprocess.PIPE, text=True) as parent:
        histories = [run / folder / HISTORY for folder in TILE_FOLDERS]
        wait_for(lambda: all(path.exists() and path.stat().st_size for path in histories))
        parent.send_signal(signal.SIGTERM)
        messages = parent.communicate()[1]
    assert parent.returncode == 143, messages
    assert "stopped by SIGTERM; running tiles have checkpoints" in messages
    assert all((run / folder / CHECKPOINT).exists() for folder in TILE_FOLDERS)
    lapgs("train", scene, "-o", run, "--resume", "--processes", "2")
    assert RunArchive.open(run).manifest.complete


@pytest.mark.skipif(sys.platform == "win32", reason="uses POSIX signals")
def test_tiles_whose_command_was_killed_stop_with_checkpoints(tmp_path: Path, scene: Path, lapgs: Lapgs) -> None:
    run = tmp_path / "run"
    lapgs("train", scene, "-o", run, *OPTIONS, "--iterations", "1200", "--tiles", "1x2", "--only-base")
    with subprocess.Popen(resuming(scene, run), stderr=subprocess.DEVNULL) as parent:
        histories = [run / folder / HISTORY for folder in TILE_FOLDERS]
        wait_for(lambda: all(path.exists() and path.stat().st_size for path in histories))
        parent.kill()
    logs = [run / folder / TILE_LOG for folder in TILE_FOLDERS]
    wait_for(lambda: all("a checkpoint is in" in log.read_text() for log in logs))
    assert all((run / folder / CHECKPOINT).exists() for folder in TILE_FOLDERS)


def test_a_tile_without_views_keeps_the_base(tmp_path: Path, scene: Path, lapgs: Lapgs) -> None:
    run = tmp_path / "run"
    lapgs("train", scene, "-o", run, *OPTIONS, "--tiles", "1x2", "--only-base")
    base = RunArchive.open(run).field(1)
    values = json.loads((run / TILES).read_text())
    # Between the two outermost Gaussians of one side: the tile beyond has one of them, too small to be seen.
    places = (base.means.double() @ torch.tensor(values["across"]).double()).sort().values
    (run / TILES).write_text(json.dumps({**values, "column_cuts": [[float(places[-1] + 1.0)]]}))
    assert "tile 0,1: fewer than 2 training views" in lapgs("train", scene, "-o", run, "--resume")
    assert not (run / "tile_0_1").exists()
    assert RunArchive.open(run).manifest.complete


def test_tiles_that_no_view_sees_are_refused_before_they_are_merged(
    tmp_path: Path, scene: Path, lapgs: Lapgs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lapgs_plugin.tiles.visibility.LEAST_PIXELS", 1.1)  # as very many tiles are small
    run = tmp_path / "run"
    messages = lapgs("train", scene, "-o", run, *OPTIONS, "--tiles", "1x2", fails=True)
    assert "see each of its 1x2 tiles" in messages
    assert not RunArchive.open(run).manifest.complete


def test_bad_requests(tmp_path: Path, scene: Path, lapgs: Lapgs) -> None:
    run, other, out = tmp_path / "run", tmp_path / "other", tmp_path / "out"
    assert "--hierarchy nested" in lapgs("train", scene, "-o", out, "--tiles", "1x2", fails=True)
    assert "--levels 1" in lapgs("train", scene, "-o", out, *OPTIONS, "--levels", "1", "--tiles", "1x2", fails=True)
    tiles = ("train", scene, "-o", out, *OPTIONS, "--tiles", "1x2")
    assert "--gpus 99" in lapgs(*tiles, "--gpus", "99", fails=True)
    assert "--processes" in lapgs(*tiles, "--only-base", "--processes", "2", fails=True)
    assert "--shard with --tiles" in lapgs(*tiles, "--shard", fails=True)
    assert "--refine-poses" in lapgs(
        "train", scene, "-o", out, *OPTIONS, "--tiles", "2x1", "--refine-poses", fails=True
    )
    lapgs("train", scene, "-o", run, *OPTIONS, "--tiles", "1x2", "--only-base")
    for option in (["--shard", "--processes", "2"], ["--view"]):
        assert f"{option[0]} with {run}" in lapgs("train", scene, "-o", run, "--resume", *option, fails=True)
    tile = ("--tile", "0,1", "--base", run)
    assert "has 1x2 tiles" in lapgs("train", scene, "-o", out, "--tile", "0,2", "--base", run, fails=True)
    assert "--iterations with --tile" in lapgs("train", scene, "-o", out, *tile, "--iterations", "9", fails=True)
    assert "no run with --tiles" in lapgs("train", scene, "-o", out, "--tile", "0,1", "--base", scene, fails=True)
    make_sample_scene(other, width=64, height=48, views=10, points=300, seed=1, progress=False)
    assert "was started with the scene" in lapgs("train", other, "-o", out, *tile, fails=True)
    assert "was started with 1x2" in lapgs("train", scene, "-o", run, "--resume", "--tiles", "2x2", fails=True)
    assert not out.exists()

    # A tile of a run with other settings is not merged.
    lapgs("train", scene, "-o", tmp_path / "seed", *OPTIONS, "--seed", "1", "--tiles", "1x2", "--only-base")
    lapgs("train", scene, "-o", run / "tile_0_1", "--tile", "0,1", "--base", tmp_path / "seed")
    assert "a tile of another run" in lapgs("train", scene, "-o", run, "--resume", fails=True)
    assert not RunArchive.open(run).manifest.complete
