"""The process in which damaged files are read: `lapgs` commands, one after another, with what they took.

Reads a request a line from standard input, answers each by a line on the descriptor that it was started with.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

STAGE_ITERATIONS = 2
"""Of the finest level, then training is stopped: long enough to use everything that was read."""
STOPPED = 130
"""Exit code of a training that this module ended, or that diverged."""
COARSE_ITERATIONS = 20
"""Of a coarser level, which whole files do not reach: a damaged manifest may ask for a thousand million."""


def serve(replies: int, more: int) -> None:
    """Answer requests until there are no more.

    Importing everything takes seconds, so a child of this process does the work, and the next one takes its place when
    it ends.

    Args:
        replies: descriptor to answer on.
        more: bytes that may be asked of the system besides what the imports took.
    """
    commands = _prepared()
    while True:
        child = os.fork()
        if child == 0:
            limit_memory(more)
            _answer(replies, {"child": os.getpid()})
            while request := _line():
                os.chdir(request["folder"])
                _answer(replies, _outcome(commands, request["command"]))
            os._exit(0)
        _, status = os.waitpid(child, 0)
        if status == 0:
            return
        _answer(replies, {"ended": os.waitstatus_to_exitcode(status)})


def _line() -> dict[str, Any] | None:
    """The next request, None at the end; never a byte beyond it, which would be lost with this process."""
    line = bytearray()
    while byte := os.read(0, 1):
        if byte == b"\n":
            return dict(json.loads(line))
        line += byte
    return None


def _answer(replies: int, values: dict[str, Any]) -> None:
    data = json.dumps(values).encode() + b"\n"
    while data:
        data = data[os.write(replies, data) :]


def _highest() -> int:
    """Most memory that this process ever had, in bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def limit_memory(more: int) -> None:
    """Refuse to grow by more than so many bytes: a damaged file must not take the machine down with it."""
    status = Path("/proc/self/statm")
    if status.exists():
        size = int(status.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + more, size + more))


def _outcome(commands: Callable[[Sequence[str]], Any], command: Sequence[str]) -> dict[str, Any]:
    """How a command ended: its exit code, its message or the traceback that escaped, its seconds and bytes."""
    from lapgs_plugin.errors import LapgsError, TrainingDivergedError

    out = io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True)  # as strict as a terminal's
    errors = io.TextIOWrapper(io.BytesIO(), "utf-8", "backslashreplace", write_through=True)
    code, message, trace, starved = 0, "", "", False
    started = time.monotonic()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        try:
            commands(command)
        except TrainingDivergedError:
            code = STOPPED  # everything was read, and a damaged rate is a large one
        except LapgsError as error:
            code, message, starved = error.exit_code, str(error), _starved(error)
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
        except BaseException as error:
            code, trace, starved = 1, _short_trace(error), _starved(error)
    return {
        "code": code,
        "message": message,
        "trace": trace,
        "starved": starved,
        "printed": (printed := _text(errors))[-2000:],
        "shown": (_text(out) + printed)[-20_000:],
        "seconds": time.monotonic() - started,
        "highest": _highest(),
    }


def _text(stream: io.TextIOWrapper) -> str:
    """All that was written to a stream."""
    stream.flush()
    buffer = stream.buffer
    assert isinstance(buffer, io.BytesIO)
    return buffer.getvalue().decode("utf-8", "replace")


def _short_trace(error: BaseException) -> str:
    """The error and where it came from; ten thousand frames of a recursion would not fit through the pipe."""
    lines = traceback.format_exception(type(error), error, error.__traceback__, limit=-30)
    return "".join(lines)[-6000:]


def _starved(error: BaseException | None) -> bool:
    """Whether the limit on memory stood behind an error, however it was reported."""
    for _ in range(20):
        if error is None:
            return False
        if isinstance(error, MemoryError) or "DefaultCPUAllocator" in str(error) or "bad_alloc" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def _prepared() -> Callable[[Sequence[str]], Any]:
    """What runs a command, with all that commands import already there."""
    import jinja2
    import torch
    import typer.main

    from lapgs_plugin.cli.app import app
    from tests.fuzz.readers import READERS

    torch.set_num_threads(1)
    _stop_training_early()
    _stop_preparing_early()
    _compile_templates_once(jinja2)
    lapgs = typer.main.get_command(app)

    def run(command: Sequence[str]) -> Any:
        name, *arguments = command
        if name in READERS:
            return READERS[name](*arguments)
        result = lapgs(list(command), standalone_mode=False)
        if isinstance(result, int) and result:
            raise SystemExit(result)
        return result

    return run


def _stop_training_early() -> None:
    from lapgs_plugin.errors import TrainingStoppedError
    from lapgs_plugin.training.stage import StageRun

    whole = StageRun.run

    def run(stage_run: Any, after_iteration: Callable[[Any], None]) -> None:
        done = 0

        def after(each: Any) -> None:
            nonlocal done
            after_iteration(each)
            done += 1
            if done == (STAGE_ITERATIONS if each.stage.level == 0 else COARSE_ITERATIONS):
                raise TrainingStoppedError("as far as this test goes")

        whole(stage_run, after)

    StageRun.run = run  # type: ignore[method-assign]


def _stop_preparing_early() -> None:
    """End `lapgs prepare` when photos and masks have been read: COLMAP's steps take long and read none of them anew."""
    from lapgs_plugin.errors import TrainingStoppedError
    from lapgs_plugin.scenes.prepare import pipeline

    def stop(*_: Any) -> None:
        raise TrainingStoppedError("as far as this test goes")

    assert hasattr(pipeline, "find_features")
    pipeline.find_features = stop


def _compile_templates_once(jinja2: Any) -> None:
    """A command makes an environment of its own, and compiling the templates takes longer than all that is tested."""
    compiled: dict[Any, Any] = {}
    whole = jinja2.Environment.compile

    def compile_(self: Any, source: Any, name: Any = None, filename: Any = None, *rest: Any, **more: Any) -> Any:
        if (name, filename) not in compiled:
            compiled[name, filename] = whole(self, source, name, filename, *rest, **more)
        return compiled[name, filename]

    jinja2.Environment.compile = compile_


if __name__ == "__main__":
    serve(int(sys.argv[1]), int(sys.argv[2]))
