"""Take runs from the store until none is left, and run each in separate processes."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, BinaryIO

from lapgs_bench.experiments.commands import Step
from lapgs_bench.experiments.store import LEASE, Claim, ResultStore
from lapgs_plugin import __version__
from lapgs_plugin.environment import run_program, versions
from lapgs_plugin.errors import LapgsError
from lapgs_plugin.files import require_own

RENEW_EVERY = LEASE / 8
"""Seconds between two renewals of a claim."""
LAST_LINES = 12
"""Lines of a failed run's log in the report."""


@dataclass(frozen=True)
class Slot:
    """Reserve a part of a machine for a worker: a value of CUDA_VISIBLE_DEVICES, or None; processors, all if empty."""

    gpu: str | None = None
    cores: tuple[int, ...] = ()


class RunStopped(Exception):
    """Report that a run was killed on request, or because its claim was lost."""


def work(
    store_path: Path, run_ids: Collection[str], slot: Slot | None = None, stop: threading.Event | None = None
) -> int:
    """Claim and run these runs until none is free.

    If `stop` is set, the current run is killed and released.

    Returns:
        Number of runs that ended, done or failed.
    """
    store = ResultStore(store_path)
    slot, stop = slot or Slot(), stop or threading.Event()
    finished = 0
    while not stop.is_set() and (claim := store.claim(run_ids)) is not None:
        try:
            row = _run(store, claim, slot, stop)
        except RunStopped:
            store.release(claim)
            continue
        except LapgsError as error:
            store.fail(claim, str(error))
        except OSError:  # such as a full disk; the claim of a process that lives on would block the run
            store.release(claim)
            raise
        else:
            store.record(claim, row)
        finished += 1
    return finished


class RunFailedError(LapgsError):
    """Report a failed command of a run, with the end of its log, line by line."""


def _run(store: ResultStore, claim: Claim, slot: Slot, stop: threading.Event) -> dict[str, Any]:
    """Run the commands of one run, and return its row of results."""
    from lapgs_bench.experiments.rows import result_row

    job = claim.job
    folder = Path(job.folder)
    log = Path(job.log)
    require_own(folder)
    require_own(log)
    if folder.exists() and not job.continues:  # left by an earlier command
        shutil.rmtree(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    log.parent.mkdir(parents=True, exist_ok=True)
    started, clock = datetime.now(timezone.utc).isoformat(timespec="seconds"), time.perf_counter()
    with log.open("ab" if job.continues else "wb") as stream:
        for step in job.steps:
            if code := _execute(step, stream, store, claim, slot, stop):
                stream.flush()
                raise RunFailedError(f"exit code {code}; {log} ends with", *last_lines(log))
    installed = versions()
    return {
        **({} if job.continues else result_row(job)),
        "wall_seconds": time.perf_counter() - clock,
        "lapgs_version": __version__,
        "torch": installed["torch"],
        "gpu": gpu_name(slot),
        "processor": installed["processor"],
        "host": socket.gethostname(),
        "python": installed["python"],
        "started": started,
        "attempt": claim.number,
        "folder": job.folder,
    }


def _execute(step: Step, log: BinaryIO, store: ResultStore, claim: Claim, slot: Slot, stop: threading.Event) -> int:
    """Run one command and return its exit code; it is killed when this process ends."""
    log.write(f"$ {' '.join(step.command)}\n".encode())
    log.flush()
    environment = dict(os.environ)
    if slot.gpu is not None:
        environment["CUDA_VISIBLE_DEVICES"] = slot.gpu
    # Use the package of this process, even if it was found through the current folder.
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    environment["PYTHONUNBUFFERED"] = "1"
    cores = ",".join(map(str, slot.cores)) or "-"
    process = subprocess.Popen(
        [sys.executable, "-m", "lapgs_bench.experiments.leash", cores, *step.command],
        cwd=step.cwd,
        env=environment,
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # Ctrl-C reaches only the worker, which then closes the pipe
    )
    assert process.stdin is not None
    try:
        next_renewal = time.monotonic() + RENEW_EVERY
        while True:
            try:
                return process.wait(timeout=0.2)
            except subprocess.TimeoutExpired:
                pass
            if stop.is_set():
                raise RunStopped
            if time.monotonic() >= next_renewal:
                if not store.renew(claim):
                    raise RunStopped
                next_renewal = time.monotonic() + RENEW_EVERY
    finally:
        process.stdin.close()
        process.wait()


def last_lines(log: Path) -> list[str]:
    """Return the end of a log without progress bars."""
    text = log.read_text(encoding="utf-8", errors="replace")
    lines = [line.rsplit("\r", 1)[-1].rstrip() for line in text.split("\n")]
    return [line for line in lines if line][-LAST_LINES:]


def gpu_name(slot: Slot) -> str:
    """Return the name of the GPU that a slot's runs use, "" without one."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "0") if slot.gpu is None else slot.gpu
    if not visible:  # all GPUs are hidden
        return ""
    name, error = run_program(["nvidia-smi", "--query-gpu=name", "--format=csv,noheader", "-i", visible.split(",")[0]])
    return "" if error else name.strip()
