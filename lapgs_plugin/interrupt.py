"""End on Ctrl-C and SIGTERM with one line, exit code 130 or 143, and nothing half written.

`install` is called once, at the start of the process, before anything heavy is imported; so this module imports little.
From then on the effect of a signal depends on the main thread:

- In a command, `Interrupted` is raised, so that temporary files and child processes are cleaned up.
- In training, `stop_request` turns the first signal into a request to stop after the current iteration.
- Elsewhere the process ends immediately: outside a command there is nothing to clean up, and compiled modules do not
  survive an exception during an import.

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

PARENT = "LAPGS_PARENT"
"""Environment variable with the number of the process that starts this one, which then ends with it."""
POLL = 0.2
"""Seconds between two looks at the parent."""

_SHOW_CURSOR = "\x1b[?25h"
"""Terminal code that shows the cursor, which progress bars hide."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM inside a command."""


class StopRequest:
    """Hold whether the user asked to stop."""

    requested = False


class _Process:
    """Hold the state of signals in this process.

    Attributes:
        number: the first signal; None before.
        since: monotonic time of that signal in seconds.
        in_command: whether a command runs.
        raised: whether `Interrupted` was raised.
        advice: end of the line, about continuing a stopped command.
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
    sys.unraisablehook = _leave_if_lost
    setattr(ExtensionFileLoader, "exec_module", _keeping_handlers(ExtensionFileLoader.exec_module))  # noqa: B010
    # Windows has other parents between, and never says that one is gone.
    if (parent := os.environ.pop(PARENT, None)) is not None and os.name == "posix":
        stop_with(int(parent))


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
        if not _process.raised:  # otherwise the command swallowed it
            return
    finally:
        _process.in_command = False
    _print_line()
    sys.exit(exit_code(130))


def advise(advice: str) -> None:
    """Add advice to the line of this command, should a signal stop it."""
    _process.advice = f"; {advice}"


def ignore() -> None:
    """Ignore signals from now on, because the command ends anyway."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def withdraw() -> None:
    """Let the error that a command raises next be its end, not the signal: the signal only followed from it."""
    _process.raised = False


def be_silent() -> None:
    """Print no line in this process: the one that started it does."""
    _process.said = True


def stop_by(number: int) -> NoReturn:
    """Act on a signal that another handler caught, as if it came now."""
    _is_first(number)
    _process.raised = True
    raise Interrupted


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


def stop_with(parent: int, clean: Callable[[], None] | None = None) -> None:
    """Stop this process as by SIGTERM once its parent is gone, even if that was killed: nobody else would stop it.

    Args:
        parent: number of that process.
        clean: called first.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(POLL)
        if clean is not None:
            clean()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def _is_first(number: int) -> bool:
    """Return whether no signal came before this one, and remember the first."""
    if _process.number is not None:
        return False
    _process.number, _process.since = number, time.monotonic()
    return True


def _handle(number: int, frame: FrameType | None) -> None:
    if not _is_first(number):
        if time.monotonic() - _process.since >= SAME_PRESS:
            _leave()
    elif not _process.in_command or _importing(frame):
        _leave()
    else:
        _process.raised = True
        raise Interrupted


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


def _leave_if_lost(unraisable: Any) -> None:
    """End the process if a callback of C code or a finalizer lost an interruption; report other errors as usual."""
    if issubclass(unraisable.exc_type, Interrupted):
        _leave()
    sys.__unraisablehook__(unraisable)


def _keeping_handlers(load: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
    """Restore our handlers after a compiled module is loaded: pycolmap's of SIGTERM prints a C++ stack.

    A signal that comes while it is loaded waits until then.
    """

    def load_and_restore(self: Any, module: Any) -> None:
        if threading.current_thread() is not threading.main_thread():
            load(self, module)
            return
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            load(self, module)
        finally:
            for number in SIGNALS:
                if (handler := signal.getsignal(number)) is not None:
                    signal.signal(number, handler)
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)

    return load_and_restore
