"""End on Ctrl-C and SIGTERM with one line, exit code 130 or 143, and nothing half written.

`install` is called once, at the start of the process, before anything heavy is imported; so this module imports little.
From then on the effect of a signal depends on the main thread:

- Outside a command (imports, parsing, exit) there is nothing to clean up: the process prints its line and ends.
- In a command, `Interrupted` is raised, so that temporary files and child processes are cleaned up. It is not raised
  during an import, which compiled modules do not survive: a short import is waited for, a long one ends the process.
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
from typing import Any, NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)

SAME_PRESS = 0.5
"""Seconds in which another signal counts as the first: wrappers forward a Ctrl-C that the terminal sent to both."""

RETRY = 0.03
"""Seconds until an interruption is raised that came during an import, or was lost in a callback of C code."""

IMPORT_PATIENCE = 0.3
"""Seconds to wait for the end of an import before ending without cleanup."""

_SHOW_CURSOR = "\x1b[?25h"  # progress bars hide the cursor


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM inside a command."""


class StopRequest:
    """A flag that is set by a request to stop."""

    requested = False


class _Process:
    """The state of signals in this process.

    Attributes:
        number: the first signal; None before.
        since: when it came.
        in_command: whether a command runs, which may have something to clean up.
        raised: whether `Interrupted` was raised in a command or will be.
        advice: what to do after the command was stopped; the line ends with it.
        said: whether the line was printed.
    """

    number: int | None = None
    since = 0.0
    in_command = raised = said = False
    advice = ""


_process = _Process()


def install() -> None:
    """Install the handlers. Call it in the main thread, before other threads start.

    An ignored signal stays ignored, as in processes that a shell starts in the background.
    """
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _handle)
        # Registered first, so run last: a finalizing interpreter would restore the default handlers.
        atexit.register(signal.signal, number, signal.SIG_IGN)
    if sys.platform != "win32":
        signal.signal(signal.SIGALRM, _stop)
        sys.unraisablehook = _unraisable
        for name in ("create_module", "exec_module"):
            setattr(ExtensionFileLoader, name, _holding_signals(getattr(ExtensionFileLoader, name)))


@contextmanager
def command() -> Iterator[None]:
    """Raise `Interrupted` on a signal inside the block, then end the process with the line and its exit code.

    The signal may leave the block as another exception, if C++ or a reader of damaged files translated it.
    """
    _process.in_command, _process.advice = True, ""
    try:
        yield
    except BaseException as error:
        stopped = isinstance(error, KeyboardInterrupt) or (_process.raised and isinstance(error, Exception))
        if not stopped or getattr(error, "exit_code", None) == 130:  # an error with a message of its own
            raise
    else:
        if not _process.raised:  # otherwise the command swallowed it, or ended before it was raised
            return
    finally:
        _process.in_command = False
        if _process.raised:
            _retry(0.0)
    _print_line()
    sys.exit(exit_code(130))


def advise(what: str) -> None:
    """Add what to do next to the line of this command, should a signal stop it."""
    _process.advice = f"; {what}"


def exit_code(code: int) -> int:
    """Return the exit code after an error: 143 instead of 130 if SIGTERM stopped the command."""
    return 128 + _process.number if code == 130 and _process.number is not None else code


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
            _is_first(number)
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


def _is_first(number: int) -> bool:
    """Whether no signal came before this one, which is remembered then."""
    if _process.number is not None:
        return False
    _process.number, _process.since = number, time.monotonic()
    return True


def _handle(number: int, frame: FrameType | None) -> None:
    if _is_first(number):
        _stop(number, frame)
    elif time.monotonic() - _process.since >= SAME_PRESS:
        _leave()


def _stop(number: int, frame: FrameType | None) -> None:
    """End the process or its command, or retry after an import."""
    importing = _importing(frame)
    late = importing and (sys.platform == "win32" or time.monotonic() - _process.since > IMPORT_PATIENCE)
    if late or not _process.in_command:
        _leave()
    _process.raised = True
    if not importing:
        raise Interrupted
    _retry(RETRY)


def _retry(seconds: float) -> None:
    """Call `_stop` after some seconds; 0 for never."""
    if sys.platform != "win32":
        signal.setitimer(signal.ITIMER_REAL, seconds)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    return frame is not None


def _print_line() -> None:
    """Print the line, once, without Python's streams, which the signal may have interrupted."""
    if _process.said:
        return
    _process.said = True
    name = "SIGTERM" if _process.number == signal.SIGTERM else "Ctrl-C"
    with suppress(OSError):
        show_cursor = _SHOW_CURSOR if os.isatty(2) else ""
        os.write(2, f"{show_cursor}lapgs: stopped by {name}{_process.advice}\n".encode())


def _leave() -> NoReturn:
    """End the process immediately."""
    _print_line()
    with suppress(Exception):  # the signal may have come in the middle of a write
        sys.stdout.flush()
    os._exit(exit_code(130))


def _unraisable(unraisable: Any) -> None:
    """Raise an interruption again that was lost in a callback of C code or a finalizer; report others as usual."""
    if issubclass(unraisable.exc_type, Interrupted) and _process.in_command:
        _retry(RETRY)
    else:
        sys.__unraisablehook__(unraisable)


def _holding_signals(load: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Block signals while a compiled module is loaded, and restore our handlers afterwards.

    Modules such as OpenImageIO call Python from C++ while they are loaded, where raising aborts the process. Threads
    that they start leave signals to the main thread. pycolmap installs a SIGTERM handler that prints a C++ stack.
    """

    def held(self: Any, argument: Any) -> Any:
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            return load(self, argument)
        finally:
            if threading.current_thread() is threading.main_thread():
                for number in SIGNALS:
                    if (handler := signal.getsignal(number)) is not None:
                        signal.signal(number, handler)
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)

    return held
