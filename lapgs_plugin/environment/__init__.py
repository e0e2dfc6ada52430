"""Find out about this machine without importing PyTorch: versions, driver, processor."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import signal
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGE = "lapgs_plugin"
TIMEOUT = 60.0
"""Seconds that an import or another program may take; a first import from a network disk can take tens."""


def versions() -> dict[str, str]:
    """Return versions to record with a measurement, without importing the packages."""
    return {
        "lapgs_plugin": installed_version(PACKAGE) or "not installed",
        "python": platform.python_version(),
        "torch": installed_version("torch") or "not installed",
        "numba": installed_version("numba") or "not installed",
        "system": f"{platform.system()} {platform.machine()}",
        "processor": processor_name(),
    }


def installed_version(distribution: str) -> str | None:
    """Return the installed version of a package, None if it is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def is_installed(module: str) -> bool:
    """Return whether a module can be found; of a dotted name, the outer packages are imported."""
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def processor_name() -> str:
    """Return the processor's model name, or its architecture."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or platform.machine()
    model = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return model[1] if model else platform.machine()


def gpus_are_hidden() -> bool:
    """Return whether CUDA_VISIBLE_DEVICES hides all GPUs."""
    return os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1")


def driver_version() -> str:
    """Return the version of the NVIDIA driver, "" without one."""
    output, error = run_program(["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"])
    return "" if error or not output.strip() else output.strip().splitlines()[0]


def gsplat_built() -> bool | None:
    """Return whether the installed gsplat includes its compiled CUDA part, None without gsplat. Imports nothing."""
    spec = importlib.util.find_spec("gsplat")
    if spec is None or not spec.submodule_search_locations:
        return None
    return any(next(Path(place).glob("csrc*.*"), None) for place in spec.submodule_search_locations)


def run_program(command: Sequence[str], **options: Any) -> tuple[str, str]:
    """Run a program; return its standard output and a line about an error, "" without one. Never raises."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT, check=False, **options
        )
    except subprocess.TimeoutExpired:
        return "", f"no answer within {TIMEOUT:.0f} s"
    except OSError as error:
        return "", error.strerror or str(error)
    if done.returncode < 0:
        return done.stdout, f"crashed ({signal.strsignal(-done.returncode)})"
    if done.returncode > 0:
        lines = done.stderr.strip().splitlines()
        return done.stdout, lines[-1] if lines else f"exit code {done.returncode}"
    return done.stdout, ""
