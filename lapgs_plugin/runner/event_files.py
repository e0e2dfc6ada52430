"""Write event files of TensorBoard from the thread that logs, many events at once."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

LONGEST = 256
"""Bytes of an event whose checksum is computed beside those of others; scalars have about 60."""


class _Pending(NamedTuple):
    """Hold events that are not in the file yet, and the size of the file without them."""

    start: int
    events: list[bytes]


class EventFile:
    """Write events to an event file.

    It takes the place of TensorBoard's `EventFileWriter`, which hands each event to a thread that opens the file for
    it. That takes Python's lock from a training loop for longer than all else that the loop logs.

    Args:
        path: of the file, with the event by which it begins.
        folder: of the file, as the script named it.
        gathers: called with this object after each event; returns whether a call of `flush` follows.
    """

    def __init__(self, path: Path, folder: str, gathers: Callable[[EventFile], bool]) -> None:
        self._path, self._folder, self._gathers = path.absolute(), folder, gathers  # the script may change its folder
        self._pending = _Pending(path.stat().st_size, [])
        self._scalars: dict[str, tuple[Any, Any]] = {}  # by tag an event, and the value in it
        self._lock = threading.Lock()  # scripts may log in several threads

    def get_logdir(self) -> str:
        """Return the folder of the file."""
        return self._folder

    def add_event(self, event: Any) -> None:
        """Add an event."""
        with self._lock:
            self._pending.events.append(event.SerializeToString())
        if not self._gathers(self):
            self.flush()

    def add_scalar(self, tag: str, number: float, step: int, walltime: float) -> None:
        """Add the event that a `SummaryWriter` makes of a number."""
        event, value = self._scalars.get(tag) or self._add_tag(tag)
        event.step, event.wall_time, value.simple_value = step, walltime, number
        self.add_event(event)

    def _add_tag(self, tag: str) -> tuple[Any, Any]:
        from tensorboard.compat.proto.event_pb2 import Event
        from torch.utils.tensorboard.summary import scalar

        event = Event(summary=scalar(tag, 0.0))  # type: ignore[no-untyped-call]
        self._scalars[tag] = event, event.summary.value[0]
        return self._scalars[tag]

    def flush(self) -> None:
        """Write all events to the file."""
        with self._lock:
            start, events = self._pending
            if not events:
                return
            records = b"".join(map(_record, events, checksums(events)))
            with self._path.open("ab") as file:
                if file.tell() > start:  # a signal or a full disk ended this function, which wrote some of them
                    file.truncate(start)
                file.write(records)
            self._pending = _Pending(start + len(records), [])

    close = flush


def _record(event: bytes, checksum: int) -> bytes:
    """Return an event as it is in the file: its length, the checksum of that, the event, its checksum."""
    return b"".join((_header(len(event)), event, struct.pack("<I", checksum)))


@cache
def _header(length: int) -> bytes:
    header = struct.pack("<Q", length)
    return header + struct.pack("<I", *checksums([header]))


def checksums(texts: Sequence[bytes]) -> list[int]:
    """Return TensorFlow's masked CRC-32C of each text.

    A checksum is linear: it is the sum (modulo 2) of one for each byte at its distance from the end, and of one for the
    length. So those of many short texts are a few operations on arrays.
    """
    from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c

    short = [text for text in texts if len(text) <= LONGEST]
    computed = iter(_checksums_of_short(short))
    return [next(computed) if len(text) <= LONGEST else masked_crc32c(text) for text in texts]


def _checksums_of_short(texts: Sequence[bytes]) -> list[int]:
    if not texts:
        return []
    by_byte, by_length = _tables()
    lengths = [len(text) for text in texts]
    longest = max(lengths)
    # A zero before a text changes no sum.
    codes = np.frombuffer(b"".join(text.rjust(longest, b"\0") for text in texts), np.uint8).reshape(len(texts), longest)
    sums: NDArray[np.uint32] = np.bitwise_xor.reduce(by_byte[np.arange(longest)[::-1], codes], 1) ^ by_length[lengths]
    rotated = sums >> np.uint32(15) | sums << np.uint32(17)
    masked: list[int] = (rotated + np.uint32(0xA282EAD8)).tolist()
    return masked


@cache
def _tables() -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the sums of bytes by distance from the end and value, (`LONGEST`, 256), and of lengths from 0."""
    values: NDArray[np.uint32] = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        values = values >> np.uint32(1) ^ (values & np.uint32(1)) * np.uint32(0x82F63B78)
    by_byte, by_length = [values], [np.uint32(0xFFFFFFFF)]
    for _ in range(LONGEST):
        by_byte.append(by_byte[0][by_byte[-1] & 0xFF] ^ (by_byte[-1] >> 8))
        by_length.append(values[by_length[-1] & 0xFF] ^ (by_length[-1] >> np.uint32(8)))
    return np.stack(by_byte[:LONGEST]), ~np.stack(by_length)
