"""Start the ranks of `--gpus` by torchrun's elastic agent, and say in one line how they ended.

Ranks say nothing about errors themselves: each writes its line into a folder of the command, which prints the one that
matters. Under `torchrun -m lapgs_plugin train` there is no such folder, and rank 0 prints its own.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from lapgs_plugin import interrupt
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.limits import usable_processors

REPORTS = "LAPGS_RANK_REPORTS"
"""Environment variable with the folder into which ranks write how they ended."""
STOPPED = tuple(128 + number for number in interrupt.SIGNALS)
"""Exit codes after Ctrl-C and SIGTERM."""
GRACE = 20.0
"""Seconds that a rank has to end after a signal: it may wait in a GPU's queue for a rank that is gone."""
POLL = 0.2
"""Seconds between two looks of the agent at its ranks."""


@dataclass(frozen=True)
class Report:
    """Say how a rank ended.

    Attributes:
        text: its line, or a traceback.
        code: its exit code.
        lost: whether it only noticed that another one had ended.
    """

    text: str
    code: int
    lost: bool = False


def is_rank() -> bool:
    """Return whether torchrun's agent started this process as one of several."""
    return "TORCHELASTIC_RUN_ID" in os.environ and os.environ.get("WORLD_SIZE", "1") != "1"


def join_started(option: str, asked: int | None) -> None:
    """Get ready to be one of the ranks that torchrun's agent started.

    Args:
        option: that asks for a number of ranks.
        asked: this number; None leaves it to torchrun.

    Raises:
        UserInputError: that is another number.
    """
    started = int(os.environ["WORLD_SIZE"])
    if asked not in (None, started):
        raise UserInputError(
            f"{option} {asked}: torchrun started {started} ranks; leave the option out, or give {started}"
        )
    _end_when_stuck()
    interrupt.stop_with(os.getppid(), _remove_reports)


def leads() -> bool:
    """Return whether this process may talk to the user: it is alone, or rank 0."""
    return not is_rank() or os.environ.get("RANK") == "0"


def end_rank(error: BaseException, text: str, code: int) -> NoReturn:
    """End a rank that failed, without waiting for the others, and say so where it is heard.

    Args:
        error: that ended it.
        text: for the user.
        code: to exit with.
    """
    from lapgs_plugin.training.ranks.group import RankLostError

    if (folder := os.environ.get(REPORTS)) is not None:
        report = {"text": text, "code": code, "lost": isinstance(error, RankLostError)}
        with suppress(FileNotFoundError):  # removed: nobody is left to read it
            (Path(folder) / os.environ["RANK"]).write_text(json.dumps(report), encoding="utf-8")
    elif leads():
        print(text, file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # libraries would wait for ranks that are gone


def _end_when_stuck() -> None:
    """End this process some time after a signal that it does not react to."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)

    def watch() -> None:
        while (number := os.read(read, 1)[0]) not in interrupt.SIGNALS:
            pass
        time.sleep(GRACE)
        os._exit(128 + number)

    threading.Thread(target=watch, name="signals", daemon=True).start()


def _remove_reports() -> None:
    """Remove the folder of reports, which an agent that was killed leaves behind."""
    if (folder := os.environ.get(REPORTS)) is not None:
        shutil.rmtree(folder, ignore_errors=True)


def require_gpus(count: int, rasterizer: str) -> None:
    """Check that --gpus can be had.

    Raises:
        UserInputError: with the rasterizer of CPUs, or on a machine with fewer GPUs.
    """
    import torch

    if rasterizer in ("cpu", "oracle"):
        raise UserInputError(
            f"--gpus {count} with --rasterizer {rasterizer}: that trains on a CPU; leave one out, or share the views "
            f"out over processes with --processes {count}"
        )
    if (here := torch.cuda.device_count()) < count:
        raise UserInputError(f"--gpus {count}: this machine has {here or 'no'} CUDA device{'s' * (here != 1)}")


def launch(count: int, on_gpus: bool, words: Iterable[str]) -> None:
    """Run this command on so many ranks of this machine.

    Args:
        count: of the ranks.
        on_gpus: whether each has a GPU of its own.
        words: the arguments of `lapgs`.

    Raises:
        SystemExit: a rank failed; its line was printed.
        Interrupted: a signal came before the ranks could react to it.
    """
    with tempfile.TemporaryDirectory(prefix="lapgs-ranks-") as folder:
        os.environ[REPORTS] = folder
        os.environ.setdefault("OMP_NUM_THREADS", str(max(1, usable_processors() // count)))
        if not on_gpus:
            os.environ["CUDA_VISIBLE_DEVICES"] = ""
        failures = _run_agent(count, [sys.executable, "-m", "lapgs_plugin", *words], folder)
        if failures is None:
            return
        reports = {
            int(file.name): Report(**json.loads(file.read_text(encoding="utf-8")))
            for file in Path(folder).iterdir()
            if file.name.isdecimal()
        }
    _end(reports, failures, count)


def _run_agent(count: int, command: list[str], folder: str) -> Mapping[int, int] | None:
    """Run a command as so many ranks; return the exit codes of those that failed first, None if all succeeded."""
    from torch.distributed.elastic.multiprocessing import DefaultLogsSpecs, SignalException, Std
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    logging.disable(logging.CRITICAL)  # this process only waits, and says in one line how that ended
    silent = dict.fromkeys(range(1, count), Std.ALL)
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=count,
        run_id=f"lapgs-{os.getpid()}",
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=0,
        monitor_interval=POLL,
        local_addr="localhost",
        logs_specs=DefaultLogsSpecs(log_dir=folder, redirects=silent),
    )
    try:
        elastic_launch(config, command[0])(*command[1:])
    except ChildFailedError as error:
        return {rank: failure.exitcode for rank, failure in error.failures.items()}
    except SignalException as error:
        return {-1: -int(error.sigval)}
    return None


def _end(reports: Mapping[int, Report], failures: Mapping[int, int], count: int) -> NoReturn:
    """Print why ranks ended, and exit with the code of that."""
    stopped = -failures.get(-1, 0)
    causes = [report for _, report in sorted(reports.items()) if not report.lost]
    killed = [(rank, -code) for rank, code in sorted(failures.items()) if rank >= 0 > code]
    if causes:
        report = causes[0]
        # Ranks agree to stop: only the one that was signalled knows by what.
        by_signals = [128 + stopped] if stopped else [each.code for each in causes if each.code in STOPPED]
        code = max(by_signals) if report.code in STOPPED else report.code
    elif stopped:
        interrupt.stop_by(stopped)
    elif killed:
        rank, number = killed[0]
        report = Report(
            f"lapgs: rank {rank} of {count} was ended by {signal.Signals(number).name}; the last checkpoint continues "
            "with --resume, also on fewer ranks",
            1,
        )
        code = 1
    else:
        rank, code = next(iter(sorted(failures.items())))
        lost = next(iter(reports.values()), None)
        report = lost or Report(f"lapgs: rank {rank} of {count} ended with exit code {code}", code)
    print(report.text, file=sys.stderr, flush=True)
    sys.exit(code)
