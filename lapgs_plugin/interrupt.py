"""Ending on Ctrl-C and SIGTERM: one line, exit code 130 or 143, nothing half written.

`install` is called once, when the process starts. It is imported before anything heavy, so it imports little. What a
signal does from then on depends on what the main thread is doing:

- Outside of a command (imports, parsing, the end of the process) there is nothing to clean up: the process writes its
  line and ends at once.
- In a command, `Interrupted` is raised, so that temporary files and child processes are cleaned up. It is never raised
  while something is being imported, because it would pass through C++ frames that abort the process: a long import ends
  the process at once, a short one is waited for.
- In training, `stop_request` turns the first signal into a request that is honoured after the current iteration.

A second signal ends the process at once with the code of the first.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.machinery import ExtensionFileLoader
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)

SAME_PRESS = 0.5
"""Seconds in which another signal counts as the first one: wrappers pass on a Ctrl-C that the terminal sent to both."""

IMPORT_PATIENCE, IMPORT_POLL = 0.3, 0.02
"""Seconds to wait for the end of an import before giving up on cleaning up, and between two looks."""

SWALLOWED_AGAIN = 0.05
"""Seconds until an interruption is raised again that a callback of C code could not pass on."""

_SHOW_CURSOR = "\x1b[?25h"  # progress bars hide it


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM, on its way out of a command."""


class _Interruption:
    """What this process knows about the signals that it got.

    Attributes:
        number: the first signal; None before.
        installed: whether this process ends as described above.
        in_command: whether there may be something to clean up.
        raised: whether `Interrupted` was raised, or is still to be.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.installed = False
        self.in_command = False
        self.raised = False
        self._since = 0.0
        self._said = False

    @property
    def exit_code(self) -> int:
        return 128 + (signal.SIGINT if self.number is None else self.number)

    def note(self, number: int) -> None:
        """Remember the first signal."""
        if self.number is None:
            self.number, self._since = number, time.monotonic()

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Handler of both signals."""
        first = self.number is None
        self.note(number)
        if first:
            self.act(frame)
        elif time.monotonic() - self._since >= SAME_PRESS:
            self.leave()

    def act(self, frame: FrameType | None) -> None:
        """End the process, or the command that it is in, or come back when that is possible."""
        if not self.in_command:
            self.leave()
        if _importing(frame):
            if time.monotonic() - self._since > IMPORT_PATIENCE or not hasattr(signal, "setitimer"):
                self.leave()
            self.come_back(IMPORT_POLL)
            return
        self.raised = True
        raise Interrupted

    def come_back(self, seconds: float) -> None:
        """Act again after so many seconds."""
        self.raised = True
        if hasattr(signal, "setitimer"):  # not on Windows
            signal.signal(signal.SIGALRM, lambda _, frame: self.act(frame))
            signal.setitimer(signal.ITIMER_REAL, seconds)

    def cancel(self) -> None:
        """Do not act again."""
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def say(self) -> None:
        """Write the line, once. Written without Python's streams, which the signal may have interrupted."""
        if self._said:
            return
        self._said = True
        name = "SIGTERM" if self.number == signal.SIGTERM else "Ctrl-C"
        with suppress(OSError):
            show_cursor = _SHOW_CURSOR if os.isatty(2) else ""
            os.write(2, f"{show_cursor}lapgs: stopped by {name}\n".encode())

    def leave(self) -> None:
        """End the process at once."""
        self.say()
        with suppress(Exception):  # the signal may have come in the middle of a write
            sys.stdout.flush()
        os._exit(self.exit_code)


_interruption = _Interruption()


def install() -> None:
    """Let this process end as the module's docstring says. Called in the main thread, before other threads start.

    A signal that is ignored stays ignored, as for what a shell starts in the background.
    """
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interruption.handle)
    _interruption.installed = True
    # Registered first, so run last: when the interpreter takes itself apart, it would give the signals their default.
    atexit.register(_ignore_signals)
    sys.unraisablehook = _unraisable
    if hasattr(signal, "pthread_sigmask"):
        for name in ("create_module", "exec_module"):
            setattr(ExtensionFileLoader, name, _holding(getattr(ExtensionFileLoader, name)))


@contextmanager
def command() -> Iterator[None]:
    """Raise `Interrupted` on a signal inside; what then comes out ends the process with its code and the line.

    A signal may come out as another exception, where C++ or a reader of damaged files translates it.
    """
    if not _interruption.installed:
        yield
        return
    _interruption.in_command = True
    try:
        yield
    except BaseException as error:
        _interruption.in_command = False
        stopped = isinstance(error, KeyboardInterrupt) or (_interruption.raised and isinstance(error, Exception))
        if not stopped or getattr(error, "exit_code", None) == 130:  # an error that says how to go on
            raise
        _interruption.say()
        sys.exit(_interruption.exit_code)
    finally:
        _interruption.in_command = False
        _interruption.cancel()
    if _interruption.raised:  # it was over before it could be interrupted, or went on all the same
        _interruption.say()
        sys.exit(_interruption.exit_code)


def exit_code(code: int) -> int:
    """What to exit with after an error: 143 instead of 130 when it was SIGTERM that stopped the command."""
    return _interruption.exit_code if code == 130 else code


@contextmanager
def signals_held() -> Iterator[None]:
    """Let signals wait until the block ends, in this thread and for good in the threads that are started inside.

    Threads that no signal is meant for must not take one: in the moments in which pycolmap's handler of SIGTERM is in
    place of ours, it would print a C++ stack.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class StopRequest:
    """Whether somebody asked this process to stop."""

    def __init__(self) -> None:
        self.requested = False


@contextmanager
def stop_request() -> Iterator[StopRequest]:
    """Turn the first Ctrl-C or SIGTERM into a request that training honours after the current iteration.

    A second one does what it would have done without. Outside the main thread, where Python delivers no signals,
    nothing changes.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if not request.requested:
            request.requested = True
            _interruption.note(number)
            return
        before = previous[number]
        if not callable(before):
            raise KeyboardInterrupt
        before(number, frame)

    previous: dict[int, Any] = {number: signal.signal(number, ask) for number in SIGNALS}
    try:
        yield request
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _ignore_signals() -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _unraisable(unraisable: Any) -> None:
    """Raise an interruption again that was lost in a callback of C code or a finalizer; report others as ever."""
    if issubclass(unraisable.exc_type, Interrupted) and _interruption.in_command:
        _interruption.come_back(SWALLOWED_AGAIN)
    else:
        sys.__unraisablehook__(unraisable)


def _holding(load: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Let signals wait while a compiled module is loaded, and put our handlers back in their place.

    Modules call Python from C++ while they are loaded, where raising aborts the process (OpenImageIO does); the threads
    they start leave signals to the main thread; and pycolmap installs a handler of SIGTERM that prints a C++ stack.
    """

    def held(self: Any, argument: Any) -> Any:
        with signals_held():
            try:
                return load(self, argument)
            finally:
                if threading.current_thread() is threading.main_thread():
                    for number in SIGNALS:
                        if (handler := signal.getsignal(number)) is not None:
                            signal.signal(number, handler)

    return held
