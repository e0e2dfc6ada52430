"""Start workers: threads of this process, jobs of Slurm (through submitit), or tasks of Ray.

Workers share runs through the store alone. When a worker dies, another one or the next `lapgs bench` takes its run.
"""

from __future__ import annotations

import math
import os
import shutil
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lapgs_bench.experiments.settings import WorkerSettings
from lapgs_bench.experiments.worker import Slot, work
from lapgs_plugin.environment import run_program
from lapgs_plugin.errors import UserInputError, require_extra, typed_line


@dataclass(frozen=True)
class WorkOrder:
    """Describe the work of workers: runs of a store on a disk that all see, and a folder for their own output."""

    store: Path
    run_ids: Sequence[str]
    logs: Path
    settings: WorkerSettings


class Launcher(ABC):
    """Hold the workers of one engine; creating it starts them."""

    @staticmethod
    @abstractmethod
    def check(options: Mapping[str, Any]) -> None:
        """Refuse unknown options, or an engine that is not installed.

        Raises:
            UserInputError, MissingExtraError: see `check_launcher`.
        """

    @abstractmethod
    def __init__(self, order: WorkOrder) -> None:
        """Start the workers."""

    @abstractmethod
    def running(self) -> bool:
        """Return whether a worker runs or waits for its start."""

    @abstractmethod
    def stop(self) -> None:
        """End all workers and wait for them; their runs are returned, or count as abandoned later."""

    @abstractmethod
    def failures(self) -> list[str]:
        """Return failures of the workers themselves, one line each."""


def launch(order: WorkOrder) -> Launcher:
    """Start workers, with settings that `check_launcher` accepts."""
    return _KINDS[order.settings.launcher](order)


def check_launcher(settings: WorkerSettings) -> None:
    """Refuse settings that `launch` cannot use, before anything is written.

    Raises:
        UserInputError: the launcher or an option of it is not known.
        MissingExtraError: the engine is not installed.
    """
    name, gpus = settings.launcher, settings.gpus
    if name not in _KINDS:
        raise UserInputError(f"--launcher {name}: expected {', '.join(_KINDS)}")
    if gpus is not None and name != "local":
        raise UserInputError(f"--gpus {gpus}: {name} assigns GPUs itself; leave it out")
    if gpus is not None and not all(gpu.strip() for gpu in gpus.split(",")):
        raise UserInputError(f"--gpus {gpus!r}: expected names separated by commas, such as 0,1")
    _KINDS[name].check(settings.launcher_options)


class LocalLauncher(Launcher):
    """Start threads of this process, one for each GPU or a single one without GPUs; cores are shared out evenly."""

    @staticmethod
    def check(options: Mapping[str, Any]) -> None:
        if options:
            raise UserInputError(f"--launcher-option {next(iter(options))}: the local launcher has none")

    def __init__(self, order: WorkOrder) -> None:
        self._stop = threading.Event()
        self._errors: list[str] = []
        self._threads = [
            threading.Thread(target=partial(self._work, order, slot), daemon=True) for slot in _slots(order)
        ]
        for thread in self._threads:
            thread.start()

    def running(self) -> bool:
        return any(thread.is_alive() for thread in self._threads)

    def stop(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def failures(self) -> list[str]:
        return self._errors

    def _work(self, order: WorkOrder, slot: Slot) -> None:
        try:
            work(order.store, order.run_ids, slot, self._stop)
        except Exception as error:  # reported by the caller; a thread's traceback would break the progress display
            self._errors.append(f"worker on {slot.gpu or 'the processor'}: {typed_line(error)}")


class SlurmLauncher(Launcher):
    """Start jobs of Slurm, one for each worker, through submitit. Options are submitit's, such as slurm_partition=gpu.

    The option cluster=local runs the jobs on this machine, as a trial.
    """

    @staticmethod
    def check(options: Mapping[str, Any]) -> None:
        require_extra("submitit", "slurm", "--launcher slurm")
        if options.get("cluster", "slurm") == "slurm" and shutil.which("sbatch") is None:
            raise UserInputError("--launcher slurm: there is no sbatch on this machine; start it on a login node")

    def __init__(self, order: WorkOrder) -> None:
        import submitit

        options = order.settings.launcher_options
        cluster = options.pop("cluster", "slurm")
        try:
            executor = submitit.AutoExecutor(folder=order.logs, cluster=cluster)
            executor.update_parameters(**{"timeout_min": 24 * 60, "name": "lapgs-bench", **options})
        except (NameError, TypeError, ValueError, RuntimeError, AssertionError) as error:
            raise UserInputError(f"--launcher-option: {error}") from error
        self._jobs = [
            executor.submit(work, order.store, list(order.run_ids)) for _ in range(order.settings.workers or 1)
        ]

    def running(self) -> bool:
        return not all(job.done() for job in self._jobs)

    def stop(self) -> None:
        for job in self._jobs:
            job.cancel(check=False)

    def failures(self) -> list[str]:
        failed = [job for job in self._jobs if job.done() and job.exception() is not None]
        return [f"job {job.job_id}: {str(job.exception()).strip().splitlines()[-1]}" for job in failed]


class RayLauncher(Launcher):
    """Start tasks of Ray, one for each worker, on this machine's cluster or a new local one.

    Options: address; num_gpus and num_cpus of a worker. Ray restarts a task whose process died.
    """

    @staticmethod
    def check(options: Mapping[str, Any]) -> None:
        require_extra("ray", "ray", "--launcher ray")
        if unknown := sorted(options.keys() - {"address", "num_gpus", "num_cpus"}):
            raise UserInputError(f"--launcher-option {unknown[0]}: Ray takes address, num_gpus and num_cpus")
        for name, least in (("num_gpus", 0.0), ("num_cpus", 0.001)):
            try:
                number = float(options.get(name, 1))
            except ValueError:
                number = math.nan
            if not least <= number < math.inf:
                raise UserInputError(
                    f"--launcher-option {name}={options[name]}: expected a number for each worker, at least {least:g}"
                )

    def __init__(self, order: WorkOrder) -> None:
        import ray

        options = order.settings.launcher_options
        self._ray = ray
        self._started = not ray.is_initialized()
        if self._started:
            handler = signal.getsignal(signal.SIGTERM)
            ray.init(address=options.get("address"), log_to_driver=False, include_dashboard=False)
            signal.signal(signal.SIGTERM, handler)  # Ray's would end this process before workers are stopped
        resources = ray.cluster_resources()
        gpus = float(options.get("num_gpus", 1 if resources.get("GPU") else 0))
        cpus = float(options.get("num_cpus", 1))
        count = order.settings.workers or max(
            1, int(resources.get("GPU", 0) / gpus if gpus else resources["CPU"] / cpus)
        )
        task = ray.remote(num_gpus=gpus, num_cpus=cpus, max_retries=3)(work)
        self._tasks = [task.remote(order.store, list(order.run_ids)) for _ in range(count)]

    def running(self) -> bool:
        return bool(self._ray.wait(self._tasks, num_returns=len(self._tasks), timeout=0)[1])

    def stop(self) -> None:
        for task in self._tasks:
            self._ray.cancel(task, force=True)
        if self._started:
            self._ray.shutdown()

    def failures(self) -> list[str]:
        done, _ = self._ray.wait(self._tasks, num_returns=len(self._tasks), timeout=0)
        lines = []
        for task in done:
            try:
                self._ray.get(task)
            except Exception as error:
                lines.append(f"a worker: {str(error).strip().splitlines()[-1]}")
        return lines


_KINDS: dict[str, type[Launcher]] = {"local": LocalLauncher, "slurm": SlurmLauncher, "ray": RayLauncher}


def _slots(order: WorkOrder) -> list[Slot]:
    """Divide this machine among the workers."""
    gpus = visible_gpus() if order.settings.gpus is None else _names(order.settings.gpus)
    count = order.settings.workers or max(1, len(gpus))
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    shares = [tuple(cores[i * len(cores) // count : (i + 1) * len(cores) // count]) for i in range(count)]
    return [Slot(gpus[i % len(gpus)] if gpus else None, share) for i, share in enumerate(shares)]


def visible_gpus() -> list[str]:
    """Return a value of CUDA_VISIBLE_DEVICES for each of this machine's GPUs."""
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return _names(chosen)
    listed, _ = run_program(["nvidia-smi", "-L"])
    lines = [line for line in listed.splitlines() if line.startswith("GPU ")]
    return [str(number) for number in range(len(lines))]


def _names(text: str) -> list[str]:
    """Return the names in a list such as "0, 1"."""
    return [name.strip() for name in text.split(",") if name.strip()]
