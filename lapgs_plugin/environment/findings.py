"""Judge the software and hardware of this machine for `lapgs doctor`."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

from lapgs_plugin.environment import (
    PACKAGE,
    gsplat_built,
    installed_version,
    processor_name,
    run_program,
    triton_missing,
)
from lapgs_plugin.environment.probes import Probe, run_probe
from lapgs_plugin.errors import counted, typed_line
from lapgs_plugin.limits import usable_processors

NOT_REPORTED = {"", "dev"}
"""No extra, and the one for development."""

VARIABLES = (
    "CUDA_VISIBLE_DEVICES",
    "CUDA_HOME",
    "TORCH_CUDA_ARCH_LIST",
    "NUMBA_CACHE_DIR",
    "NUMBA_DISABLE_JIT",
    "OMP_NUM_THREADS",
)
"""Environment variables that change the choice of hardware and programs, or speed."""


@dataclass(frozen=True)
class Finding:
    """Describe the state of one part of the machine, such as a package.

    Attributes:
        name: of the part.
        status: "ok", "absent" (missing but not needed) or "problem" (needed or broken).
        detail: version, location or reason, one line.
        advice: how to get it, usually a command; empty if there is nothing to do.
    """

    name: str
    status: str
    detail: str
    advice: str = ""


def system_findings() -> list[Finding]:
    """Report Python, operating system, processor, memory and the environment variables that matter."""
    memory = _memory_gib()
    machine = f"{processor_name()}, {usable_processors()} cores usable"
    return [
        Finding("Python", "ok", f"{platform.python_version()} ({sys.executable})"),
        Finding("System", "ok", platform.platform(terse=True)),
        Finding("Processor", "ok", machine if memory is None else f"{machine}, {memory:.1f} GiB memory"),
        *(Finding(name, "ok", os.environ[name]) for name in VARIABLES if name in os.environ),
    ]


def torch_findings(probe: Probe, driver: str) -> list[Finding]:
    """Report PyTorch and the GPUs that it can use.

    Args:
        probe: result of the probe "torch".
        driver: result of `driver_version`.
    """
    if probe.error:
        return [Finding("PyTorch", "problem", probe.error, "python -m pip install --force-reinstall torch")]
    facts = probe.facts
    build = f"built for CUDA {facts['cuda']}" if facts["cuda"] else "built without CUDA"
    findings = [Finding("PyTorch", "ok", f"{facts['version']}, {build}")]
    if facts["gpus"]:
        suffix = f", driver {driver}" if driver else ""
        return [*findings, *(Finding("GPU", "ok", gpu + suffix) for gpu in facts["gpus"])]
    if not driver:
        return [*findings, Finding("GPU", "absent", "no NVIDIA driver found")]
    if facts["cuda"]:
        reason = facts["complaint"] or "PyTorch cannot use it"
        return [*findings, Finding("GPU", "problem", f"driver {driver}, but {reason}", "update the NVIDIA driver")]
    advice = "install PyTorch for CUDA as pytorch.org/get-started says"
    return [*findings, Finding("GPU", "problem", f"driver {driver}, but PyTorch is built without CUDA", advice)]


def compiler_findings(torch_cuda: str | None) -> list[Finding]:
    """Report CUDA toolkit and C++ compiler, which only building CUDA extensions needs.

    Args:
        torch_cuda: CUDA version PyTorch is built for, such as "12.4"; None without CUDA.
    """
    nvcc = shutil.which("nvcc") or shutil.which("nvcc", path=str(Path(os.environ.get("CUDA_HOME", "")) / "bin"))
    release = re.search(r"release ([\d.]+)", run_program([nvcc, "--version"])[0]) if nvcc else None
    toolkit = Finding(
        "CUDA toolkit", "absent", "no nvcc on the path", "" if not torch_cuda else _toolkit_advice(torch_cuda)
    )
    if nvcc and release:
        toolkit = Finding("CUDA toolkit", "ok", f"{release[1]} ({nvcc})")
        if torch_cuda and release[1].split(".")[0] != torch_cuda.split(".")[0]:
            detail = f"{release[1]} ({nvcc}), but PyTorch is built for {torch_cuda}: extensions will not build"
            toolkit = Finding("CUDA toolkit", "problem", detail, _toolkit_advice(torch_cuda))
    names = ("cl",) if sys.platform == "win32" else (os.environ.get("CXX", ""), "c++", "g++", "clang++")
    path = next((compiler for name in names if name and (compiler := shutil.which(name))), None)
    if path is None:
        return [toolkit, Finding("C++ compiler", "absent", f"none of {', '.join(filter(None, names))} on the path")]
    output = "" if sys.platform == "win32" else run_program([path, "--version"])[0]
    return [toolkit, Finding("C++ compiler", "ok", f"{(output.splitlines() or [''])[0]} ({path})".strip())]


def _toolkit_advice(torch_cuda: str) -> str:
    return f"to build CUDA extensions, install the CUDA {torch_cuda} toolkit"


def numba_findings(probe: Probe) -> list[Finding]:
    """Report the CPU rasterizer: Numba, its cache of compiled kernels, threads.

    Args:
        probe: result of the probe "rasterizer".
    """
    if probe.error:
        return [Finding("CPU rasterizer", "problem", probe.error, "python -m pip install --force-reinstall numba")]
    facts = probe.facts
    findings = [Finding("CPU rasterizer", "ok", f"Numba {facts['numba']}, {counted(facts['threads'], 'thread')}")]
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        findings = [Finding("CPU rasterizer", "problem", "NUMBA_DISABLE_JIT is set", "unset NUMBA_DISABLE_JIT")]
    if facts["cache"] is None:
        advice = "set NUMBA_CACHE_DIR to a folder that can be written"
        detail = "no folder to write to, every start compiles again"
        return [*findings, Finding("Kernel cache", "problem", detail, advice)]
    folder = Path(facts["cache"])
    kernels = len(list(folder.glob("*.nbi")))
    state = f"{kernels} compiled kernels" if kernels else "empty; kernels are compiled at first use"
    return [*findings, Finding("Kernel cache", "ok", f"{state} ({folder})")]


def package_findings(requirements: Sequence[Requirement], imports: Mapping[str, Probe]) -> list[Finding]:
    """Report packages with their versions.

    Args:
        requirements: of the packages.
        imports: by distribution, result of the probe "import" for compiled packages.
    """
    return [_with_import(_package_finding(requirement), imports.get(requirement.name)) for requirement in requirements]


def _with_import(package: Finding, probe: Probe | None) -> Finding:
    """Add the error of an installed package's import, which may lack a system library."""
    if package.status != "ok" or probe is None or not probe.error:
        return package
    advice = f"python -m pip install --force-reinstall {package.name}"
    return Finding(package.name, "problem", f"{package.detail}, but the import fails: {probe.error}", advice)


def extra_findings(requirements: Mapping[str, Sequence[Requirement]]) -> list[Finding]:
    """Report for every optional extra in the result of `own_requirements` whether all its packages are installed."""
    findings = []
    for extra in sorted(requirements.keys() - NOT_REPORTED):
        if not requirements[extra]:
            continue
        members = [_package_finding(member) for member in requirements[extra]]
        lacking = [member.name for member in members if member.status != "ok"]
        detail = f"lacks {', '.join(lacking)}" if lacking else ", ".join(f"{m.name} {m.detail}" for m in members)
        advice = f"python -m pip install '{PACKAGE}[{extra}]'" if lacking else ""
        findings.append(Finding(f"[{extra}]", "absent" if lacking else "ok", detail, advice))
    return findings


ENTRY_POINT_GROUPS = {
    f"{PACKAGE}.hooks": "a hook, part of every run",
    f"{PACKAGE}.supervisions": "--supervision {}",
    f"{PACKAGE}.backbones": "--backbone {}",
    f"{PACKAGE}.strategies": "--strategy {}",
    f"{PACKAGE}.rasterizers": "--rasterizer {}",
    f"{PACKAGE}.reports": "lapgs report, of folders of kind {}",
    "lapgs.commands": "lapgs {}",
    "lapgs.scenes": "a reader of scenes",
}
"""Groups of entry points through which other packages extend this one, with the use of their entries."""


def entry_point_findings() -> list[Finding]:
    """Return the entry points of other packages, without importing them. Misspelt groups are problems."""
    findings = {}
    for distribution in metadata.distributions():
        for entry in distribution.entry_points:
            source = f"{entry.value} of {distribution.name} {distribution.version}"
            if distribution.name == PACKAGE:
                continue
            if entry.group in ENTRY_POINT_GROUPS:
                use = ENTRY_POINT_GROUPS[entry.group].format(entry.name)
                findings[entry.group, entry.name] = Finding(entry.name, "ok", f"{use}: {source}")
            elif entry.group.startswith((f"{PACKAGE}.", "lapgs.")):
                detail = f"{source} is in the group {entry.group}, which nothing reads"
                advice = f"name one of {', '.join(ENTRY_POINT_GROUPS)} in its pyproject.toml"
                findings[entry.group, entry.name] = Finding(entry.name, "problem", detail, advice)
    return [findings[key] for key in sorted(findings)]


def own_requirements() -> dict[str, list[Requirement]]:
    """Return the requirements in this package's metadata for this Python by extra, "" for those always needed."""
    try:
        parsed = [Requirement(text) for text in metadata.requires(PACKAGE) or []]
    except metadata.PackageNotFoundError:
        return {"": []}
    always = [requirement for requirement in parsed if _applies(requirement, "")]
    extras = metadata.metadata(PACKAGE).get_all("Provides-Extra") or ()
    optional = [requirement for requirement in parsed if requirement not in always]
    return {"": always, **{extra: [one for one in optional if _applies(one, extra)] for extra in extras}}


def _applies(requirement: Requirement, extra: str) -> bool:
    """Return whether a requirement applies here with this extra."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra})


def gsplat_finding(torch: Probe, nvcc: bool) -> Finding:
    """Report whether gsplat's CUDA part can be used, which is optional. Its Python part is listed with the packages."""
    built = gsplat_built()
    if built is None:
        return Finding("gsplat CUDA part", "absent", "gsplat is not installed")
    if torch.error or not torch.facts["gpus"]:
        return Finding("gsplat CUDA part", "absent", "PyTorch sees no GPU to use it on")
    if built:
        return Finding("gsplat CUDA part", "ok", "built")
    if nvcc:
        builds = sorted(Path(torch.facts["extensions"]).glob("gsplat_cuda*/gsplat_cuda*.so"))
        state = f"built at its first use ({builds[0]})" if builds else "not built yet; gsplat compiles it at first use"
        return Finding("gsplat CUDA part", "ok", state if builds else f"{state}, which takes minutes")
    advice = "install the CUDA toolkit, or a gsplat wheel built for this PyTorch"
    detail = "not built, and there is no nvcc to compile it; --packed and --antialiased need it, and all without Triton"
    return Finding("gsplat CUDA part", "absent", detail, advice)


def triton_finding(torch: Probe) -> Finding:
    """Report whether Triton can start our kernels on a GPU."""
    if torch.error or not torch.facts["gpus"]:
        return Finding("Triton", "absent", "PyTorch sees no GPU to use it on")
    if missing := triton_missing():
        advice = "install PyTorch for CUDA, which brings Triton, a C compiler and Python's headers (python3-dev)"
        return Finding("Triton", "problem", missing, advice)
    return Finding("Triton", "ok", f"{installed_version('triton')}, with a C compiler for what starts kernels")


def extension_finding(module: str, purpose: str) -> Finding:
    """Report whether a compiled extension can be imported; an installed one is imported in another process."""
    try:
        installed = importlib.util.find_spec(module.partition(".")[0]) is not None
    except (ImportError, ValueError) as error:
        return Finding(module, "problem", typed_line(error), "install it again")
    if not installed:
        return Finding(module, "absent", f"not installed ({purpose})")
    probe = run_probe("import", "torch", module)  # extensions find PyTorch's libraries after it is loaded
    if probe.error:
        return Finding(module, "problem", probe.error, "build it again with this PyTorch and this Python")
    return Finding(module, "ok", purpose)


def _package_finding(requirement: Requirement) -> Finding:
    version = installed_version(requirement.name)
    install = f"python -m pip install '{requirement.name}{requirement.specifier}'"
    minimum = next((bound.version for bound in requirement.specifier if bound.operator == ">="), "")
    if version is None:
        return Finding(requirement.name, "problem", "not installed", install)
    if minimum and Version(version).release < Version(minimum).release:
        detail = f"{version} is older than {minimum}, which is needed"
        return Finding(requirement.name, "problem", detail, install)
    return Finding(requirement.name, "ok", version)


def _memory_gib() -> float | None:
    """Return the physical memory; None where the system has no such call (Windows)."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (AttributeError, ValueError, OSError):
        return None
