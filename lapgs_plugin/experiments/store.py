"""Who runs what, and what came out: one SQLite file that several workers share, on one machine or on many.

A run is pending, running, done or failed. A worker claims one, renews its claim while the run lasts, and either
records the run's row or its failure. A claim that is not renewed for `LEASE` seconds, or whose process is gone from
this machine, is anybody's. What a worker records is taken only while the claim is still its own, so a worker that was
suspended and comes back records nothing, and a run that is done is never run again.

The journal is SQLite's default, not WAL, which does not work across machines on a network file system.
"""

from __future__ import annotations

import json
import os
import socket
import sqlite3
import sys
import time
import uuid
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from lapgs_plugin import __version__
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.experiments.commands import Step
from lapgs_plugin.experiments.expansion import RunSpec
from lapgs_plugin.files import one_line_errors
from lapgs_plugin.untrusted import STRICT, parse_json

FORMAT_VERSION = 1
LEASE = 120.0
"""Seconds that a claim holds without being renewed. Clocks of machines that share a store may differ by less."""
MOST_CLAIMS = 3
"""A run whose workers died this often is failed: it is probably what kills them."""
PATIENCE = 60.0
"""Seconds to wait for another process's transaction, which takes milliseconds."""

PENDING, RUNNING, DONE, FAILED = "pending", "running", "done", "failed"

_TABLES = """
CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE runs (
    run_id TEXT PRIMARY KEY,
    position INTEGER NOT NULL,
    spec TEXT NOT NULL,
    job TEXT NOT NULL,
    state TEXT NOT NULL,
    owner TEXT,
    lease_until REAL,
    claims INTEGER NOT NULL DEFAULT 0,
    record TEXT,
    error TEXT
);
"""


@dataclass(frozen=True)
class Job:
    """What a worker needs to know of a run.

    Attributes:
        run_id: of the run.
        spec: what is trained.
        folder: that it writes into.
        log: file for what its commands print.
        steps: its commands.
        evaluate: whether the last of them is `lapgs eval`.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    run_id: str
    spec: RunSpec
    folder: str
    log: str
    steps: tuple[Step, ...]
    evaluate: bool

    def attempt(self, number: int) -> Job:
        """The same in a folder of its own: a worker that lost its claim may still be writing into the last one's."""
        if number == 1:
            return self
        folder, log = f"{self.folder}-attempt{number}", f"{self.log.removesuffix('.log')}-attempt{number}.log"
        steps = [
            Step(tuple(word.replace(self.folder, folder) for word in step.command), step.cwd) for step in self.steps
        ]
        return replace(self, folder=folder, log=log, steps=tuple(steps))

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Job:
        advice = "plan the experiment again in another folder"
        job: Job = parse_json(text, "a run in the store", cls, error=RunFolderError, advice=advice)
        return job


@dataclass(frozen=True)
class Claim:
    """A worker's right to one run.

    Attributes:
        job: the run, in a folder of this attempt.
        owner: who has it; no two claims have the same.
        number: how often the run was claimed so far, this time included.
    """

    job: Job
    owner: str
    number: int


@dataclass(frozen=True)
class Outcome:
    """A run in the store.

    Attributes:
        run_id: of the run.
        state: "pending", "running", "done" or "failed".
        record: the row of a run that is done, else None.
        error: why it failed, "" unless it did.
    """

    run_id: str
    state: str
    record: dict[str, Any] | None
    error: str


class ResultStore:
    """An experiment's results. Every method is one transaction; objects may be used by several threads.

    All methods raise RunFolderError when the file cannot be read or written.

    Args:
        path: the file; `create` makes one.

    Raises:
        RunFolderError: there is none, it is no store, or another version wrote it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise RunFolderError(f"{path} does not exist; `lapgs bench EXPERIMENT.toml` makes it")
        with self._transaction() as connection:
            about = dict(connection.execute("SELECT key, value FROM about").fetchall())
        if about.get("format") != str(FORMAT_VERSION):
            raise RunFolderError(
                f"{path} was written by {about.get('created_by', 'an unknown program')} in format "
                f"{about.get('format')}, expected {FORMAT_VERSION}; use that version, or choose another folder"
            )

    @classmethod
    def create(cls, path: Path) -> ResultStore:
        """Open the store at `path`, after making it if there is none."""
        if not path.is_file():
            with one_line_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                # Two processes may be here at once: each makes a whole file, and the second keeps the first's.
                fresh = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
                connection = sqlite3.connect(fresh)
                try:
                    connection.executescript(_TABLES)
                    values = [("format", str(FORMAT_VERSION)), ("created_by", f"lapgs_plugin {__version__}")]
                    connection.executemany("INSERT INTO about VALUES (?, ?)", values)
                    connection.commit()
                finally:
                    connection.close()
                try:
                    if not path.exists():
                        _put_if_absent(fresh, path)
                finally:
                    fresh.unlink(missing_ok=True)
        return cls(path)

    def plan(self, jobs: Sequence[Job]) -> None:
        """Put runs into the store in this order. Those done stay done; those failed get another chance."""
        with self._transaction() as connection:
            for position, job in enumerate(jobs):
                values = (job.run_id, position, json.dumps(asdict(job.spec)), job.to_json(), PENDING)
                connection.execute(
                    "INSERT INTO runs (run_id, position, spec, job, state) VALUES (?, ?, ?, ?, ?) "
                    "ON CONFLICT (run_id) DO UPDATE SET position = excluded.position",
                    values,
                )
                connection.execute(
                    "UPDATE runs SET job = ?, state = ?, claims = 0, error = NULL WHERE run_id = ? AND state IN (?, ?)",
                    (job.to_json(), PENDING, job.run_id, PENDING, FAILED),
                )

    def claim(self, run_ids: Collection[str]) -> Claim | None:
        """Take the first of these runs that nobody has; None when there is none to take."""
        now, wanted = time.time(), set(run_ids)
        with self._transaction() as connection:
            found = connection.execute(
                "SELECT run_id, job, state, owner, lease_until, claims FROM runs WHERE state IN (?, ?) "
                "ORDER BY position",
                (PENDING, RUNNING),
            ).fetchall()
            for run_id, job, state, holder, lease_until, claims in found:
                if run_id not in wanted or (state == RUNNING and not _abandoned(holder, lease_until, now)):
                    continue
                if claims >= MOST_CLAIMS:
                    connection.execute(
                        "UPDATE runs SET state = ?, owner = NULL, error = ? WHERE run_id = ?",
                        (FAILED, f"the worker that ran it died {claims} times", run_id),
                    )
                    continue
                owner = _new_owner()
                connection.execute(
                    "UPDATE runs SET state = ?, owner = ?, lease_until = ?, claims = ? WHERE run_id = ?",
                    (RUNNING, owner, now + LEASE, claims + 1, run_id),
                )
                return Claim(Job.from_json(job).attempt(claims + 1), owner, claims + 1)
        return None

    def has_free(self, run_ids: Collection[str]) -> bool:
        """Whether `claim` would find one of these runs."""
        now, wanted = time.time(), set(run_ids)
        with self._transaction() as connection:
            found = connection.execute("SELECT run_id, state, owner, lease_until FROM runs").fetchall()
        return any(
            run_id in wanted and (state == PENDING or (state == RUNNING and _abandoned(holder, lease_until, now)))
            for run_id, state, holder, lease_until in found
        )

    def renew(self, claim: Claim) -> bool:
        """Hold a claim for another `LEASE`; False when it is lost, and the run must be stopped."""
        return self._update(claim, "lease_until = ?", (time.time() + LEASE,))

    def release(self, claim: Claim) -> None:
        """Give a run back that was stopped on request: it is pending, and this was no attempt."""
        self._update(claim, "state = ?, owner = NULL, claims = claims - 1", (PENDING,))

    def record(self, claim: Claim, row: Mapping[str, Any]) -> bool:
        """Keep the row of a finished run; False when the claim was lost, and nothing is kept."""
        return self._update(claim, "state = ?, owner = NULL, record = ?, error = NULL", (DONE, json.dumps(dict(row))))

    def fail(self, claim: Claim, error: str) -> bool:
        """Keep why a run failed; False when the claim was lost."""
        return self._update(claim, "state = ?, owner = NULL, error = ?", (FAILED, error))

    def outcomes(self, run_ids: Collection[str] | None = None) -> list[Outcome]:
        """The runs in their order, all or those."""
        wanted = None if run_ids is None else set(run_ids)
        with self._transaction() as connection:
            found = connection.execute("SELECT run_id, state, record, error FROM runs ORDER BY position").fetchall()
        return [
            Outcome(run_id, state, None if record is None else self._row(run_id, record), error or "")
            for run_id, state, record, error in found
            if wanted is None or run_id in wanted
        ]

    def _row(self, run_id: str, text: str) -> dict[str, Any]:
        """What is recorded of a run."""
        name, advice = f"the record of {run_id} in {self._path}", "run the experiment again in another folder"
        row: dict[str, Any] = parse_json(text, name, dict[str, Any], error=RunFolderError, advice=advice)
        return row

    def _update(self, claim: Claim, changes: str, values: tuple[Any, ...]) -> bool:
        with self._transaction() as connection:
            cursor = connection.execute(
                f"UPDATE runs SET {changes} WHERE run_id = ? AND owner = ? AND state = ?",
                (*values, claim.job.run_id, claim.owner, RUNNING),
            )
            return cursor.rowcount == 1

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """One transaction that no other process interrupts."""
        connection = sqlite3.connect(self._path, timeout=PATIENCE, isolation_level=None)
        try:
            connection.execute("BEGIN IMMEDIATE")
            yield connection
            connection.execute("COMMIT")
        except sqlite3.OperationalError as error:
            raise RunFolderError(
                f"{self._path} cannot be read or written ({error}); expected a store of results on a disk with room "
                "and file locks"
            ) from error
        except sqlite3.DatabaseError as error:
            raise RunFolderError(f"{self._path} is no store of results ({error}); choose another folder") from error
        finally:
            connection.close()  # rolls back what was not committed


def _put_if_absent(source: Path, target: Path) -> None:
    """Give a whole file its name, unless another process was first."""
    try:
        os.link(source, target)
    except FileExistsError:
        pass
    except OSError:  # no hard links on this file system
        source.replace(target)


def _new_owner() -> str:
    return f"{socket.gethostname()}|{os.getpid()}|{uuid.uuid4().hex}"


def _abandoned(owner: str, lease_until: float, now: float) -> bool:
    """Whether a claim is nobody's any more."""
    host, pid, _ = owner.rsplit("|", 2)
    return now > lease_until or (host == socket.gethostname() and not _alive(int(pid)))


def _alive(pid: int) -> bool:
    if sys.platform == "win32":  # asking there would end the process; the lease decides
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
