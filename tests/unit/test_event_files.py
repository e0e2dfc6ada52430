"""Event files, against TensorBoard's own writer and reader."""

from __future__ import annotations

import threading
from pathlib import Path

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
    file = EventFile(ours, "folder", lambda: many[0])
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
    file = EventFile(path, str(tmp_path), lambda: False)

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
