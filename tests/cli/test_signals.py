"""Ctrl-C and SIGTERM at any moment of any command: one line, 130 or 143, nothing half written.

Each case is a process of its own. What a signal meets depends on the machine's speed: the few cases say what holds
whatever it meets, and the campaign draws its delays.
"""

from __future__ import annotations

import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from lapgs_plugin.fields.gaussian_field import GaussianField
from lapgs_plugin.files import TEMPORARY_PATTERN
from lapgs_plugin.runs.archive import RunArchive
from lapgs_plugin.scenes.images import read_image
from tests.cli.run_folder import write_run, write_scene
from tests.waiting import wait_for

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="uses POSIX signals")

CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
TIMEOUT = 600.0
"""Seconds until a process counts as stuck; a busy machine takes a hundred times as long as an idle one."""

READY = "installed"
"""What a process prints as soon as its handlers are there; before, the interpreter starts and Ctrl-C is its own."""

# As the script `lapgs`, besides that line. Whoever runs the tests may have Ctrl-C ignored in what they start.
COMMAND = f"""
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
import lapgs_plugin.interrupt as interrupt
install = interrupt.install
def install_and_say():
    install()
    print("{READY}", flush=True)
interrupt.install = install_and_say
from lapgs_plugin.cli import main
main()
"""


@dataclass(frozen=True)
class Ended:
    """A process that got signals.

    Attributes:
        code: its exit code.
        text: what it printed, both streams.
        seconds: from its first signal to its end.
    """

    code: int
    text: str
    seconds: float

    @property
    def clean(self) -> bool:
        """Whether it says in one line, besides its ordinary ones, that it was stopped."""
        noise = re.search(r"Traceback|what\(\)|\*\*\*|KeyboardInterrupt|Interrupted|Fatal|Aborted", self.text)
        return noise is None and len(re.findall(r"^lapgs: .*stopped.*", self.text, re.MULTILINE)) == 1


def signalled(
    words: Sequence[object],
    signals: Sequence[tuple[float, signal.Signals]],
    begun: Callable[[subprocess.Popen[str]], None] = lambda process: None,
) -> Ended:
    """Start a command and send it each signal so many seconds after the one before.

    The first is sent so long after the handlers are there and `begun` returns.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == f"{READY}\n"
    begun(process)
    begin = time.monotonic()
    for number, (delay, which) in enumerate(signals):
        try:
            process.wait(delay)
        except subprocess.TimeoutExpired:
            process.send_signal(which)
            begin = begin if number else time.monotonic()
    try:
        text, _ = process.communicate(timeout=TIMEOUT)
    finally:
        process.kill()
    return Ended(process.returncode, text, time.monotonic() - begin)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"), size=(128, 96))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a scene of its own: its records are of that scene's size."""
    folder = tmp_path_factory.mktemp("runs")
    return write_run(folder / "run", write_scene(folder / "scene"))


def commands(scene: Path, run: Path, out: Path) -> dict[str, list[object]]:
    """Commands by name, as words; all but those about one run write below `out` alone."""
    return {
        "sample": ["sample", out / "sample", "--views", 200],
        "train": ["train", scene, "-o", out / "run", "--iterations", 4000],
        "eval": ["eval", run],
        "render": ["render", run, "--out", out / "pictures", "--trajectory", "orbit", "--frames", 5_000],
        "view": ["view", run],
        "export": ["export", run, "--out", out / "export"],
        "report": ["report", run],
        "doctor": ["doctor"],
    }


def has_written(out: Path, pattern: str = "*") -> Callable[[subprocess.Popen[str]], None]:
    """Return a function that waits until a command has written a file below a folder."""

    def wait(process: subprocess.Popen[str]) -> None:
        wait_for(lambda: process.poll() is not None or any(map(Path.is_file, out.rglob(pattern))), TIMEOUT)

    return wait


def shows_its_page(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    assert any("http://" in line for line in process.stdout)


def half_written(out: Path) -> list[str]:
    """Files below a folder that cannot be read, and temporary ones."""
    broken = [str(path) for path in out.rglob(TEMPORARY_PATTERN)]
    for path in out.rglob("*"):
        try:
            if path.suffix == ".ply":
                GaussianField.load_ply(path)
            elif path.suffix == ".png":
                read_image(path)
            elif path.name == "manifest.json":
                RunArchive.open(path.parent)
        except Exception as error:
            broken.append(f"{path}: {error}")
    return broken


@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("delay", [0.0, pytest.param(0.3, marks=pytest.mark.slow), 1.0])
def test_a_signal_while_a_command_starts(which: signal.Signals, delay: float, scene: Path, tmp_path: Path) -> None:
    ended = signalled(["train", scene, "-o", tmp_path / "run", "--iterations", 4000], [(delay, which)])
    assert ended.code == CODES[which], ended.text
    assert ended.clean, ended.text
    assert half_written(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "which"),
    [
        pytest.param("sample", signal.SIGTERM, marks=pytest.mark.slow),
        ("render", signal.SIGTERM),
        ("view", signal.SIGTERM),
        pytest.param("view", signal.SIGINT, marks=pytest.mark.slow),
    ],
)
def test_a_signal_in_the_middle_of_a_command(
    name: str, which: signal.Signals, scene: Path, run: Path, tmp_path: Path
) -> None:
    begun = shows_its_page if name == "view" else has_written(tmp_path)
    ended = signalled(commands(scene, run, tmp_path)[name], [(0.1, which)], begun)
    assert ended.code == CODES[which], ended.text
    assert ended.clean, ended.text
    assert half_written(tmp_path) == []


@pytest.mark.parametrize(
    "gap", [pytest.param(0.02, marks=pytest.mark.slow), 0.2, pytest.param(0.7, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("training", [False, True])
def test_a_second_ctrl_c_ends_as_the_first(training: bool, gap: float, scene: Path, run: Path, tmp_path: Path) -> None:
    words = commands(scene, run, tmp_path)["train"]
    begun = [has_written(tmp_path, "history.jsonl")] if training else []
    ended = signalled(words, [(0.1, signal.SIGINT), (gap, signal.SIGINT)], *begun)
    assert ended.code == 130, ended.text
    assert ended.clean, ended.text


# OpenImageIO makes its enumerations by Python's `enum`, from C++ that aborts the process when that raises.
WHILE_LOADING = """
import os, signal, sys
from lapgs_plugin import interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)
interrupt.install()

def press(frame, event, argument):
    if event == "call" and frame.f_back and frame.f_back.f_code.co_name == "_call_with_frames_removed":
        if frame.f_code.co_filename.endswith("enum.py"):
            sys.setprofile(None)
            os.kill(os.getpid(), signal.{signal})

import enum, numpy
with interrupt.command():
    sys.setprofile(press)
    import OpenImageIO
"""


@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_compiled_module_is_loaded(which: signal.Signals) -> None:
    code = WHILE_LOADING.format(signal=which.name)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == CODES[which], done.stderr
    name = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}[which]
    assert done.stderr == f"lapgs: stopped by {name}\n"


BEFORE_THE_HANDLER_IS_OURS_AGAIN = """
import os, signal
from importlib.machinery import ExtensionFileLoader
from lapgs_plugin import interrupt

def load(self, module):  # handles the signal itself, as pycolmap does
    signal.signal(signal.SIGTERM, lambda *_: os._exit(7))
    os.kill(os.getpid(), signal.SIGTERM)
    signal.signal(signal.SIGTERM, ours)

ExtensionFileLoader.exec_module = load
interrupt.install()
ours = signal.getsignal(signal.SIGTERM)
with interrupt.command():
    ExtensionFileLoader.exec_module(None, None)
"""


def test_a_signal_waits_while_a_compiled_module_has_a_handler_of_its_own() -> None:
    code = BEFORE_THE_HANDLER_IS_OURS_AGAIN
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 143, done.stderr
    assert done.stderr == "lapgs: stopped by SIGTERM\n"


AFTER_PYCOLMAP = """
import os, signal
from lapgs_plugin import interrupt
interrupt.install()
with interrupt.command():
    import pycolmap
    os.kill(os.getpid(), signal.SIGTERM)
"""


def test_pycolmap_does_not_keep_its_handler_of_sigterm() -> None:
    done = subprocess.run([sys.executable, "-c", AFTER_PYCOLMAP], capture_output=True, text=True, check=False)
    assert done.returncode == 143
    assert done.stderr == "lapgs: stopped by SIGTERM\n"


LOST = """
import ctypes, os, signal, time
from lapgs_plugin import interrupt
interrupt.install()
press = ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.SIGTERM) or time.sleep(0.01))
with interrupt.command():
    press()  # ctypes cannot pass on what is raised in a callback
    time.sleep(30)
    print("nothing was raised")
"""


def test_an_interruption_that_a_callback_loses_is_raised_again() -> None:
    done = subprocess.run([sys.executable, "-c", LOST], capture_output=True, text=True, check=False)
    assert done.stdout == ""
    assert done.returncode == 143
    assert done.stderr == "lapgs: stopped by SIGTERM\n"


PREPARING = """
import os, signal, sys
from lapgs_plugin.scenes.prepare import pipeline
from lapgs_plugin.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)
pipeline.prepare_scene = lambda *_, **__: os.kill(os.getpid(), signal.SIGINT)
sys.argv = ["lapgs", "prepare", "photos", "scene"]
main()
"""


def test_a_stopped_prepare_says_that_repeating_it_continues() -> None:
    done = subprocess.run([sys.executable, "-c", PREPARING], capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert done.stderr == "lapgs: stopped by Ctrl-C; scene keeps the finished steps, repeat the command to continue\n"


def test_doctor_does_not_wait_for_the_programs_that_it_asks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "nvidia-smi"
    program.write_text(f"#!/bin/sh\ntouch {tmp_path}/asked\nexec sleep 50\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    ended = signalled(["doctor"], [(0.1, signal.SIGTERM)], has_written(tmp_path, "asked"))
    assert ended.code == 143, ended.text
    assert ended.clean, ended.text
    assert ended.seconds < 25  # seen 0.2, and 51 while the program was waited for


CAMPAIGN = 150


@pytest.mark.slow
@pytest.mark.parametrize("seed", [16, 17])
def test_a_campaign_of_signals(seed: int, scene: Path, run: Path, tmp_path: Path) -> None:
    """Hundreds of processes; prints how they ended (pytest -s)."""
    draw = random.Random(seed)
    outcomes: Counter[tuple[str, str, str]] = Counter()
    failures: list[str] = []
    for case in range(CAMPAIGN):
        out = tmp_path / str(case)
        out.mkdir()
        words = commands(scene, run, out)
        name = draw.choice(list(words))
        which = draw.choice(list(CODES))
        delay = draw.choice([draw.uniform(0.0, 0.3), draw.uniform(0.0, 3.0), draw.uniform(0.0, 12.0)])
        again = [(draw.choice([0.02, 0.05, 0.1, 0.2, 0.6]), which)] if draw.random() < 0.3 else []
        ended = signalled(words[name], [(delay, which), *again])
        outcome = _outcome(ended, which, half_written(out) + half_written(run))
        outcomes[name, which.name, outcome] += 1
        print(f"{case} {name} {which.name} {delay:.2f} {again}: {outcome} in {ended.seconds:.1f} s", flush=True)
        if outcome not in ("stopped", "finished"):
            failures.append(f"{name} {which.name} {delay:.3f} {again}: {outcome}\n{ended.text[-3000:]}")
    print(*(f"{count} {key}" for key, count in sorted(outcomes.items())), sep="\n")
    assert not failures, "\n\n".join(failures)
    assert sum(count for (*_, outcome), count in outcomes.items() if outcome == "stopped") > CAMPAIGN / 2


def _outcome(ended: Ended, which: signal.Signals, broken: list[str]) -> str:
    if broken:
        return f"half written: {broken}"
    if ended.code == 0 and "Traceback" not in ended.text:
        return "finished"
    if ended.code != CODES[which]:
        return f"exit code {ended.code}"
    return "stopped" if ended.clean else "not one line"
