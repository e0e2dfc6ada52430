"""Runs on several ranks, on gloo: the same bits as in one process, and one line whatever happens to a rank."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lapgs_plugin.cli.app import app
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CACHE, CHECKPOINT, HISTORY
from lapgs_plugin.scenes.options import SceneOptions
from lapgs_plugin.training.model import TrainableField
from lapgs_plugin.training.preparation import TrainRequest, prepare
from lapgs_plugin.training.ranks.equality import digest, require_same, source_checksum
from lapgs_plugin.training.ranks.group import ALONE, Ranks
from lapgs_plugin.training.ranks.shards import epoch_order, tree_sum
from lapgs_plugin.training.ranks.steps import SharedSteps
from lapgs_plugin.training.settings import Densification, TrainSettings
from lapgs_plugin.training.strategies import Gradients
from lapgs_plugin.training.trainer import Trainer
from tests import ranks
from tests.bent_scene import write_model
from tests.cli.commands import succeeding
from tests.cli.run_folder import write_run, write_scene
from tests.folders import snapshot
from tests.refusals import refuses
from tests.training_runs import plys
from tests.training_scene import blob_field, ring_camera
from tests.waiting import wait_for

pytestmark = pytest.mark.skipif(not torch.distributed.is_gloo_available(), reason="needs PyTorch with gloo")

TIMEOUT = 600.0
"""Seconds until a command counts as stuck; a busy machine takes a hundred times as long as an idle one."""
OPTIONS: Sequence[object] = (
    *("--iterations", 320, "--levels", 2, "--strategy", "3dgs", "--densify-every", 20, "--sh-degree", 1, "--eval"),
    *("--views-per-step", 4, "--checkpoint-every", 40, "--appearance", "bilateral", "--keep", "best"),
)
Pair = tuple[Path, list["subprocess.Popen[str]"], list[str]]
SETTINGS = TrainSettings(
    iterations=320,
    levels=2,
    sh_degree=1,
    views_per_step="4",
    appearance="bilateral",
    keep="best",
    densification=Densification(strategy="3dgs", options=Gradients(), every=20),
    ranks=2,
)
"""What `OPTIONS` asks of two ranks."""


def figures(archive: RunArchive) -> list[dict[str, Any]]:
    """The history without times."""
    return [
        {name: value for name, value in entry.items() if name not in ("elapsed", "rate")} for entry in archive.history()
    ]


def command(*words: object) -> subprocess.Popen[str]:
    """Start `lapgs` with some arguments."""
    return subprocess.Popen(
        [sys.executable, "-m", "lapgs_plugin", *map(str, words)],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def errors(output: str) -> list[str]:
    """Lines of an output that tell of an end before the time."""
    words = ("lapgs:", "Error", "Traceback", "death signal", "failed", "Warning")
    return [line for line in output.splitlines() if any(word in line for word in words)]


def children(process: subprocess.Popen[str]) -> list[int]:
    """Process ids of the ranks of a command, the last one last."""
    listed = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text(encoding="ascii")
    return sorted(map(int, listed.split()))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"), [f"{number:02d}.png" for number in range(16)])


@pytest.fixture(scope="module")
def whole(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """Fields of the run that one process trains as two ranks would."""
    out = tmp_path_factory.mktemp("whole") / "run"
    request = TrainRequest(scene, out, SETTINGS, SceneOptions(eval=True))
    with prepare(request) as run:
        Trainer(run).run()
    return plys(RunArchive.open(out))


@pytest.fixture(scope="module")
def pair(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Pair:
    """Two ranks of `tests.ranks`, at last of different runs: their folder, processes and outputs."""
    folder = tmp_path_factory.mktemp("two")
    words = [folder, "train", scene, "-o", folder / "run", *OPTIONS]
    started = ranks.start("tests.ranks", [words, [*words, "--seed", 7]])
    return folder, started, [process.communicate(timeout=TIMEOUT)[0] for process in started]


def test_two_ranks_train_to_the_bits_of_one_process(pair: Pair, tmp_path: Path) -> None:
    folder, _, outputs = pair
    for name in ranks.CASES:
        ranks.train(tmp_path / name, name, ALONE)
        assert (folder / name).is_dir(), outputs
        one, two = RunArchive.open(tmp_path / name), RunArchive.open(folder / name)
        assert plys(one) == plys(two), name
        assert figures(one) == figures(two), name


def test_ranks_whose_fields_differ_do_not_go_on(pair: Pair) -> None:
    folder, _, outputs = pair
    for output in outputs:
        assert "level 0, iteration 0: the field of rank 1 is not that of rank 0" in output
    assert RunArchive.open(folder / ranks.DIFFERENT).available_levels == ()


def test_ranks_of_different_runs_are_refused_by_rank_0_alone(
    pair: Pair,
) -> None:
    folder, started, (first, second) = pair
    assert [process.returncode for process in started] == [2, 2]
    (line,) = errors(first)
    assert "rank 1 has other settings than rank 0 (seed: 7 and 0)" in line
    assert errors(second) == []
    assert not (folder / "run").exists()


@pytest.mark.parametrize(
    ("words", "facts"),
    [
        (["missing"], "rank 1 of 2: missing: no such scene folder"),
        (["SCENE", "--background", "white"], "rank 1 has other options than rank 0 (background: white and black)"),
    ],
)
def test_why_one_rank_cannot_go_on_is_said_by_rank_0_alone(
    words: list[str], facts: str, scene: Path, tmp_path: Path
) -> None:
    own = [str(scene) if word == "SCENE" else word for word in words]
    out = ["-o", tmp_path / "run", *OPTIONS]
    started = ranks.start("lapgs_plugin", [["train", scene, *out], ["train", *own, *out]])
    first, second = (process.communicate(timeout=TIMEOUT)[0] for process in started)
    assert [process.returncode for process in started] == [2, 2]
    (line,) = errors(first)
    assert facts in line
    assert errors(second) == []
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_a_rank_that_is_stopped_says_nothing(scene: Path, tmp_path: Path) -> None:
    """torchrun's agent stops the other ranks when one has failed."""
    started = ranks.start("lapgs_plugin", [["help"], ["train", scene, "-o", tmp_path / "run"]])
    waits = Path(f"/proc/{started[1].pid}/status")
    wait_for(lambda: bool(int(waits.read_text().split("SigCgt:")[1].split()[0], 16) >> (signal.SIGTERM - 1) & 1))
    started[1].send_signal(signal.SIGTERM)
    assert started[1].communicate(timeout=TIMEOUT)[0] == ""
    assert started[1].returncode == 143
    assert started[0].communicate(timeout=TIMEOUT)[0]


class TwoThatSay(Ranks):
    """Two ranks that have what they are given."""

    size = 2

    def __init__(self, theirs: dict[str, Any]) -> None:
        self.theirs = theirs

    def gathered(self, value: Any) -> list[Any]:
        return [value, self.theirs]


@pytest.mark.parametrize(
    ("theirs", "facts"),
    [
        ({"settings": {"seed": 0, "rates": {"sh": 0.1}, "of": [1]}}, r"other settings than rank 0 \(sh: 0.1 and 0.2\)"),
        ({"settings": {"seed": 0, "rates": None, "of": [1]}}, r"\(rates: None and {'sh': 0.2}\)"),
        ({"settings": {"seed": 0, "rates": {"sh": 0.2}, "of": [2]}}, r"\(of: 2 and 1\)"),
        ({"settings": {"seed": 0, "rates": {"sh": 0.2}, "of": None}}, r"\(of: None and \[1\]\)"),
        ({"settings": {"seed": 0, "rates": {"sh": 0.2}, "of": [1], "new": 3}}, r"\(new: 3 and None\)"),
    ],
)
def test_the_value_that_differs_is_named(theirs: dict[str, Any], facts: str) -> None:
    ours = {"settings": {"seed": 0, "rates": {"sh": 0.2}, "of": [1]}}
    require_same(TwoThatSay(ours), ours)
    with pytest.raises(UserInputError, match=facts):
        require_same(TwoThatSay(theirs), ours)


def test_a_checksum_tells_versions_apart(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    file = tmp_path / "inner" / "a.py"
    checksums = set()
    for text in ("", "1", "2"):
        file.write_text(text)
        checksums |= {source_checksum(tmp_path)}
    file.rename(tmp_path / "b.py")
    checksums |= {source_checksum(tmp_path)}
    assert len(checksums) == 4
    (tmp_path / "b.pyc").write_text("compiled")
    assert source_checksum(tmp_path) in checksums


def stopped_on_two(scene: Path, out: Path) -> None:
    """Start a run on two ranks, and stop it by SIGTERM; checks its line."""
    on_two = command("train", scene, "-o", out, *OPTIONS, "--processes", 2)
    wait_for(lambda: on_two.poll() is not None or (out / HISTORY).exists(), TIMEOUT)
    on_two.send_signal(signal.SIGTERM)
    output, _ = on_two.communicate(timeout=TIMEOUT)
    assert on_two.returncode == 143, output
    (line,) = errors(output)
    assert "a checkpoint is in" in line


def test_a_run_that_is_stopped_continues_in_one_process_to_the_same_bits(
    scene: Path, whole: list[bytes], tmp_path: Path
) -> None:
    out = tmp_path / "run"
    stopped_on_two(scene, out)
    with prepare(TrainRequest(scene, out, SETTINGS, SceneOptions(eval=True), resume=True)) as run:
        Trainer(run).run()
    assert plys(RunArchive.open(out)) == whole


@pytest.mark.slow
def test_a_rank_that_is_killed_ends_a_continued_run_which_continues_on_fewer(
    scene: Path, whole: list[bytes], tmp_path: Path
) -> None:
    out = tmp_path / "run"
    stopped_on_two(scene, out)
    words = ["train", scene, "-o", out, *OPTIONS, "--resume"]
    (out / CACHE / "rank_5").mkdir(parents=True)  # as of a run on more ranks that was killed

    written = (out / CHECKPOINT).stat().st_mtime_ns
    on_four = command(*words, "--processes", 4)
    wait_for(lambda: on_four.poll() is not None or (out / CHECKPOINT).stat().st_mtime_ns > written, TIMEOUT)
    assert not (out / CACHE).exists()
    os.kill(children(on_four)[-1], signal.SIGKILL)
    began = time.monotonic()
    output, _ = on_four.communicate(timeout=TIMEOUT)
    assert time.monotonic() - began < 30.0
    assert on_four.returncode == 1, output
    (line,) = errors(output)
    assert "rank 3 of 4" in line
    assert "SIGKILL" in line
    assert "--resume" in line

    on_one = command(*words)
    output, _ = on_one.communicate(timeout=TIMEOUT)
    assert on_one.returncode == 0, output
    assert plys(RunArchive.open(out)) == whole


@pytest.mark.parametrize(("where", "photo"), [("disk", "01.png"), ("memory", "02.png")])  # of rank 0, of rank 1
def test_a_photo_that_one_rank_cannot_read_is_named_under_torchrun_and_replaces_no_run(
    where: str, photo: str, tmp_path: Path
) -> None:
    scene = write_scene(tmp_path / "scene", [f"{number:02d}.png" for number in range(16)])
    (damaged,) = scene.rglob(photo)
    run = write_run(tmp_path / "run", scene)
    before = snapshot(run)
    damaged.write_bytes(damaged.read_bytes()[:-40])
    words = ["train", scene, "-o", run, *OPTIONS, "--images-on", where, "--overwrite"]
    ended = subprocess.run(
        [
            *(sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"),
            *("-m", "lapgs_plugin", *map(str, words)),
        ],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=TIMEOUT,
    )
    assert ended.returncode == 1
    (line,) = (line for line in ended.stdout.splitlines() if line.startswith("lapgs:"))
    assert damaged.name in line
    assert "damaged or cut short" in line
    assert snapshot(run) == before


@pytest.mark.slow
def test_ranks_whose_command_is_killed_leave_a_checkpoint_and_end(
    scene: Path, whole: list[bytes], tmp_path: Path
) -> None:
    out = tmp_path / "run"
    on_two = command("train", scene, "-o", out, *OPTIONS, "--processes", 2)
    wait_for(lambda: on_two.poll() is not None or (out / HISTORY).exists(), TIMEOUT)
    on_two.kill()
    began = time.monotonic()
    on_two.communicate(timeout=TIMEOUT)  # to the end of the ranks, which have its output
    assert time.monotonic() - began < 30.0
    assert (out / CHECKPOINT).exists()
    on_one = command("train", scene, "-o", out, *OPTIONS, "--resume")
    output, _ = on_one.communicate(timeout=TIMEOUT)
    assert on_one.returncode == 0, output
    assert plys(RunArchive.open(out)) == whole


@pytest.mark.slow
def test_more_ranks_than_photos_are_refused_in_one_line(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", [f"{number}.png" for number in range(2)])
    three = ranks.start("lapgs_plugin", [["train", scene, "-o", tmp_path / "run", "--iterations", 20]] * 3)
    outputs = [process.communicate(timeout=TIMEOUT)[0] for process in three]
    assert [process.returncode for process in three] == [2, 2, 2]
    (line,) = errors("".join(outputs))
    assert "3 ranks: the scene has 2 training photos" in line


@pytest.mark.parametrize(
    ("words", "facts"),
    [
        (["--gpus", 2, "--rasterizer", "cpu"], "--gpus 2 with --rasterizer cpu: that trains on a CPU"),
        (["--gpus", 2, "--processes", 2], "--gpus 2 with --processes 2: give one of them"),
        (["--processes", 17], "--processes 17: the scene has 16 photos, and each rank needs one to train on"),
        (["--processes", 3, "--views-per-step", 2], "--processes 3: a step of this run has 2 views, fewer than ranks"),
        (["--processes", 2, "--stop", "auto"], "--processes 2 with --stop auto: ends runs of one process alone"),
        pytest.param(
            ["--gpus", 2],
            "--gpus 2: this machine has no CUDA devices",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU"),
        ),
    ],
)
def test_options_that_cannot_be_had_are_refused(words: Sequence[object], facts: str, scene: Path) -> None:
    refuses(UserInputError, facts, succeeding(app, 200), "train", scene, "-o", scene / "run", *words)


def test_ranks_are_no_more_than_images_of_a_model(tmp_path: Path) -> None:
    write_model(tmp_path, [ring_camera(angle, 56, 40) for angle in (0.0, 0.1, 0.2)], "PINHOLE", ())
    facts = "--processes 4: the scene has 3 photos"
    refuses(UserInputError, facts, succeeding(app, 200), "train", tmp_path, "-o", tmp_path / "run", "--processes", 4)


@given(st.integers(1, 40), st.integers(1, 16), st.integers(0, 5))
def test_an_epoch_has_every_view_once_and_shards_in_turn(count: int, shards: int, epoch: int) -> None:
    order = epoch_order(count, 0, 0, epoch, shards)
    assert sorted(order) == list(range(count))
    assert [view % shards for view in order] == [position % shards for position in range(count)]


@given(st.integers(1, 40), st.integers(0, 20))
def test_what_is_due_every_second_time_is_due_for_all_views_and_for_all_ranks_alike(count: int, start: int) -> None:
    steps = SharedSteps(count, 0, 0, 8, ALONE, exact=True)
    due = [i for i in range(start * count + 1, (start + 40) * count + 1) if steps.turn(i) % 2 == 0]
    assert {steps.view(iteration) for iteration in due} == set(range(count))
    for ranks_now in (2, 4):
        for first in range(1, count - 6, 8):
            numbers = [steps.view(i) % 8 % ranks_now for i in range(first, first + 8) if steps.turn(i) % 2 == 0]
            assert sorted(numbers) == sorted([*range(ranks_now)] * (4 // ranks_now))


@pytest.mark.parametrize("count", [0, 5])
def test_fields_have_equal_digests_if_all_their_bits_are_equal(count: int) -> None:
    fields = [TrainableField.create(blob_field(count), SETTINGS.rates, 1.0) for _ in range(2)]
    one, other = (digest([field]) for field in fields)
    assert one == other
    for param in fields[1].params.values() if count else ():
        with torch.no_grad():
            last = param.view(-1)[-1:]
            before = last.clone()
            last.copy_(torch.nextafter(before, before + 1))
            assert digest([fields[1]]) != one
            last.copy_(before)


@pytest.mark.parametrize("size", [1, 2, 4, 8])
def test_sums_of_shards_do_not_depend_on_the_number_of_ranks(size: int) -> None:
    values = torch.randn(8, 1000, generator=torch.Generator().manual_seed(0))

    def total(owned: list[int]) -> torch.Tensor:
        sums = tree_sum([[values[shard].clone()] for shard in owned])
        assert sums is not None
        return sums[0]

    of_ranks = [[total(list(range(rank, 8, size)))] for rank in range(size)]
    together = tree_sum(of_ranks)
    assert together is not None
    assert torch.equal(together[0], total(list(range(8))))
