"""Test that the store neither loses nor repeats runs when workers die, and that it refuses damaged files."""

from __future__ import annotations

import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from lapgs_bench.experiments import store as store_module
from lapgs_bench.experiments.commands import defaults_of
from lapgs_bench.experiments.store import DONE, FAILED, LEASE, MAX_CLAIMS, PENDING, RUNNING, Job, Outcome, ResultStore
from lapgs_bench.experiments.worker import work
from lapgs_plugin.errors import RunFolderError
from tests.experiments.examples import COPY, START, copying_jobs, starts
from tests.mishaps import disk_full
from tests.waiting import wait_for

WORKER = "import sys; from pathlib import Path; from lapgs_bench.experiments.worker import work; "
WORKER += "print(work(Path(sys.argv[1]), sys.argv[2:]))"


def start_worker(store: Path, run_ids: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", WORKER, str(store), *run_ids], stdout=subprocess.DEVNULL)


def worked(folder: Path, jobs: Sequence[Job]) -> list[Outcome]:
    """Plan the jobs, and work until all have ended."""
    path, run_ids = folder / "results.sqlite", [job.run_id for job in jobs]
    store = ResultStore.create(path)
    store.plan(jobs)
    assert work(path, run_ids) == len(jobs)
    return store.outcomes(run_ids)


@pytest.fixture
def planned(tmp_path: Path) -> tuple[ResultStore, list[str]]:
    jobs = copying_jobs(tmp_path, 8)
    store = ResultStore.create(tmp_path / "results.sqlite")
    store.plan(jobs)
    return store, [job.run_id for job in jobs]


def test_a_finished_run_is_repeated_only_if_that_is_asked_for(tmp_path: Path) -> None:
    jobs = copying_jobs(tmp_path, 2)
    worked(tmp_path, jobs)
    store = ResultStore(tmp_path / "results.sqlite")
    store.plan(jobs)
    assert [outcome.state for outcome in store.outcomes()] == [DONE, DONE]
    store.plan(jobs[1:], repeat=True)
    assert [(outcome.state, outcome.record is None) for outcome in store.outcomes()] == [(DONE, False), (PENDING, True)]


def test_workers_share_the_runs(planned: tuple[ResultStore, list[str]], tmp_path: Path) -> None:
    store, run_ids = planned
    workers = [start_worker(tmp_path / "results.sqlite", run_ids) for _ in range(2)]
    assert [worker.wait(timeout=60) for worker in workers] == [0, 0]
    outcomes = store.outcomes(run_ids)
    assert [outcome.state for outcome in outcomes] == [DONE] * len(run_ids)
    assert [outcome.run_id for outcome in outcomes] == run_ids
    assert starts(tmp_path) == dict.fromkeys(run_ids, 1)


def test_a_killed_worker_costs_one_run_its_first_attempt(tmp_path: Path) -> None:
    jobs = copying_jobs(
        tmp_path,
        2,
        seconds=1.0,
        code=COPY.replace(START, START + "import os; open(started + '-pid', 'w').write(str(os.getpid())); "),
    )
    path, run_ids = tmp_path / "results.sqlite", [job.run_id for job in jobs]
    store = ResultStore.create(path)
    store.plan(jobs)
    doomed = start_worker(path, run_ids)
    wait_for(lambda: (tmp_path / "started-pid").exists() and (tmp_path / "started-pid").read_text() != "")
    child = int((tmp_path / "started-pid").read_text())
    doomed.send_signal(signal.SIGKILL)
    doomed.wait()
    wait_for(lambda: not Path(f"/proc/{child}").exists() if sys.platform == "linux" else True)
    assert work(path, run_ids) == len(run_ids), "what the dead worker held is taken over"
    assert [outcome.state for outcome in store.outcomes(run_ids)] == [DONE] * len(run_ids)
    first, *others = run_ids
    assert starts(tmp_path) == {first: 2, **dict.fromkeys(others, 1)}
    record = store.outcomes([first])[0].record
    assert record is not None
    assert record["attempt"] == 2
    assert record["folder"].endswith(f"{first}-attempt2"), "not where the dead one's command was writing"
    assert Path(record["folder"], "manifest.json").is_file()


def test_a_worker_that_slept_through_its_lease_records_nothing(
    planned: tuple[ResultStore, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, run_ids = planned
    slept = store.claim(run_ids[:1])
    assert slept is not None
    assert store.claim(run_ids[:1]) is None, "it is running"
    assert not store.has_free(run_ids[:1])
    now = time.time()
    monkeypatch.setattr(store_module.time, "time", lambda: now + LEASE + 1)
    assert store.has_free(run_ids[:1])
    other = store.claim(run_ids[:1])
    assert other is not None
    assert (slept.number, other.number) == (1, 2)
    assert not store.renew(slept)
    assert not store.record(slept, {"psnr": 1.0})
    assert store.record(other, {"psnr": 2.0})
    assert not store.fail(slept, "late")
    (outcome,) = store.outcomes(run_ids[:1])
    assert (outcome.state, outcome.record) == (DONE, {"psnr": 2.0})


def test_a_worker_in_another_container_is_not_taken_for_dead(
    planned: tuple[ResultStore, list[str]], tmp_path: Path
) -> None:
    """Containers on the host's network have its name, but numbers of processes of their own."""
    apart = ["unshare", "--map-root-user", "--pid", "--fork", "--kill-child"]
    if (
        sys.platform != "linux"
        or shutil.which("unshare") is None
        or subprocess.run([*apart, "true"], check=False).returncode
    ):
        pytest.skip("this machine lets nobody number processes anew")
    store, run_ids = planned
    claim = store.claim(run_ids[:1])
    assert claim is not None
    code = "import sys; from pathlib import Path; from lapgs_bench.experiments.store import ResultStore; "
    code += "print(ResultStore(Path(sys.argv[1])).has_free(sys.argv[2:]))"
    command = [*apart, sys.executable, "-c", code, str(tmp_path / "results.sqlite"), run_ids[0]]
    assert subprocess.check_output(command, text=True) == "False\n"
    assert store.renew(claim)


def test_a_run_that_kills_its_workers_fails_in_the_end(
    planned: tuple[ResultStore, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    store, run_ids = planned
    now = time.time()
    for death in range(MAX_CLAIMS):
        monkeypatch.setattr(store_module.time, "time", lambda death=death: now + death * (LEASE + 1))
        assert store.claim(run_ids[:1]) is not None
    monkeypatch.setattr(store_module.time, "time", lambda: now + MAX_CLAIMS * (LEASE + 1))
    assert store.claim(run_ids[:1]) is None
    (outcome,) = store.outcomes(run_ids[:1])
    assert (outcome.state, outcome.error) == (FAILED, f"the worker that ran it died {MAX_CLAIMS} times")


def test_what_is_done_stays_done_and_what_failed_gets_another_chance(
    planned: tuple[ResultStore, list[str]], tmp_path: Path
) -> None:
    store, run_ids = planned
    done, failed = store.claim(run_ids), store.claim(run_ids)
    assert done is not None
    assert failed is not None
    store.record(done, {"psnr": 1.0})
    store.fail(failed, "why")
    assert [outcome.state for outcome in store.outcomes(run_ids[:2])] == [DONE, FAILED]
    store.plan(copying_jobs(tmp_path, 8))
    assert [outcome.state for outcome in store.outcomes(run_ids[:2])] == [DONE, PENDING]
    released = store.claim(run_ids)
    assert released is not None
    assert (released.job.run_id, released.number) == (run_ids[1], 1)
    store.release(released)
    assert store.outcomes([run_ids[1]])[0].state == PENDING


def test_a_command_that_fails_is_reported_with_the_end_of_its_log(tmp_path: Path) -> None:
    lines = "".join(f"print('line {i}'); " for i in range(30)) + "sys.exit(3)"
    jobs = [*copying_jobs(tmp_path, 1, code=START + lines), *copying_jobs(tmp_path, 2)[1:]]
    failed, done = worked(tmp_path, jobs)
    assert (failed.state, done.state) == (FAILED, DONE), "the rest goes on"
    assert "exit code 3" in failed.error
    assert failed.error.splitlines()[-1] == "line 29"
    assert "line 17" not in failed.error


def test_a_command_that_writes_no_run_is_a_failure(tmp_path: Path) -> None:
    jobs = copying_jobs(tmp_path, 1, code=START)
    (outcome,) = worked(tmp_path, jobs)
    assert outcome.state == FAILED
    assert "is not a run" in outcome.error


def test_a_worker_without_room_gives_its_run_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its process lives on, as that of `lapgs bench` does, so nobody would take the run before its claim expires."""
    jobs = copying_jobs(tmp_path, 1)
    path, run_ids = tmp_path / "results.sqlite", [jobs[0].run_id]
    store = ResultStore.create(path)
    store.plan(jobs)

    def fail(*_: object, **__: object) -> None:
        raise disk_full()

    with monkeypatch.context() as full:
        full.setattr(Path, "mkdir", fail)
        with pytest.raises(OSError, match="No space left"):
            work(path, run_ids)
    assert store.has_free(run_ids)
    assert work(path, run_ids) == 1
    (outcome,) = store.outcomes(run_ids)
    assert outcome.record is not None
    assert outcome.record["attempt"] == 1, "nothing died"


def test_stopping_kills_the_run_and_gives_it_back(tmp_path: Path) -> None:
    jobs = copying_jobs(tmp_path, 1, seconds=60.0)
    path, run_ids = tmp_path / "results.sqlite", [jobs[0].run_id]
    store = ResultStore.create(path)
    store.plan(jobs)
    stop = threading.Event()
    thread = threading.Thread(target=work, args=(path, run_ids, None, stop))
    thread.start()
    wait_for(lambda: bool(starts(tmp_path)))
    stop.set()
    thread.join(timeout=10)
    assert not thread.is_alive()
    assert store.outcomes(run_ids)[0].state == PENDING


def test_a_store_of_another_version(tmp_path: Path) -> None:
    path = tmp_path / "results.sqlite"
    ResultStore.create(path)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE about SET value = '7' WHERE key = 'format'")
        connection.execute("UPDATE about SET value = 'lapgs_plugin 9.0' WHERE key = 'created_by'")
    connection.close()
    with pytest.raises(RunFolderError, match=r"written by lapgs_plugin 9\.0 in format 7, expected 1"):
        ResultStore(path)
    path.write_bytes(b"not a database at all" * 100)
    with pytest.raises(RunFolderError, match="is no store of results"):
        ResultStore(path)
    with pytest.raises(RunFolderError, match="does not exist"):
        ResultStore(tmp_path / "none.sqlite")


def test_a_store_refuses_runs_with_other_defaults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    older = [replace(job, defaults=defaults_of(job.spec)) for job in copying_jobs(tmp_path, 3)]
    store = ResultStore.create(tmp_path / "results.sqlite")
    store.plan(older)
    monkeypatch.setattr("lapgs_plugin.training.strategies.LONG_RUN", 10)  # what "auto" means for these runs
    newer = [replace(job, defaults=defaults_of(job.spec)) for job in older]
    store.plan(newer)  # nothing was begun
    assert store.claim([newer[0].run_id]) is not None
    store.plan(newer)
    with pytest.raises(RunFolderError, match=r"1 of its runs .* the 2 that remain \(.*strategy was 'mcmc', is '3dgs'"):
        store.plan(older)
    store.plan(older[:1])  # nothing remains to be run


def test_a_store_without_its_tables_or_in_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "results.sqlite"
    sqlite3.connect(path).close()
    path.touch()
    with pytest.raises(RunFolderError, match=r"cannot be read or written \(no such table"):
        ResultStore(path)
    store = ResultStore.create(path)  # as after a command that was killed while it made the file
    monkeypatch.setattr(store_module, "LOCK_TIMEOUT", 0.1)
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(RunFolderError, match="database is locked"):
        store.claim([])
    other.close()
    assert store.claim([]) is None


def test_many_processes_make_one_store(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "results.sqlite"
    code = "import sys; from pathlib import Path; from lapgs_bench.experiments.store import ResultStore; "
    code += "ResultStore.create(Path(sys.argv[1]))"
    makers = [subprocess.Popen([sys.executable, "-c", code, str(path)]) for _ in range(4)]
    assert [maker.wait(timeout=60) for maker in makers] == [0] * 4
    assert sorted(file.name for file in path.parent.iterdir()) == ["results.sqlite"]


def test_a_transaction_that_is_killed_leaves_the_store_as_it_was(
    planned: tuple[ResultStore, list[str]], tmp_path: Path
) -> None:
    store, run_ids = planned
    path = tmp_path / "results.sqlite"
    code = (
        "import os, sqlite3, sys; c = sqlite3.connect(sys.argv[1], isolation_level=None); "
        "c.execute('BEGIN IMMEDIATE'); c.execute(\"UPDATE runs SET state = 'done'\"); os.kill(os.getpid(), 9)"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert {outcome.state for outcome in store.outcomes(run_ids)} == {PENDING}
    assert store.claim(run_ids) is not None
    assert Counter(outcome.state for outcome in store.outcomes(run_ids)) == {PENDING: 7, RUNNING: 1}


def test_a_store_is_not_made_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    (tmp_path / "results.sqlite").symlink_to(tmp_path / "empty")
    with pytest.raises(RunFolderError, match="is a link"):
        ResultStore.create(tmp_path / "results.sqlite")
    assert (tmp_path / "empty").read_bytes() == b""


@pytest.mark.parametrize("name", ["folder", "log"])
def test_no_run_is_written_through_a_link(tmp_path: Path, name: str) -> None:
    (job,) = copying_jobs(tmp_path, 1)
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "file").write_text("precious")
    path = Path(getattr(job, name))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(tmp_path / "precious" / ("" if name == "folder" else "file"))
    (outcome,) = worked(tmp_path, [job])
    assert outcome.state == FAILED
    assert f"{path} is a link" in outcome.error
    assert (tmp_path / "precious" / "file").read_text() == "precious"
