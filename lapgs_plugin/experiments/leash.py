"""A command that does not outlive whoever asked for it: `python -m lapgs_plugin.experiments.leash CORES COMMAND...`

Its standard input is a pipe that the worker holds open. When the worker ends, however it ends, the pipe closes and the
command and all that it started are killed: a run that goes on without a worker would write over the files of the next
attempt and use a GPU that others time their runs on. CORES are processor numbers separated by commas, or - for all.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading


def main() -> int:
    cores, command = sys.argv[1], sys.argv[2:]
    if cores != "-" and sys.platform == "linux":
        os.sched_setaffinity(0, [int(core) for core in cores.split(",")])
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    threading.Thread(target=_kill_when_released, args=(child,), daemon=True).start()
    code = child.wait()
    return code if code >= 0 else 128 - code


def _kill_when_released(child: subprocess.Popen[bytes]) -> None:
    while os.read(sys.stdin.fileno(), 1):  # unbuffered: a buffer's lock would be in the way when this process ends
        pass
    if sys.platform == "win32":
        child.kill()
        return
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main())
