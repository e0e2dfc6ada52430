"""Test launchers with real workers, some of which are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from lapgs_bench.experiments import launchers, worker
from lapgs_bench.experiments.execution import execute
from lapgs_bench.experiments.launchers import Launcher, WorkOrder, launch
from lapgs_bench.experiments.settings import WorkerSettings
from lapgs_bench.experiments.store import DONE, Outcome, ResultStore
from lapgs_bench.experiments.worker import Slot, gpu_name
from lapgs_plugin.errors import UserInputError
from tests.experiments.examples import COPY, RAY_WARNS, START, copying_jobs, starts
from tests.waiting import wait_for

NOTE_ENVIRONMENT = START + (
    "import os; stream = open(started + '-gpus', 'a'); "
    "stream.write(os.environ.get('CUDA_VISIBLE_DEVICES', 'none') + '\\n'); stream.close(); "
)


def order(
    tmp_path: Path, count: int, workers: int, code: str = COPY, seconds: float = 0.0, **settings: Any
) -> WorkOrder:
    jobs = copying_jobs(tmp_path, count, seconds, code)
    store = ResultStore.create(tmp_path / "results.sqlite")
    store.plan(jobs)
    logs, engine = tmp_path / "logs" / "workers", WorkerSettings(workers=workers, **settings)
    return WorkOrder(tmp_path / "results.sqlite", [job.run_id for job in jobs], logs, engine)


def run_all(order: WorkOrder, start: Callable[[], Launcher]) -> list[Outcome]:
    ended: list[Outcome] = []
    outcomes = execute(ResultStore(order.store), order.run_ids, start, ended.append)
    assert sorted(outcome.run_id for outcome in ended) == sorted(order.run_ids), "each ends once"
    return outcomes


def test_local_workers_get_a_gpu_each(tmp_path: Path) -> None:
    code = COPY.replace(START, NOTE_ENVIRONMENT)
    work_order = order(tmp_path, 6, 2, code, seconds=0.3, gpus="3, 5")
    outcomes = run_all(work_order, lambda: launch(work_order))
    assert [outcome.state for outcome in outcomes] == [DONE] * 6
    assert set((tmp_path / "started-gpus").read_text().split()) == {"3", "5"}
    assert starts(tmp_path) == dict.fromkeys(work_order.run_ids, 1)


def test_visible_gpus_are_those_that_are_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,7")
    assert launchers.visible_gpus() == ["2", "7"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert launchers.visible_gpus() == []


def test_the_gpu_of_a_slot_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "nvidia-smi"
    program.write_text('#!/bin/sh\necho "Card ${4}"\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,7")
    assert gpu_name(Slot()) == "Card 2"
    assert gpu_name(Slot("7")) == "Card 7"
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert gpu_name(Slot()) == "", "hidden"
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert gpu_name(Slot()) == "Card 0"


def test_workers_that_do_nothing_are_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> int:
        raise OSError("no space left")

    monkeypatch.setattr(launchers, "work", broken)
    work_order = order(tmp_path, 1, 1)
    with pytest.raises(UserInputError, match=r"workers end without finishing a run: .*no space left"):
        run_all(work_order, lambda: launch(work_order))


def test_a_worker_that_fails_beside_others_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def work(store: Path, run_ids: Sequence[str], slot: Slot, stop: threading.Event) -> int:
        if slot.gpu == "5":
            raise OSError("no space left")
        return worker.work(store, run_ids, slot, stop)

    monkeypatch.setattr(launchers, "work", work)
    work_order = order(tmp_path, 2, 2, gpus="3,5")
    assert [outcome.state for outcome in run_all(work_order, lambda: launch(work_order))] == [DONE] * 2
    assert caplog.messages == ["a worker failed, the others continue: worker on 5: OSError: no space left"]


def test_jobs_through_submitit(tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    work_order = order(tmp_path, 3, 2, launcher="slurm", launcher_option=["cluster=local"])
    outcomes = run_all(work_order, lambda: launch(work_order))
    assert [outcome.state for outcome in outcomes] == [DONE] * 3
    assert starts(tmp_path) == dict.fromkeys(work_order.run_ids, 1)
    assert list((tmp_path / "logs" / "workers").glob("*_log.out")), "what the workers said"


def test_an_option_that_submitit_does_not_know(tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    with pytest.raises(UserInputError, match=r"--launcher-option: .*slurm_partiton"):
        launch(order(tmp_path, 1, 1, launcher="slurm", launcher_option=["cluster=local", "slurm_partiton=gpu"]))


@pytest.mark.skipif(sys.platform != "linux", reason="other systems leave the command alone")
def test_a_command_ends_with_its_leash() -> None:
    code = "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
    command = [sys.executable, "-m", "lapgs_bench.experiments.leash", "-", sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as leash:
        assert leash.stdout is not None
        child = Path("/proc", leash.stdout.readline().decode().strip(), "cmdline")
        assert child.read_bytes()
        leash.kill()
        wait_for(lambda: not child.exists() or not child.read_bytes())  # gone, or not yet waited for by its new parent


@pytest.mark.slow
@RAY_WARNS
def test_tasks_of_a_local_ray_cluster_whose_workers_are_killed(tmp_path: Path) -> None:
    ray = pytest.importorskip("ray")
    killing = "import os; open(started + '-worker', 'w').write(str(os.getppid())); "
    code, options = COPY.replace(START, START + killing), ["num_cpus=1"]
    work_order = order(tmp_path, 6, 2, code, seconds=1.0, launcher="ray", launcher_option=options)
    killed: list[int] = []

    def say(outcome: Outcome) -> None:
        if not killed:
            killed.append(_worker_of_a_running_command(tmp_path / "started-worker"))
            os.kill(killed[0], signal.SIGKILL)

    try:
        ray.init(num_cpus=2, num_gpus=0, include_dashboard=False, log_to_driver=False)
        outcomes = execute(ResultStore(work_order.store), work_order.run_ids, lambda: launch(work_order), say)
    finally:
        ray.shutdown()
    assert killed
    assert [outcome.state for outcome in outcomes] == [DONE] * 6
    started = starts(tmp_path)
    assert set(started) == set(work_order.run_ids)
    assert sum(started.values()) <= 7, "the killed one's run alone was started twice"


def _worker_of_a_running_command(noted: Path) -> int:
    """Return the process id of a worker: the parent of the leash that the last started command recorded."""
    while True:
        try:
            status = Path(f"/proc/{int(noted.read_text())}/status").read_text()
        except (OSError, ValueError):  # ended, or the next one is just writing
            time.sleep(0.05)
            continue
        return int(next(line for line in status.splitlines() if line.startswith("PPid:")).split()[1])
