"""Numbers that a loop logs for TensorBoard, written late, against PyTorch's writer as it is."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from lapgs_plugin.checkouts.attachment import Attachment
from lapgs_plugin.runner import late_scalars
from lapgs_plugin.runner.event_files import EventFile
from lapgs_plugin.runner.late_numbers import LateNumber
from lapgs_plugin.runner.late_scalars import LateScalars

pytest.importorskip("tensorboard")

from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from torch.utils.tensorboard.writer import SummaryWriter


@contextmanager
def late() -> Iterator[None]:
    scalars = LateScalars()
    with Attachment(scalars.replacements()), scalars.written():
        yield


def events_of(folder: Path) -> list[list[Any]]:
    """Return the events of each file of a folder, without the one by which a file begins."""
    return [list(EventFileLoader(str(file)).Load())[1:] for file in sorted(folder.glob("events.*"))]


def losses_of(folder: Path) -> list[tuple[int, float]]:
    """Return the steps and values of a folder's one file."""
    (events,) = events_of(folder)
    return [(event.step, event.summary.value[0].tensor.float_val[0]) for event in events]


def log(folder: Path, number: Callable[[float], Any]) -> None:
    """Log numbers, tensors and a histogram, with and without steps and times."""
    writer, changing = SummaryWriter(str(folder)), torch.zeros(1)
    for step in range(250):
        changing += 1.0 / 3.0
        writer.add_scalar("number", number(step / 7), step, walltime=1000.0 + step)
        writer.add_scalar("tensor", changing, torch.tensor(step))
        writer.add_scalar("integer", scalar_value=step, global_step=step, new_style=True)
        if step % 60 == 59:
            writer.add_histogram("histogram", torch.arange(3.0), step)
            writer.add_scalar("half", changing.bfloat16())
            writer.add_image("image", torch.rand(3, 20, 30, generator=torch.Generator().manual_seed(step)), step)
            if step > 100:
                writer.flush()
    writer.close()
    writer.add_scalar("another", number(0.5), 1)
    writer.close()


def test_files_have_the_same(tmp_path: Path) -> None:
    log(tmp_path / "plain", float)
    with late():
        log(tmp_path / "late", lambda value: LateNumber(lambda: value))
    contents = [
        [
            [(event.step, event.summary, event.wall_time < 2000 and event.wall_time) for event in events]
            for events in events_of(tmp_path / name)
        ]
        for name in ("plain", "late")
    ]
    assert [len(events) for events in contents[0]] == [250 * 3 + 4 * 3, 1]
    assert contents[0] == contents[1]


def test_files_grow_with_their_events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that TensorBoard shows a run that goes on, and little is missing of one that is killed."""
    monkeypatch.setattr(late_scalars, "MOST_WAITING", 10)
    with late():
        writer = SummaryWriter(str(tmp_path))
        for step in range(25):
            writer.add_scalar("loss", 0.5, step)
            assert len(losses_of(tmp_path)) == (step + 1) // 10 * 10
        writer.add_text("text", "of the script")
        (events,) = events_of(tmp_path)
        assert [event.summary.value[0].tag for event in events[-2:]] == ["loss", "text/text_summary"]
        assert len(events) == 26
    writer.add_scalar("loss", 0.5, 25)  # after training
    assert len(events_of(tmp_path)[0]) == 27


def test_closed_files_are_forgotten(tmp_path: Path) -> None:
    """So that a script that opens a writer again and again does not take more and more memory."""

    def open_files() -> int:
        gc.collect()
        return sum(isinstance(held, EventFile) for held in gc.get_objects())

    before = open_files()
    with late():
        for turn in range(3):
            writer = SummaryWriter(str(tmp_path / str(turn)))
            writer.add_scalar("loss", LateNumber(lambda: 0.5), turn)
            assert open_files() == before + 1
            writer.close()
            assert open_files() == before
    assert [losses_of(tmp_path / str(turn)) for turn in range(3)] == [[(turn, 0.5)] for turn in range(3)]


def test_a_writer_that_is_dropped_loses_nothing(tmp_path: Path) -> None:
    with late():
        SummaryWriter(str(tmp_path)).add_scalar("loss", LateNumber(lambda: 0.5), 1)
        gc.collect()
    assert losses_of(tmp_path) == [(1, 0.5)]


def test_a_writer_from_before_training(tmp_path: Path) -> None:
    writer = SummaryWriter(str(tmp_path))
    writer.add_scalar("loss", 0.5, 0)
    with late():
        writer.add_scalar("loss", LateNumber(lambda: 1.5), 1)
        writer.add_histogram("histogram", torch.arange(3.0), 2)
        writer.add_scalar("loss", 2.5, 3)
    writer.add_scalar("loss", 3.5, 4)
    writer.close()
    (events,) = events_of(tmp_path)
    assert [event.step for event in events] == list(range(5))


def test_a_folder_of_another_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Has files that only TensorBoard's own writer can write."""
    monkeypatch.setattr(Path, "is_file", lambda path: False)
    with late():
        writer = SummaryWriter(str(tmp_path))
        for step in range(3):
            writer.add_scalar("loss", LateNumber(lambda: 0.5), step)
        writer.close()
    assert losses_of(tmp_path) == [(step, 0.5) for step in range(3)]


def test_nothing_is_read_before_many_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(late_scalars, "MOST_WAITING", 10)
    read, times = list[int](), list[float]()

    def loss(step: int) -> Any:
        return LateNumber(lambda: float(read.append(step) or step))  # type: ignore[func-returns-value]

    with late():
        writer = SummaryWriter(str(tmp_path))
        for step in range(25):
            times.append(time.time())
            writer.add_scalar("loss", loss(step), step)
            assert read == list(range((step + 1) // 10 * 10))
        writer.flush()
        assert read == list(range(25))
        times.append(time.time())
        writer.add_scalar("loss", loss(25), 25)
        times.append(time.time())
    assert losses_of(tmp_path) == [(step, float(step)) for step in range(26)]
    (events,) = events_of(tmp_path)
    assert all(times[i] <= event.wall_time <= times[i + 1] for i, event in enumerate(events))


def log_and_raise(folders: Sequence[Path], number: Callable[[], float], error: BaseException) -> None:
    """Log five numbers in each folder, close nothing, and raise an error."""
    with late():
        writers = [SummaryWriter(str(folder)) for folder in folders]
        for step in range(5):
            for writer in writers:
                writer.add_scalar("loss", LateNumber(number), step)
        raise error


@pytest.mark.parametrize("error", [ValueError(), KeyboardInterrupt()])
def test_nothing_is_lost(tmp_path: Path, error: BaseException) -> None:
    folders = tmp_path / "a", tmp_path / "b"
    add_scalar = SummaryWriter.add_scalar
    with pytest.raises(type(error)):
        log_and_raise(folders, lambda: 0.5, error)
    assert SummaryWriter.add_scalar is add_scalar
    for folder in folders:
        assert losses_of(folder) == [(step, 0.5) for step in range(5)]


def test_an_error_of_the_gpu_is_seen(tmp_path: Path) -> None:
    """And not the one of reading numbers after it."""

    def fail() -> float:
        raise RuntimeError("CUDA error: the second")

    with pytest.raises(RuntimeError, match="the first"):
        log_and_raise([tmp_path], fail, RuntimeError("CUDA error: the first"))


def test_the_first_error_is_seen_where_the_file_takes_no_more(tmp_path: Path) -> None:
    def interrupted() -> None:
        with late():
            SummaryWriter(str(tmp_path)).add_scalar("loss", 1.0, 1)
            (file,) = tmp_path.iterdir()
            file.unlink()
            file.mkdir()  # cannot be written to
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
