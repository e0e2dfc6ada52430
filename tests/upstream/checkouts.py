"""Run the real checkouts in processes of their own on the CPU stand-ins, at a tiny size.

The folder in LAPGS_UPSTREAM holds checkouts called fastgs, taming, graphdeco, dashgaussian, mini_splatting and so on;
LAPGS_FASTGS and the like name one elsewhere. Tests of checkouts that are not there are skipped.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from lapgs_plugin.evaluation.metrics import mean_quality
from lapgs_plugin.rendering.run import run_renderer, run_scene
from lapgs_plugin.runs.archive import RunArchive

BARE = """
import runpy, sys
from pathlib import Path
from lapgs_plugin.checkouts.cpu_device import cuda_on_cpu

variant, *sys.argv = sys.argv[1:]
sys.path[0] = str(Path(sys.argv[0]).parent)
with cuda_on_cpu(variant):
    runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Run the script as Python does."""

COUNTING = """
import json, sys
from dataclasses import replace
from functools import wraps
from pathlib import Path
from lapgs_plugin.runner import driver
from lapgs_plugin.cli import main

calls = []

def counted(replacement):
    entry = [replacement.label, 0]
    calls.append(entry)
    def make(original):
        made = replacement.make(original)
        @wraps(made)  # renderers are asked for their parameters
        def call(*args, **kwargs):
            entry[1] += 1
            return made(*args, **kwargs)
        return call
    return replace(replacement, make=make)

class Counting(driver.Attachment):
    def __init__(self, replacements):
        super().__init__([counted(replacement) for replacement in replacements])

driver.Attachment = Counting
file, *words = sys.argv[1:]
sys.argv = ["lapgs", "run", *words]
try:
    main()
finally:
    Path(file).write_text(json.dumps(calls))
"""
"""Run `lapgs run` and count the calls of every replacement."""


@dataclass(frozen=True)
class Done:
    """Hold the results of a run.

    Attributes:
        folder: its -m folder.
        progress: its stderr: progress bars, and lines of lapgs.
        calls: (symbol, number of calls) for each replacement.
    """

    folder: Path
    progress: str
    calls: tuple[tuple[str, int], ...] = ()

    @property
    def losses(self) -> list[float]:
        """Running mean of the loss, which the progress bar shows every ten iterations."""
        return _losses(self.progress)

    @property
    def losses_by_stage(self) -> list[list[float]]:
        return [_losses(text) for text in re.split(r"level [0-9]+: [0-9]+ iterations at", self.progress)[1:]]


def checkout(variable: str) -> Path:
    """Return the folder in an environment variable, or that of LAPGS_UPSTREAM; skip the test without it."""
    name = variable.removeprefix("LAPGS_").lower()
    folder = Path(os.environ.get(variable) or Path(os.environ.get("LAPGS_UPSTREAM", "nowhere"), name))
    if not folder.is_dir():
        pytest.skip(f"needs a checkout of the backbone: {variable}, or the folder {name} in LAPGS_UPSTREAM")
    return folder.resolve()


def knows_antialiasing(folder: Path) -> bool:
    """Return whether a graphdeco checkout is for the rasterizers since October 2024."""
    return "antialiasing" in (folder / "gaussian_renderer" / "__init__.py").read_text(encoding="utf-8")


def run_bare(script: Path, variant: str, arguments: list[str], folder: Path) -> Done:
    """Run the script by itself on a stand-in of that variant, writing to `folder`."""
    return Done(folder, _python(BARE, variant, script, *arguments, "-m", folder))


def run_lapgs(script: Path, options: list[str], arguments: list[str], folder: Path) -> Done:
    """Run `lapgs run --device cpu OPTIONS SCRIPT ARGUMENTS`, writing to `folder`."""
    calls = folder.with_name(f"{folder.name}-calls.json")
    progress = _python(COUNTING, calls, "--device", "cpu", *options, script, *arguments, "-m", folder)
    return Done(folder, progress, tuple((label, count) for label, count in json.loads(calls.read_text())))


def assert_same_quality(archive: RunArchive) -> None:
    """Compare the held-out PSNR of the checkout's own renders with that of the archived fields."""
    (measured,) = [entry["psnr"] for entry in archive.history() if "psnr" in entry and entry["level"] == 0]
    renderer = run_renderer(archive, device="cpu", rasterizer="cpu")
    pairs = ((renderer.render(view.camera).composed[0], view.image) for view in run_scene(archive).test)
    assert mean_quality(pairs)["psnr"] == pytest.approx(measured, abs=0.05)


def _python(code: str, *arguments: Any) -> str:
    """Run a program that must succeed, and return its stderr."""
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stderr


def _losses(text: str) -> list[float]:
    shown = re.findall(r"(?<!Depth )\bLoss=([0-9.]+)", text)
    return [float(value) for i, value in enumerate(shown) if i == 0 or value != shown[i - 1]]
