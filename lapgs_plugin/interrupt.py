"""End on Ctrl-C and SIGTERM with one line, exit code 130 or 143, and nothing half written.

`install` is called once, at the start of the process, before anything heavy is imported; so this module imports little.
From then on the effect of a signal depends on the main thread:

- Outside a command (imports, parsing, exit) there is nothing to clean up: the process prints its line and ends.
- In a command, `Interrupted` is raised, so that temporary files and child processes are cleaned up. It is not raised
  during an import, because it would abort the process in C++ frames: a short import is waited for, a long one ends the
  process.
- In training, `stop_request` turns the first signal into a request to stop after the current iteration.

A second signal ends the process immediately with the exit code of the first.
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
"""Seconds in which another signal counts as the first: wrappers forward a Ctrl-C that the terminal sent to both."""

IMPORT_PATIENCE, IMPORT_POLL = 0.3, 0.02
"""Seconds to wait for the end of an import before ending without cleanup, and between two checks."""

SWALLOWED_AGAIN = 0.05
"""Seconds until an interruption is raised again that was lost in a callback of C code."""

_SHOW_CURSOR = "\x1b[?25h"  # progress bars hide the cursor


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM inside a command."""


class _Interruption:
    """Handle the signals of this process.

    Attributes:
        number: the first signal; None before.
        installed: whether signals are handled as the module describes.
        in_command: whether a command runs, which may have something to clean up.
        raised: whether `Interrupted` was raised or will be.
        advice: what to do after the command was stopped; the line ends with it.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.installed = False
        self.in_command = False
        self.raised = False
        self.advice = ""
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
        """Handle either signal."""
        first = self.number is None
        self.note(number)
        if first:
            self.act(frame)
        elif time.monotonic() - self._since >= SAME_PRESS:
            self.leave()

    def act(self, frame: FrameType | None) -> None:
        """End the process or its command, or retry after an import."""
        if not self.in_command:
            self.leave()
        if _importing(frame):
            if time.monotonic() - self._since > IMPORT_PATIENCE or not hasattr(signal, "setitimer"):
                self.leave()
            self.act_later(IMPORT_POLL)
            return
        self.raised = True
        raise Interrupted

    def act_later(self, seconds: float) -> None:
        """Call `act` again after some seconds."""
        self.raised = True
        if hasattr(signal, "setitimer"):  # not on Windows
            signal.signal(signal.SIGALRM, lambda _, frame: self.act(frame))
            signal.setitimer(signal.ITIMER_REAL, seconds)

    def cancel(self) -> None:
        """Cancel `act_later`."""
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def print_line(self) -> None:
        """Print the line, once, without Python's streams, which the signal may have interrupted."""
        if self._said:
            return
        self._said = True
        name = "SIGTERM" if self.number == signal.SIGTERM else "Ctrl-C"
        with suppress(OSError):
            show_cursor = _SHOW_CURSOR if os.isatty(2) else ""
            os.write(2, f"{show_cursor}lapgs: stopped by {name}{self.advice}\n".encode())

    def leave(self) -> None:
        """End the process immediately."""
        self.print_line()
        with suppress(Exception):  # the signal may have come in the middle of a write
            sys.stdout.flush()
        os._exit(self.exit_code)


_interruption = _Interruption()


def install() -> None:
    """Install the handlers. Call it in the main thread, before other threads start.

    An ignored signal stays ignored, as in processes that a shell starts in the background.
    """
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interruption.handle)
    _interruption.installed = True
    # Registered first, so run last: a finalizing interpreter would restore the default handlers.
    atexit.register(_ignore_signals)
    sys.unraisablehook = _unraisable
    if hasattr(signal, "pthread_sigmask"):
        for name in ("create_module", "exec_module"):
            setattr(ExtensionFileLoader, name, _holding_signals(getattr(ExtensionFileLoader, name)))


@contextmanager
def command() -> Iterator[None]:
    """Raise `Interrupted` on a signal inside the block, then end the process with the line and its exit code.

    The signal may leave the block as another exception, if C++ or a reader of damaged files translated it.
    """
    if not _interruption.installed:
        yield
        return
    _interruption.in_command, _interruption.advice = True, ""
    try:
        yield
    except BaseException as error:
        _interruption.in_command = False
        stopped = isinstance(error, KeyboardInterrupt) or (_interruption.raised and isinstance(error, Exception))
        if not stopped or getattr(error, "exit_code", None) == 130:  # an error with a message of its own
            raise
        _interruption.print_line()
        sys.exit(_interruption.exit_code)
    finally:
        _interruption.in_command = False
        _interruption.cancel()
    if _interruption.raised:  # the command ended before the signal reached it, or swallowed it
        _interruption.print_line()
        sys.exit(_interruption.exit_code)


def advise(what: str) -> None:
    """Add what to do next to the line of this command, should a signal stop it."""
    _interruption.advice = f"; {what}"


def exit_code(code: int) -> int:
    """Return the exit code after an error: 143 instead of 130 if SIGTERM stopped the command."""
    return _interruption.exit_code if code == 130 else code


@contextmanager
def signals_held() -> Iterator[None]:
    """Block signals in this thread until the block ends, and permanently in threads started inside it.

    Otherwise such a thread could receive a signal while pycolmap's SIGTERM handler is installed, which prints a C++
    stack.
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
    """A flag that is set by a request to stop."""

    def __init__(self) -> None:
        self.requested = False


@contextmanager
def stop_request() -> Iterator[StopRequest]:
    """Turn the first Ctrl-C or SIGTERM into a request, which training follows after the current iteration.

    A second signal is handled as usual. Outside the main thread, where Python delivers no signals, nothing changes.
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
    """Raise an interruption again that was lost in a callback of C code or a finalizer; report others as usual."""
    if issubclass(unraisable.exc_type, Interrupted) and _interruption.in_command:
        _interruption.act_later(SWALLOWED_AGAIN)
    else:
        sys.__unraisablehook__(unraisable)


def _holding_signals(load: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Block signals while a compiled module is loaded, and restore our handlers afterwards.

    Modules such as OpenImageIO call Python from C++ while they are loaded, where raising aborts the process. Threads
    that they start leave signals to the main thread. pycolmap installs a SIGTERM handler that prints a C++ stack.
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
