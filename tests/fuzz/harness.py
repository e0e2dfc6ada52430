"""Damaged files, and what has to come of them: a result, or one line that says what is wrong with which file.

A case is a file that some command reads, damaged. It is read in a process of its own (`worker`), which is used for many
cases and started again when it dies, hangs or has grown too large: native readers end a process, and what they allocate
Python does not see. `KINDS` (in `kinds`) says how files of each kind are made, damaged and read.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from types import TracebackType
from typing import Any

from lapgs_plugin.errors import printable
from tests.fuzz.worker import STOPPED

MOST_BYTES = 1_500_000_000
"""Of the whole process, torch and all."""
MOST_SECONDS = 60.0
"""Of a processor, which a busy machine gives no case more of."""
MOST_WAITING = 60.0
"""Seconds by the clock in which a case does nothing: it waits for something that never comes."""
MOST_MORE = 4_000_000_000
"""What a case may ask of the system before that refuses: so much is a failure however it is reported."""
START_SECONDS = 300.0
LONGEST_LINE = 1_500
"""Characters of a message: one that quotes a whole file is no line."""
ROOT = Path(__file__).parents[2]
Damage = Callable[[bytes, Random], bytes]


@dataclass(frozen=True)
class Kind:
    """One kind of file.

    Attributes:
        name: of the kind.
        target: the file, below a folder that `templates.make_templates` fills.
        damage: makes other bytes of the file's.
        commands: one of them reads it, drawn for each case; paths are below the case's folder, where they do not
            begin with {templates}.
        slow_commands: take long, and are added where there is time.
        also: further folders that commands write to or that have to lie beside it.
        layout: what is damaged is no file but which files there are: `content` is `rearrange`'s, and `target` names a
            folder.
    """

    name: str
    target: str
    damage: Damage
    commands: Sequence[tuple[str, ...]]
    slow_commands: Sequence[tuple[str, ...]] = ()
    also: Sequence[str] = ()
    layout: bool = False

    @property
    def folders(self) -> list[str]:
        return list(dict.fromkeys([self.target.split("/")[0], *self.also]))


@dataclass(frozen=True)
class Case:
    """A damaged file and the command that reads it."""

    kind: Kind
    content: bytes
    command: tuple[str, ...]

    @classmethod
    def drawn(cls, kind: Kind, template: bytes, random: Random, slow: bool = False) -> Case:
        commands = [*kind.commands, *(kind.slow_commands if slow else ())]
        return cls(kind, kind.damage(template, random), random.choice(commands))


@dataclass(frozen=True)
class Problem:
    """What a case should not have done.

    Attributes:
        what: the rule it broke, in a few words.
        detail: message or traceback.
    """

    what: str
    detail: str

    @property
    def signature(self) -> str:
        """The same for the same mistake: the rule, and the place in our code if there is a traceback."""
        places = re.findall(r'File ".*?/((?:lapgs_plugin|tests)/[^"]+)", line (\d+), in (\S+)', self.detail)
        own = [f"{file}:{line} {name}" for file, line, name in places if file.startswith("lapgs_plugin")]
        last = self.detail.strip().splitlines()[-1] if self.detail.strip() else ""
        kind = re.match(r"[\w.]*", last)
        return f"{self.what} | {kind[0] if kind and own else ''} | {own[-1] if own else last[:100]}"


class Reader:
    """The process that cases are read in; a context manager.

    Args:
        scratch: folder for the cases' files.

    Attributes:
        patience: seconds of a processor for a case.
        waits: seconds by the clock in which a case may do nothing.
        highest: most memory that the process ever had, in bytes.
        longest: seconds that a case took.
    """

    def __init__(self, scratch: Path) -> None:
        self.patience, self.waits = MOST_SECONDS, MOST_WAITING
        self._scratch = scratch
        self._process: subprocess.Popen[bytes] | None = None
        self._replies = -1
        self._child = 0
        self._buffer = b""
        self.highest = 0
        self.longest = 0.0

    def __enter__(self) -> Reader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None:
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process.wait()
            os.close(self._replies)
            self._process = None

    def run(self, command: Sequence[str], folder: Path) -> dict[str, Any] | Problem:
        """What `worker` says of a command, or how its process ended."""
        process = self._started()
        assert process.stdin is not None
        started = time.monotonic()
        process.stdin.write(json.dumps({"folder": str(folder), "command": list(command)}).encode() + b"\n")
        process.stdin.flush()
        before = used = self._used()
        worked, answer = started, None
        while answer is None and used - before < self.patience and time.monotonic() - worked < self.waits:
            answer = self._read(min(1.0, self.waits))
            if (now := self._used()) > used:
                used, worked = now, time.monotonic()
        self.longest = max(self.longest, time.monotonic() - started)
        if answer is None:
            self._replace_child()
            return Problem(f"took more than {min(self.patience, self.waits):g} s", " ".join(command))
        if "ended" in answer:
            self._meet_child()
            return Problem(f"ended the process ({answer['ended']})", self._log.read_text(errors="replace")[-2000:])
        self.highest = max(self.highest, answer["highest"])
        if answer["highest"] > MOST_BYTES or answer["starved"]:
            self._replace_child()  # what it once had cannot be told from what the next case takes
        return answer

    def _used(self) -> float:
        """Seconds of a processor that the child and what it started have used; 0 where that is unknown."""
        ticks = 0
        family = [str(self._child)]
        for process in family:
            try:
                words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
                ticks += sum(map(int, words[11:15]))  # with those of its children that have ended
                family += Path(f"/proc/{process}/task/{process}/children").read_text().split()
            except OSError:
                continue
        return ticks / os.sysconf("SC_CLK_TCK")

    @property
    def _log(self) -> Path:
        return self._scratch / "native.log"

    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is not None:
            return self._process
        self._scratch.mkdir(parents=True, exist_ok=True)
        self._replies, sending = os.pipe()
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.fuzz.worker", str(sending), str(MOST_MORE)],
                cwd=ROOT,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                pass_fds=[sending],
                # Arenas of threads would be counted as memory that was asked for.
                env={**os.environ, "OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2", "PYTHONPATH": str(ROOT)},
            )
        os.close(sending)
        self._meet_child()
        return self._process

    def _replace_child(self) -> None:
        os.kill(self._child, signal.SIGKILL)
        while "ended" not in (self._read(START_SECONDS) or {"ended": None}):
            pass  # it may have answered just before
        self._meet_child()

    def _meet_child(self) -> None:
        answer = self._read(START_SECONDS)
        if answer is None:
            text = self._log.read_text(errors="replace")[-4000:]
            raise RuntimeError(f"the process that reads cases does not start: {text}")
        self._child = int(answer["child"])

    def _read(self, patience: float) -> dict[str, Any] | None:
        """The next answer, None if there is none in time or the process is gone."""
        until = time.monotonic() + patience
        while b"\n" not in self._buffer:
            ready, _, _ = select.select([self._replies], [], [], max(0.0, until - time.monotonic()))
            chunk = os.read(self._replies, 1 << 16) if ready else b""
            if not chunk:
                return None
            self._buffer += chunk
        line, _, self._buffer = self._buffer.partition(b"\n")
        return dict(json.loads(line))


@dataclass
class Fuzzer:
    """Tries cases.

    Attributes:
        templates: folder of whole files, see `templates.make_templates`.
        scratch: folder for the cases.
        reader: what reads them.
        slow: also use commands that take long.
    """

    templates: Path
    scratch: Path
    reader: Reader
    slow: bool = False
    cases: int = field(default=0, init=False)

    def draw(self, kind: Kind, random: Random) -> Case:
        return Case.drawn(kind, self.whole(kind), random, self.slow)

    def whole(self, kind: Kind) -> bytes:
        """The undamaged content."""
        target = self.templates / kind.target
        if not kind.layout:
            return target.read_bytes()
        return "\n".join(sorted(str(path.relative_to(target)) for path in target.rglob("*"))).encode()

    def problem(self, case: Case) -> Problem | None:
        """What is wrong with how a case ended, None if nothing."""
        answer, folder = self.answer(case), self.scratch / "case"
        return answer if isinstance(answer, Problem) else judged(answer, case, folder, self.templates)

    def answer(self, case: Case) -> dict[str, Any] | Problem:
        """What `Reader.run` says of a case."""
        self.cases += 1
        folder, target = self.scratch / "case", self.scratch / "case" / case.kind.target
        shutil.rmtree(folder, ignore_errors=True)
        for name in case.kind.folders:
            shutil.copytree(self.templates / name, folder / name)
        command = [word.format(templates=self.templates) for word in case.command]
        if not case.kind.layout:
            target.write_bytes(case.content)
            return self.reader.run(command, folder)
        outside = self.scratch / "outside"
        shutil.rmtree(outside, ignore_errors=True)
        shutil.copytree(self.templates / case.kind.folders[0], outside)
        before = _contents(outside)
        named = rearrange(target, json.loads(case.content), outside)
        answer = self.reader.run([f"./{named.name}" if word == case.kind.target else word for word in command], folder)
        if _contents(outside) != before:
            return Problem("wrote through a link", " ".join(command))
        return answer

    def require_good(self, case: Case) -> None:
        """Fail with the way to try the case again, after keeping its file."""
        problem = self.problem(case)
        if problem is None:
            return
        kept = self.keep(case)
        raise AssertionError(
            f"{case.kind.name}: {problem.what}\n{problem.detail}\ncommand: {' '.join(case.command)}\n"
            f"content: {case.content[:300]!r}{' ...' if len(case.content) > 300 else ''}\n"
            f"again: python -m tests.fuzz.campaign --replay {kept}"
        )

    def keep(self, case: Case) -> Path:
        """Write a case where `campaign --replay` finds it: KIND--COMMAND NUMBER--DIGEST."""
        commands = [*case.kind.commands, *case.kind.slow_commands]
        digest = hashlib.sha256(case.content).hexdigest()[:12]
        folder = Path(os.environ.get("LAPGS_FUZZ_KEEP", self.scratch.parent / "fuzz-failures"))
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{case.kind.name}--{commands.index(case.command)}--{digest}"
        path.write_bytes(case.content)
        return path


def _contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def rearrange(folder: Path, steps: Sequence[Sequence[str]], outside: Path) -> Path:
    """Remove, replace, move and rename what lies in a folder.

    Args:
        folder: nothing outside of it changes.
        steps: an action, the path it is about, and for "move" and "rename" another name, for "copy" another path. Those
            whose paths a former step removed or whose other name a folder has are left out. "rename" also changes the
            name in the folder's texts, and of the path "" the folder's own name.
        outside: a folder like it, which links of the action "outside" point to.

    Returns:
        The folder, by its new name if it has one.
    """
    for action, name, *other in steps:
        path = folder / name
        itself = os.path.normpath(path) == os.path.normpath(folder)
        there = path.exists() or (action in SPECIAL and path.parent.is_dir())
        if not there or (itself and action != "rename") or _through_link(path, folder):
            continue
        if action == "rename" and not name:
            folder = folder.rename(folder.with_name(other[0]))
        elif action == "rename":
            _rename(folder, path, other[0])
        elif action == "copy":
            target = folder / other[0]
            if path.is_file() and target.is_file() and not _through_link(target, folder):
                target.write_bytes(path.read_bytes())
        elif action == "move":
            if not path.with_name(Path(other[0]).name).is_dir():
                path.rename(path.with_name(Path(other[0]).name))
        else:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
            _put(action, path, outside / name)
    return folder


def _through_link(path: Path, folder: Path) -> bool:
    """Whether a path in the folder is a link or lies behind one, as a former step made it."""
    return os.path.realpath(path) != os.path.normpath(os.path.realpath(folder) + os.sep + os.path.relpath(path, folder))


SPECIAL = {
    "loop": "",
    "zero": "/dev/zero",
    "null": "/dev/null",
    "up": "..",
    "dangling": "/nonexistent/x",
    "fifo": "",
    "outside": "",
}
"""Links and what is no file; of the links with a fixed target that target."""


def _put(action: str, path: Path, outside: Path) -> None:
    """Make what lies at a path now; nothing for "remove"."""
    if action == "folder":
        path.mkdir()
    elif action == "file":
        path.touch()
    elif action == "fifo":
        os.mkfifo(path)
    elif action in SPECIAL:
        path.symlink_to({"loop": path.name, "outside": str(outside)}.get(action, SPECIAL[action]))


def _rename(folder: Path, path: Path, name: str) -> None:
    """Rename a file, also where a text of the folder names it."""
    before, after = path.name, name + path.suffix
    path.rename(path.with_name(after))
    for text in (*folder.rglob("*.json"), *folder.rglob("*.txt")):
        quoted = json.dumps(after)[1:-1] if text.suffix == ".json" else after
        text.write_text(text.read_text().replace(before, quoted), errors="surrogateescape")


def judged(answer: dict[str, Any], case: Case, folder: Path, templates: Path) -> Problem | None:
    """Hold how a command ended against the rules."""
    message = answer["message"]
    if answer["trace"]:
        return Problem("traceback", answer["trace"])
    if answer["highest"] > MOST_BYTES or answer["starved"]:
        return Problem(f"more than {MOST_BYTES / 1e9:g} GB", message or answer["printed"])
    if answer["code"] not in (0, 2, STOPPED):
        return Problem(f"exit code {answer['code']}", message or answer["printed"])
    if any(not (char.isprintable() or char in "\n\r\t") for char in answer["shown"]):
        return Problem("control characters in its output", repr(answer["shown"]))
    if answer["code"] != 2:
        return None
    lines = message.split("\n") if case.kind.name == "experiment" else [message]  # all its mistakes are told
    return next(filter(None, (_judged_line(line, case, folder, templates) for line in lines)), None)


def _judged_line(message: str, case: Case, folder: Path, templates: Path) -> Problem | None:
    """Hold a message against the rules."""
    if not message.strip() or not message.isprintable():
        return Problem("no single line of text", repr(message[:600]))
    if len(message) > LONGEST_LINE:
        return Problem(f"a line of more than {LONGEST_LINE} characters", message[:600])
    if not _names_a_file(message, case, folder, templates):
        return Problem("names no file", message)
    return None


def _names_a_file(message: str, case: Case, folder: Path, templates: Path) -> bool:
    """Whether a message names the damaged file, a folder that it lies in, or a scene that it speaks of."""
    parts = case.kind.target.split("/")
    names = [*parts, *case.kind.also, str(folder), str(templates)]
    if case.kind.layout:
        names += [printable(word) for step in json.loads(case.content) for word in step[1:] if word]
    return any(name in message for name in names)
