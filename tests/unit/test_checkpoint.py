"""Damaged checkpoints and optimizer states give one line and leave the run unchanged."""

from __future__ import annotations

import copy
import io
import logging
import pickle
import signal
import time
import tracemalloc
import weakref
import zipfile
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from lapgs_plugin.errors import RunFolderError, TrainingStoppedError
from lapgs_plugin.hierarchy.plan import Stage
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.runs.layout import CHECKPOINT
from lapgs_plugin.scenes.scene import Scene
from lapgs_plugin.training import between_steps
from lapgs_plugin.training.checkpoint import check_densifier
from lapgs_plugin.training.monitor import Monitor, Tick
from lapgs_plugin.training.settings import Densification, TrainSettings
from tests.training_runs import resume, train
from tests.training_scene import ring_scene

SETTINGS = TrainSettings(
    iterations=24,
    hierarchy="laplacian",
    inherit="full",
    sh_degree=1,
    sh_every=4,
    densification=Densification(start=3, until=20, every=5, reset_every=12),
    joint=0.25,
)
Saved = dict[str, Any]


class StopInTheEnd(Monitor):
    """Stop the run one iteration before the end of a level, of the finest during joint training."""

    def __init__(self, level: int = 0) -> None:
        self._level = level

    def tick(self, stage: Stage, tick: Tick) -> None:
        if (tick.level, tick.iteration) == (self._level, stage.iterations - 1):
            signal.raise_signal(signal.SIGINT)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return ring_scene()


@pytest.fixture(scope="module")
def stopped(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run that was stopped in its last stage."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    with pytest.raises(TrainingStoppedError):
        train(folder, scene, SETTINGS, monitor=StopInTheEnd())
    return folder


def put(saved: Any, value: Any, *keys: Any) -> Any:
    """Return `saved` with another value at a path of keys."""
    at = saved
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = value
    return saved


def drop(saved: Saved, *keys: Any) -> Saved:
    at = saved
    for key in keys[:-1]:
        at = at[key]
    del at[keys[-1]]
    return saved


def cut(saved: Saved, *keys: Any) -> Saved:
    """Return `saved` with one tensor that lacks its last row."""
    at = saved
    for key in keys[:-1]:
        at = at[key]
    at[keys[-1]] = at[keys[-1]][:-1].clone()
    return saved


STATE = ("state",)
COLOURS: Saved = {"transforms": torch.zeros(2, 3, 4), "gradient": None, "moments": {}}
BEST: Saved = {"psnr": 20.0, "iteration": 1, "joint": None, "appearance": COLOURS}
DAMAGE: dict[str, tuple[Callable[[Saved], Any], str]] = {
    "a list": (lambda saved: [], "holds a list, expected a dictionary"),
    "empty": (lambda saved: {}, "holds level None and a state that is a NoneType"),
    "no state": (lambda saved: {"level": 0}, "a state that is a NoneType, expected a number and a dictionary"),
    "a tensor": (lambda saved: torch.zeros(3), "holds a Tensor, expected a dictionary"),
    "level in words": (lambda saved: put(saved, "0", "level"), "holds level '0'"),
    "another level": (lambda saved: put(saved, 7, "level"), "is of level 7, expected 0"),
    "another inner level": (lambda saved: put(saved, 1, "state", "level"), "level is 1, expected 0"),
    "empty state": (lambda saved: {"level": 0, "state": {}}, "it lacks level"),
    "no counts": (lambda saved: drop(saved, "state", "counts"), "it lacks counts"),
    "no iteration": (lambda saved: drop(saved, "state", "counts", "iteration"), "it lacks counts.iteration"),
    "iteration in words": (
        lambda saved: put(saved, "9", "state", "counts", "iteration"),
        "counts.iteration is '9'",
    ),
    "iteration too large": (
        lambda saved: put(saved, 999, "state", "counts", "iteration"),
        "counts.iteration is 999, expected at most 12",
    ),
    "unknown": (lambda saved: put(saved, 1, "state", "colour"), "it has an unknown key colour"),
    "overhead": (lambda saved: put(saved, [], "state", "overhead"), "overhead is"),
    "a list as model": (lambda saved: put(saved, [], "state", "model"), "model is .., expected"),
    "no means": (lambda saved: drop(saved, "state", "model", "params", "means"), "splats without means"),
    "params cut": (lambda saved: cut(saved, "state", "model", "params", "quats"), "quaternions has shape"),
    "a moment cut": (
        lambda saved: cut(saved, "state", "model", "moments", "means", "exp_avg"),
        r"model\.moments: means\.exp_avg is float32 \(\d+, 3\), expected finite float32",
    ),
    "no moment": (lambda saved: drop(saved, "state", "model", "moments", "sh", "exp_avg_sq"), "sh has exp_avg, step"),
    "no moments": (lambda saved: drop(saved, "state", "model", "moments", "sh"), "Adam's state is of means, op"),
    "a moment in words": (
        lambda saved: put(saved, "x", "state", "model", "moments", "means", "exp_avg"),
        r"model\.moments\.means\.exp_avg is 'x'",
    ),
    "joint cut": (
        lambda saved: cut(saved, "state", "joint", 1, "moments", "opacities", "exp_avg_sq"),
        r"joint\.1\.moments: opacities\.exp_avg_sq",
    ),
    "no joint": (lambda saved: put(saved, None, "state", "joint"), r"joint has levels \[\], expected \[1\]"),
    "other joint": (
        lambda saved: put(saved, {5: saved["state"]["joint"][1]}, "state", "joint"),
        r"joint has levels \[5\], expected \[1\]",
    ),
    "doubles": (
        lambda saved: put(
            saved, saved["state"]["model"]["params"]["means"].double(), *STATE, "model", "params", "means"
        ),
        r"model\.params\.means is float64",
    ),
    "NaN": (
        lambda saved: put(saved, saved["state"]["model"]["params"]["sh"] * torch.nan, *STATE, "model", "params", "sh"),
        r"model\.params\.sh is float32 .*, expected finite",
    ),
    "unsigned": (lambda saved: put(saved, False, "state", "model", "signed"), "model is no residual of SH degree 1"),
    "colours of the best state": (
        lambda saved: put(saved, {**BEST, "model": saved["state"]["model"]}, "state", "best"),
        "best.appearance is not the state of transforms for 0 views",
    ),
    "densifier": (lambda saved: put(saved, {}, "state", "densifier"), "densifier is not the state"),
    "densifier cut": (
        lambda saved: put(saved, torch.zeros(2), "state", "densifier", "grad2d"),
        "densifier is not the state",
    ),
    "random": (lambda saved: put(saved, torch.zeros(3), "state", "random"), r"random is float32 \(3,\)"),
    "random numbers": (
        lambda saved: put(saved, torch.full_like(saved["state"]["random"], 255), "state", "random"),
        "random is no state of PyTorch's generator",
    ),
    "a view of more": (
        lambda saved: put(saved, torch.zeros(1).expand(10**12), "state", "random"),
        "names tensors of 4,0.* bytes, expected at most its own",
    ),
    "sparse": (lambda saved: put(saved, torch.eye(3).to_sparse(), "state", "random"), "expected dense ones"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_checkpoint_is_one_line(name: str, stopped: Path, scene: Scene) -> None:
    path = stopped / CHECKPOINT
    whole = path.read_bytes()
    make, message = DAMAGE[name]
    try:
        torch.save(make(copy.deepcopy(torch.load(path, weights_only=True))), path)
        damaged = path.read_bytes()
        history = (stopped / "history.jsonl").read_bytes()
        with pytest.raises(RunFolderError, match=message) as caught:
            resume(stopped, scene, SETTINGS)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)
        assert "delete it to continue from the last finished level" in str(caught.value)
        assert (path.read_bytes(), (stopped / "history.jsonl").read_bytes()) == (damaged, history)
    finally:
        path.write_bytes(whole)


def test_density_control_keeps_any_rows_of_gaussians() -> None:
    """A strategy of another package has columns, whole numbers, and sums that begin later than others."""
    fresh = {"sums": None, "later": None, "views": 0}
    kept = {"sums": torch.zeros(5, 2), "later": None, "views": 3}
    check_densifier(kept, fresh, 5, Path("checkpoint.pt"))
    check_densifier({**kept, "later": torch.zeros(5, dtype=torch.int64)}, fresh, 5, Path("checkpoint.pt"))
    for damaged in (torch.zeros(4, 2), torch.zeros(()), torch.full((5,), torch.nan), 0.5):
        with pytest.raises(RunFolderError, match=r"densifier is not the state .* for 5 Gaussians"):
            check_densifier({**kept, "sums": damaged}, fresh, 5, Path("checkpoint.pt"))


def test_a_checkpoint_of_a_finished_level_is_reported(
    stopped: Path, scene: Scene, caplog: pytest.LogCaptureFixture
) -> None:
    path = stopped / CHECKPOINT
    whole = path.read_bytes()
    try:
        torch.save({**torch.load(path, weights_only=True), "level": 1}, path)
        with caplog.at_level(logging.WARNING), RunArchive.open(stopped, resume=True) as archive:
            assert archive.load_checkpoint() is None
        assert "is of level 1, which is finished: it is not used" in caplog.text
    finally:
        path.write_bytes(whole)


def bomb() -> bytes:
    """Return a zip file with contents a thousand times as large."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("checkpoint/data.pkl", pickle.dumps({"level": 0}))
        archive.writestr("checkpoint/data/0", bytes(200 * 2**20))
    return stream.getvalue()


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (bomb, "unpacks to 209,7.* bytes, expected no more than its own"),
        (lambda: pickle.dumps({"level": 0}), "is not a zip file"),
        (lambda: b"", "is not a zip file"),
    ],
)
def test_files_that_torch_did_not_write(
    contents: Callable[[], bytes], message: str, stopped: Path, scene: Scene
) -> None:
    path = stopped / CHECKPOINT
    whole = path.read_bytes()
    try:
        path.write_bytes(contents())
        tracemalloc.start()
        with pytest.raises(RunFolderError, match=rf"checkpoint\.pt cannot be read \(.*{message}.*; delete it"):
            resume(stopped, scene, SETTINGS)
        assert tracemalloc.get_traced_memory()[1] < 10 * 2**20  # 0.3 MiB seen
    finally:
        tracemalloc.stop()
        path.write_bytes(whole)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda saved: [], "holds a list"),
        (lambda saved: {}, "Adam's state is of , expected"),
        (lambda saved: cut(saved, "quats", "exp_avg"), r"quats\.exp_avg is float32 \(\d+, 4\), expected"),
        (lambda saved: put(saved, 1, "sh"), "sh is 1, expected"),
    ],
)
def test_a_damaged_optimizer_state_is_one_line(
    make: Callable[[Saved], Any], message: str, stopped: Path, scene: Scene
) -> None:
    checkpoint, path = stopped / CHECKPOINT, stopped / "level_1" / "optimizer.pt"
    kept = checkpoint.read_bytes(), path.read_bytes()
    try:
        checkpoint.unlink()
        torch.save(make(torch.load(path, weights_only=True)), path)
        with pytest.raises(RunFolderError, match=message) as caught:
            resume(stopped, scene, SETTINGS)
        assert "start again with --overwrite" in str(caught.value)
    finally:
        checkpoint.write_bytes(kept[0])
        path.write_bytes(kept[1])


@pytest.mark.parametrize("level", [1, 0])
def test_a_base_with_fewer_harmonics_is_resumed(level: int, scene: Scene, tmp_path: Path) -> None:
    """In its own stage, and in that of the residual, which trains it jointly."""
    settings = replace(SETTINGS, inherit="geometry", base_sh_degree=0)
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "run", scene, settings, monitor=StopInTheEnd(level))
    archive = resume(tmp_path / "run", scene, settings)
    assert [archive.field(each).sh_degree for each in (1, 0)] == [0, 1]


def test_the_checkpoint_itself_is_fine(stopped: Path, scene: Scene) -> None:
    """Last in this file, because the run ends."""
    resume(stopped, scene, SETTINGS)
    assert RunArchive.open(stopped).manifest.complete


@pytest.mark.parametrize(("seconds", "between"), [(0.0, 60), (2.0, 60), (5.0, 100)])
def test_checkpoints_take_a_twentieth_of_the_time_at_most(
    seconds: float, between: int, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, saved = [time.monotonic()], []

    def step() -> float:
        now[0] += 0.5
        return now[0]

    def save(archive: RunArchive, state: Saved, extends_to: int | None = None) -> None:
        now[0] += seconds
        saved.append(now[0])

    monkeypatch.setattr(between_steps, "time", SimpleNamespace(monotonic=step))
    monkeypatch.setattr(RunArchive, "save_checkpoint", save)
    train(tmp_path / "run", scene, TrainSettings(iterations=900, levels=1, sh_degree=0, densification=Densification()))
    pauses = [later - earlier - seconds for earlier, later in pairwise(saved)]
    assert pauses
    assert all(between <= pause <= between + 15 for pause in pauses)


@pytest.mark.parametrize("level", [1, 0])
def test_a_continued_stage_does_not_hold_its_checkpoint_in_memory(
    level: int, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "run", scene, SETTINGS, monitor=StopInTheEnd(level))
    load, loaded, held = RunArchive.load_checkpoint, list[weakref.ref[torch.Tensor]](), list[bool]()

    def watched(archive: RunArchive) -> Saved | None:
        state = load(archive)
        assert state is not None
        models = [state["model"], *(state["joint"] or {}).values()]
        loaded.extend(weakref.ref(tensor) for model in models for tensor in model["params"].values())
        loaded.extend(
            weakref.ref(part) for model in models for each in model["moments"].values() for part in each.values()
        )
        return state

    class Looks(Monitor):
        def tick(self, stage: Stage, tick: Tick) -> None:
            held.append(any(tensor() is not None for tensor in loaded))

    monkeypatch.setattr(RunArchive, "load_checkpoint", watched)
    resume(tmp_path / "run", scene, SETTINGS, monitor=Looks())
    assert len(loaded) >= 10
    assert held
    assert not any(held)


def test_predictions_that_joint_training_renders_are_not_cached_when_it_continues(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(TrainingStoppedError):
        train(tmp_path / "run", scene, SETTINGS, monitor=StopInTheEnd(0))
    checkpoint = RunArchive.open(tmp_path / "run").load_checkpoint()
    assert checkpoint is not None
    assert checkpoint["joint"] is not None
    record = resume(tmp_path / "run", scene, SETTINGS).manifest.record(0)
    assert record.overhead_seconds["cache"] == checkpoint["overhead"]["cache"] > 0.0
