"""Time whole training iterations on the CPU: our rasterizer, the oracle, and gsplat's PyTorch code.

An iteration is activations, rendering, L1 + SSIM, the backward pass and Adam, at SH degree 3. The contenders take
turns, so that a change in the machine's load affects all of them. Ratios are of medians of one run.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from lapgs_bench.kernels.random_scene import BenchScene, blended_per_pixel, make_scene
from lapgs_plugin.environment import installed_version, versions
from lapgs_plugin.errors import UserInputError
from lapgs_plugin.fields.rasterizer import Rasterizer
from lapgs_plugin.jit.threads import one_pool
from lapgs_plugin.limits import usable_processors
from lapgs_plugin.ops.adam import ADAM_EPS
from lapgs_plugin.ops.adam.on_cpu import FieldAdam
from lapgs_plugin.ops.photometric_loss.in_numba import photometric_loss_cpu
from lapgs_plugin.ops.photometric_loss.in_torch import photometric_loss_torch
from lapgs_plugin.reference_raster import CpuRasterizer, OracleRasterizer, pipeline

# The contenders: the fast rasterizer with our loss and Adam, and the others with PyTorch's.
FAST, ORACLE, GSPLAT = "cpu", "oracle", "gsplat"

MAX_LOSS_SHARE = 0.20
"""Largest time of the loss, as a share of the rest of an iteration."""
MAX_MEMORY = 1.5e9
"""Most bytes of memory for training the largest case."""

FAST_ITERATIONS = 3
"""Timed iterations of the fast contender in each turn; an untimed one before them fills the caches."""
LEARNING_RATE = 1e-6
"""Rate of the optimizer, so small that the scene keeps its statistics."""
GAUSSIANS_OF_ALL_TURNS = {ORACLE: 400_000, GSPLAT: 200_000}
"""Slow contenders take part in as many turns as add up to this many Gaussians, at least in one."""

# Limits of a case, so that a typing error does not fill a machine's memory.
MAX_SIDE, MAX_GAUSSIANS = 8192, 10_000_000


@dataclass(frozen=True)
class BenchCase:
    """Describe a scene to time.

    Attributes:
        width, height: of the image, in pixels.
        required: by contender, the least ratio of its time to the fast one's.
    """

    width: int
    height: int
    gaussians: int
    required: Mapping[str, float] = field(default_factory=dict)

    @property
    def size(self) -> str:
        return f"{self.width}x{self.height}"

    @property
    def name(self) -> str:
        """The form that `parse_cases` reads."""
        return f"{self.size}/{self.gaussians}"


CASES = (
    BenchCase(200, 150, 2_000, {ORACLE: 40, GSPLAT: 35}),
    BenchCase(400, 300, 10_000, {ORACLE: 28, GSPLAT: 50}),
    BenchCase(800, 533, 50_000, {ORACLE: 24, GSPLAT: 70}),
    BenchCase(1600, 1066, 200_000, {ORACLE: 24, GSPLAT: 85}),
)
"""Cases from a thumbnail to the size that papers call 1.6K."""


def parse_cases(text: str | None) -> tuple[BenchCase, ...]:
    """Parse cases such as "200x150,64x48/500": a size of `CASES`, or any size with a number of Gaussians; None for all.

    Raises:
        UserInputError: an entry has another form, or names no known size and no number of Gaussians.
    """
    if text is None:
        return CASES
    return tuple(_parse_case(entry.strip()) for entry in text.split(","))


def _parse_case(entry: str) -> BenchCase:
    match = re.fullmatch(r"([1-9][0-9]{0,9})x([1-9][0-9]{0,9})(?:/([1-9][0-9]{0,18}))?", entry)
    known = {(case.width, case.height): case for case in CASES}
    if match is not None:
        width, height = int(match[1]), int(match[2])
        if max(width, height) > MAX_SIDE or int(match[3] or 1) > MAX_GAUSSIANS:
            raise UserInputError(
                f"--sizes {entry!r}: expected at most {MAX_SIDE}x{MAX_SIDE} pixels and {MAX_GAUSSIANS} Gaussians"
            )
        case = known.get((width, height))
        if match[3] is not None and (case is None or case.gaussians != int(match[3])):
            return BenchCase(width, height, int(match[3]))
        if case is not None:
            return case
    sizes = ", ".join(f"{width}x{height}" for width, height in known)
    raise UserInputError(f"--sizes {entry!r}: expected one of {sizes}, or WIDTHxHEIGHT/GAUSSIANS such as 640x480/30000")


@dataclass(frozen=True)
class CaseResult:
    """Hold the measurements of one case; times are medians in milliseconds.

    Attributes:
        blended_per_pixel: Gaussians that a pixel blends, on average.
        milliseconds: of an iteration, by contender.
        iterations: number of timed ones, by contender.
        parts: the fast contender's time by part: prepare (activate, project, sort), blend, loss (with its gradient),
            blend_back, project_back, adam. Measured in separate iterations, so their sum is approximate.
        loss_share: time of the loss, as a share of the rest of the fast contender's iteration.
        gsplat_tile_loop: time of gsplat's Python loop over the tiles of each Gaussian; None where gsplat did not take
            part.
        peak_memory: bytes of a process that only trains with the fast contender; None where the system does not
            report it.
    """

    case: BenchCase
    blended_per_pixel: float
    milliseconds: dict[str, float]
    iterations: dict[str, int]
    parts: dict[str, float]
    loss_share: float
    gsplat_tile_loop: float | None
    peak_memory: int | None

    @property
    def ratios(self) -> dict[str, float]:
        """Each other contender's time divided by the fast one's."""
        return {name: ms / self.milliseconds[FAST] for name, ms in self.milliseconds.items() if name != FAST}

    @property
    def missed(self) -> list[str]:
        """One line for each requirement that is not met."""
        lines = [
            f"{self.case.name}: {name} takes {self.ratios[name]:.1f} times as long, expected at least {required:g}"
            for name, required in self.case.required.items()
            if name in self.ratios and self.ratios[name] < required
        ]
        if self.case.required and self.loss_share > MAX_LOSS_SHARE:
            lines.append(
                f"{self.case.name}: the loss adds {self.loss_share:.0%}, expected at most {MAX_LOSS_SHARE:.0%}"
            )
        if self.case.required and self.peak_memory is not None and self.peak_memory > MAX_MEMORY:
            lines.append(f"{self.case.name}: training takes {self.peak_memory / 1e9:.2f} GB, expected at most 1.5")
        return lines


def report(results: Sequence[CaseResult], dtype: torch.dtype) -> dict[str, Any]:
    """Return all measurements, and the machine, for a JSON file."""
    return {
        "machine": machine(),
        "dtype": str(dtype).removeprefix("torch."),
        "cases": [{**asdict(r), "ratios": r.ratios, "missed": r.missed} for r in results],
    }


def machine() -> dict[str, str | int]:
    """Describe the processor, the cores that this process may use, threads, and versions."""
    return {
        **versions(),
        "gsplat": installed_version("gsplat") or "",
        "cores": usable_processors(),
        "threads": torch.get_num_threads(),
    }


class Contender:
    """Train an implementation's own copy of the parameters."""

    def __init__(
        self,
        rasterizer: Rasterizer,
        loss: Callable[[Tensor, Tensor], Tensor],
        optimizer: Callable[[Tensor], torch.optim.Optimizer],
        scene: BenchScene,
        threads: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.rasterizer: Any = rasterizer  # gsplat's has attributes that `Rasterizer` lacks
        self._loss = loss
        self._scene = scene
        self._threads = threads
        leaves = {name: value.clone().requires_grad_() for name, value in scene.field.parameters.items()}
        self._field = scene.field.with_parameters(leaves)
        self._optimizers = [optimizer(leaf) for leaf in leaves.values()]
        self._background = torch.zeros(3, dtype=scene.target.dtype)

    def _render(self) -> Tensor:
        image: Tensor = self.rasterizer(self._field, self._scene.camera, background=self._background).image
        return image

    def loss(self) -> float:
        """Return the current loss; all contenders begin with the same one."""
        with torch.no_grad():
            return float(self._loss(self._render(), self._scene.target))

    def iteration(self) -> dict[str, float]:
        """Run one training iteration and return the milliseconds of its four parts."""
        with self._threads():
            moments = [time.perf_counter()]
            image = self._render()
            moments.append(time.perf_counter())
            loss = self._loss(image, self._scene.target)
            moments.append(time.perf_counter())
            loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it without types
            moments.append(time.perf_counter())
            for optimizer in self._optimizers:
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            moments.append(time.perf_counter())
        spans = (1e3 * (end - start) for start, end in pairwise(moments))
        return dict(zip(("forward", "loss", "backward", "adam"), spans, strict=True))


def _fast(scene: BenchScene) -> Contender:
    return Contender(
        CpuRasterizer(), photometric_loss_cpu, lambda p: FieldAdam([p], lr=LEARNING_RATE), scene, threads=one_pool
    )


def contender_names(dtype: torch.dtype) -> list[str]:
    """Return the contenders that can run here, the fast one first."""
    return [FAST, ORACLE, *([GSPLAT] if dtype == torch.float32 else [])]


def make_contenders(scene: BenchScene) -> dict[str, Contender]:
    """Make the contenders of `contender_names`."""

    def torch_adam(parameter: Tensor) -> torch.optim.Optimizer:
        return torch.optim.Adam([parameter], lr=LEARNING_RATE, eps=ADAM_EPS)

    contenders = {FAST: _fast(scene), ORACLE: Contender(OracleRasterizer(), photometric_loss_torch, torch_adam, scene)}
    if GSPLAT in contender_names(scene.target.dtype):
        from lapgs_bench.kernels.gsplat_on_cpu import GsplatTorchRasterizer

        contenders[GSPLAT] = Contender(GsplatTorchRasterizer(), photometric_loss_torch, torch_adam, scene)
    return contenders


def planned_turns(case: BenchCase, turns: int, contenders: Sequence[str]) -> list[str]:
    """Order the contenders' turns: the fast one in every turn, slow ones in fewer, evenly spread."""
    plan = []
    for turn in range(turns):
        for name in contenders:
            budget = GAUSSIANS_OF_ALL_TURNS.get(name)
            own = turns if budget is None else min(turns, max(1, budget // case.gaussians))
            if (turn + 1) * own // turns > turn * own // turns:
                plan.append(name)
    return plan


def run_case(
    case: BenchCase, turns: int, dtype: torch.dtype, advance: Callable[[str], None] = lambda name: None
) -> CaseResult:
    """Measure one case in turns of `FAST_ITERATIONS` timed iterations; slow contenders get fewer turns in large cases.

    `advance` is called after each turn with the contender's name.
    """
    scene = make_scene(case.width, case.height, case.gaussians, dtype)
    contenders = make_contenders(scene)
    timed: dict[str, list[dict[str, float]]] = {name: [] for name in contenders}
    tile_loops = []
    contenders[FAST].iteration()
    for name in planned_turns(case, turns, list(contenders)):
        contender = contenders[name]
        if name == FAST:
            contender.iteration()
        timed[name] += [contender.iteration() for _ in range(FAST_ITERATIONS if name == FAST else 1)]
        if name == GSPLAT:
            tile_loops.append(contender.rasterizer.tile_loop_seconds)
        advance(name)
    totals = {name: median(sum(parts.values()) for parts in runs) for name, runs in timed.items()}
    loss = median(parts["loss"] for parts in timed[FAST])
    return CaseResult(
        case=case,
        blended_per_pixel=blended_per_pixel(scene),
        milliseconds=totals,
        iterations={name: len(runs) for name, runs in timed.items()},
        parts=_parts(contenders[FAST], turns),
        loss_share=loss / (totals[FAST] - loss),
        gsplat_tile_loop=1e3 * median(tile_loops) if tile_loops else None,
        peak_memory=peak_memory(case, dtype),
    )


def _parts(fast: Contender, repeats: int) -> dict[str, float]:
    """Measure the parts of the fast contender's iteration, in milliseconds."""
    runs = []
    for _ in range(repeats):
        with _kernel_times() as kernels:
            parts = fast.iteration()
        blend, back = kernels["blend"], kernels["blend_backward"]
        others = parts["forward"] - blend, parts["backward"] - back
        runs.append((others[0], blend, parts["loss"], back, others[1], parts["adam"]))
    names = "prepare", "blend", "loss", "blend_back", "project_back", "adam"
    return dict(zip(names, map(median, zip(*runs, strict=True)), strict=True))


@contextmanager
def _kernel_times() -> Iterator[dict[str, float]]:
    """Record the milliseconds of each parallel kernel of the fast rasterizer that runs inside, by name."""
    times: dict[str, float] = {}
    run = vars(pipeline)["parallel"]

    def timed(kernel: Callable[..., None], *arguments: Any) -> None:
        start = time.perf_counter()
        run(kernel, *arguments)
        times[kernel.__name__] = 1e3 * (time.perf_counter() - start)

    with patch.object(pipeline, "parallel", timed):
        yield times


def peak_memory(case: BenchCase, dtype: torch.dtype) -> int | None:
    """Return the peak memory, in bytes, of a new process that trains a few iterations; None where the system does not
    report it."""
    command = [sys.executable, "-m", __spec__.name, case.name, str(dtype).removeprefix("torch.")]
    finished = subprocess.run(command, capture_output=True, text=True, check=True)
    answer = finished.stdout.strip()
    return int(answer) if answer else None


def _main(name: str, dtype: str) -> None:
    """Train a few iterations, and print the peak memory of this process in bytes, if the system reports it."""
    (case,) = parse_cases(name)
    contender = _fast(make_scene(case.width, case.height, case.gaussians, getattr(torch, dtype)))
    for _ in range(3):
        contender.iteration()
    status = Path("/proc/self/status")  # getrusage counts the parent's memory, too
    match = re.search(r"VmHWM:\s*(\d+) kB", status.read_text()) if status.exists() else None
    print("" if match is None else int(match[1]) * 1024)


if __name__ == "__main__":
    _main(*sys.argv[1:])
