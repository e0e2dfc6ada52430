"""Run imports that may crash in processes of their own, such as of an extension built for another PyTorch.

`python -m lapgs_plugin.environment.probes PROBE` prints the facts of a probe as JSON.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lapgs_plugin.environment import PACKAGE, is_installed, run_program
from lapgs_plugin.errors import typed_line


@dataclass(frozen=True)
class Probe:
    """Hold the result of a probe.

    Attributes:
        facts: by name; empty if the probe failed.
        error: one line; empty if it succeeded.
    """

    facts: dict[str, Any]
    error: str = ""


def run_probe(name: str, *arguments: str) -> Probe:
    """Run one of `PROBES` in a new process. Never raises."""
    command = [sys.executable, "-m", f"{PACKAGE}.environment.probes", name, *arguments]
    # This process's modules, not those of the current folder: a 3DGS checkout has a `utils` and a `scene`.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    with tempfile.TemporaryDirectory() as elsewhere:
        output, error = run_program(command, cwd=elsewhere, env=environment)
    if error:
        return Probe({}, error)
    try:
        facts = json.loads(output.strip().splitlines()[-1])
    except (IndexError, ValueError):
        return Probe({}, "the probe printed nothing readable")
    return Probe({}, facts["error"]) if "error" in facts else Probe(facts)


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
    # PyTorch warns why it cannot use a GPU, for example because the driver is too old.
    complaint = str(caught[0].message).splitlines()[0] if caught else ""
    return {
        "version": torch.__version__,
        "cuda": torch.version.cuda,
        "gpus": gpus,
        "complaint": complaint,
        "extensions": extensions_folder(),
    }


def extensions_folder() -> str:
    """Return where PyTorch keeps extensions that it compiled, as `cpp_extension.load` chooses it."""
    import torch
    from torch.utils.cpp_extension import get_default_build_root

    python = f"py{sys.version_info.major}{sys.version_info.minor}{getattr(sys, 'abiflags', '')}"
    platform = f"cu{torch.version.cuda.replace('.', '')}" if torch.version.cuda else "cpu"
    return os.environ.get("TORCH_EXTENSIONS_DIR") or str(Path(get_default_build_root(), f"{python}_{platform}"))


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


def _probe_import(*names: str) -> dict[str, Any]:
    """Import modules, and names of them that are written module:name."""
    for each in names:
        module, _, name = each.partition(":")
        if name and not hasattr(importlib.import_module(module), name) and not is_installed(f"{module}.{name}"):
            raise ImportError(f"{module} has no {name}")
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
    except BaseException as error:  # an import may raise anything, SystemExit included
        facts = {"error": typed_line(error)}
    print(json.dumps(facts))


if __name__ == "__main__":
    _main(*sys.argv[1:])
