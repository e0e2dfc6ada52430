"""Find out about this machine without importing PyTorch: versions, driver, processor."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shutil
import signal
import subprocess
import sysconfig
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGE = "lapgs_plugin"

TIMEOUT = 60.0
"""Longest time of an import or another program. A first import from a network disk can take tens of seconds."""


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
    """Return whether a module can be found. The packages around a dotted name are imported."""
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
    """Return whether the installed gsplat includes its compiled CUDA part, None without gsplat. Imports nothing.

    A part that gsplat compiled at its first use is in another folder, see `findings.gsplat_finding`.
    """
    spec = importlib.util.find_spec("gsplat")
    if spec is None or not spec.submodule_search_locations:
        return None
    return any(next(Path(folder).glob("csrc*.*"), None) for folder in spec.submodule_search_locations)


def triton_missing() -> str:
    """Return a clause about the missing requirement of Triton's kernels, "" without one. Imports and compiles nothing.

    Triton starts each kernel by a small C program, for which it needs a C compiler and Python's headers.
    """
    if importlib.util.find_spec("triton") is None:
        return "Triton is not installed"
    if not any(map(shutil.which, (os.environ.get("CC", "gcc"), "gcc", "clang"))):
        return "there is no C compiler for Triton (gcc, clang or CC)"
    scheme = sysconfig.get_default_scheme().replace("posix_local", "posix_prefix")  # as Triton looks for it
    header = Path(sysconfig.get_path("include", scheme), "Python.h")
    return "" if header.is_file() else f"Triton needs Python's headers to compile C, and there is no {header}"


_running: set[subprocess.Popen[str]] = set()
"""Programs of `run_program`, in all threads."""


def run_program(command: Sequence[str], **options: Any) -> tuple[str, str]:
    """Run a program; return its standard output and a line about an error, "" without one. Never raises."""
    pipe = subprocess.PIPE
    try:
        process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, errors="replace", **options)
    except OSError as error:
        return "", error.strerror or str(error)
    with process:
        _running.add(process)
        try:
            printed, complaints = process.communicate(timeout=TIMEOUT)
        except subprocess.TimeoutExpired:
            return "", f"no answer within {TIMEOUT:.0f} s"
        finally:
            process.kill()
            _running.discard(process)
    if process.returncode < 0:
        return printed, f"crashed ({signal.strsignal(-process.returncode)})"
    if process.returncode > 0:
        lines = complaints.strip().splitlines()
        return printed, lines[-1] if lines else f"exit code {process.returncode}"
    return printed, ""


def stop_programs() -> None:
    """Kill the programs that `run_program` runs in other threads."""
    for process in tuple(_running):
        process.kill()
