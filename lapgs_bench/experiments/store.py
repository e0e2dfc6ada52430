"""Store claims and results of runs in one SQLite file that workers share, on one machine or on many.

A run is pending, running, done or failed. A worker claims a run, renews its claim while the run lasts, and records the
row of results or the failure. A claim is abandoned when it is not renewed for `LEASE` seconds, or when its process on
this machine is gone; another worker may then take the run. A worker can only record while it holds the claim, so one
that was suspended records nothing, and a finished run is not repeated.

The journal is SQLite's default, because WAL does not work across machines on a network file system.
"""

from __future__ import annotations

import json
import os
import socket
import sqlite3
import time
import uuid
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from lapgs_bench.experiments.commands import Step
from lapgs_bench.experiments.expansion import RunSpec
from lapgs_plugin import __version__
from lapgs_plugin.errors import RunFolderError
from lapgs_plugin.files import is_folder, one_line_errors, require_own
from lapgs_plugin.untrusted import STRICT, parse_json, shortened

FORMAT_VERSION = 1
"""Version of the tables; a store of another version is refused."""
LEASE = 120.0
"""Seconds that a claim lasts without renewal. Clocks of machines that share a store must differ by less."""
MAX_CLAIMS = 3
"""Claims after which a run fails, because it probably kills its workers."""
SHOWN = 3
"""Most changed defaults that a message names."""
LOCK_TIMEOUT = 60.0
"""Seconds to wait for another process."""

PENDING, RUNNING, DONE, FAILED = "pending", "running", "done", "failed"

_TABLES = (
    "CREATE TABLE IF NOT EXISTS about (key TEXT PRIMARY KEY, value TEXT NOT NULL)",
    """CREATE TABLE IF NOT EXISTS runs (
    run_id TEXT PRIMARY KEY,
    position INTEGER NOT NULL,
    job TEXT NOT NULL,
    state TEXT NOT NULL,
    owner TEXT,
    lease_until REAL,
    claims INTEGER NOT NULL DEFAULT 0,
    record TEXT,
    error TEXT
)""",
)


@dataclass(frozen=True)
class Job:
    """Describe a run to a worker: its settings, output folder, log file and commands.

    Attributes:
        spec: settings in its row of results; None without such a row.
        evaluate: whether the last command is `lapgs eval`.
        defaults: see `commands.defaults_of`.
        scene: its scene's folder; "" for a scene that is made, and in stores of earlier versions.
    """

    __pydantic_config__: ClassVar[Any] = STRICT

    run_id: str
    spec: RunSpec | None
    folder: str
    log: str
    steps: tuple[Step, ...]
    evaluate: bool
    defaults: str
    scene: str = ""

    @property
    def continues(self) -> bool:
        """Whether its commands continue what is in its folder, as a tile's do; others start in an empty one."""
        return self.spec is None

    def attempt(self, number: int) -> Job:
        """Return the job in a separate folder: a worker that lost its claim may still write to the previous one.

        A job that continues keeps its folder, which `lapgs train` locks.
        """
        if number == 1 or self.continues:
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
    """Give a worker the right to one run.

    Attributes:
        job: the run, in a folder of this attempt.
        owner: unique name of the holder.
        number: claims of the run so far, with this one.
    """

    job: Job
    owner: str
    number: int


@dataclass(frozen=True)
class Outcome:
    """Describe a run in the store: its state, the row of a finished run, the reason of a failure or ""."""

    run_id: str
    state: str
    record: dict[str, Any] | None
    error: str

    @property
    def ended(self) -> bool:
        return self.state in (DONE, FAILED)


class ResultStore:
    """Keep an experiment's results in a file. Each method is one transaction; threads may share an object.

    Raises:
        RunFolderError: the file is missing, is no store, or was written by another version; from all methods, it cannot
            be read or written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise RunFolderError(f"{path} does not exist; `lapgs bench EXPERIMENT` makes it")
        with _transaction(self._path) as connection:
            about = dict(connection.execute("SELECT key, value FROM about").fetchall())
        if about.get("format") != str(FORMAT_VERSION):
            raise RunFolderError(
                f"{path} was written by {about.get('created_by', 'an unknown program')} in format "
                f"{about.get('format')}, expected {FORMAT_VERSION}; use that version, or choose another folder"
            )

    @classmethod
    def create(cls, path: Path) -> ResultStore:
        """Open the store at `path`; make it if it does not exist."""
        require_own(path)
        with one_line_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            missing = not path.exists() or path.stat().st_size == 0
        if missing:
            with _transaction(path) as connection:  # several processes may come here at once
                for table in _TABLES:
                    connection.execute(table)
                values = [("format", str(FORMAT_VERSION)), ("created_by", f"lapgs_plugin {__version__}")]
                connection.executemany("INSERT OR IGNORE INTO about VALUES (?, ?)", values)
        return cls(path)

    def plan(self, jobs: Sequence[Job], repeat: bool = False) -> None:
        """Add runs in this order. Finished runs stay; failed runs become pending again.

        Args:
            jobs: the runs.
            repeat: make finished runs pending again, too.

        Raises:
            RunFolderError: runs that are finished or running are of another scene, or have other defaults than the
                others would have.
        """
        with _transaction(self._path) as connection:
            begun = _begun(connection)
            self._require_same_scenes(begun, jobs)
            self._require_same_defaults(begun, jobs)
            again = (PENDING, FAILED, DONE) if repeat else (PENDING, FAILED)
            states = ", ".join("?" * len(again))
            for position, job in enumerate(jobs):
                connection.execute(
                    "INSERT INTO runs (run_id, position, job, state) VALUES (?, ?, ?, ?) "
                    "ON CONFLICT (run_id) DO UPDATE SET position = excluded.position",
                    (job.run_id, position, job.to_json(), PENDING),
                )
                connection.execute(
                    "UPDATE runs SET job = ?, state = ?, claims = 0, record = NULL, error = NULL "
                    f"WHERE run_id = ? AND state IN ({states})",
                    (job.to_json(), PENDING, job.run_id, *again),
                )

    def _require_same_scenes(self, begun: Mapping[str, Job], jobs: Sequence[Job]) -> None:
        # A run's name leaves the folder out, because scenes are moved and copied. Another one may have the same name.
        pairs = {
            (begun[job.run_id].scene, job.scene, job.spec.images)
            for job in jobs
            if job.spec is not None and job.scene and job.run_id in begun
        }
        for before, now, images in sorted(pairs):
            if before and not _same_scene(before, now, images):
                raise RunFolderError(
                    f"{self._path}: its runs are of {before}, whose files differ from those of {now}; choose another "
                    "folder with --out"
                )

    def _require_same_defaults(self, begun: Mapping[str, Job], jobs: Sequence[Job]) -> None:
        pairs = [(begun[job.run_id].defaults, job.defaults) for job in jobs if job.run_id in begun]
        others = [pair for pair in pairs if pair[0] != pair[1]]
        if others and len(pairs) < len(jobs):
            raise RunFolderError(
                f"{self._path}: {len(others)} of its runs have other defaults than the {len(jobs) - len(pairs)} that "
                f"remain ({_differences(*others[0])}), and a table would mix them; choose another folder with --out, "
                "or finish it with the version that began it"
            )

    def claim(self, run_ids: Collection[str]) -> Claim | None:
        """Claim the first free run of these; None when none is free."""
        with _transaction(self._path) as connection:
            for run_id, job, claims in _free(connection, run_ids):
                if claims >= MAX_CLAIMS:
                    connection.execute(
                        "UPDATE runs SET state = ?, owner = NULL, error = ? WHERE run_id = ?",
                        (FAILED, f"the worker that ran it died {claims} times", run_id),
                    )
                    continue
                owner = f"{_machine()}|{os.getpid()}|{uuid.uuid4().hex}"
                connection.execute(
                    "UPDATE runs SET state = ?, owner = ?, lease_until = ?, claims = ? WHERE run_id = ?",
                    (RUNNING, owner, time.time() + LEASE, claims + 1, run_id),
                )
                return Claim(Job.from_json(job).attempt(claims + 1), owner, claims + 1)
        return None

    def has_free(self, run_ids: Collection[str]) -> bool:
        """Tell whether `claim` would find one of these runs."""
        with _transaction(self._path) as connection:
            return any(True for _ in _free(connection, run_ids))

    def renew(self, claim: Claim) -> bool:
        """Extend a claim by `LEASE`; False when it is lost, and the run must be stopped."""
        return self._update(claim, "lease_until = ?", (time.time() + LEASE,))

    def release(self, claim: Claim) -> None:
        """Make a stopped run pending again, without counting this attempt."""
        self._update(claim, "state = ?, owner = NULL, claims = claims - 1", (PENDING,))

    def record(self, claim: Claim, row: Mapping[str, Any]) -> bool:
        """Record the row of a finished run; False when the claim is lost, and nothing is recorded."""
        return self._update(claim, "state = ?, owner = NULL, record = ?, error = NULL", (DONE, json.dumps(dict(row))))

    def fail(self, claim: Claim, error: str) -> bool:
        """Record the reason of a failure; False when the claim is lost."""
        return self._update(claim, "state = ?, owner = NULL, error = ?", (FAILED, error))

    def outcomes(self, run_ids: Collection[str] | None = None) -> list[Outcome]:
        """Return all runs, or these, in order."""
        wanted = None if run_ids is None else set(run_ids)
        with _transaction(self._path) as connection:
            rows = connection.execute("SELECT run_id, state, record, error FROM runs ORDER BY position").fetchall()
        return [
            Outcome(run_id, state, None if record is None else self._row(run_id, record), error or "")
            for run_id, state, record, error in rows
            if wanted is None or run_id in wanted
        ]

    def _row(self, run_id: str, text: str) -> dict[str, Any]:
        """Parse the recorded row of a run."""
        name, advice = f"the record of {run_id} in {self._path}", "run the experiment again in another folder"
        row: dict[str, Any] = parse_json(text, name, dict[str, Any], error=RunFolderError, advice=advice)
        return row

    def _update(self, claim: Claim, changes: str, values: tuple[Any, ...]) -> bool:
        with _transaction(self._path) as connection:
            cursor = connection.execute(
                f"UPDATE runs SET {changes} WHERE run_id = ? AND owner = ? AND state = ?",
                (*values, claim.job.run_id, claim.owner, RUNNING),
            )
            return cursor.rowcount == 1


@contextmanager
def _transaction(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a transaction that locks out other processes."""
    try:
        # Closing rolls back an uncommitted transaction.
        with closing(sqlite3.connect(path, timeout=LOCK_TIMEOUT, isolation_level=None)) as connection:
            connection.execute("BEGIN IMMEDIATE")
            yield connection
            connection.execute("COMMIT")
    except sqlite3.OperationalError as error:
        raise RunFolderError(
            f"{path} cannot be read or written ({error}); expected a store of results on a disk with room and file "
            "locks"
        ) from error
    except sqlite3.DatabaseError as error:
        raise RunFolderError(f"{path} is no store of results ({error}); choose another folder") from error


def _begun(connection: sqlite3.Connection) -> dict[str, Job]:
    """Return the jobs that are running or done, by their runs."""
    rows = connection.execute("SELECT run_id, job FROM runs WHERE state IN (?, ?)", (RUNNING, DONE)).fetchall()
    return {run_id: Job.from_json(text) for run_id, text in rows}


def _same_scene(one: str, other: str, images: str) -> bool:
    """Tell whether two folders are one scene: the same, moved, or with photos and model of the same names and sizes."""
    return one == other or not is_folder(Path(one)) or _sizes(Path(one), images) == _sizes(Path(other), images)


def _sizes(scene: Path, images: str) -> dict[str, int]:
    """Return the sizes in bytes of a scene's files by name, without the PLY files that training scripts add."""
    parts = [path for part in (images, "sparse") for path in (scene / part).rglob("*") if path.suffix != ".ply"]
    files = [*scene.glob("transforms*.json"), *parts]
    return {path.relative_to(scene).as_posix(): path.stat().st_size for path in files if path.is_file()}


def _free(connection: sqlite3.Connection, run_ids: Collection[str]) -> Iterator[tuple[str, str, int]]:
    """Yield name, job and claims of those of these runs that wait or were abandoned, in order."""
    wanted, now = set(run_ids), time.time()
    rows = connection.execute(
        "SELECT run_id, job, claims, state, owner, lease_until FROM runs WHERE state IN (?, ?) ORDER BY position",
        (PENDING, RUNNING),
    ).fetchall()
    for run_id, job, claims, state, holder, lease_until in rows:
        if run_id in wanted and (state == PENDING or _abandoned(holder, lease_until, now)):
            yield run_id, job, claims


def _differences(one: str, other: str) -> str:
    """Return the first differences of two texts of `commands.defaults_of` in words."""
    advice = "choose another folder with --out"
    before, now = (
        parse_json(text, "the defaults of a run", dict[str, Any], error=RunFolderError, advice=advice)
        for text in (one, other)
    )
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    words = [f"{name} was {shortened(before.get(name))}, is {shortened(now.get(name))}" for name in names]
    return "; ".join(words[:SHOWN])


def _abandoned(owner: str, lease_until: float, now: float) -> bool:
    """Tell whether a claim has expired, or its process on this machine has ended."""
    machine, pid, _ = owner.rsplit("|", 2)
    return now > lease_until or (machine == _machine() and not _alive(int(pid)))


def _machine() -> str:
    """Return the name of this machine, and on Linux of its container: each has numbers of processes of its own."""
    try:
        container = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        container = ""
    return f"{socket.gethostname()} {container}"


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
