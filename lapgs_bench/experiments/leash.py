"""Run a command that ends with the process that started it: `python -m lapgs_bench.experiments.leash CORES COMMAND...`

The worker holds this process's standard input open. When the worker ends in any way, the pipe closes, and the command
and all its children are killed. Otherwise they would overwrite the next attempt's files and use a GPU on which other
runs are timed. CORES are processor numbers separated by commas, or - for all.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial

PR_SET_PDEATHSIG = 1
"""Linux's prctl(2) that ends the command with this process, which Ray kills together with a worker.

`interrupt.stop_with` is for processes that stop by themselves, with a checkpoint; a command may be deaf to that."""


def main() -> int:
    cores, command = sys.argv[1], sys.argv[2:]
    first: Callable[[], object] | None = None
    if sys.platform == "linux":
        first = partial(ctypes.CDLL(None).prctl, PR_SET_PDEATHSIG, signal.SIGKILL)
        if cores != "-":
            os.sched_setaffinity(0, [int(core) for core in cores.split(",")])
    child = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=first,  # noqa: PLW1509  # safe, because there is no other thread yet
    )
    threading.Thread(target=_kill_when_released, args=(child,), daemon=True).start()
    code = child.wait()
    return code if code >= 0 else 128 - code


def _kill_when_released(child: subprocess.Popen[bytes]) -> None:
    while os.read(sys.stdin.fileno(), 1):  # unbuffered, because a buffer's lock would block the end of this process
        pass
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())
