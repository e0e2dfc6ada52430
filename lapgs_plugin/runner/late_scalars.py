"""Write numbers of a checkout's loop to TensorBoard some time after the loop logs them, without waiting for the GPU."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from numbers import Real
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lapgs_plugin.checkouts.attachment import Replacement
from lapgs_plugin.runner.event_files import EventFile
from lapgs_plugin.runner.late_numbers import LateNumber, number, read

MOST_WAITING = 300
"""Scalars that wait before all of them are written: those of about a hundred iterations of the family's loops."""

WRITER = "torch.utils.tensorboard.writer"
"""PyTorch's module of TensorBoard's writers."""
FILE_METHODS = "add_event", "flush", "close"
"""Methods of its `FileWriter` before which scalars have to be written."""


class LateScalars:
    """Make the replacements of TensorBoard's writers.

    The event files have the same events in the same order, with the times of the calls.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[Any, Callable[[], None]]] = deque()  # writers, and what gives a scalar to each
        self._unflushed: dict[EventFile, None] = {}  # in the order of their first events
        self._writing = False

    def replacements(self) -> list[Replacement]:
        """Return the replacements of PyTorch's writers; none where the script has not imported them."""
        if (module := sys.modules.get(WRITER)) is None:
            return []
        consumer = "training() in its reports"
        # All events of a `SummaryWriter` pass through its `FileWriter`, images and histograms included.
        files = [Replacement(module.FileWriter, name, self._after_scalars, consumer) for name in FILE_METHODS]
        return [
            Replacement(module, "EventFileWriter", self._event_file, consumer),
            Replacement(module.SummaryWriter, "add_scalar", self._late, consumer),
            *files,
        ]

    @contextmanager
    def written(self) -> Iterator[None]:
        """Write all scalars at the end, also after an exception."""
        try:
            yield
        except BaseException:
            # A GPU that failed has no numbers, and a full disk takes none: the first error is the one to see.
            with suppress(RuntimeError, OSError):
                self._finish()
            raise
        self._finish()

    def _event_file(self, original: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(original)
        def event_file(*args: Any, **kwargs: Any) -> Any:
            writer = original(*args, **kwargs)
            path = Path(getattr(writer, "_file_name", ""))
            if not path.is_file():  # its folder is on another machine
                return writer
            writer.close()
            return EventFile(path, writer.get_logdir(), self._gathers)

        return event_file

    def _gathers(self, file: EventFile) -> bool:
        """Return whether scalars are being written, after which this file is flushed."""
        if self._writing:
            self._unflushed[file] = None
        return self._writing

    def _late(self, original: Callable[..., None]) -> Callable[..., None]:
        @wraps(original)
        def add_scalar(
            writer: Any,
            tag: str,
            scalar_value: Any,
            global_step: Any = None,
            walltime: float | None = None,
            *args: Any,
            **kwargs: Any,
        ) -> None:
            value = scalar_value
            if isinstance(value, Tensor) and value.numel() == 1 and value.dtype is torch.float32:
                value = read(value)
            if not isinstance(value, (LateNumber, Real)):
                original(writer, tag, value, global_step, walltime, *args, **kwargs)
                return
            step = None if global_step is None else int(global_step)
            walltime = time.time() if walltime is None else walltime

            def write() -> None:
                file = None if writer.file_writer is None else writer.file_writer.event_writer
                if isinstance(file, EventFile) and not (args or kwargs):
                    file.add_scalar(tag, float(value), step or 0, walltime)
                else:
                    original(writer, tag, number(value), step, walltime, *args, **kwargs)

            self._waiting.append((writer, write))
            if len(self._waiting) >= MOST_WAITING:  # one wait: a read waits for all that the GPU was given
                self._write()

        return add_scalar

    def _after_scalars(self, original: Callable[..., None]) -> Callable[..., None]:
        @wraps(original)
        def method(*args: Any, **kwargs: Any) -> None:
            self._write()
            original(*args, **kwargs)

        return method

    def _write(self) -> None:
        if self._writing:  # by this, its own event
            return
        self._writing = True
        try:
            while self._waiting:
                _, write = self._waiting[0]
                write()
                self._waiting.popleft()  # not before its file has it: a signal may end this function
        finally:
            self._writing = False
            for file in list(self._unflushed):
                file.flush()
                self._unflushed.pop(file, None)

    def _finish(self) -> None:
        writers = {writer for writer, _ in self._waiting}
        self._write()
        for writer in writers:
            writer.flush()
