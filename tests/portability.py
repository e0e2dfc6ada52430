"""Run tests as on other processors: `make portability`, or `python -m tests.portability` with pytest's arguments.

PyTorch and Numba are told to compute as for another processor. Two ways to compute the same then differ as they do
there, and a comparison whose tolerance was found on one machine shows whether it holds.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from llvmlite.binding import get_host_cpu_features

ROOT = Path(__file__).parents[1]
SETTINGS = (
    *(("default", "x86-64-v2"), ("avx2", "x86-64-v3"), ("avx512", "host")),
    *(("default", "host"), ("avx512", "x86-64-v2")),  # one library wide, the other narrow
)
"""ATEN_CPU_CAPABILITY and Numba's processor: each value at least once."""
NEEDS = {
    "default": (),
    "avx2": ("avx2", "fma"),
    "avx512": ("avx512f", "avx512bw", "avx512dq", "avx512vl"),
    "x86-64-v2": ("sse4.2", "ssse3", "popcnt"),
    "x86-64-v3": ("avx2", "bmi2", "fma"),
    "host": (),
}
"""LLVM's names of what a processor must have."""


def main(arguments: list[str]) -> int:
    """Run pytest once for each setting and print a line for each; 1 if a run failed."""
    features = get_host_cpu_features()
    outcomes = []
    for pair in SETTINGS:
        title = "PyTorch for {}, Numba for {}".format(*pair)
        lacking = [feature for name in pair for feature in NEEDS[name] if not features.get(feature)]
        if lacking:
            outcomes.append(f"skipped: {title}: this processor lacks {', '.join(lacking)}")
            continue
        print(f"\n{title}", flush=True)
        command = [sys.executable, "-m", "pytest", "-m", "not slow and not browser", *arguments]
        code = subprocess.run(command, cwd=ROOT, env=environment(*pair), check=False).returncode
        outcomes.append(f"{'FAILED' if code else 'passed'}: {title}")
    print("", *outcomes, sep="\n")
    return int(any(outcome.startswith("FAILED") for outcome in outcomes))


def environment(aten: str, numba: str) -> dict[str, str]:
    """This process's environment with both libraries' processor, and a cache of kernels for it alone."""
    changed = {"ATEN_CPU_CAPABILITY": aten, "NUMBA_CACHE_DIR": str(ROOT / "runs" / "portability" / numba)}
    if numba != "host":
        changed |= {"NUMBA_CPU_NAME": numba, "NUMBA_CPU_FEATURES": ""}
    return {**os.environ, **changed}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
