"""Try many damaged files and list what goes wrong: python -m tests.fuzz.campaign --cases 2000.

Also tries one again that a test or a campaign kept: python -m tests.fuzz.campaign --replay FILE.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from random import Random

from tests.fuzz.harness import Case, Fuzzer, Problem, Reader
from tests.fuzz.kinds import BY_NAME, KINDS
from tests.fuzz.templates import make_templates


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=1_000, help="over all kinds")
    parser.add_argument("--seed", type=int, default=None, help="another campaign; drawn and printed unless given")
    parser.add_argument("--kind", action="append", help="only kinds whose names contain this")
    parser.add_argument("--replay", type=Path, help="a file that was kept")
    options = parser.parse_args()
    seed = time.time_ns() % 2**32 if options.seed is None else options.seed
    kinds = [kind for kind in KINDS if not options.kind or any(word in kind.name for word in options.kind)]
    with tempfile.TemporaryDirectory(prefix="lapgs-fuzz-") as scratch, Reader(Path(scratch, "work")) as reader:
        templates = make_templates(Path(scratch, "templates"), reader)
        fuzzer = Fuzzer(templates, Path(scratch, "work"), reader, slow=True)
        if options.replay:
            return _replay(fuzzer, options.replay)
        print(f"seed {seed}", flush=True)
        found = campaign(fuzzer, kinds, options.cases, seed)
        print(
            f"{fuzzer.cases} cases, {sum(found.values())} failed in {len(found)} ways; at most "
            f"{reader.highest / 1e9:.2f} GB and {reader.longest:.1f} s"
        )
    return 1 if found else 0


def campaign(fuzzer: Fuzzer, kinds: list, cases: int, seed: int) -> Counter[str]:  # type: ignore[type-arg]
    """Try cases of all kinds in turn; print each new kind of failure."""
    failures: Counter[str] = Counter()
    for number in range(cases):
        kind = kinds[number % len(kinds)]
        case = fuzzer.draw(kind, Random(f"{kind.name} {seed} {number}"))
        problem = fuzzer.problem(case)
        if problem is None:
            continue
        if problem.signature not in failures:
            print(f"{kind.name}: {problem.signature}\n    {fuzzer.keep(case)}", flush=True)
        failures[problem.signature] += 1
    return failures


def _replay(fuzzer: Fuzzer, path: Path) -> int:
    name, command, _ = path.name.split("--")
    kind = BY_NAME[name]
    case = Case(kind, path.read_bytes(), [*kind.commands, *kind.slow_commands][int(command)])
    problem: Problem | None = fuzzer.problem(case)
    print("good" if problem is None else f"{problem.what}\n{problem.detail}")
    return 0 if problem is None else 1


if __name__ == "__main__":
    sys.exit(main())
