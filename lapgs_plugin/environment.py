"""What this machine has: versions for records, and what `lapgs doctor` finds.

Whatever can crash on import (a CUDA extension built for another PyTorch, PyTorch itself) is imported in a process of
its own: `python -m lapgs_plugin.environment PROBE` prints what it finds as JSON.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import packaging.requirements
from packaging.version import Version

PACKAGE = "lapgs_plugin"
PROBE_TIMEOUT = 60.0
"""Seconds that one import or one foreign program may take; a first import from a network disk takes tens."""
OLDEST_PYTHON = (3, 10)
DEVELOPMENT_EXTRA = "dev"

VARIABLES = (
    "CUDA_VISIBLE_DEVICES",
    "CUDA_HOME",
    "TORCH_CUDA_ARCH_LIST",
    "NUMBA_CACHE_DIR",
    "NUMBA_DISABLE_JIT",
    "OMP_NUM_THREADS",
)
"""Environment variables that change what is used or how fast it is."""


def versions() -> dict[str, str]:
    """Versions to keep beside a measurement, without importing what they are of."""
    return {
        "lapgs_plugin": _version(PACKAGE) or "not installed",
        "python": platform.python_version(),
        "torch": _version("torch") or "not installed",
        "numba": _version("numba") or "not installed",
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
    }


@dataclass(frozen=True)
class Finding:
    """One thing that was looked for.

    Attributes:
        name: what.
        status: "ok", "absent" (not there and not needed) or "problem" (needed or half there, and not usable).
        detail: version, place or reason, one line.
        advice: what to do to have it, usually a command; empty when there is nothing to do.
    """

    name: str
    status: str
    detail: str
    advice: str = ""


@dataclass(frozen=True)
class Probe:
    """Result of a probe process: facts, or why there are none.

    Attributes:
        facts: what it found.
        error: one line; empty when it succeeded.
    """

    facts: dict[str, Any]
    error: str = ""


@dataclass(frozen=True)
class Requirement:
    """A requirement of this package as its metadata has it.

    Attributes:
        name: of the distribution.
        text: with version bounds, as an installer takes it.
        minimum: lowest version, "" when any will do.
        extra: the extra that asks for it, "" when it is always needed.
    """

    name: str
    text: str
    minimum: str
    extra: str


def run_probe(name: str, *arguments: str) -> Probe:
    """Run one of `PROBES` in a new process; never raises."""
    command = [sys.executable, "-m", f"{PACKAGE}.environment", name, *arguments]
    # The same modules as here, and not those of the current folder: a 3DGS checkout has a `utils` and a `scene`.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    with tempfile.TemporaryDirectory() as elsewhere:
        output, error = _run(command, cwd=elsewhere, env=environment)
    if error:
        return Probe({}, error)
    try:
        facts = json.loads(output.strip().splitlines()[-1])
    except (IndexError, ValueError):
        return Probe({}, "the probe printed nothing readable")
    return Probe({}, facts["error"]) if "error" in facts else Probe(facts)


def system_findings() -> list[Finding]:
    """Python, operating system, processor, memory and the environment variables that matter."""
    wanted = ".".join(map(str, OLDEST_PYTHON))
    old = sys.version_info < OLDEST_PYTHON
    python = Finding(
        "Python",
        "problem" if old else "ok",
        f"{platform.python_version()} ({sys.executable})",
        f"use Python {wanted} or newer" if old else "",
    )
    memory = _memory_gib()
    machine = f"{_processor()}, {_usable_processors()} cores usable"
    return [
        python,
        Finding("System", "ok", platform.platform(terse=True)),
        Finding("Processor", "ok", machine if memory is None else f"{machine}, {memory:.1f} GiB memory"),
        *(Finding(name, "ok", os.environ[name]) for name in VARIABLES if name in os.environ),
    ]


def torch_findings(probe: Probe, driver: str) -> list[Finding]:
    """PyTorch and the GPUs it can use.

    Args:
        probe: result of the probe "torch".
        driver: what `driver_version` returned.
    """
    if probe.error:
        return [Finding("PyTorch", "problem", probe.error, "python -m pip install --force-reinstall torch")]
    facts = probe.facts
    build = f"built for CUDA {facts['cuda']}" if facts["cuda"] else "built without CUDA"
    found = [Finding("PyTorch", "ok", f"{facts['version']}, {build}")]
    if facts["gpus"]:
        suffix = f", driver {driver}" if driver else ""
        return [*found, *(Finding("GPU", "ok", gpu + suffix) for gpu in facts["gpus"])]
    if not driver:
        return [*found, Finding("GPU", "absent", "no NVIDIA driver found")]
    if facts["cuda"]:
        reason = facts["complaint"] or "PyTorch cannot use it"
        return [*found, Finding("GPU", "problem", f"driver {driver}, but {reason}", "update the NVIDIA driver")]
    advice = "install PyTorch for CUDA as pytorch.org/get-started says"
    return [*found, Finding("GPU", "problem", f"driver {driver}, but PyTorch is built without CUDA", advice)]


def gpus_are_hidden() -> bool:
    """Whether CUDA_VISIBLE_DEVICES says that there are none."""
    return os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1")


def driver_version() -> str:
    """Version of the NVIDIA driver, "" without one."""
    output, error = _run(["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"])
    return "" if error or not output.strip() else output.strip().splitlines()[0]


def compiler_findings(torch_cuda: str | None) -> list[Finding]:
    """CUDA toolkit and C++ compiler, which only building CUDA extensions needs.

    Args:
        torch_cuda: CUDA version PyTorch is built for, such as "12.4"; None without CUDA.
    """
    nvcc = shutil.which("nvcc") or shutil.which("nvcc", path=str(Path(os.environ.get("CUDA_HOME", "")) / "bin"))
    release = re.search(r"release ([\d.]+)", _run([nvcc, "--version"])[0]) if nvcc else None
    toolkit = Finding(
        "CUDA toolkit", "absent", "no nvcc on the path", "" if not torch_cuda else _toolkit_advice(torch_cuda)
    )
    if nvcc and release:
        toolkit = Finding("CUDA toolkit", "ok", f"{release[1]} ({nvcc})")
        if torch_cuda and release[1].split(".")[0] != torch_cuda.split(".")[0]:
            detail = f"{release[1]} ({nvcc}), but PyTorch is built for {torch_cuda}: extensions will not build"
            toolkit = Finding("CUDA toolkit", "problem", detail, _toolkit_advice(torch_cuda))
    names = ("cl",) if sys.platform == "win32" else (os.environ.get("CXX", ""), "c++", "g++", "clang++")
    path = next((found for name in names if name and (found := shutil.which(name))), None)
    if path is None:
        return [toolkit, Finding("C++ compiler", "absent", f"none of {', '.join(filter(None, names))} on the path")]
    output = "" if sys.platform == "win32" else _run([path, "--version"])[0]
    return [toolkit, Finding("C++ compiler", "ok", f"{(output.splitlines() or [''])[0]} ({path})".strip())]


def _toolkit_advice(torch_cuda: str) -> str:
    return f"to build CUDA extensions, install the CUDA {torch_cuda} toolkit"


def numba_findings(probe: Probe) -> list[Finding]:
    """The CPU rasterizer: Numba, its cache of compiled kernels, threads.

    Args:
        probe: result of the probe "rasterizer".
    """
    if probe.error:
        return [Finding("CPU rasterizer", "problem", probe.error, "python -m pip install --force-reinstall numba")]
    facts = probe.facts
    found = [Finding("CPU rasterizer", "ok", f"Numba {facts['numba']}, {facts['threads']} threads")]
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        found = [Finding("CPU rasterizer", "problem", "NUMBA_DISABLE_JIT is set", "unset NUMBA_DISABLE_JIT")]
    if facts["cache"] is None:
        advice = "set NUMBA_CACHE_DIR to a folder that can be written"
        return [*found, Finding("Kernel cache", "problem", "no folder to write to, every start compiles again", advice)]
    folder = Path(facts["cache"])
    kernels = len(list(folder.glob("*.nbi")))
    state = f"{kernels} compiled kernels" if kernels else "empty, the first start compiles for half a minute"
    return [*found, Finding("Kernel cache", "ok", f"{state} ({folder})")]


def package_findings(requirements: Sequence[Requirement], imports: Mapping[str, Probe]) -> list[Finding]:
    """Every package that is always needed, with its version.

    Args:
        requirements: what `own_requirements` returned.
        imports: by distribution, result of the probe "import" for those that are compiled.
    """
    found = [_package_finding(each) for each in requirements if not each.extra]
    return [_with_import(finding, imports[finding.name]) if finding.name in imports else finding for finding in found]


def _with_import(package: Finding, probe: Probe) -> Finding:
    """The finding of an installed package that may still refuse to be imported, for want of a system library."""
    if package.status != "ok" or not probe.error:
        return package
    advice = f"python -m pip install --force-reinstall {package.name}"
    return Finding(package.name, "problem", f"{package.detail}, but the import fails: {probe.error}", advice)


def extra_findings(requirements: Sequence[Requirement]) -> list[Finding]:
    """Every optional extra: whether all it brings is installed."""
    extras = sorted({each.extra for each in requirements} - {"", DEVELOPMENT_EXTRA})
    found = []
    for extra in extras:
        members = [_package_finding(each) for each in requirements if each.extra == extra]
        lacking = [member.name for member in members if member.status != "ok"]
        detail = f"lacks {', '.join(lacking)}" if lacking else ", ".join(f"{m.name} {m.detail}" for m in members)
        advice = f"python -m pip install '{PACKAGE}[{extra}]'" if lacking else ""
        found.append(Finding(f"[{extra}]", "absent" if lacking else "ok", detail, advice))
    return found


def own_requirements() -> list[Requirement]:
    """What this package's metadata asks for on this Python; empty when it is not installed."""
    try:
        texts = metadata.requires(PACKAGE) or []
    except metadata.PackageNotFoundError:
        return []
    extras = ("", *(metadata.metadata(PACKAGE).get_all("Provides-Extra") or ()))
    parsed = [packaging.requirements.Requirement(text) for text in texts]
    return [
        _own(requirement, extra)
        for requirement in parsed
        for extra in extras
        if _applies(requirement, extra) and not (extra and _applies(requirement, ""))
    ]


def _applies(requirement: packaging.requirements.Requirement, extra: str) -> bool:
    """Whether a requirement's marker, the extra aside, holds here."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def gsplat_finding(torch: Probe, nvcc: bool) -> Finding:
    """Whether gsplat's CUDA part can be used here. Its Python part, whose densification trains on a CPU as well, is a
    package like others."""
    built = gsplat_built()
    if built is None:
        return Finding("gsplat CUDA part", "absent", "gsplat is not installed")
    if torch.error or not torch.facts["gpus"]:
        return Finding("gsplat CUDA part", "absent", "PyTorch sees no GPU to use it on")
    if built:
        return Finding("gsplat CUDA part", "ok", "built")
    if nvcc:
        return Finding("gsplat CUDA part", "ok", "not built yet; gsplat compiles it at first use, for some minutes")
    advice = "install the CUDA toolkit, or a gsplat wheel built for this PyTorch"
    return Finding("gsplat CUDA part", "problem", "not built, and there is no nvcc to compile it", advice)


def gsplat_built() -> bool | None:
    """Whether the installed gsplat came with its CUDA part, or None without gsplat. Imports nothing."""
    spec = importlib.util.find_spec("gsplat")
    if spec is None or not spec.submodule_search_locations:
        return None
    return any(next(Path(place).glob("csrc*.*"), None) for place in spec.submodule_search_locations)


def extension_finding(module: str, purpose: str) -> Finding:
    """Whether a compiled extension can be imported; tries it in another process if it is there at all."""
    try:
        there = importlib.util.find_spec(module.partition(".")[0]) is not None
    except (ImportError, ValueError) as error:
        return Finding(module, "problem", _first_line(error), "install it again")
    if not there:
        return Finding(module, "absent", f"not installed ({purpose})")
    probe = run_probe("import", "torch", module)  # extensions find PyTorch's libraries only once it is loaded
    if probe.error:
        return Finding(module, "problem", probe.error, "build it again with this PyTorch and this Python")
    return Finding(module, "ok", purpose)


def _package_finding(requirement: Requirement) -> Finding:
    version = _version(requirement.name)
    install = f"python -m pip install '{requirement.text}'"
    if version is None:
        return Finding(requirement.name, "problem", "not installed", install)
    if requirement.minimum and Version(version).release < Version(requirement.minimum).release:
        detail = f"{version} is older than {requirement.minimum}, which is needed"
        return Finding(requirement.name, "problem", detail, install)
    return Finding(requirement.name, "ok", version)


def _own(requirement: packaging.requirements.Requirement, extra: str) -> Requirement:
    minimum = next((bound.version for bound in requirement.specifier if bound.operator == ">="), "")
    return Requirement(requirement.name, f"{requirement.name}{requirement.specifier}", minimum, extra)


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    """The processor's name as its maker writes it, or its architecture."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or platform.machine()
    model = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return model[1] if model else platform.machine()


def _usable_processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _memory_gib() -> float | None:
    """Physical memory; None where the system does not say (Windows)."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (AttributeError, ValueError, OSError):
        return None


def _run(command: Sequence[str], **options: Any) -> tuple[str, str]:
    """Standard output of a program, and one line about what went wrong ("" when nothing did); never raises."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=PROBE_TIMEOUT, check=False, **options
        )
    except subprocess.TimeoutExpired:
        return "", f"no answer within {PROBE_TIMEOUT:.0f} s"
    except OSError as error:
        return "", error.strerror or str(error)
    if done.returncode < 0:
        return done.stdout, f"crashed ({signal.strsignal(-done.returncode)})"
    if done.returncode > 0:
        lines = done.stderr.strip().splitlines()
        return done.stdout, lines[-1] if lines else f"exit code {done.returncode}"
    return done.stdout, ""


def _first_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"


def _probe_torch() -> dict[str, Any]:
    import torch

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        available = torch.cuda.is_available()
    gpus = []
    for index in range(torch.cuda.device_count() if available else 0):
        properties = torch.cuda.get_device_properties(index)
        memory = properties.total_memory / 2**30
        gpus.append(f"{properties.name}, {memory:.0f} GiB, compute capability {properties.major}.{properties.minor}")
    # PyTorch explains in a warning why a GPU that is there cannot be used, such as an old driver.
    complaint = str(caught[0].message).splitlines()[0] if caught else ""
    return {"version": torch.__version__, "cuda": torch.version.cuda, "gpus": gpus, "complaint": complaint}


def _probe_rasterizer() -> dict[str, Any]:
    import numba
    from numba.core.dispatcher import Dispatcher

    from lapgs_plugin.jit.threads import num_threads
    from lapgs_plugin.ops.photometric_loss import in_numba as loss

    folders = [value.stats.cache_path for value in vars(loss).values() if isinstance(value, Dispatcher)]
    return {
        "numba": numba.__version__,
        "threads": num_threads(),
        "cache": next((folder for folder in folders if folder), None),
    }


def _probe_import(*modules: str) -> dict[str, Any]:
    for module in modules:
        importlib.import_module(module)
    return {}


PROBES: dict[str, Callable[..., dict[str, Any]]] = {
    "torch": _probe_torch,
    "rasterizer": _probe_rasterizer,
    "import": _probe_import,
}


def _main(name: str, *arguments: str) -> None:
    try:
        facts = PROBES[name](*arguments)
    except BaseException as error:  # whatever an import does, SystemExit included, is a finding
        facts = {"error": _first_line(error)}
    print(json.dumps(facts))


if __name__ == "__main__":
    _main(*sys.argv[1:])
