"""Event files, against TensorBoard's own writer and reader."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lapgs_plugin.runner.event_files import LONGEST, EventFile, checksums

pytest.importorskip("tensorboard")

from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c
from tensorboard.summary.writer.event_file_writer import EventFileWriter

LENGTHS = st.sampled_from([0, 1, 7, 60, LONGEST - 1, LONGEST, LONGEST + 1, 1000])


@given(st.lists(LENGTHS.flatmap(lambda length: st.binary(min_size=length, max_size=length)), max_size=5))
def test_checksums_are_those_of_tensorflow(texts: list[bytes]) -> None:
    assert checksums(texts) == [masked_crc32c(text) for text in texts]


def test_a_file_is_that_of_tensorboard(tmp_path: Path) -> None:
    """Byte by byte, after the event by which each begins."""
    events = [Event(step=step, wall_time=step / 7, file_version="x" * (step * 20)) for step in range(40)]
    reference = EventFileWriter(str(tmp_path))
    reference.flush()
    (path,) = tmp_path.iterdir()
    ours = tmp_path / "ours"
    ours.write_bytes(path.read_bytes())
    many = [True]
    file = EventFile(ours, "folder", lambda file: many[0])
    for event in events:
        reference.add_event(event)
        file.add_event(event)
        many[0] = event.step < 30
    reference.close()
    file.close()
    assert ours.read_bytes() == path.read_bytes()
    assert file.get_logdir() == "folder"


def test_threads_add_events(tmp_path: Path) -> None:
    path = tmp_path / "events"
    path.touch()
    file = EventFile(path, str(tmp_path), lambda file: False)

    def add(first: int) -> None:
        for step in range(first, first + 50):
            file.add_event(Event(step=step))

    threads = [threading.Thread(target=add, args=(100 * i,)) for i in range(1, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    steps = [event.step for event in EventFileLoader(str(path)).Load()]
    assert sorted(steps) == [100 * i + k for i in range(1, 5) for k in range(50)]


def test_a_file_stays_the_same_one_when_the_script_changes_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("events").touch()
    file = EventFile(Path("events"), ".", lambda file: False)
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    file.add_event(Event(step=3))
    assert [event.step for event in EventFileLoader(str(tmp_path / "events")).Load()] == [3]
    assert not Path("events").exists()


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_events_are_in_the_file_once_after_a_write_that_was_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    """By a full disk in the middle of an event, or by a signal after the last one."""
    path, gathers = tmp_path / "events", [True]
    path.touch()
    file = EventFile(path, str(tmp_path), lambda file: gathers[0])
    for step in range(3):
        file.add_event(Event(step=step, wall_time=step + 0.5))
    opened = Path.open

    def open_ending(self: Path, mode: str) -> Any:
        stream: Any = opened(self, mode, buffering=0)
        return _Ending(stream, share)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", open_ending)
        with pytest.raises(KeyboardInterrupt):
            file.flush()
    assert path.stat().st_size > 0
    file.add_event(Event(step=3))
    file.close()
    gathers[0] = False
    file.add_event(Event(step=4))
    assert [event.step for event in EventFileLoader(str(path)).Load()] == [0, 1, 2, 3, 4]


class _Ending:
    """Write a share of the first bytes, then end as after a signal."""

    def __init__(self, stream: Any, share: float) -> None:
        self._stream, self._share = stream, share

    def __enter__(self) -> _Ending:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def tell(self) -> int:
        return int(self._stream.tell())

    def write(self, content: bytes) -> None:
        self._stream.write(content[: int(len(content) * self._share)])
        raise KeyboardInterrupt
